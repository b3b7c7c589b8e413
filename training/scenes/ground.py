"""Ground planes: a plane through given points, or the plane that most of a scene stands on. numpy only."""

from __future__ import annotations

import numpy as np

from ..errors import LodgsError
from ..splats.similarity import Similarity

MIN_FLATNESS = 1e-3
"""Points whose width is below this fraction of their length count as a line."""
MAX_SLOPE = 40.0
"""Maximum angle between a ground plane and the horizontal, in degrees."""
TRIES, BATCH = 2000, 100
"""Number of candidate planes, each through three points, and number of planes evaluated at a time."""
MAX_POINTS = 20_000
"""Maximum number of points used; larger sets are sampled at random."""
THICKNESSES = 0.005, 0.01, 0.015, 0.02
"""Maximum distances of a plane's points from the plane, as fractions of the scene's size, from first to last
try: the ground of splats is rougher than that of triangulated points."""
BELOW_WEIGHT = 2.0
"""Number of points on the plane that one point below it cancels."""
NEAR_DEPTHS, MIN_NEAR_POINTS = 1.5, 100
"""Search radius around the cameras in median depths, and the number of points that it must contain."""
MIN_SHARE = 0.02
"""Minimum score of a ground plane of the first thickness, as a fraction of the points. It grows with the
thickness, as the share of the lowest part of a ball does."""


def fit_plane(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane to points (P, 3) by least squares of the distances.

    Args:
        up: (3,) direction that determines the side of the normal.

    Returns:
        The unit normal (3,) and the points' centroid (3,), which is on the plane; float64.

    Raises:
        LodgsError: there are fewer than three points, or they are on a line.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    if len(points) < 3:
        raise LodgsError(
            f"Cannot fit a ground plane: it needs three selected points or more, not {len(points)}.",
            "Select points of the ground in Edit Mode, or empties on it.",
        )
    middle = points.mean(axis=0)
    squares = (points - middle).T @ (points - middle)
    values, vectors = np.linalg.eigh(squares)
    if values[1] <= MIN_FLATNESS**2 * values[2] or values[2] <= 0:
        raise LodgsError(
            "Cannot fit a ground plane: the selected points are on a line.",
            "Select points off the line, too.",
        )
    normal = vectors[:, 0]
    return normal * (-1.0 if normal @ up < 0 else 1.0), middle


def find_ground(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the ground plane of a scene: about level, with many points on it and few below it.

    Use random sample consensus (Fischler and Bolles 1981) with a fixed seed, then fit the plane to its
    points. The score is the number of points on the plane minus BELOW_WEIGHT times the number of points below
    it. Points far outside the scene are ignored.

    Args:
        points: (P, 3), such as the scene's points or the means of its splats.
        up: (3,) approximate up direction.

    Returns:
        As :func:`fit_plane`.

    Raises:
        LodgsError: no plane reaches the minimum score.
    """
    for thickness in THICKNESSES:
        if (ground := ground_plane(points, up, thickness=thickness)) is not None:
            return ground[:2]
    raise LodgsError(
        "Cannot find the ground: no plane lies under this scene.",
        "Select points of the ground in Edit Mode, or empties on it.",
    )


def ground_plane(
    points: np.ndarray, up: np.ndarray, max_slope: float = MAX_SLOPE, thickness: float = THICKNESSES[0]
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return normal, point and score of the ground plane, see :func:`find_ground`; None without one.

    The unit normal (3,) points up. The score is a fraction of the points, at least MIN_SHARE.

    Args:
        points: (N, 3).
        up: (3,) approximate up direction, of any length.
        max_slope: maximum angle between the plane and the horizontal, in degrees.
        thickness: one of THICKNESSES.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    rng = np.random.default_rng(0)
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    if len(points) > MAX_POINTS:
        points = points[rng.choice(len(points), MAX_POINTS, replace=False)]
    if len(points) < 3:
        return None
    low, high = np.percentile(points, (5, 95), axis=0)
    reach = high - low
    points = points[((points >= low - reach) & (points <= high + reach)).all(axis=1)]
    best = None
    best_score = MIN_SHARE * thickness / THICKNESSES[0] * len(points)
    thickness *= float(np.linalg.norm(reach))
    for _ in range(TRIES // BATCH):
        a, b, c = points[rng.integers(len(points), size=(3, BATCH))]
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        normals = normals / np.maximum(lengths, 1e-300)[:, None]
        normals *= np.where(normals @ up < 0, -1, 1)[:, None]
        level = (normals @ up > np.cos(np.radians(max_slope))) & (lengths > 0)
        normals, origins = normals[level], a[level]
        heights = normals @ points.T - (normals * origins).sum(axis=1)[:, None]
        on_plane = (np.abs(heights) <= thickness).sum(axis=1)
        scores = on_plane - BELOW_WEIGHT * (heights < -thickness).sum(axis=1)
        if len(scores) and scores.max() > best_score:
            best_score = scores.max()
            best = normals[scores.argmax()], origins[scores.argmax()]
    if best is None:
        return None
    normal, middle = best
    for _ in range(5):
        on_plane = np.abs((points - middle) @ normal) <= thickness
        normal, middle = fit_plane(points[on_plane], up)
    return normal, middle, float(best_score / len(points))


def points_near_cameras(points: np.ndarray, center: np.ndarray, depth: float) -> np.ndarray:
    """Return the points (P, 3) close enough to the cameras to search for the ground: distant terrain rises.

    Args:
        center: (3,) mean camera position.
        depth: median depth of the cameras; 0 if unknown, which returns all points.
    """
    near = points[np.linalg.norm(points - center, axis=1) < NEAR_DEPTHS * depth]
    return near if len(near) > MIN_NEAR_POINTS else points


def ground_placement(normal: np.ndarray, middle: np.ndarray) -> Similarity:
    """Return the transform that moves a plane to z = 0 with its normal (3,) up.

    It uses the smallest rotation about the plane's point (3,) and a vertical translation.
    """
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(normal, z)
    cosine = float(normal @ z)
    if cosine < -1 + 1e-12:  # the axis of a half turn is arbitrary
        rotation = np.diag([1.0, -1.0, -1.0])
    else:
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        rotation = np.eye(3) + cross + cross @ cross / (1 + cosine)
    return Similarity(rotation, 1.0, middle * (1, 1, 0) - rotation @ middle)


def scaling_about(point: np.ndarray, scale: float) -> Similarity:
    """Return the transform that scales about a fixed point (3,)."""
    point = np.asarray(point, np.float64)
    return Similarity(np.eye(3), scale, point - scale * point)
