"""Levels of detail as 3D Tiles 1.1: ``tileset.json`` and glTF files, for Cesium and other globes.

The scene is divided into cells. Each cell has a chain of tiles, from the coarsest level to the finest, which
replace one another (``refine: REPLACE``). Geometric errors make Cesium switch at the rule's distances.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import atomic_folder, check_export_folder
from .gaussians import SplatRows, Splats
from .georeference import is_on_earth
from .gltf import COMPRESSION, SPLATS, write_compressed_glb
from .levels import Bundle, Level
from .portable_levels import PortableLevels, portable_batches

TILESET_FILE = "tileset.json"
MAX_TILE_SPLATS = 200_000
"""Maximum number of splats in a tile of the finest level."""
SCREEN_ERROR = 16.0
"""Cesium's default limit of the error on the screen in pixels."""
_FAR = 1000.0
"""Distance up to which a scene is shown, in multiples of its diagonal."""
_CORE = 3.0
"""Radius of the core, in radii of the scene. Splats that extend beyond it share a cell."""
_DERIVATIVE_STEP = 1.0
"""Half distance in metres of positions that determine the transform of their surroundings."""
_BENT = 1e6
"""Distance in metres from the center up to which splats follow the curvature; the sky may be farther."""
_SIGMAS = 3.0
"""Extent of a splat in boxes, in standard deviations."""


def write_tiles(folder: Path, levels: PortableLevels) -> None:
    """Write a tileset into a folder, and replace an earlier one there.

    A scene whose georeference is in ECEF or UTM coordinates, or else whose local origin is in ECEF
    coordinates, is placed on the globe. A scene on a UTM map gets the curvature of the Earth. Other scenes
    have z up.

    Raises:
        LodgsError: the folder has other files or cannot be written.
    """
    check_export_folder(folder, TILESET_FILE, r"cell\d+_level\d+\.glb")
    transform, bend = _earth_transform(levels.bundle, levels.sphere()[0])
    if bend is not None:
        bent = [_bend(level, bend) for level in levels.bundle.levels]
        levels = replace(levels, bundle=replace(levels.bundle, levels=bent))
    if transform is not None:
        meta = levels.bundle.meta | {"up_rotation": np.eye(3).tolist()}
        levels = replace(levels, bundle=replace(levels.bundle, meta=meta))
    levels = replace(levels, origin=np.zeros(3), views=())
    with atomic_folder(folder) as tiles:
        document = _write_cells(tiles, levels)
        if transform is not None:
            document["root"]["transform"] = transform.T.reshape(-1).tolist()
        (tiles / TILESET_FILE).write_text(json.dumps(document, allow_nan=False), "utf-8")


def _earth_transform(
    bundle: Bundle, center: np.ndarray
) -> tuple[np.ndarray | None, Callable[[np.ndarray], np.ndarray] | None]:
    """Return the transform (4, 4) from a bundle's coordinates to ECEF, or None if it is unknown.

    Coordinates on a map get the transform of their surroundings at the center. A function then maps positions
    (N, 3) to those that this transform moves to the right place.
    """
    place = bundle.georeference
    if place is not None and place.is_ecef:
        return place.matrix, None
    if place is not None and (zone := place.zone) is not None:
        matrix = place.matrix

        def on_map(positions: np.ndarray) -> np.ndarray:
            return positions.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]

        def on_earth(positions: np.ndarray) -> np.ndarray:
            return zone.to_ecef(on_map(positions))

        if not zone.contains(on_map(center)):
            place_text = ", ".join(f"{value:.6g}" for value in on_map(center))
            raise LodgsError(
                f"Cannot place scene on Earth: ({place_text}) lies outside of the map {place.crs[:60]}.",
                "Correct the scene's georeference.json, and train again.",
            )
        step = _DERIVATIVE_STEP / np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        sides = [on_earth(center + sign * step * np.eye(3)) for sign in (1, -1)]
        linear = (sides[0] - sides[1]).T / (2 * step)
        transform = np.eye(4)
        transform[:3, :3] = linear
        transform[:3, 3] = on_earth(center[None])[0] - linear @ center
        back = np.linalg.inv(linear)

        def bend(positions: np.ndarray) -> np.ndarray:
            is_near = np.linalg.norm(positions - center, axis=1) < _BENT / _DERIVATIVE_STEP * step
            bent = positions.astype(np.float64)
            bent[is_near] = (on_earth(positions[is_near]) - transform[:3, 3]) @ back.T
            return bent

        return transform, bend
    if not is_on_earth(bundle.origin):
        return None, None
    transform = np.eye(4)
    transform[:3, 3] = bundle.origin
    return transform, None


@dataclass(frozen=True)
class _BentRows:
    """Splats whose positions a function maps when they are read."""

    rows: SplatRows
    bend: Callable[[np.ndarray], np.ndarray]

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        splats = self.rows.select(index)
        return replace(splats, means=self.bend(splats.means).astype(np.float32))


def _bend(level: Level, bend: Callable[[np.ndarray], np.ndarray]) -> Level:
    """Return a level whose positions a function maps."""
    rows = _BentRows(level.rows, bend)
    return (
        replace(level, splats=rows.select(slice(None)))
        if level.on_disk is None
        else replace(level, on_disk=rows)
    )


def _write_cells(folder: Path, levels: PortableLevels) -> dict:
    """Write the files of all cells, and return the tileset."""
    used = levels.fine_to_coarse if levels.distances else levels.fine_to_coarse[:1]
    errors = [SCREEN_ERROR * d / levels.focal for d in reversed(levels.distances)] or [0.0]
    sphere = levels.sphere()
    planes: list[tuple[int, int, float]] | None = None
    cells: list[dict | None] = []
    boxes: list[np.ndarray] = []
    for level, error in zip(used, errors, strict=True):
        means, far = _survey(level.rows, *sphere)
        if planes is None:
            planes = _split(means[~far])
            cells = [None] * (len(planes) + 2)
            boxes = [np.array([[np.inf] * 3, [-np.inf] * 3]) for _ in cells]
        numbers = np.where(far, len(planes) + 1, _cell_numbers(means, planes))
        for cell, inner in enumerate(cells):
            index = np.flatnonzero(numbers == cell)
            if not len(index):
                continue
            name = f"cell{cell}_level{level.number}.glb"
            splats = level.rows.select(index)
            tile = Bundle("", [Level(level.number, splats)], meta=_meta(levels))
            write_compressed_glb(folder / name, PortableLevels(tile))
            box = _box(splats, levels.bundle.up_rotation)
            boxes[cell] = np.array([np.minimum(boxes[cell][0], box[0]), np.maximum(boxes[cell][1], box[1])])
            cells[cell] = {
                "boundingVolume": _volume(boxes[cell]),
                "geometricError": error,
                "refine": "REPLACE",
                "content": {"uri": name},
                **({"children": [inner]} if inner else {}),
            }
    box = np.array([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])  # empty cells have none
    far = SCREEN_ERROR * _FAR * float(np.linalg.norm(box[1] - box[0])) / levels.focal
    error = max(far, *errors)
    extensions = {name: [SPLATS, COMPRESSION] for name in ("extensionsUsed", "extensionsRequired")}
    return {
        "asset": {"version": "1.1", "generator": "LODGS"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extensions},
        "geometricError": error,
        "root": {
            "boundingVolume": _volume(box), "geometricError": error, "refine": "REPLACE",
            "children": [cell for cell in cells if cell],
        },
    }  # fmt: skip


def _meta(levels: PortableLevels) -> dict:
    bundle = levels.bundle
    return {"up_rotation": bundle.up_rotation.tolist(), **({"antialias": True} if bundle.antialias else {})}


def _survey(rows: SplatRows, center: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the means (N, 3) of all splats, and whether they are far away or huge (N,) bool.

    The sky and floaters would put every camera inside the boxes of the other splats.
    """
    means, far = np.empty((len(rows), 3), np.float32), np.empty(len(rows), bool)
    for begin, splats in portable_batches(rows):
        end = begin + len(splats)
        means[begin:end] = splats.means
        reach = _SIGMAS * np.exp(splats.log_scales.max(axis=1))
        far[begin:end] = np.linalg.norm(splats.means - center, axis=1) + reach > _CORE * radius
    return means, far


def _split(means: np.ndarray) -> list[tuple[int, int, float]]:
    """Divide cells at the median of their longer axis until each has at most MAX_TILE_SPLATS splats.

    Returns:
        Cell, axis and position of each plane, in order. Splats above the n-th plane become cell n + 1.
    """
    planes: list[tuple[int, int, float]] = []
    cells = [means]
    cell = 0
    while cell < len(cells):
        part = cells[cell]
        if len(part) <= MAX_TILE_SPLATS:
            cell += 1
            continue
        low, high = np.quantile(part, (0.05, 0.95), axis=0)
        axis = int(np.argmax(high - low))
        position = float(np.median(part[:, axis]))
        above = part[:, axis] > position
        if not above.any():  # all splats are at one place
            cell += 1
            continue
        planes.append((cell, axis, position))
        cells[cell] = part[~above]
        cells.append(part[above])
    return planes


def _cell_numbers(means: np.ndarray, planes: list[tuple[int, int, float]]) -> np.ndarray:
    """Return the cell (N,) of each position."""
    numbers = np.zeros(len(means), np.int32)
    for new, (cell, axis, position) in enumerate(planes, 1):
        numbers[(numbers == cell) & (means[:, axis] > position)] = new
    return numbers


def _box(splats: Splats, rotation: np.ndarray) -> np.ndarray:
    """Return the lowest and highest corner (2, 3) of turned splats, float64."""
    reach = _SIGMAS * np.exp(splats.log_scales.astype(np.float64)).max(axis=1, keepdims=True)
    means = splats.means.astype(np.float64) @ rotation.T
    return np.array([(means - reach).min(axis=0), (means + reach).max(axis=0)])


def _volume(box: np.ndarray) -> dict:
    """Return a bounding volume: centre and half axes."""
    center, half = box.mean(axis=0).tolist(), np.diag((box[1] - box[0]) / 2).ravel().tolist()
    return {"box": [*center, *half]}
