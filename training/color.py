"""The sRGB transfer function (IEC 61966-2-1) for values >= 0, extended above 1. numpy only."""

from __future__ import annotations

import numpy as np


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Convert linear light of any shape to display-coded values."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_from_srgb(coded: np.ndarray) -> np.ndarray:
    """Convert display-coded values of any shape to linear light."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
