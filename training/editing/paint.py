"""Paint on splats: a colour over each splat's own, the same from all directions.

A splat of colour c and paint amount a shows (1 - a) c + p, where p is the paint's display-coded colour times
a, so that strokes and averages of paint are sums. Colours are linear in their harmonics: all degrees are
scaled by 1 - a, and p is added to degree 0. Looks (``look``) apply to the painted colour.

Paint is stored in four extra columns (COLUMNS), which every file keeps, until :func:`apply_paint` mixes them
in. numpy only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..splats.gaussians import SH_C0, Splats
from .cleaning import assign_cells, default_gap

COLUMNS = ("paint_red", "paint_green", "paint_blue", "paint_amount")
"""Columns of splats: p, then a."""
CELLS = (1 / 8, 1 / 4, 1 / 2, 1, 2, 4)
"""Cell sizes for the search of painted splats, as multiples of ``cleaning.default_gap``."""


def read_paint(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the paint (N, 4) from columns (N,) by name; None without paint."""
    if not all(name in columns for name in COLUMNS):
        return None
    return np.stack([columns[name] for name in COLUMNS], axis=1)


def paint_columns(paint: np.ndarray) -> dict[str, np.ndarray]:
    """Return paint (N, 4) as columns (N,) by name."""
    return dict(zip(COLUMNS, np.ascontiguousarray(paint.T, np.float32), strict=True))


def blend_paint(paint: np.ndarray, share: np.ndarray, color: tuple[float, float, float] | None) -> np.ndarray:
    """Replace fractions (N,) in [0, 1] of paint (N, 4) with another colour, or with no paint if None."""
    share = share[:, None]
    new = np.zeros(4, np.float32) if color is None else np.array([*color, 1], np.float32)
    return (1 - share) * paint + share * new


def mix_paint(sh: np.ndarray, paint: np.ndarray) -> np.ndarray:
    """Return harmonics (N, K, 3) with paint (N, 4) mixed in."""
    mixed = sh * (1 - paint[:, 3, None, None])
    mixed[:, 0] += (paint[:, :3] - 0.5 * paint[:, 3:]) * np.float32(1 / SH_C0)
    return mixed


def apply_paint(splats: Splats) -> Splats:
    """Return splats with paint mixed into their colours, without paint columns."""
    paint = read_paint(splats.extras)
    if paint is None:
        return splats
    extras = {name: column for name, column in splats.extras.items() if name not in COLUMNS}
    return replace(splats, sh=mix_paint(splats.sh, paint), extras=extras)


def transfer_paint(paint: np.ndarray, means: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return paint (M, 4) for splats at ``targets`` (M, 3), averaged from painted splats near them.

    Each target takes the mean paint of all splats in its cell, with the smallest of CELLS that has any splat.
    Targets without a splat in the largest cell get no paint.

    Args:
        paint: (N, 4).
        means: (N, 3) of the splats with this paint.
    """
    result = np.zeros((len(targets), 4), np.float32)
    painted = paint[:, 3] > 0
    if not painted.any():
        return result
    lengths = default_gap(means) * np.array(CELLS)
    low, high = means[painted].min(axis=0) - lengths[-1], means[painted].max(axis=0) + lengths[-1]
    near = ((means >= low) & (means <= high)).all(axis=1)
    means, paint = means[near], paint[near]
    pending = np.flatnonzero(((targets >= low) & (targets <= high)).all(axis=1))
    for length in lengths:
        cell, cells = assign_cells(np.concatenate([means, targets[pending]]), length)
        source_cell, target_cell = cell[: len(means)], cell[len(means) :]
        counts = np.bincount(source_cell, minlength=len(cells))[target_cell]
        sums = np.stack(
            [np.bincount(source_cell, channel, len(cells))[target_cell] for channel in paint.T], axis=1
        )
        has_paint = counts > 0
        result[pending[has_paint]] = sums[has_paint] / counts[has_paint, None]
        pending = pending[~has_paint]
    return result
