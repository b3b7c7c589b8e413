"""Local origins: float64 offsets that keep coordinates far from 0 precise in float32.

A scene in UTM or ECEF coordinates lies 10⁵ to 10⁷ units from 0, where float32 numbers are up to 0.5 apart.
Training, bundles and Blender therefore subtract a local origin. It is (0, 0, 0) for other scenes, whose
coordinates stay the same bit by bit.
"""

from __future__ import annotations

import numpy as np

from .dialects import MAX_COORDINATE

FAR_SCENE, FAR_SPLATS = 100.0, 1000.0
"""Minimum distances from 0 of scenes and of third-party splats with a local origin, in their own sizes.

Splats need a larger one: an object that was cut out of a scene should stay at its place.
"""
NO_ORIGIN = np.zeros(3)
ORIGIN_SAMPLE = 50_000
"""Approximate maximum number of positions that determine an origin."""


def choose_origin(
    positions: np.ndarray, points: np.ndarray | None = None, far: float = FAR_SCENE
) -> np.ndarray:
    """Return the local origin for positions, (3,) float64; zeros unless they are far from 0.

    It is the median position, rounded to a power of ten that exceeds the size of the scene. The size is the
    median distance from the median position.

    Args:
        positions: (N, 3) positions of the cameras, or means of splats.
        points: (P, 3) further positions that count for the size.
        far: minimum distance from 0, in multiples of the size.
    """
    positions, *point_sets = [_sample(values) for values in (positions, points) if values is not None]
    if not len(positions):
        return NO_ORIGIN
    middle = np.median(positions, axis=0)
    distances = [np.median(np.linalg.norm(s - middle, axis=1)) for s in (positions, *point_sets) if len(s)]
    size, distance = float(max(distances)), float(np.linalg.norm(middle))
    if not max(far * size, 1e-30) < distance < 1e12 * size:
        return NO_ORIGIN
    step = 10.0 ** np.ceil(np.log10(4 * size))
    return np.round(middle / step) * step + 0.0  # no negative zeros


def describe_origin(origin: np.ndarray) -> str:
    """Return a sentence about a local origin; "" if it is zero."""
    if not np.any(origin):
        return ""
    return f"Coordinates are relative to the local origin ({', '.join(map(format_number, origin))})."


def format_number(value: float) -> str:
    """Return the shortest text of a number that restores it exactly, without a fraction of zero."""
    return repr(float(value)).removesuffix(".0")


def _sample(positions: np.ndarray) -> np.ndarray:
    """Return at most about ORIGIN_SAMPLE evenly spaced valid positions (S, 3) float64."""
    sample = np.asarray(positions[:: max(1, len(positions) // ORIGIN_SAMPLE)], np.float64).reshape(-1, 3)
    return sample[(np.abs(sample) <= MAX_COORDINATE).all(axis=1)]
