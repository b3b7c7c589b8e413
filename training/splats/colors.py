"""Colours of points and splats in PLY files of other programs, as 8-bit, 16-bit or float columns."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

_NAMES = ("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")
_MAX_UNIT = 2.0
"""Largest float colour of a file whose colours are relative to 1; bright ones may exceed 1."""


def color_names(columns: Collection[str]) -> tuple[str, str, str] | None:
    """Return the names of the red, green and blue columns, or None."""
    return next((names for names in _NAMES if set(names) <= set(columns)), None)


def full_intensity(columns: Sequence[np.ndarray]) -> float:
    """Return the value of full intensity of the columns (P,) of a file: 1, 255 or 65535.

    The largest value decides, because programs also store colours from 0 to 255 in wider types.
    """
    largest = max((float(np.max(column[np.isfinite(column)], initial=0)) for column in columns), default=0.0)
    if np.issubdtype(columns[0].dtype, np.floating) and largest <= _MAX_UNIT:
        return 1.0
    return 255.0 if largest <= 255 else 65535.0
