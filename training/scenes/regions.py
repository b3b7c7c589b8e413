"""Parts of a scene that are trained by themselves: cells on the ground, and the views that see them.

The rules are those of VastGaussian (Lin et al. 2024, Sec. 3.2 and 3.3). numpy only: Blender shows cells.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..documents import read_json
from ..errors import LodgsError
from ..files import atomic_write
from .cameras import Camera
from .colmap import Scene, observed_points

CELL_MARGIN = 0.2
"""Share of a cell's side by which it is enlarged on each side for what it is trained on."""
MIN_IMAGE_SHARE = 0.25
"""A view that stands elsewhere belongs to a cell that covers more than this share of its image."""
_RAYS = 16, 12
"""Over an image, across and down, to tell which share of it a box covers."""
_HEIGHTS = 0.01, 0.99
"""Quantiles of the points' heights between which a cell's box stands."""


@dataclass(frozen=True, eq=False)
class Region:
    """A cell on the ground, and what it is trained on.

    Attributes:
        ground: (3, 3) float64, rotation from the world to axes of which the last points up.
        cell: (2, 2), where it begins and ends along the first two of these; infinite where nothing is beyond.
            It includes where it begins.
        area: (2, 2), the same enlarged: where the points lie that it begins with.
        views: names of the views that it is trained and measured on.
        seam: only what lies at the cell's borders is trained, to fit the cells beside it, and all else stays
            as it is.
    """

    ground: np.ndarray
    cell: np.ndarray
    area: np.ndarray
    views: tuple[str, ...]
    seam: bool = False

    def select_views(self, scene: Scene) -> Scene:
        """The scene with the region's views alone.

        Raises:
            LodgsError: it has none of them.
        """
        names = frozenset(self.views)
        cameras = [camera for camera in scene.cameras if camera.name in names]
        if not cameras:
            raise LodgsError(f"{scene.folder} has none of the region's views.", "Write the plan again.")
        return replace(scene, cameras=cameras, distorted=[name for name in scene.distorted if name in names])

    def start_points(self, scene: Scene) -> np.ndarray:
        """Which of the points (P,) training begins with: those around it, and what its views observe."""
        return self.in_enlarged_cell(scene.points) | observed_points(scene, frozenset(self.views))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of points (P, 3) are the cell's, (P,); of all cells of a plan exactly one has each."""
        return _within(_on_ground(self.ground, points), self.cell)

    def in_enlarged_cell(self, points: np.ndarray) -> np.ndarray:
        """Which of points (P, 3) lie in the enlarged cell, (P,)."""
        return _within(_on_ground(self.ground, points), self.area)

    def near_border(self, points: np.ndarray) -> np.ndarray:
        """Which of points (P, 3) are the cell's and as near to another as the cell is enlarged, (P,)."""
        return self.contains(points) & ~_within(_on_ground(self.ground, points), self._inside)

    def as_seam(self, scene: Scene) -> Region:
        """The same cell to be fitted to those beside it, by its views that stand at its borders, on either
        side."""
        eyes = _on_ground(self.ground, np.array([camera.center for camera in scene.cameras]))
        near = _within(eyes, self.area) & ~_within(eyes, self._inside)
        names = {camera.name for camera, its in zip(scene.cameras, near, strict=True) if its}
        views = tuple(name for name in self.views if name in names)
        return replace(self, views=views, seam=True)

    def overlaps(self, other: Region) -> bool:
        """Whether another cell has a part of the enlarged one."""
        return bool(
            (
                np.maximum(self.area[:, 0], other.cell[:, 0]) < np.minimum(self.area[:, 1], other.cell[:, 1])
            ).all()
        )

    @property
    def _inside(self) -> np.ndarray:
        """(2, 2), the cell without its borders."""
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(self.cell), 2 * self.cell - self.area, self.cell)

    def write(self, path: Path) -> None:
        """Writes it as JSON, without limits where it has none.

        Raises:
            OSError: the file cannot be written.
        """
        values = {
            "ground": self.ground.tolist(), "cell": _finite(self.cell), "area": _finite(self.area),
            "views": self.views, "seam": self.seam,
        }  # fmt: skip
        with atomic_write(path) as temporary:
            Path(temporary).write_text(json.dumps(values, indent=1), encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Region:
        """Reads it again, to the bit.

        Raises:
            LodgsError: the file cannot be read, or is no region's.
        """
        values = read_json(path, f"The region {path}")
        try:
            ground = np.array(values["ground"], np.float64)
            cell, area = _bounds(values["cell"]), _bounds(values["area"])
            views, seam = tuple(values["views"]), values.get("seam", False)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise _damaged(path) from error
        rotation = ground.shape == (3, 3) and np.allclose(ground @ ground.T, np.eye(3), atol=1e-6)
        named = views and all(isinstance(name, str) for name in views)
        if not (rotation and named and isinstance(seam, bool)):
            raise _damaged(path)
        return cls(ground, cell, area, views, seam)


def plan_cells(scene: Scene, columns: int, rows: int) -> list[Region]:
    """Cells that cover the ground, each with about as many of the cameras, and the views that see them.

    Along the ground's longer side there are columns, and in each of them rows. The outer ones have no end. A
    view belongs to the cells in whose enlarged area it stands, and to those that cover more than IN_SIGHT of
    its image; a cell is a box as high as the points are.

    Args:
        columns, rows: how many, at least 1.

    Raises:
        LodgsError: there are too few views for so many cells, or too few places where they stand.
    """
    cameras = scene.cameras
    if len(cameras) < 2 * columns * rows:
        raise LodgsError(
            f"{len(cameras)} views are too few for {columns}x{rows} cells.", "Ask for fewer cells."
        )
    ground = scene.up_rotation()
    eyes = _on_ground(ground, np.array([camera.center for camera in cameras]))
    if np.ptp(eyes[:, 1]) > np.ptp(eyes[:, 0]):  # columns divide the longer side
        ground = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ ground
        eyes = _on_ground(ground, np.array([camera.center for camera in cameras]))
    points = _on_ground(ground, scene.points)
    heights = np.quantile(np.append(points[:, 2], eyes[:, 2]), _HEIGHTS)
    outermost = np.stack([eyes[:, :2].min(axis=0), eyes[:, :2].max(axis=0)], axis=1)
    regions = []
    for cell, standing in _cells(eyes, columns, rows):
        if not (cell[:, 0] < cell[:, 1]).all():
            raise LodgsError("Too many views stand in one place for so many cells.", "Ask for fewer cells.")
        finite = np.where(np.isfinite(cell), cell, outermost)
        area = cell + CELL_MARGIN * np.ptp(finite, axis=1)[:, None] * [-1, 1]
        box = np.concatenate([np.clip(area, *_around(outermost)), [[*heights]]])
        seen = np.array([_share_of_image(camera, ground, box) > MIN_IMAGE_SHARE for camera in cameras])
        belongs = seen | _within(eyes, area) | standing
        names = tuple(camera.name for camera, its in zip(cameras, belongs, strict=True) if its)
        regions.append(Region(ground, cell, area, names))
    return regions


def _cells(eyes: np.ndarray, columns: int, rows: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The bounds (2, 2) of each cell, and which cameras (V,) stand in it, about the same number in each."""
    for across, column in _parts(eyes[:, 0], np.arange(len(eyes)), columns):
        for along, cell in _parts(eyes[:, 1], column, rows):
            standing = np.zeros(len(eyes), bool)
            standing[cell] = True
            yield np.array([across, along]), standing


def _parts(
    places: np.ndarray, which: np.ndarray, count: int
) -> Iterator[tuple[tuple[float, float], np.ndarray]]:
    """Divides some of places (V,) by their order: where each part begins and ends, and which are in it."""
    parts = np.array_split(which[np.argsort(places[which], kind="stable")], count)
    borders = [(places[one[-1]] + places[other[0]]) / 2 for one, other in pairwise(parts)]
    yield from zip(zip([-np.inf, *borders], [*borders, np.inf], strict=True), parts, strict=True)


def _around(outermost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (2, 1) each of what counts as the scene: the cameras' rectangle (2, 2), enlarged."""
    reach = CELL_MARGIN * np.ptp(outermost, axis=1)[:, None]
    return outermost[:, :1] - reach, outermost[:, 1:] + reach


def _share_of_image(camera: Camera, ground: np.ndarray, box: np.ndarray) -> float:
    """The share of a view's image that a box covers, nothing before it; from within, all.

    Args:
        box: (3, 2), where it begins and ends along the ground's axes.
    """
    across, down = ((np.arange(n) + 0.5) / n for n in _RAYS)
    x, y = np.meshgrid(across * camera.width, down * camera.height)
    pixels = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = pixels.reshape(-1, 3) @ camera.world_to_camera[:3, :3] @ ground.T
    eye = ground @ camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = (box.T[:, None] - eye) / rays  # to where a ray meets the two planes across each axis
    first, last = np.nanmin(ways, axis=0).max(axis=1), np.nanmax(ways, axis=0).min(axis=1)
    return float(np.mean((first <= last) & (last > 0)))


def _on_ground(ground: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points.astype(np.float64) @ ground.T


def _within(places: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    return ((places[:, :2] >= bounds[:, 0]) & (places[:, :2] < bounds[:, 1])).all(axis=1)


def _finite(bounds: np.ndarray) -> list[list[float | None]]:
    return [[value if np.isfinite(value) else None for value in each] for each in bounds.tolist()]


def _bounds(values: list[list[float | None]]) -> np.ndarray:
    """(2, 2) float64; ValueError where there are none."""
    (a, b), (c, d) = values
    found = [-np.inf if a is None else a, np.inf if b is None else b]
    found += [-np.inf if c is None else c, np.inf if d is None else d]
    bounds = np.array(found, np.float64).reshape(2, 2)
    if not (bounds[:, 0] < bounds[:, 1]).all():
        raise ValueError("no bounds")
    return bounds


def _damaged(path: Path) -> LodgsError:
    return LodgsError(f"{path} is no region of a plan.", "Write the plan again.")
