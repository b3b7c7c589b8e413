"""Readers use little memory for files of any size: sparse files, endless lines and too large promises."""

import struct
import tracemalloc

import numpy as np
import pytest

from training.documents import read_json
from training.errors import LodgsError
from training.scenes.colmap_model import read_cameras, read_observations, read_points, read_poses
from training.scenes.depths import read_depth_map
from training.scenes.formats import bundler, metashape
from training.scenes.image_headers import image_size
from training.scenes.point_cloud import read_points as read_point_cloud
from training.splats.formats.splat import SplatFile
from training.splats.ply import read_elements

SIZE = 1 << 33
"""Bytes of a sparse file, more than any of these readers may use."""
PLY = (
    "ply\nformat {} 1.0\nelement vertex {}\n"
    + "".join(f"property float {c}\n" for c in "xyz")
    + "end_header\n"
)


@pytest.fixture
def within():
    """``within(megabytes, function)`` checks the peak of allocated memory, also if the function fails."""

    def run(megabytes, function):
        tracemalloc.start()
        try:
            return function()
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < megabytes * 1e6, f"{peak / 1e6:.0f} MB"

    return run


def sparse(path, head: bytes = b"", size: int = SIZE):
    path.parent.mkdir(exist_ok=True)
    with open(path, "wb") as file:
        file.write(head)
        file.truncate(size)
    return path


def test_rows_of_a_large_splat_file(tmp_path, within):
    path = sparse(tmp_path / "a.splat", np.array([1, 2, 3], np.float32).tobytes())
    splats = within(10, lambda: SplatFile(path))
    assert len(splats) == SIZE // 32
    assert within(10, lambda: splats.select(slice(0, 1000))).means[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("name", "head", "read"),
    [
        ("points3D.bin", struct.pack("<Q", 10), read_points),
        ("points3D.bin", struct.pack("<Q", 2**60), read_points),
        ("images.bin", struct.pack("<Q", 2**60), read_poses),
        ("images.bin", struct.pack("<Q", 2**60), lambda model: read_observations(model, ["a"])),
        ("images.bin", struct.pack("<Qi7di", 1, 0, 1, 0, 0, 0, 0, 0, 0, 1) + b"x" * (1 << 17), read_poses),
        ("cameras.bin", struct.pack("<Q", 2**60), read_cameras),
        ("points3D.txt", b"", read_points),
        ("images.txt", b"1 1 0 0 0 0 0 0 1 a.jpg\n", read_poses),
        ("cameras.txt", b"", read_cameras),
    ],
)
def test_large_colmap_files(tmp_path, within, name, head, read):
    for other in ("cameras", "images"):
        (tmp_path / f"{other}{name[-4:]}").touch()
    sparse(tmp_path / name, head)
    with pytest.raises(LodgsError, match=name):
        within(150, lambda: read(tmp_path))


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", ["1000000000", str(2**70)])
def test_large_point_clouds(tmp_path, within, kind, count):
    path = sparse(tmp_path / "a.ply", PLY.format(kind, count).encode(), SIZE // 2)
    with pytest.raises(LodgsError, match="Cannot read"):
        within(10, lambda: read_point_cloud(path))


def test_elements_of_a_large_ply_are_mapped(tmp_path, within):
    path = sparse(tmp_path / "a.ply", PLY.format("binary_little_endian", 600_000_000).encode())
    assert len(within(10, lambda: read_elements(path, splats=False))[0]["vertex"]) == 600_000_000


PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 4, 4)
JPEG = b"\xff\xd8\xff\xc0" + struct.pack(">HBHH", 7, 8, 4, 4) + b"\xff\xda\0\2"
EXR = struct.pack("<II", 20000630, 2) + b"displayWindow\0box2i\0" + struct.pack("<I", SIZE // 2 - 1)


@pytest.mark.parametrize("head", [PNG, JPEG, EXR])
def test_large_images(tmp_path, within, head):
    path = sparse(tmp_path / "a", head, SIZE if head == EXR else 200_000_000)
    with pytest.raises(LodgsError, match="Cannot read"):
        within(10, lambda: image_size(path))


def test_large_header_of_a_depth_map(tmp_path, within):
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\2\0" + struct.pack("<I", 2**31))
    with pytest.raises(LodgsError, match="header is too long"):
        within(10, lambda: read_depth_map(path))


def test_large_documents(tmp_path, within):
    (tmp_path / "list.txt").write_text("a.jpg\n")
    bundle = sparse(tmp_path / "bundle.out", b"# Bundle file v0.3\n1 100000000000\n")
    for read in (
        lambda: read_json(bundle),
        lambda: bundler.read(bundle, tmp_path),
        lambda: metashape.read(bundle, tmp_path),
    ):
        with pytest.raises(LodgsError, match=r"bundle\.out"):
            within(150, read)


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("a.jpg", "a.jpg"), ("a b.jpg 0 532.1", "a b.jpg"), ("a.jpg 532", "a.jpg"), ("a.jpg 0", "a.jpg"),
        ("a 2 0 5e2", "a 2"), ("a.jpg x", "a.jpg x"), ("a" + " " * 10**6 + "b", "a" + " " * 10**6 + "b"),
    ],
)  # fmt: skip
def test_names_in_the_list_of_bundler(line, name):
    assert bundler._photo_name(line) == name
