"""A way along places where photographs were taken, without the steps of who took them. numpy only."""

from __future__ import annotations

import numpy as np

from ..errors import LodgsError

SPREAD = 1.5
"""Standard deviation of the neighbours that count for a place, in photographs."""


def smooth_path(positions: np.ndarray, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses smoothed along their order by a Gaussian, narrower towards both ends, which stay where they are.

    Args:
        positions: (V, 3).
        quats: (V, 4) of length 1; q and -q are one rotation.

    Returns:
        Positions (V, 3) and quats (V, 4), each on the side of the one before; and when to be there (V,), from
        0 to 1, which goes on everywhere alike along the way. float64.

    Raises:
        LodgsError: there are fewer than two, or all are at one place.
    """
    positions, quats = np.asarray(positions, np.float64), np.asarray(quats, np.float64)
    if len(positions) < 2:
        raise LodgsError(f"{len(positions)} view(s) make no way.", "Choose a scene of two views or more.")
    if not np.ptp(positions, axis=0).any():
        raise LodgsError("All views are at one place.", "Turn a camera there by hand.")
    turns = np.where(np.einsum("ij,ij->i", quats[1:], quats[:-1]) < 0, -1.0, 1.0)
    quats = quats * np.cumprod(np.append(1.0, turns))[:, None]
    places = np.arange(len(positions))
    within = np.minimum(places, places[::-1])[:, None]  # as many on either side: straight ways stay straight
    apart = np.abs(places[:, None] - places)
    spread = np.clip(within / 2, 1e-3, SPREAD)
    weights = np.exp(-np.square(apart / spread) / 2) * (apart <= within)
    weights /= weights.sum(axis=1, keepdims=True)
    positions, quats = weights @ positions, weights @ quats
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    times = np.append(0.0, np.cumsum(np.maximum(steps, 1e-6 * steps.sum())))
    return positions, quats, times / times[-1]
