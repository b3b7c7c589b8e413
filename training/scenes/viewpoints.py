"""Cameras for capturing splats or Blender scenes: on a dome, from above, or along a path. numpy only."""

from __future__ import annotations

import numpy as np

from ..errors import LodgsError
from ..splats.gaussians import Splats
from .cameras import Camera, look_at
from .overview import central_ball

INSIDE = 0.9
"""Fraction of the corners of objects that each dome view contains, and of an area that aerial views cover."""
OPAQUE = 0.5
"""Minimum opacity of the splats that determine the views."""
DOMES = (1.1, 2.2)
"""Radii of the dome's two shells, in multiples of the distance at which the splats fill the image."""
CLOSE = (0.25, 0.5, 1.0)
"""Distances of close views from the splats' surface, in multiples of the diameter of the ball around them."""
CLOSE_SAMPLE, DIRECTIONS = 5000, 64
"""Number of splats and of directions from which the free view of a close camera is found."""
CLOSE_ELEVATIONS = -0.2, 0.9
"""Sines of the lowest and highest elevation of a close camera above its target."""
CONE = 0.1
"""Splats within this fraction of their depth from the axis of a close view hide its target."""
UP = (0.0, -1.0, 0.0)
"""Up direction of most COLMAP worlds."""
NEAR_SHARE = 0.01
"""Near depth as a fraction of the distance to the splats' centre."""
FOCAL = 1.2
"""Focal length of the views, in image heights."""
HEIGHT = 2.0
"""Default height of aerial views above the top, in multiples of their spacing."""
SIDES = ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))
"""Horizontal offsets of aerial views, in multiples of their height: straight down, then from four sides."""
TURNS = (0, 60, -60, 180, 120, -120)
"""Headings of consecutive path views, in degrees from the path's direction; they cover a full turn."""


def surrounding_views(
    points: np.ndarray, count: int, width: int = 960, height: int = 640
) -> tuple[list[Camera], float]:
    """Return views of points (N, 3) float64 without cameras, and their near depth.

    Half of them are on a dome (:func:`dome_views_around`); the others are close to the surface, also inside
    (:func:`close_views`). The up direction is assumed.

    Raises:
        LodgsError: there is no point.
    """
    if not len(points):
        raise _no_splats_error()
    around, near = dome_views_around(central_ball(points), count - count // 2, width, height)
    return around + close_views(points, count // 2, width, height), near


def close_views(points: np.ndarray, count: int, width: int = 960, height: int = 640) -> list[Camera]:
    """Return views that look at points (N, 3) from the distances CLOSE in turn, where few points hide them.

    Of free directions, they take outward and inward ones in turn, so that some are inside rooms. Without
    such views, levels would lose the detail of surfaces that a camera approaches.
    """
    rng = np.random.default_rng(0)
    middle, radius = central_ball(points)
    inner = points[np.linalg.norm(points - middle, axis=1) <= radius]
    sample = inner[rng.choice(len(inner), min(len(inner), CLOSE_SAMPLE), replace=False)]
    up = np.array(UP)
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    number = np.arange(DIRECTIONS)
    low, high = CLOSE_ELEVATIONS
    sine = low + (high - low) * (number + 0.5) / DIRECTIONS
    azimuth = number * 2.399963  # golden angle: an even spiral
    level = np.cos(azimuth)[:, None] * east + np.sin(azimuth)[:, None] * np.cross(up, east)
    directions = sine[:, None] * up + np.sqrt(1 - sine**2)[:, None] * level
    lens, views = _lens(width, height), []
    for number, target in enumerate(sample[rng.integers(len(sample), size=count)]):
        distance = 2 * radius * CLOSE[number % len(CLOSE)]
        offsets = sample - target
        along = offsets @ directions.T
        aside = np.einsum("ij,ij->i", offsets, offsets)[:, None] - along**2
        hides = (along > 0.1 * distance) & (along < 1.1 * distance) & (aside < (CONE * along) ** 2)
        outward = directions @ (target - middle) / radius
        side = 1 if number // len(CLOSE) % 2 == 0 else -1
        direction = directions[(hides.sum(axis=0) - 0.1 * side * outward).argmin()]
        pose = look_at(target + distance * direction, target, UP)
        views.append(Camera(f"close_{number:04d}", *lens, pose))
    return views


def ball_of_corners(corners: np.ndarray) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius of a ball around most corners (N, 3) of objects, N > 0."""
    center = np.median(corners, axis=0)
    return center, max(float(np.quantile(np.linalg.norm(corners - center, axis=1), INSIDE)), 1e-6)


def dome_views_around(
    ball: tuple[np.ndarray, float],
    count: int,
    width: int = 960,
    height: int = 640,
    up: tuple[float, float, float] = UP,
    lowest: float = -1.0,
) -> tuple[list[Camera], float]:
    """Return views of a ball from all directions on two shells, and their near depth.

    Args:
        ball: center (3,) float64 and radius, see ``overview.central_ball`` and :func:`ball_of_corners`.
        up: up direction of the images, along an axis.
        lowest: sine of the dome's lowest elevation: 0 is level, -1 straight below.
    """
    middle, radius = ball
    fill_distance = radius * np.hypot(1, 2 * FOCAL)  # a ball of this radius touches the top and bottom edges
    number = np.arange(count)
    elevation_sine = lowest + (1 - lowest) * (number + 0.5) / count
    azimuth = number * 2.399963  # golden angle: an even spiral
    ring = np.sqrt(1 - elevation_sine**2)
    outward = elevation_sine[:, None] * np.array(up)
    outward[:, np.flatnonzero(np.array(up) == 0)] = np.stack(
        [ring * np.cos(azimuth), ring * np.sin(azimuth)], axis=1
    )
    positions = middle + fill_distance * np.where(number % 2, *DOMES)[:, None] * outward
    lens = _lens(width, height)
    views = [
        Camera(f"dome_{n:04d}", *lens, look_at(position, middle, up)) for n, position in enumerate(positions)
    ]
    return views, NEAR_SHARE * fill_distance


def aerial_views(
    points: np.ndarray, count: int, width: int = 960, height: int = 640, altitude: float = 0.0
) -> tuple[list[Camera], float]:
    """Return evenly spaced views of an area from one height, and their near depth.

    Like a drone's photos, they look straight down and obliquely from four sides in turn.

    Args:
        points: (N, 3) float64 splat means or object corners, z up; the outermost ones are ignored.
        altitude: height above the top; 0 selects HEIGHT times the spacing of the views.

    Raises:
        LodgsError: there is no point, or the points have no horizontal extent.
    """
    if not len(points):
        raise _no_splats_error()
    low, high = np.quantile(points, [(1 - INSIDE) / 2, (1 + INSIDE) / 2], axis=0)
    sides = high[:2] - low[:2]
    if not sides.max() > 0:
        raise LodgsError("Cannot view the area from above: it has no extent.", "Choose a larger area.")
    shape = np.maximum(sides, 1e-3 * sides.max())
    rows = min(max(round(float(np.sqrt(count * shape[1] / shape[0]))), 1), count)
    number = np.arange(count)
    row = number * rows // count
    first, columns = np.searchsorted(row, row), np.bincount(row)[row]
    column = number - first
    fractions = np.stack([(column + 0.5) / columns, (row + 0.5) / rows], axis=1)
    altitude = altitude or HEIGHT * float(max(sides[0] * rows / count, sides[1] / rows))
    targets = np.column_stack([low[:2] + fractions * sides, np.full(count, high[2])])
    side = np.array(SIDES)[(column + 2 * row) % len(SIDES)]  # spreads each kind of view evenly, too
    positions = targets + altitude * np.column_stack([side, np.ones(count)])
    lens = _lens(width, height)
    views = [
        Camera(f"above_{n:04d}", *lens, look_at(position, target, (0.0, 0.0, 1.0)))
        for n, (position, target) in enumerate(zip(positions, targets, strict=True))
    ]
    return views, NEAR_SHARE * altitude


def walk_views(
    splats: Splats, path: np.ndarray, up: np.ndarray, count: int, width: int = 960, height: int = 640
) -> tuple[list[Camera], float]:
    """Return level views along a path that look ahead, to both sides and back in turn, and their near depth.

    Args:
        path: (P, 3) corners in the splats' world.
        up: (3,) up direction of the images in the splats' world.

    Raises:
        LodgsError: see :func:`views_along`, or if there is no opaque splat.
    """
    views = views_along(path, up, count, width, height)
    positions = np.array([view.center for view in views])
    distances = np.linalg.norm(opaque_means(splats) - np.median(positions, axis=0), axis=1)
    return views, NEAR_SHARE * float(np.median(distances))


def views_along(
    path: np.ndarray, up: np.ndarray, count: int, width: int = 960, height: int = 640
) -> list[Camera]:
    """Return the views of :func:`walk_views`, independent of the splats.

    Raises:
        LodgsError: the path has no length or is vertical.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    knots = np.concatenate([[0], np.cumsum(lengths)])
    stations = (np.arange(count) + 0.5) / count * knots[-1]

    def at(stations: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(stations, knots, coordinate) for coordinate in path.T], axis=1)

    step = knots[-1] / count / 2
    positions = at(stations)
    ahead = at(stations + step) - at(stations - step)
    up = up / np.linalg.norm(up)
    level = ahead - (ahead @ up)[:, None] * up
    if not (np.linalg.norm(level, axis=1) > 1e-6 * step).all():
        raise LodgsError(
            "Cannot place views along the path: it has no length or is vertical.", "Choose another curve."
        )
    level /= np.linalg.norm(level, axis=1)[:, None]
    heading = np.radians(np.resize(TURNS, count))[:, None]
    directions = np.cos(heading) * level + np.sin(heading) * np.cross(up, level)
    lens = _lens(width, height)
    return [
        Camera(f"walk_{n:04d}", *lens, look_at(position, position + direction, up))
        for n, (position, direction) in enumerate(zip(positions, directions, strict=True))
    ]


def opaque_means(splats: Splats) -> np.ndarray:
    """Return the means of the opaque splats, (N, 3) float64.

    Raises:
        LodgsError: there is no opaque splat.
    """
    means = splats.means[splats.opacity_logits > np.log(OPAQUE / (1 - OPAQUE))].astype(np.float64)
    if not len(means):
        raise _no_splats_error()
    return means


def _no_splats_error() -> LodgsError:
    return LodgsError("Cannot place views: there is no opaque splat.", "Use custom cameras.")


def _lens(width: int, height: int) -> tuple[int, int, float, float, float, float]:
    return width, height, FOCAL * height, FOCAL * height, width / 2, height / 2
