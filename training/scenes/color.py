"""The sRGB transfer function (IEC 61966-2-1) of values from 0 on, continued above 1. numpy only."""

from __future__ import annotations

import numpy as np


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Display-coded values of linear light."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_from_srgb(coded: np.ndarray) -> np.ndarray:
    """Linear light of display-coded values."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
