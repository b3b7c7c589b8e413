"""SPZ against values worked by hand from its documentation, and its rounding."""

import gzip
import struct

import numpy as np
import pytest

from tests.training.splats.test_formats import random_splats
from training.errors import LodgsError
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.sh import basis
from training.splats.spz import pack_spz, read_spz, unpack_spz, write_spz

HEADER = "<IIIBBBB"
MAGIC = 0x5053474E
QUARTER = np.sqrt(0.5)


def spz(count: int, degree: int, body: bytes, version: int = 3, flags: int = 0) -> bytes:
    """Versions 1 to 3: magic, version, number of splats, SH degree, fractional bits, flags, reserved."""
    return gzip.compress(struct.pack(HEADER, MAGIC, version, count, degree, 12, flags, 0) + body, 1)


def spz4(
    count: int, degree: int, version: int = 4, cut: int = 0, sizes=None, extensions: bytes = b""
) -> bytes:
    """Version 4: header of 32 bytes, extensions, packed and unpacked size of each stream, streams."""
    zstandard = pytest.importorskip("zstandard")
    sizes = sizes or [count * width for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if width]
    values = np.random.default_rng(0).integers(0, 256, max(sum(sizes), 1), np.uint8).tobytes()
    streams = [zstandard.compress(values[:size]) for size in sizes]
    offset = 32 + len(extensions)
    head = struct.pack(
        "<IIIBBBBI12x", MAGIC, version, count, degree, 12, 2 if extensions else 0, len(sizes), offset
    )
    table = b"".join(struct.pack("<QQ", *pair) for pair in zip(map(len, streams), sizes, strict=True))
    return (head + extensions + table + b"".join(streams))[: -cut or None]


def content(version: int, rotation: bytes, degree: int = 0, rest: bytes = b"") -> bytes:
    """One splat at (1, -2, 0.25) with 12 fractional bits, scales exp(-2) and opacity 51 / 255."""
    head = struct.pack(HEADER, 0x5053474E, version, 1, degree, 12, 0, 0)
    position = b"".join(struct.pack("<i", value)[:3] for value in (4096, -8192, 1024))
    return gzip.compress(head + position + bytes([51, 255, 0, 128]) + bytes([128] * 3) + rotation + rest)


@pytest.mark.parametrize(
    ("version", "rotation", "expected"),
    [
        (2, bytes([128, 128, 255]), (0, 1 / 255, 1 / 255, 1)),
        (3, struct.pack("<I", 3 << 30), (1, 0, 0, 0)),
        (3, struct.pack("<I", 3 << 30 | 512 | 511), (QUARTER, 0, 0, -QUARTER)),
        (3, struct.pack("<I", 0 << 30 | 511), (QUARTER, QUARTER, 0, 0)),
    ],
)
def test_values_of_one_splat(version, rotation, expected):
    splats, _ = unpack_spz(content(version, rotation, 1, bytes(range(120, 129))), 1)
    np.testing.assert_array_equal(splats.means, [[1, -2, 0.25]])
    np.testing.assert_allclose(splats.log_scales, -2, rtol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, np.log(0.25), rtol=1e-5)
    np.testing.assert_allclose(splats.sh[0, 0], np.array([0.5, -0.5, 128 / 255 - 0.5]) / 0.15, rtol=1e-5)
    np.testing.assert_allclose(splats.sh[0, 1:].ravel() * 128, np.arange(-8, 1), atol=1e-5)
    np.testing.assert_allclose(splats.quats[0], expected, atol=6e-3)


@pytest.mark.parametrize("degree", range(4))
def test_errors_are_at_most_half_a_step(degree):
    splats = random_splats(500, degree)
    splats.quats /= np.linalg.norm(splats.quats, axis=1, keepdims=True)
    reread, _ = unpack_spz(pack_spz(splats), 500)
    assert np.abs(reread.means - splats.means).max() <= np.abs(splats.means).max() * 2.0**-22
    in_range = splats.log_scales.clip(-10, 5.9)
    assert np.abs(reread.log_scales - in_range).max() <= 0.5 / 16 + 1e-6
    alphas, expected = (
        1 / (1 + np.exp(-logits)) for logits in (reread.opacity_logits, splats.opacity_logits)
    )
    assert np.abs(alphas - expected).max() <= 0.5 / 255 + 1e-6
    cosines = np.abs((reread.quats * splats.quats).sum(1) / np.linalg.norm(reread.quats, axis=1))
    angles = np.degrees(2 * np.arccos(cosines.clip(0, 1)))
    assert np.median(angles) < 1 and angles.max() < 12  # w is derived, inexactly if it is small
    color = splats.sh[:, 0].clip(-0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(reread.sh[:, 0] - color).max() <= 0.5 / 255 / 0.15 + 1e-6
    steps = np.where(np.arange(1, splats.sh.shape[1]) <= 3, 8, 16)[:, None] / 128
    assert (
        np.abs(reread.sh[:, 1:] - splats.sh[:, 1:].clip(-1, 127 / 128)) <= steps / 2 + 1 / 256 + 1e-6
    ).all()


GOOD = content(2, bytes(3))


DAMAGED = {
    "empty": b"",
    "not compressed": b"NGSP",
    "without end": GOOD[:-12],
    "cut": GOOD[:20],
    "version 4": content(4, bytes(3)),
    "version 1": content(1, bytes(3)),
    "version 5": content(5, bytes(4)),
    "without rotations": content(2, b""),
    "degree 9": content(2, bytes(3), 9),
    "2^32 splats": gzip.compress(struct.pack(HEADER, 0x5053474E, 2, 2**32 - 1, 3, 12, 0, 0)),
}


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED)
def test_damaged_data_are_rejected(data):
    with pytest.raises(ValueError):
        unpack_spz(data, 1000)


def colors(splats: Splats, directions: np.ndarray) -> np.ndarray:
    """Return the colours (N, 3) of splats seen along directions (N, 3)."""
    values = [np.zeros(len(splats)) for _ in range(splats.sh.shape[1])]
    basis(*directions.T, splats.sh_degree, values)
    return np.einsum("kn,nkc->nc", np.array(values), splats.sh)


def covariances(splats: Splats) -> np.ndarray:
    w, x, y, z = (splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)).T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    return np.einsum("nij,nj,nkj->nik", rotation, np.exp(2 * splats.log_scales), rotation)


def assert_same_scene(actual: Splats, expected: Splats, matrix: np.ndarray) -> None:
    """Compare splats with others whose axes a matrix turns."""
    np.testing.assert_allclose(actual.means, expected.means @ matrix.T, atol=1e-4)
    np.testing.assert_allclose(
        covariances(actual), matrix @ covariances(expected) @ matrix.T, rtol=0.02, atol=1e-3
    )
    directions = np.random.default_rng(1).normal(size=(len(expected), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(colors(actual, directions @ matrix.T), colors(expected, directions), atol=1e-3)


@pytest.mark.parametrize("degree", range(4))
def test_axes_of_files_are_right_up_back(tmp_path, degree):
    """README of nianticlabs/spz: RUB, while PLY has RDF. Values inside glTF keep their axes."""
    splats = random_splats(400, degree)
    splats.sh[:, 1:] = np.rint(splats.sh[:, 1:] * 8).clip(-7, 7) / 8
    write_spz(tmp_path / "a.spz", splats, {})
    stored, _ = unpack_spz((tmp_path / "a.spz").read_bytes(), 400)
    stored.log_scales, stored.sh[:, 0] = splats.log_scales, splats.sh[:, 0]  # their rounding is tested above
    assert_same_scene(stored, splats, np.diag([1.0, -1, -1]))
    reread, meta = read_spz(tmp_path / "a.spz")
    reread.log_scales, reread.sh[:, 0] = splats.log_scales, splats.sh[:, 0]
    assert_same_scene(reread, splats, np.eye(3))
    assert meta == {}


@pytest.mark.parametrize(
    ("number", "letters"),
    [(0, "RUB"), (4, "RUB"), (6, "RDF"), (8, "RUF"), (1, "LDB"), (16, "RBU"), (9, "LFD")],
)
def test_axes_of_an_extension(tmp_path, number, letters):
    """SPZ_ADOBE_coordinate_system: directions of the axes by number; another extension precedes it."""
    extensions = struct.pack("<II4x", 0xADBE0002, 4) + struct.pack("<III", 0xADBE0003, 4, number)
    (tmp_path / "a.spz").write_bytes(spz4(50, 3, extensions=extensions))
    (tmp_path / "b.spz").write_bytes(spz4(50, 3))
    actual, usual = read_spz(tmp_path / "a.spz")[0], read_spz(tmp_path / "b.spz")[0]
    right, down, forward = np.eye(3)
    directions = {"R": right, "L": -right, "D": down, "U": -down, "F": forward, "B": -forward}
    matrix = np.column_stack([directions[letter] for letter in letters]) @ np.diag([1.0, -1, -1])
    for splats in (actual, usual):
        splats.log_scales = splats.log_scales / 4 - 2  # the largest ones are out of all proportion
    assert_same_scene(actual, usual, matrix)


def test_rotations_of_version_3_are_finer(tmp_path):
    splats = random_splats(2000)
    write_spz(tmp_path / "a.spz", splats, {})
    reread, _ = read_spz(tmp_path / "a.spz")
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    angles = np.degrees(2 * np.arccos(np.abs((unit * reread.quats).sum(axis=1)).clip(0, 1)))
    assert angles.max() < 0.25 and np.abs(np.linalg.norm(reread.quats, axis=1) - 1).max() < 1e-3


def test_positions_of_version_1_are_halves(tmp_path):
    body = np.array([1, -2, 0.25], "<f2").tobytes() + bytes([51, 255, 0, 128, *[128] * 3, 128, 128, 128])
    (tmp_path / "a.spz").write_bytes(spz(1, 0, body, version=1))
    np.testing.assert_array_equal(read_spz(tmp_path / "a.spz")[0].means, [[1, 2, -0.25]])


@pytest.mark.parametrize("degree", range(5))
def test_version_4_has_the_values_of_version_3(tmp_path, degree):
    packed = spz4(30, degree)
    values = (
        np.random.default_rng(0)
        .integers(0, 256, 30 * max(9, 3 * ((degree + 1) ** 2 - 1)), np.uint8)
        .tobytes()
    )
    widths = (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1))
    (tmp_path / "a.spz").write_bytes(packed)
    (tmp_path / "b.spz").write_bytes(spz(30, degree, b"".join(values[: 30 * width] for width in widths)))
    actual, expected = read_spz(tmp_path / "a.spz")[0], read_spz(tmp_path / "b.spz")[0]
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name))


def test_filter_is_declared(tmp_path):
    write_spz(tmp_path / "a.spz", random_splats(3), {"antialias": True})
    assert read_spz(tmp_path / "a.spz")[1] == {"antialias": True}


@pytest.mark.parametrize(("degree", "shift", "message"), [(4, 0, "degree 4"), (0, 1e7, "exceed the limit")])
def test_splats_that_do_not_fit_are_refused(tmp_path, degree, shift, message):
    splats = random_splats(3, degree)
    splats.means += np.float32(shift)
    with pytest.raises(LodgsError, match=message):
        write_spz(tmp_path / "a.spz", splats, {})
    assert not list(tmp_path.iterdir())


def test_many_batches_and_none(tmp_path):
    for count in (70_000, 0):
        splats = random_splats(count, 1)
        write_spz(tmp_path / "a.spz", splats, {})
        reread, _ = read_spz(tmp_path / "a.spz")
        np.testing.assert_allclose(reread.means, splats.means, atol=1e-6)


BAD = {
    "bomb": lambda: spz(10, 0, bytes(10_000_000)),
    "short": lambda: spz(1000, 0, bytes(100_000))[:-20],
    "many": lambda: spz(2**32 - 1, 3, bytes(10_000)),
    "few": lambda: spz(1000, 0, bytes(10_000)),
    "magic": lambda: gzip.compress(b"no splats" * 10),
    "degree": lambda: spz(1, 9, b""),
    "text": lambda: b"no splats" * 10,
    "empty": lambda: b"",
    "v4 many": lambda: spz4(2**32 - 1, 3, sizes=[10]),
    "v4 cut": lambda: spz4(300, 0, cut=1),
    "v4 streams": lambda: spz4(300, 0, sizes=[300, 300]),
    "v4 table": lambda: spz4(300, 0)[:50],
    "v4 head": lambda: spz4(300, 0)[:20],
    "v3 unpacked": lambda: spz4(300, 0, version=3),
    "v5": lambda: spz4(300, 0, version=5),
    "axes": lambda: spz4(3, 0, extensions=struct.pack("<III", 0xADBE0003, 4, 17)),
    "axes cut": lambda: spz4(3, 0, extensions=struct.pack("<II", 0xADBE0003, 4)),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_refused(tmp_path, name):
    (tmp_path / "a.spz").write_bytes(BAD[name]())
    with pytest.raises(LodgsError, match="Cannot read"), open_as_ply(tmp_path / "a.spz"):
        pass


@pytest.mark.filterwarnings("error")
def test_extreme_sizes_become_the_smallest_without_a_warning(tmp_path):
    splats = random_splats(3)
    splats.log_scales[:2] = [[-1e38], [-np.inf]]
    write_spz(tmp_path / "a.spz", splats, {})
    np.testing.assert_array_equal(read_spz(tmp_path / "a.spz")[0].log_scales[:2], np.float32(-10))
