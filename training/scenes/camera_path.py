"""Smooth camera paths through photo positions, without the shake of a hand-held camera. numpy only."""

from __future__ import annotations

import numpy as np

from ..errors import LodgsError

SPREAD = 1.5
"""Standard deviation of the smoothing kernel, in photos."""


def smooth_path(positions: np.ndarray, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth ordered poses with a Gaussian that narrows towards both ends, which stay in place.

    Args:
        positions: (V, 3).
        quats: (V, 4) of length 1; q and -q are the same rotation.

    Returns:
        Positions (V, 3); quats (V, 4), each in the hemisphere of its predecessor; and times (V,) from 0 to 1
        for constant speed along the path. All are float64.

    Raises:
        LodgsError: there are fewer than two poses, or all share one position.
    """
    positions = np.asarray(positions, np.float64)
    quats = np.asarray(quats, np.float64)
    if len(positions) < 2:
        raise LodgsError(
            f"Cannot create a camera path from {len(positions)} view(s).",
            "Choose a scene of at least two views.",
        )
    if not np.ptp(positions, axis=0).any():
        raise LodgsError(
            "Cannot create a camera path: all views share one position.",
            "Animate a camera's rotation instead.",
        )
    signs = np.where(np.einsum("ij,ij->i", quats[1:], quats[:-1]) < 0, -1.0, 1.0)
    quats = quats * np.cumprod(np.append(1.0, signs))[:, None]
    index = np.arange(len(positions))
    radius = np.minimum(index, index[::-1])[:, None]  # symmetric windows keep straight paths straight
    offset = np.abs(index[:, None] - index)
    spread = np.clip(radius / 2, 1e-3, SPREAD)
    weights = np.exp(-np.square(offset / spread) / 2) * (offset <= radius)
    weights /= weights.sum(axis=1, keepdims=True)
    positions = weights @ positions
    quats = weights @ quats
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    times = np.append(0.0, np.cumsum(np.maximum(steps, 1e-6 * steps.sum())))
    return positions, quats, times / times[-1]
