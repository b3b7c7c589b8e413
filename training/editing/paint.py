"""Paint on splats: how much of a colour lies over each one's own, the same from everywhere.

A splat of colour c shows (1 - a) c + p: a is its amount of paint from 0 to 1, and p the paint's display-coded
colour times that amount, so that strokes and means of paint are sums. Colours are linear in their harmonics:
those of every degree fade by 1 - a, and the first takes p up. Looks act on what is painted (``look``).

Paint is four further columns of the splats (COLUMNS), which go wherever they go, until :func:`apply_paint` mixes
it in. numpy only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..splats.gaussians import SH_C0, Splats
from .cleaning import assign_cells, default_gap

COLUMNS = ("paint_red", "paint_green", "paint_blue", "paint_amount")
"""Of the splats: p, then a."""
CELLS = (1 / 8, 1 / 4, 1 / 2, 1, 2, 4)
"""How long cells are in which painted splats are looked for, over ``cleaning.default_gap``."""


def read_paint(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """(N, 4) the paint among columns (N,) by name; None where there is none."""
    if not all(name in columns for name in COLUMNS):
        return None
    return np.stack([columns[name] for name in COLUMNS], axis=1)


def paint_columns(paint: np.ndarray) -> dict[str, np.ndarray]:
    """Paint (N, 4) as columns (N,) by name."""
    return dict(zip(COLUMNS, np.ascontiguousarray(paint.T, np.float32), strict=True))


def blend_paint(paint: np.ndarray, share: np.ndarray, color: tuple[float, float, float] | None) -> np.ndarray:
    """Paint (N, 4) of which shares (N,) in [0, 1] give way to another colour, or if None to no paint."""
    share = share[:, None]
    new = np.zeros(4, np.float32) if color is None else np.array([*color, 1], np.float32)
    return (1 - share) * paint + share * new


def mix_paint(sh: np.ndarray, paint: np.ndarray) -> np.ndarray:
    """Harmonics (N, K, 3) with paint (N, 4) over them."""
    found = sh * (1 - paint[:, 3, None, None])
    found[:, 0] += (paint[:, :3] - 0.5 * paint[:, 3:]) * np.float32(1 / SH_C0)
    return found


def apply_paint(splats: Splats) -> Splats:
    """Splats in the colours that their paint gives them, with no columns of paint any more."""
    paint = read_paint(splats.extras)
    if paint is None:
        return splats
    extras = {name: column for name, column in splats.extras.items() if name not in COLUMNS}
    return replace(splats, sh=mix_paint(splats.sh, paint), extras=extras)


def transfer_paint(paint: np.ndarray, means: np.ndarray, to: np.ndarray) -> np.ndarray:
    """(M, 4) the paint that splats at means ``to`` (M, 3) take over, by their places, from others.

    It is the mean of all that are in the same cell of space, the smallest of CELLS that has any. Who is alone
    in the largest gets none.

    Args:
        paint: (N, 4).
        means: (N, 3) where it is.
    """
    found = np.zeros((len(to), 4), np.float32)
    some = paint[:, 3] > 0
    if not some.any():
        return found
    lengths = default_gap(means) * np.array(CELLS)
    low, high = means[some].min(axis=0) - lengths[-1], means[some].max(axis=0) + lengths[-1]
    near = ((means >= low) & (means <= high)).all(axis=1)
    means, paint = means[near], paint[near]
    left = np.flatnonzero(((to >= low) & (to <= high)).all(axis=1))
    for length in lengths:
        cell, cells = assign_cells(np.concatenate([means, to[left]]), length)
        own, other = cell[: len(means)], cell[len(means) :]
        counts = np.bincount(own, minlength=len(cells))[other]
        sums = np.stack([np.bincount(own, each, len(cells))[other] for each in paint.T], axis=1)
        held = counts > 0
        found[left[held]] = sums[held] / counts[held, None]
        left = left[~held]
    return found
