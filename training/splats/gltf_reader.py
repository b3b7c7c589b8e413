"""Reader of splats in glTF, with levels by MSFT_lod; ``gltf`` writes them.

Drafts of KHR_gaussian_splatting are read, too: attributes that start with an underscore, base colour and
opacity in COLOR_0, logarithmic scales, and other names of the compression with SPZ.
"""

from __future__ import annotations

import base64
import os
import re
import struct
from collections import deque
from pathlib import Path, PurePosixPath
from typing import NoReturn
from urllib.parse import unquote

import numpy as np

from ..color import srgb_from_linear
from ..documents import open_file, parse_json
from ..errors import LodgsError, printable
from .batches import batch_slices
from .bundle import write_bundle
from .gaussians import SH_C0, Splats, equalize_degrees
from .gltf import (
    CHUNK,
    COMPONENTS,
    COMPRESSION,
    DESCRIPTION,
    HEADER,
    LOD,
    MAX_DEGREE,
    SPLATS,
    WIDTHS,
    Y_UP,
    harmonics,
)
from .levels import MAX_READ_LEVELS, Bundle, Level
from .mapped_rows import require_size
from .portable_levels import join_levels, parse_description, place_splats, splats_from_activated, upright_meta
from .quats import rotation_matrices
from .spz import unpack_spz

_MAX_JSON, _MAX_TEXT = 1 << 24, 1 << 28
"""Maximum bytes of the JSON of a .glb and of a .gltf, which may contain the data as text."""
_COMPRESSIONS = COMPRESSION, "KHR_gaussian_splatting_compression_spz", "KHR_spz_gaussian_splats_compression"
"""Names of the compression with SPZ, the last one in place of ``SPLATS``."""
_LINEAR = "lin_rec709_display"
"""Colour space of splats whose colours are linear light."""
_MIN_SPLAT = 32
"""Minimum bytes of a splat: position, rotation, scale, opacity and base colour."""
_SPZ_SPLAT = 19
"""Minimum bytes of a splat of SPZ before compression."""
_MAX_RATIO = 20
"""Maximum ratio of compression that is read; that of trained splats is about 2."""
_BLOCK = 1 << 16
"""Values of an accessor that are copied at a time."""
_INSTANCING = "EXT_mesh_gpu_instancing"
_MEMORY, _RATIO = 1 << 27, 64
"""Bytes of splats in instances that a file of any size may have, and further bytes per byte of its size."""
_DEFECTS = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, struct.error)
_TRANSFORM = {"matrix", "rotation", "scale", "translation"}
_PlacedParts = list[tuple[Splats, np.ndarray]]
"""Sets of splats with their transforms (4, 4)."""


def read_glb(path: Path, bundle: Path) -> None:
    """Convert the splats of a ``.glb`` or ``.gltf`` file to a bundle.

    Raises:
        LodgsError: the file is damaged, has no splats or refers to other files.
    """
    try:
        levels = _GlbReader(path).levels()
    except _DEFECTS as error:
        reason = printable(f"{type(error).__name__}: {error}")[:300]
        raise LodgsError(f"Cannot read {path}: it is damaged ({reason}).", "Export it again.") from error
    write_bundle(bundle, levels)


class _GlbReader:
    """Reader of the splats of one file. Defects raise one of ``_DEFECTS``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._buffers: dict[int, np.ndarray] = {}
        self._meshes: dict[int, list[Splats]] = {}
        self._splats = self._placed = 0
        self._meta: dict = {}
        with open_file(path) as file:
            self._size = os.fstat(file.fileno()).st_size
            if path.suffix.lower() == ".gltf":
                self._json = parse_json(file.read(_MAX_TEXT + 1), f"The JSON of {path}", _MAX_TEXT)
                return
            magic, version, _ = HEADER.unpack(file.read(HEADER.size))
            if magic != b"glTF" or version != 2:
                raise LodgsError(
                    f"Cannot read {path}: it is not a binary glTF file of version 2.", "Export it as .glb."
                )
            length, kind = CHUNK.unpack(file.read(CHUNK.size))
            if kind != b"JSON" or length > min(_MAX_JSON, self._size):
                raise ValueError("its JSON is missing or too long")
            self._json = parse_json(file.read(length), f"The JSON of {path}", _MAX_JSON)
            if not (head := file.read(CHUNK.size)):
                return
            length, kind = CHUNK.unpack(head)
            if kind != b"BIN\0" or file.tell() + length > self._size:
                raise ValueError("its binary data are truncated")
            if length and "uri" not in self._item("buffers", 0):
                self._buffers[0] = np.memmap(file, np.uint8, "r", file.tell(), length)

    @np.errstate(over="ignore", invalid="ignore")
    def levels(self) -> Bundle:
        """Return the levels of all nodes with MSFT_lod, each with the other splats, or all as one level."""
        nodes = self._world_nodes()
        coarser = {index for node, _ in nodes.values() for index in self._coarser(node)}
        groups: list[list[_PlacedParts]] = []
        outside: list[_PlacedParts] = []
        for index, (node, matrix) in nodes.items():
            parts = self._node_splats(node, matrix)
            if parts and self._coarser(node):
                groups.append([parts, *self._coarser_splats(node, matrix)])
            elif parts and index not in coarser:
                outside.append(parts)
        fine_to_coarse = [
            [part for parts in level for part in parts] for level in join_levels(groups, outside)
        ]
        if not any(fine_to_coarse):
            raise LodgsError(f"Cannot read {self._path}: it has no Gaussian splats.", "Choose another file.")
        return self._own(fine_to_coarse) or self._foreign(fine_to_coarse)

    def _coarser_splats(self, node: dict, matrix: np.ndarray) -> list[_PlacedParts]:
        """Return the splats of the levels of a node that are coarser than itself."""
        ids = self._coarser(node)
        if len(ids) >= MAX_READ_LEVELS:
            raise ValueError(f"{len(ids) + 1} levels")
        parent = matrix @ np.linalg.inv(_matrix(node))
        others = [self._item("nodes", index) for index in ids]
        return [parts for n in others if (parts := self._node_splats(n, parent @ _matrix(n)))]

    def _own(self, fine_to_coarse: list[_PlacedParts]) -> Bundle | None:
        """Return the bundle that LODGS has written; None if another program has written or moved it."""
        text = (self._scene().get("extras") or {}).get(DESCRIPTION)
        if text is None:
            return None
        bundle, placement = parse_description(text, self._path)
        same = len(bundle.levels) == len(fine_to_coarse) and all(
            len(parts) == 1 and np.allclose(parts[0][1], Y_UP @ placement, rtol=1e-9, atol=1e-9)
            for parts in fine_to_coarse
        )
        if not same:
            return None
        parts = equalize_degrees([splats for ((splats, _),) in fine_to_coarse])
        for level, splats in zip(reversed(bundle.levels), parts, strict=True):
            level.splats = splats
        return bundle

    def _foreign(self, fine_to_coarse: list[_PlacedParts]) -> Bundle:
        placed = [place_splats(*part, self._path) for parts in fine_to_coarse for part in parts]
        meta, splats = upright_meta(placed, "Y")
        remaining, levels = iter(equalize_degrees(splats)), []
        for number, parts in enumerate(fine_to_coarse):
            joined = Splats.concatenated([next(remaining) for _ in parts])
            levels.append(Level(len(fine_to_coarse) - number, joined))
        return Bundle("", levels[::-1], meta=self._meta | meta)

    def _scene(self) -> dict:
        """Return the scene to read; in a file without scenes, one of all nodes that no other node lists."""
        if self._json.get("scenes"):
            return self._item("scenes", self._json.get("scene", 0))
        nodes = self._json.get("nodes", [])
        listed = {index for node in nodes for index in [*node.get("children", []), *self._coarser(node)]}
        return {"nodes": [index for index in range(len(nodes)) if index not in listed]}

    def _world_nodes(self) -> dict[int, tuple[dict, np.ndarray]]:
        """Return the nodes of the scene with their transforms (4, 4), by index."""
        waiting = deque((index, np.eye(4)) for index in self._scene().get("nodes", []))
        nodes: dict[int, tuple[dict, np.ndarray]] = {}
        while waiting:
            index, parent = waiting.popleft()
            node = self._item("nodes", index)
            if index in nodes:
                raise ValueError(f"node {index} occurs twice")
            matrix = parent @ _matrix(node) if _TRANSFORM & node.keys() else parent
            nodes[index] = node, matrix
            waiting += [(child, matrix) for child in node.get("children", [])]
        return nodes

    def _coarser(self, node: dict) -> list[int]:
        return list(node.get("extensions", {}).get(LOD, {}).get("ids", []))

    def _node_splats(self, node: dict, matrix: np.ndarray) -> _PlacedParts:
        """Return the splats of a node, and its transform."""
        if "mesh" not in node:
            return []
        splats = self._mesh(_natural(node["mesh"]))
        places = self._instances(node)
        self._placed += len(places) * sum(map(len, splats))
        if self._placed * _MIN_SPLAT > _MEMORY + _RATIO * self._size:
            raise ValueError(f"it is too short for {self._placed:,} splats in instances")
        return [(part, matrix @ place) for place in places for part in splats]

    def _mesh(self, index: int) -> list[Splats]:
        """Return the splats of a mesh, which several nodes may show."""
        if index not in self._meshes:
            self._meshes[index] = [
                self._primitive(primitive)
                for primitive in self._item("meshes", index)["primitives"]
                if {SPLATS, _COMPRESSIONS[-1]} & primitive.get("extensions", {}).keys()
            ]
        return self._meshes[index]

    def _instances(self, node: dict) -> list[np.ndarray]:
        """Return the transforms (4, 4) of the instances of a node's mesh, relative to the node."""
        attributes = node.get("extensions", {}).get(_INSTANCING, {}).get("attributes", {})
        columns = {
            name.lower(): self._accessor(index, 4 if name == "ROTATION" else 3)
            for name, index in attributes.items()
            if name.lower() in _TRANSFORM
        }
        if not columns:
            return [np.eye(4)]
        rows = zip(*columns.values(), strict=True)
        return [_matrix(dict(zip(columns, row, strict=True))) for row in rows]

    def _primitive(self, primitive: dict) -> Splats:
        extension = primitive["extensions"].get(SPLATS)
        inner = primitive["extensions"] if extension is None else extension.get("extensions", {})
        if name := next((name for name in _COMPRESSIONS if name in inner), ""):
            splats = self._compressed(inner[name]["bufferView"])
        elif inner:
            self._refuse_extension(next(iter(inner)))
        else:
            splats = self._uncompressed(primitive["attributes"], extension)
        if extension and extension.get("colorSpace") == _LINEAR:
            splats.sh = _display_coded(splats.sh)
        return splats

    def _uncompressed(self, attributes: dict, extension: dict) -> Splats:
        attributes = {re.sub("^_", f"{SPLATS}:", name): index for name, index in attributes.items()}
        step = np.float32(extension.get("quantizedPositionScale", 1))  # of the first draft
        means = self._accessor(attributes["POSITION"], 3) * step
        quats = self._accessor(attributes[f"{SPLATS}:ROTATION"], 4)[:, [3, 0, 1, 2]]
        scales = self._accessor(attributes[f"{SPLATS}:SCALE"], 3)
        if (scales < 0).any():
            scales = np.exp(scales)  # logarithms, which SplatTransform wrote until June 2026
        if f"{SPLATS}:OPACITY" in attributes:
            alphas = self._accessor(attributes[f"{SPLATS}:OPACITY"], 1)[:, 0]
        else:
            alphas = self._accessor(attributes["COLOR_0"], 4)[:, 3]
        if (alphas < 0).any():
            alphas = 1 / (1 + np.exp(-alphas))  # logits, which JSplat wrote
        degree = max((n for n in range(MAX_DEGREE + 1) if harmonics(n)[-1] in attributes), default=0)
        base, *rest = harmonics(degree)
        if base in attributes:
            sh = [self._accessor(attributes[base], 3)]
        else:
            sh = [(self._accessor(attributes["COLOR_0"], 4)[:, :3] - 0.5) / SH_C0]
        sh += [self._accessor(attributes[name], 3) for name in rest]
        if len({len(column) for column in (means, quats, scales, alphas, *sh)}) > 1:
            raise ValueError("attributes have different lengths")
        self._splats += len(means)
        if self._splats * _MIN_SPLAT > self._size:
            raise ValueError(f"it is too short for {self._splats:,} splats")
        return splats_from_activated(means, quats, scales, alphas, np.stack(sh, axis=1))

    def _refuse_extension(self, name: str) -> NoReturn:
        raise LodgsError(
            f"Cannot read {self._path}: its splats need the extension {printable(name)}.",
            "Export it without compression.",
        )

    def _compressed(self, index: object) -> Splats:
        data, _ = self._view(index)
        require_size(data, self._path)
        splats, meta = unpack_spz(data.tobytes(), len(data) * _MAX_RATIO // _SPZ_SPLAT, self._path)
        self._meta |= meta
        self._splats += len(splats)
        if self._splats * _SPZ_SPLAT > self._size * _MAX_RATIO:
            raise ValueError(f"it is too short for {self._splats:,} splats")
        return splats

    def _view(self, index: object) -> tuple[np.ndarray, int]:
        """Return the bytes of a buffer view, and its stride or 0."""
        view = self._item("bufferViews", index)
        if extensions := view.get("extensions"):
            self._refuse_extension(next(iter(extensions)))
        begin = _natural(view.get("byteOffset", 0))
        data = self._buffer(_natural(view["buffer"]))[begin : begin + _natural(view["byteLength"])]
        return data, _natural(view.get("byteStride", 0))

    def _buffer(self, index: int) -> np.ndarray:
        """Return the bytes of a buffer: in the .glb, as text in the JSON, or in a file below its folder."""
        if index not in self._buffers:
            uri = self._item("buffers", index)["uri"]
            if uri.startswith("data:"):
                data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
            else:
                name = PurePosixPath(unquote(uri))
                if ":" in uri or "\\" in uri or name.is_absolute() or ".." in name.parts:
                    raise LodgsError(
                        f"Cannot read {self._path}: it refers to other files outside its folder.",
                        "Export it as one .glb file.",
                    )
                with open_file(self._path.parent / name) as file:
                    data = np.memmap(file, np.uint8, "r")
            self._buffers[index] = data
            self._size += len(data)
        return self._buffers[index]

    def _accessor(self, index: object, width: int) -> np.ndarray:
        """Return the values (N, width) float32 of an accessor."""
        accessor = self._item("accessors", index)
        data, stride = self._view(accessor["bufferView"])
        if WIDTHS[accessor["type"]] != width or "sparse" in accessor:
            raise ValueError(f"accessor {index} is not supported")
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        count = _natural(accessor["count"])
        begin = _natural(accessor.get("byteOffset", 0))
        stride = stride or width * kind.itemsize
        end = begin + (count - 1) * stride + width * kind.itemsize
        if stride < width * kind.itemsize or (count and end > len(data)):
            raise ValueError(f"accessor {index} exceeds its data")
        if not count:
            return np.zeros((0, width), np.float32)
        raw = np.ndarray((count, width), kind, data, begin, (stride, kind.itemsize))
        values = np.empty((count, width), np.float32)
        for block in batch_slices(count, _BLOCK):
            require_size(data, self._path)
            values[block] = raw[block]
        if accessor.get("normalized") and kind.kind != "f":
            values = np.maximum(values / np.iinfo(kind).max, -1)
        return values

    def _item(self, name: str, index: object) -> dict:
        """Return an entry of a list of the document."""
        return self._json[name][_natural(index)]


def _natural(value: object) -> int:
    """Return the value, or raise ValueError if it is not an integer of at least 0."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r} is not a count")
    return value


def _matrix(node: dict) -> np.ndarray:
    """Return the transform (4, 4) of a node relative to its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(np.array([w, x, y, z]))
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64)
    return matrix


def _display_coded(sh: np.ndarray) -> np.ndarray:
    """Convert coefficients (N, C, 3) of linear light to display-coded ones, in the first order."""
    base = (0.5 + SH_C0 * sh[:, 0]).clip(0)
    slope = np.where(base <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(base, 0.0031308) ** (1 / 2.4 - 1))
    return np.concatenate(
        [((srgb_from_linear(base) - 0.5) / SH_C0)[:, None], sh[:, 1:] * slope[:, None]],
        axis=1,
        dtype=np.float32,
    )
