"""Quaternions: matrices, and the three smaller components that several formats store. numpy only."""

from __future__ import annotations

from math import sqrt

import numpy as np

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Smaller components of a rotation by its largest one."""


def rotation_matrices(quats: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4)."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return np.stack(rows, axis=-1).reshape(*quats.shape[:-1], 3, 3)


def split_quats(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index (N,) of the largest component of rotations (N, 4) wxyz, and the others (N, 3).

    The others are fractions of their range, from -sqrt(1/2) to sqrt(1/2), in the order w, x, y, z.
    """
    unit = quats / np.maximum(np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True), 1e-30)
    largest = np.abs(unit).argmax(axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    smaller = unit[rows[:, None], _OTHERS[largest]]
    return largest, (smaller / sqrt(2) + 0.5).clip(0, 1)


def join_quats(largest: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Return the rotations (N, 4) wxyz float32 that :func:`split_quats` split."""
    smaller = (fractions - 0.5) * sqrt(2)
    quats = np.empty((len(fractions), 4), np.float32)
    rows = np.arange(len(quats))
    quats[rows[:, None], _OTHERS[largest]] = smaller
    quats[rows, largest] = np.sqrt((1 - (smaller**2).sum(axis=1)).clip(0))
    return quats
