"""Cells of a large scene that are trained separately, and the views of each cell.

The rules are those of VastGaussian (Lin et al. 2024, Sec. 3.2 and 3.3). numpy only, because Blender shows
cells.
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
from .colmap import Scene
from .observations import observed_points

CELL_MARGIN = 0.2
"""Fraction of a cell's side by which the trained area extends beyond the cell on each side."""
MIN_IMAGE_SHARE = 0.25
"""Fraction of a view's image that a cell must cover to include a view from outside."""
_RAYS = 16, 12
"""Number of rays across and down an image used to estimate the fraction covered by a box."""
_HEIGHTS = 0.01, 0.99
"""Quantiles of the points' heights that bound a cell's box."""


@dataclass(frozen=True, eq=False)
class Region:
    """A cell on the ground with its training area and views.

    Attributes:
        ground: (3, 3) float64 rotation from the world to axes whose last one points up.
        cell: (2, 2) lower (inclusive) and upper (exclusive) bounds along the first two axes; infinite at the
            outer border.
        area: (2, 2) bounds of the enlarged cell, which contains the initial points.
        views: names of the training and evaluation views.
        seam: True to train only the splats at the cell's borders, to match the adjacent cells.
    """

    ground: np.ndarray
    cell: np.ndarray
    area: np.ndarray
    views: tuple[str, ...]
    seam: bool = False

    def select_views(self, scene: Scene) -> Scene:
        """Return the scene with only the region's views.

        Raises:
            LodgsError: the scene has none of them.
        """
        names = frozenset(self.views)
        cameras = [camera for camera in scene.cameras if camera.name in names]
        if not cameras:
            raise LodgsError(
                f"Cannot train the region: {scene.folder} has none of its views.", "Create the plan again."
            )
        return replace(scene, cameras=cameras, distorted=[name for name in scene.distorted if name in names])

    def start_points(self, scene: Scene) -> np.ndarray:
        """Return a mask (P,) of the initial points: those in the enlarged cell or observed by the views."""
        return self.in_enlarged_cell(scene.points) | observed_points(scene, frozenset(self.views))

    def select_points(self, scene: Scene, full_scene: Scene) -> Scene:
        """Return a scene, which has the points of the full scene, with the initial points of the region."""
        return scene.select_points(self.start_points(full_scene))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (P,) of the points (P, 3) in the cell. The cells of a plan do not overlap."""
        return _within(_on_ground(self.ground, points), self.cell)

    def in_enlarged_cell(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (P,) of the points (P, 3) in the enlarged cell."""
        return _within(_on_ground(self.ground, points), self.area)

    def near_border(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (P,) of the points (P, 3) in the cell, up to one margin away from another cell."""
        return self.contains(points) & ~_within(_on_ground(self.ground, points), self._interior)

    def as_seam(self, scene: Scene) -> Region:
        """Return the region as a seam, with only the views from positions near the cell's borders."""
        positions = _on_ground(self.ground, np.array([camera.center for camera in scene.cameras]))
        near = _within(positions, self.area) & ~_within(positions, self._interior)
        names = {camera.name for camera, is_near in zip(scene.cameras, near, strict=True) if is_near}
        views = tuple(name for name in self.views if name in names)
        return replace(self, views=views, seam=True)

    def overlaps(self, other: Region) -> bool:
        """Return True if the enlarged cell overlaps another region's cell."""
        low = np.maximum(self.area[:, 0], other.cell[:, 0])
        high = np.minimum(self.area[:, 1], other.cell[:, 1])
        return bool((low < high).all())

    @property
    def _interior(self) -> np.ndarray:
        """Bounds (2, 2) of the cell without its border zone."""
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(self.cell), 2 * self.cell - self.area, self.cell)

    def write(self, path: Path) -> None:
        """Write the region as JSON; infinite bounds become null.

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
        """Read a region written by :meth:`write`, bit by bit.

        Raises:
            LodgsError: the file cannot be read or contains no region.
        """
        values = read_json(path, f"The region {path}")
        try:
            ground = np.array(values["ground"], np.float64)
            cell = _bounds(values["cell"])
            area = _bounds(values["area"])
            views = tuple(values["views"])
            seam = values.get("seam", False)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise _damaged_error(path) from error
        rotation = ground.shape == (3, 3) and np.allclose(ground @ ground.T, np.eye(3), atol=1e-6)
        named = views and all(isinstance(name, str) for name in views)
        if not (rotation and named and isinstance(seam, bool)):
            raise _damaged_error(path)
        return cls(ground, cell, area, views, seam)


def plan_cells(scene: Scene, columns: int, rows: int) -> list[Region]:
    """Divide the ground into cells with about equal numbers of cameras, and assign views to each cell.

    The ground's longer side is divided into columns, and each column into rows. Outer cells are unbounded. A
    view belongs to the cells whose enlarged area contains its position, and to those whose box, as high as
    the points, covers more than MIN_IMAGE_SHARE of its image.

    Args:
        columns, rows: number of columns and rows, at least 1.

    Raises:
        LodgsError: there are too few views or distinct positions for the number of cells.
    """
    cameras = scene.cameras
    if len(cameras) < 2 * columns * rows:
        raise LodgsError(
            f"Cannot plan {columns}x{rows} cells with {len(cameras)} views: each cell needs at least 2.",
            "Choose fewer cells.",
        )
    ground = scene.up_rotation()
    positions = _on_ground(ground, np.array([camera.center for camera in cameras]))
    if np.ptp(positions[:, 1]) > np.ptp(positions[:, 0]):  # columns divide the longer side
        ground = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ ground
        positions = _on_ground(ground, np.array([camera.center for camera in cameras]))
    points = _on_ground(ground, scene.points)
    heights = np.quantile(np.append(points[:, 2], positions[:, 2]), _HEIGHTS)
    outermost = np.stack([positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)], axis=1)
    regions = []
    for cell, members in _cells(positions, columns, rows):
        if not (cell[:, 0] < cell[:, 1]).all():
            raise LodgsError(
                f"Cannot plan {columns}x{rows} cells: too many views share one position.",
                "Choose fewer cells.",
            )
        finite = np.where(np.isfinite(cell), cell, outermost)
        area = cell + CELL_MARGIN * np.ptp(finite, axis=1)[:, None] * [-1, 1]
        box = np.concatenate([np.clip(area, *_scene_bounds(outermost)), [[*heights]]])
        covers = np.array([_share_of_image(camera, ground, box) > MIN_IMAGE_SHARE for camera in cameras])
        belongs = covers | _within(positions, area) | members
        names = tuple(camera.name for camera, selected in zip(cameras, belongs, strict=True) if selected)
        regions.append(Region(ground, cell, area, names))
    return regions


def _cells(positions: np.ndarray, columns: int, rows: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the bounds (2, 2) of each cell and a mask (V,) of its cameras, about equally many per cell."""
    for x_bounds, column in _partition(positions[:, 0], np.arange(len(positions)), columns):
        for y_bounds, cell in _partition(positions[:, 1], column, rows):
            members = np.zeros(len(positions), bool)
            members[cell] = True
            yield np.array([x_bounds, y_bounds]), members


def _partition(
    coordinates: np.ndarray, indices: np.ndarray, count: int
) -> Iterator[tuple[tuple[float, float], np.ndarray]]:
    """Divide the indexed coordinates into sorted groups; yield the bounds and the indices of each group."""
    groups = np.array_split(indices[np.argsort(coordinates[indices], kind="stable")], count)
    borders = [(coordinates[low[-1]] + coordinates[high[0]]) / 2 for low, high in pairwise(groups)]
    yield from zip(zip([-np.inf, *borders], [*borders, np.inf], strict=True), groups, strict=True)


def _scene_bounds(outermost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (2, 1) of the scene: the cameras' rectangle (2, 2), enlarged by the margin."""
    margin = CELL_MARGIN * np.ptp(outermost, axis=1)[:, None]
    return outermost[:, :1] - margin, outermost[:, 1:] + margin


def _share_of_image(camera: Camera, ground: np.ndarray, box: np.ndarray) -> float:
    """Return the fraction of a view's image that a box covers, ignoring occlusion; 1 from inside.

    Args:
        box: (3, 2) lower and upper bounds along the ground's axes.
    """
    u, v = ((np.arange(n) + 0.5) / n for n in _RAYS)
    x, y = np.meshgrid(u * camera.width, v * camera.height)
    pixels = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = pixels.reshape(-1, 3) @ camera.world_to_camera[:3, :3] @ ground.T
    origin = ground @ camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (box.T[:, None] - origin) / rays  # along each ray to the two planes of each axis
    first, last = np.nanmin(distances, axis=0).max(axis=1), np.nanmax(distances, axis=0).min(axis=1)
    return float(np.mean((first <= last) & (last > 0)))


def _on_ground(ground: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points.astype(np.float64) @ ground.T


def _within(positions: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    return ((positions[:, :2] >= bounds[:, 0]) & (positions[:, :2] < bounds[:, 1])).all(axis=1)


def _finite(bounds: np.ndarray) -> list[list[float | None]]:
    return [[value if np.isfinite(value) else None for value in axis] for axis in bounds.tolist()]


def _bounds(values: list[list[float | None]]) -> np.ndarray:
    """Return bounds (2, 2) float64; raise ValueError for invalid bounds."""
    (a, b), (c, d) = values
    flat = [-np.inf if a is None else a, np.inf if b is None else b]
    flat += [-np.inf if c is None else c, np.inf if d is None else d]
    bounds = np.array(flat, np.float64).reshape(2, 2)
    if not (bounds[:, 0] < bounds[:, 1]).all():
        raise ValueError("no bounds")
    return bounds


def _damaged_error(path: Path) -> LodgsError:
    return LodgsError(f"Cannot read {path}: it is not a region of a plan.", "Create the plan again.")
