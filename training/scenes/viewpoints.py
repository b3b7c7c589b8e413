"""Where to look at splats from that no photograph shows: all around, above, or along a way. numpy only."""

from __future__ import annotations

import numpy as np

from ..errors import LodgsError
from ..splats.gaussians import Splats
from .cameras import Camera, look_at

INSIDE = 0.9
"""The share of opaque splats that a dome is to show whole."""
OPAQUE = 0.5
DOMES = (1.1, 2.2)
"""Radii of a dome's two shells, in multiples of the distance from which the splats fill the picture."""
UP = (0.0, -1.0, 0.0)
"""As in most COLMAP worlds."""
NEAR_SHARE = 0.01
"""Depth at which drawing begins, as a share of the distance to the splats' middle."""
FOCAL = 1.2
"""Focal length of the views, in heights of their picture."""
HEIGHT = 2.0
"""Height of views above an area, in multiples of how far they are apart."""
SIDES = ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))
"""From where views above an area look at it, in turn, in heights: straight down, and from four sides."""
TURNS = (0, 60, -60, 180, 120, -120)
"""Where views along a way look, one after the other, in degrees from ahead: together all around."""


def dome_views(splats: Splats, count: int, width: int = 960, height: int = 640) -> tuple[list[Camera], float]:
    """Views of splats from all around, on two shells, and the depth at which drawing begins.

    Which way is up, and whether splats are to be seen from inside, they do not say: for a room or a street
    give a way to walk, or cameras of your own.

    Raises:
        LodgsError: there is no opaque splat to look at.
    """
    return dome_views_around(opaque_means(splats), count, width, height)


def dome_views_around(
    places: np.ndarray,
    count: int,
    width: int = 960,
    height: int = 640,
    up: tuple[float, float, float] = UP,
    lowest: float = -1.0,
) -> tuple[list[Camera], float]:
    """As :func:`dome_views`, of places (N, 3) float64: of opaque splats or some of them, or of a thing's corners.

    Args:
        up: what is up in the pictures, along an axis.
        lowest: sine of the elevation at which the dome begins: 0 on the level, -1 straight below.

    Raises:
        LodgsError: there are none.
    """
    if not len(places):
        raise _nothing()
    middle = np.median(places, axis=0)
    radius = max(float(np.quantile(np.linalg.norm(places - middle, axis=1), INSIDE)), 1e-6)
    fills = radius * np.hypot(1, 2 * FOCAL)  # a ball of that radius meets the upper and lower edge
    number = np.arange(count)
    sine, turn = lowest + (1 - lowest) * (number + 0.5) / count, number * 2.399963  # evenly, along a spiral
    ring = np.sqrt(1 - sine**2)
    away = sine[:, None] * np.array(up)
    away[:, np.flatnonzero(np.array(up) == 0)] = np.stack([ring * np.cos(turn), ring * np.sin(turn)], axis=1)
    eyes = middle + fills * np.where(number % 2, *DOMES)[:, None] * away
    lens = _lens(width, height)
    views = [Camera(f"dome_{n:04d}", *lens, look_at(eye, middle, up)) for n, eye in enumerate(eyes)]
    return views, NEAR_SHARE * fills


def aerial_views(
    places: np.ndarray, count: int, width: int = 960, height: int = 640, raised: float = 0.0
) -> tuple[list[Camera], float]:
    """Views of an area as a drone takes them: at one height, evenly spread, straight down and from four sides
    in turn; and the depth at which drawing begins.

    Args:
        places: (N, 3) float64 of splats, or of things' corners, z up. The few outermost do not count.
        raised: how far the views are above the top; 0 for HEIGHT times as far as they are apart.

    Raises:
        LodgsError: there are none, or they have no extent on the ground.
    """
    if not len(places):
        raise _nothing()
    low, high = np.quantile(places, [(1 - INSIDE) / 2, (1 + INSIDE) / 2], axis=0)
    sides = high[:2] - low[:2]
    if not sides.max() > 0:
        raise LodgsError("What is to be seen from above has no extent.", "Choose something larger.")
    shape = np.maximum(sides, 1e-3 * sides.max())
    rows = min(max(round(float(np.sqrt(count * shape[1] / shape[0]))), 1), count)
    number = np.arange(count)
    row = number * rows // count
    first, many = np.searchsorted(row, row), np.bincount(row)[row]
    column = number - first
    across = np.stack([(column + 0.5) / many, (row + 0.5) / rows], axis=1)
    raised = raised or HEIGHT * float(max(sides[0] * rows / count, sides[1] / rows))
    targets = np.column_stack([low[:2] + across * sides, np.full(count, high[2])])
    side = np.array(SIDES)[(column + 2 * row) % len(SIDES)]  # each kind evenly spread, too
    eyes = targets + raised * np.column_stack([side, np.ones(count)])
    lens = _lens(width, height)
    views = [
        Camera(f"above_{n:04d}", *lens, look_at(eye, target, (0.0, 0.0, 1.0)))
        for n, (eye, target) in enumerate(zip(eyes, targets, strict=True))
    ]
    return views, NEAR_SHARE * raised


def walk_views(
    splats: Splats, way: np.ndarray, up: np.ndarray, count: int, width: int = 960, height: int = 640
) -> tuple[list[Camera], float]:
    """Views evenly along a way, level, that look ahead, to both sides and back in turn.

    Args:
        way: (P, 3) its corners, in the splats' world.
        up: (3,) what is up in the pictures, in the splats' world.

    Returns:
        The views and, as for a dome, the depth at which drawing begins.

    Raises:
        LodgsError: as :func:`views_along`, or there is no opaque splat to look at.
    """
    views = views_along(way, up, count, width, height)
    eyes = np.array([view.center for view in views])
    away = np.linalg.norm(opaque_means(splats) - np.median(eyes, axis=0), axis=1)
    return views, NEAR_SHARE * float(np.median(away))


def views_along(
    way: np.ndarray, up: np.ndarray, count: int, width: int = 960, height: int = 640
) -> list[Camera]:
    """The views of :func:`walk_views`, whatever there is to see.

    Raises:
        LodgsError: the way has no length or leads straight up.
    """
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
    reached = np.concatenate([[0], np.cumsum(lengths)])
    places = (np.arange(count) + 0.5) / count * reached[-1]

    def at(places: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(places, reached, coordinate) for coordinate in way.T], axis=1)

    pause = reached[-1] / count / 2
    eyes, ahead = at(places), at(places + pause) - at(places - pause)
    up = up / np.linalg.norm(up)
    level = ahead - (ahead @ up)[:, None] * up
    if not (np.linalg.norm(level, axis=1) > 1e-6 * pause).all():
        raise LodgsError("The way to walk has no length, or leads straight up.", "Choose another curve.")
    level /= np.linalg.norm(level, axis=1)[:, None]
    turn = np.radians(np.resize(TURNS, count))[:, None]
    looks = np.cos(turn) * level + np.sin(turn) * np.cross(up, level)
    lens = _lens(width, height)
    return [
        Camera(f"walk_{n:04d}", *lens, look_at(eye, eye + look, up))
        for n, (eye, look) in enumerate(zip(eyes, looks, strict=True))
    ]


def opaque_means(splats: Splats) -> np.ndarray:
    """Where opaque splats are, (N, 3) float64.

    Raises:
        LodgsError: there are none.
    """
    means = splats.means[splats.opacity_logits > np.log(OPAQUE / (1 - OPAQUE))].astype(np.float64)
    if not len(means):
        raise _nothing()
    return means


def _nothing() -> LodgsError:
    return LodgsError("There is no opaque splat to look at.", "Give cameras of your own.")


def _lens(width: int, height: int) -> tuple[int, int, float, float, float, float]:
    return width, height, FOCAL * height, FOCAL * height, width / 2, height / 2
