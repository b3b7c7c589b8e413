"""Levels of detail as binary glTF: KHR_gaussian_splatting, with one node per level (MSFT_lod).

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..files import atomic_write
from .gaussians import SH_C0, Splats
from .portable_levels import PortableLevels, portable_batches
from .spz import pack_spz

MAX_DEGREE = 3
SPLATS, LOD, COVERAGE = "KHR_gaussian_splatting", "MSFT_lod", "MSFT_screencoverage"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
DESCRIPTION = "lodgs"
"""Key of the scene's extras with the levels' rule and meta, as JSON."""
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_MAX_BYTES = 2**32 - 1
_RESERVE = 256
"""Bytes of JSON for the bounds of a level, which are known after its splats are written."""
_VIEW_ANGLE = math.radians(60)
"""Vertical field of view for which distances are converted to covered shares of the screen."""
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of OpenCV's cameras to those of glTF's."""
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From z up to y up."""
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_COLUMNS = {
    "POSITION": ("VEC3", 5126),
    "COLOR_0": ("VEC4", 5121),
    f"{SPLATS}:ROTATION": ("VEC4", 5126),
    f"{SPLATS}:SCALE": ("VEC3", 5126),
    f"{SPLATS}:OPACITY": ("SCALAR", 5126),
}


def write_glb(path: Path, levels: PortableLevels) -> None:
    """Write a ``.glb`` file in batches of rows.

    Raises:
        LodgsError: the file cannot be written or exceeds 4 GiB.
    """
    document, size = _document(levels)
    text = _padded(document, 0)
    reserved = len(text) + _RESERVE * len(document["meshes"])
    begin = HEADER.size + 2 * CHUNK.size + reserved
    if begin + size > _MAX_BYTES:
        raise LodgsError(
            f"Cannot write {path}: {(begin + size) / 1e9:.1f} GB exceed the 4 GiB of a .glb file.",
            "Export fewer levels or a lower SH degree, or write USD.",
        )
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        for level, mesh in zip(levels.fine_to_coarse, document["meshes"], strict=True):
            attributes = mesh["primitives"][0]["attributes"]
            low, high = np.full(3, np.inf), np.full(3, -np.inf)
            for row, splats in portable_batches(level.rows):
                low, high = np.minimum(low, splats.means.min(0)), np.maximum(high, splats.means.max(0))
                for name, column in _values(splats).items():
                    offset = document["bufferViews"][attributes[name]]["byteOffset"]
                    file.seek(begin + offset + row * _item_size(name))
                    file.write(np.ascontiguousarray(column).data)
            document["accessors"][attributes["POSITION"]] |= {"min": low.tolist(), "max": high.tolist()}
        file.truncate(begin + size)
        file.seek(0)
        file.write(HEADER.pack(b"glTF", 2, begin + size))
        file.write(CHUNK.pack(reserved, b"JSON") + _padded(document, reserved))
        file.write(CHUNK.pack(size, b"BIN\0"))


def write_compressed_glb(path: Path, levels: PortableLevels) -> None:
    """Write a ``.glb`` file of one level with its splats as SPZ, the only form that CesiumJS reads.

    Raises:
        LodgsError: the file cannot be written.
    """
    (level,) = levels.bundle.levels
    splats = level.splats
    data = pack_spz(splats, levels.bundle.antialias)
    document, _ = _document(levels)
    for accessor in document["accessors"]:
        del accessor["bufferView"]
    position = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    position |= {"min": splats.means.min(0).tolist(), "max": splats.means.max(0).tolist()}
    splatting = document["meshes"][0]["primitives"][0]["extensions"][SPLATS]
    splatting["extensions"] = {COMPRESSION: {"bufferView": 0}}
    document["extensionsUsed"].append(COMPRESSION)
    document["extensionsRequired"] = [SPLATS, COMPRESSION]
    document["bufferViews"] = [{"buffer": 0, "byteOffset": 0, "byteLength": len(data)}]
    data = data.ljust(len(data) + -len(data) % 4, b"\0")
    document["buffers"] = [{"byteLength": len(data)}]
    text = _padded(document, 0)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(HEADER.pack(b"glTF", 2, HEADER.size + 2 * CHUNK.size + len(text) + len(data)))
        file.write(CHUNK.pack(len(text), b"JSON") + text + CHUNK.pack(len(data), b"BIN\0") + data)


def _padded(document: dict, size: int) -> bytes:
    """Return JSON of at least a size that is a multiple of 4."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    return text.ljust(max(size, len(text) + -len(text) % 4))


def _document(levels: PortableLevels) -> tuple[dict, int]:
    """Return the JSON document, and the size of the binary data."""
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "LODGS"},
        "extensionsUsed": [SPLATS],
        "scene": 0,
        "scenes": [{"nodes": [0], "extras": {DESCRIPTION: levels.describe()}}],
        "nodes": [], "meshes": [], "accessors": [], "bufferViews": [], "buffers": [],
    }  # fmt: skip
    matrix = (Y_UP @ levels.placement).T.ravel().tolist()
    size = 0
    for level in levels.fine_to_coarse:
        attributes = {}
        for name, (kind, component) in _columns(level.sh_degree).items():
            attributes[name] = len(document["accessors"])
            length = len(level.rows) * _item_size(name)
            view = {"buffer": 0, "byteOffset": size, "byteLength": length}
            accessor = {
                "bufferView": attributes[name], "componentType": component, "count": len(level.rows),
                "type": kind,
            }  # fmt: skip
            if name == "COLOR_0":
                accessor["normalized"] = True
            document["bufferViews"].append(view)
            document["accessors"].append(accessor)
            size += length + -length % 4
        extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        primitive = {"attributes": attributes, "mode": 0, "extensions": {SPLATS: extension}}
        node = {"name": f"Level {level.number}", "mesh": len(document["meshes"]), "matrix": matrix}
        document["meshes"].append({"name": node["name"], "primitives": [primitive]})
        document["nodes"].append(node)
    document["buffers"].append({"byteLength": size})
    if len(document["nodes"]) > 1:
        document["extensionsUsed"].append(LOD)
        finest = document["nodes"][0]
        finest["extensions"] = {LOD: {"ids": list(range(1, len(document["nodes"])))}}
        if levels.distances:
            finest["extras"] = {COVERAGE: _coverages(levels)}
    _add_cameras(document, levels)
    return document, size


def _coverages(levels: PortableLevels) -> list[float]:
    """Return the smallest share of the screen at which each level is drawn, fine to coarse."""
    _, radius = levels.sphere()
    shares = []
    for distance in levels.distances[-2::-1]:
        height = radius / max((radius + distance / levels.fade) * math.tan(_VIEW_ANGLE / 2), 1e-12)
        shares.append(min(height**2, 1.0))
    return [*shares, 0.0]


def _add_cameras(document: dict, levels: PortableLevels) -> None:
    if levels.views:
        document["cameras"] = []
    for view in levels.views:
        camera = {
            "yfov": 2 * math.atan(view.height / 2 / view.fy),
            "aspectRatio": view.width / view.fx * view.fy / view.height,
            "znear": max(view.near, 1e-4),
        }
        matrix = Y_UP @ levels.placement @ view.camera_to_world @ _FLIP
        node = {"name": view.name, "camera": len(document["cameras"]), "matrix": matrix.T.ravel().tolist()}
        document["cameras"].append({"name": view.name, "type": "perspective", "perspective": camera})
        document["scenes"][0]["nodes"].append(len(document["nodes"]))
        document["nodes"].append(node)


def _columns(degree: int) -> dict[str, tuple[str, int]]:
    """Return accessor type and component type of each attribute by name."""
    return _COLUMNS | {name: ("VEC3", 5126) for name in harmonics(degree)}


def harmonics(degree: int) -> list[str]:
    """Return the names of the attributes of spherical harmonics up to a degree."""
    return [f"{SPLATS}:SH_DEGREE_{n}_COEF_{i}" for n in range(degree + 1) for i in range(2 * n + 1)]


def _item_size(name: str) -> int:
    kind, component = _COLUMNS.get(name, ("VEC3", 5126))
    return WIDTHS[kind] * np.dtype(COMPONENTS[component]).itemsize


def _values(splats: Splats) -> dict[str, np.ndarray]:
    """Return the attributes of splats by name, in the types of :data:`_COLUMNS`."""
    alphas = splats.opacities
    color = np.column_stack([0.5 + SH_C0 * splats.sh[:, 0], alphas])
    values = {
        "POSITION": splats.means,
        "COLOR_0": (255 * color).round().clip(0, 255).astype(np.uint8),
        f"{SPLATS}:ROTATION": splats.quats[:, [1, 2, 3, 0]],
        f"{SPLATS}:SCALE": np.exp(splats.log_scales),
        f"{SPLATS}:OPACITY": alphas,
    }
    values |= {name: splats.sh[:, i] for i, name in enumerate(harmonics(splats.sh_degree))}
    return {name: column if name == "COLOR_0" else column.astype("<f4") for name, column in values.items()}
