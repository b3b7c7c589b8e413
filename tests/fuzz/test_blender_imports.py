"""Blender's import operators: a file is imported, or an error is reported and nothing is left of it."""

from __future__ import annotations

import importlib
import importlib.util
import json
import shutil
import struct
import zlib
from contextlib import redirect_stdout, suppress
from io import StringIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import Defect, attempt
from tests.fuzz.mutations import corrupted, corrupted_comments, corrupted_value
from tests.fuzz.test_splats import bundles
from tools.blender_module import EXTENSION, start_blender
from training.errors import LodgsError
from training.splats.bundle import write_bundle
from training.splats.formats.splat import write_splat
from training.splats.gltf import write_glb
from training.splats.level_folder import write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply
from training.splats.portable_levels import PortableLevels
from training.splats.sog import write_sog
from training.splats.spz import write_spz

pytestmark = [
    pytest.mark.blender,
    pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed"),
]

POSE = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
TRANSFORMS = {
    "w": 96, "h": 72, "fl_x": 80.0, "fl_y": 82.0, "cx": 47.0, "cy": 37.0, "k1": 0.1,
    "ply_file_path": "points.ply",
    "frames": [{"file_path": f"images/{name}", "transform_matrix": POSE} for name in ("a.png", "b.png")],
}  # fmt: skip
SPLAT_CAMERAS = [
    {"id": number, "img_name": name, "width": 96, "height": 72, "position": [0, 0, number], "fx": 80,
     "fy": 82, "rotation": np.eye(3).tolist()}
    for number, name in enumerate(("a", "b"))
]  # fmt: skip
POINTS = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
POINTS += "end_header\n0 0 5\n0 1 5\n"
MODEL = {
    "cameras.txt": "1 PINHOLE 96 72 80 82 47 37\n",
    "images.txt": "1 1 0 0 0 0 0 0 1 a.png\n1 2 1\n2 1 0 0 0 1 0 0 1 b.png\n\n",
    "points3D.txt": "1 0 0 5 1 2 3 0.5 1 0\n2 0 1 5 1 2 3 0.5\n",
}


def png(width: int, height: int) -> bytes:
    """Return a black photo; Blender's Python has no Pillow."""
    rows = zlib.compress(bytes(height * (1 + 3 * width)))
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0), b"IDAT" + rows, b"IEND")
    packed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


PHOTO = png(96, 72)


@pytest.fixture(scope="module")
def bpy():
    return start_blender()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("imports")


@pytest.fixture(scope="module")
def files(folder) -> dict[str, bytes]:
    """Return a valid file of each format by name."""
    splats = bundles()[0].levels[0].splats
    splats.extras.clear()
    write_ply(folder / "a.ply", splats)
    write_splat(folder / "a.splat", splats, {})
    write_spz(folder / "a.spz", splats, {})
    levels = [Level(level.number, level.splats) for level in bundles()[0].levels]
    write_glb(folder / "a.glb", PortableLevels(Bundle("flod", levels)))
    with suppress(LodgsError):  # its packages are missing
        write_sog(folder / "a.sog", splats, {})
    for bundle in bundles():
        write_bundle(folder / f"{bundle.method}.ply", bundle)
    paths = (path for path in folder.iterdir() if path.is_file())
    return {path.name: path.read_bytes() for path in sorted(paths)}


def contents(bpy) -> dict[str, list[str]]:
    """Return the names of the file's data of each kind."""
    data = bpy.data
    kinds = [name for name in dir(data) if isinstance(getattr(data, name), bpy.types.bpy_prop_collection)]
    return {name: sorted(item.name for item in getattr(data, name)) for name in kinds}


def run(bpy, operator, **arguments) -> None:
    """Run an operator in an empty file and use the scene; nothing may remain of one that is refused."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    before = contents(bpy)
    with redirect_stdout(StringIO()):  # Blender prints reports
        try:
            result = operator(**arguments)
        except RuntimeError as error:
            if contents(bpy) != before:
                raise Defect(f"half a scene is left after: {error}") from error
            raise LodgsError(str(error).strip()) from error
    if result != {"FINISHED"}:
        raise Defect(f"{result} without a report")
    bpy.context.view_layer.update()
    roots = importlib.import_module(f"{EXTENSION}.blender_lodgs.data.roots").roots(bpy.context.scene)
    assert roots
    for obj in bpy.data.objects:
        assert np.isfinite(np.array(obj.matrix_world)).all(), obj.name


def test_seeds_are_valid(bpy, folder, files):
    for name, content in files.items():
        (folder / name).write_bytes(content)
        run(bpy, bpy.ops.lodgs.import_splats, filepath=str(folder / name))
    for kind in ("transforms.json", "cameras.json", "model"):
        run(bpy, bpy.ops.lodgs.import_colmap, directory=str(write_export(folder, kind)))


@pytest.mark.cases(short=60, weight=0.5)
@given(data=st.data())
def test_corrupt_splat_files(bpy, folder, files, data):
    name = data.draw(st.sampled_from(sorted(files)))
    content = data.draw(corrupted([files[name]]))
    path = folder / name
    path.write_bytes(content)
    budget = data.draw(st.sampled_from([0, 10]))
    attempt(
        f"Blender {path.suffix}",
        lambda: run(bpy, bpy.ops.lodgs.import_splats, filepath=str(path), budget=budget),
        (name, content),
    )


@pytest.mark.cases(short=20, weight=0.2)
@given(data=st.data())
def test_corrupt_bundle_headers(bpy, folder, files, data):
    content = files[data.draw(st.sampled_from(["flod.ply", "octree.ply", "clod.ply"]))]
    content = data.draw(corrupted_comments(content))
    (folder / "header.ply").write_bytes(content)
    attempt(
        "Blender bundle header",
        lambda: run(bpy, bpy.ops.lodgs.import_splats, filepath=str(folder / "header.ply")),
        content,
    )


@pytest.mark.cases(short=20, weight=0.1)
@given(data=st.data())
def test_corrupt_level_folders(bpy, folder, data):
    levels = folder / "levels"
    shutil.rmtree(levels, ignore_errors=True)
    write_folder(levels, bundles()[0])
    manifest = levels / "manifest.json"
    values = data.draw(corrupted_value(json.loads(manifest.read_text())))
    manifest.write_text(json.dumps(values))
    attempt(
        "Blender level folder",
        lambda: run(bpy, bpy.ops.lodgs.import_splats, filepath=str(levels)),
        values,
    )


def write_export(folder, kind: str, content: bytes | None = None, name: str = ""):
    """Write a scene of a kind with photos and points; one of its files may have another content."""
    export = folder / "export"
    shutil.rmtree(export, ignore_errors=True)
    files = {"images/a.png": PHOTO, "images/b.png": PHOTO, "points.ply": POINTS.encode()}
    if kind == "model":
        files |= {f"sparse/0/{file}": text.encode() for file, text in MODEL.items()}
    else:
        values = TRANSFORMS if kind == "transforms.json" else SPLAT_CAMERAS
        files[kind] = json.dumps(values).encode()
    if content is not None:
        files[name or kind] = content
    for file, data in files.items():
        (export / file).parent.mkdir(parents=True, exist_ok=True)
        (export / file).write_bytes(data)
    return export


@pytest.mark.cases(short=40, weight=0.3)
@given(data=st.data(), kind=st.sampled_from(["transforms.json", "cameras.json"]))
def test_corrupt_exports(bpy, folder, data, kind):
    values = TRANSFORMS if kind == "transforms.json" else SPLAT_CAMERAS
    if data.draw(st.booleans()):
        content = json.dumps(data.draw(corrupted_value(values))).encode("utf-8", "surrogatepass")
    else:
        content = data.draw(corrupted([json.dumps(values).encode()]))
    export = write_export(folder, kind, content)
    attempt(
        f"Blender {kind}",
        lambda: run(bpy, bpy.ops.lodgs.import_colmap, directory=str(export)),
        content,
    )


@pytest.mark.cases(short=40, weight=0.3)
@given(data=st.data(), name=st.sampled_from(sorted(MODEL)))
def test_corrupt_models(bpy, folder, data, name):
    content = data.draw(corrupted([MODEL[name].encode()]))
    export = write_export(folder, "model", content, f"sparse/0/{name}")
    attempt(
        "Blender COLMAP",
        lambda: run(bpy, bpy.ops.lodgs.import_colmap, directory=str(export)),
        (name, content),
    )
