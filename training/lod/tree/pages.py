"""Order of a tree's splats in a file, and the bounds of its pages. numpy only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..blocks import SIZE, morton_codes
from ..rules.cut import PARENT, PARENT_SIZE

BOUNDS = tuple(f"{end}_{axis}" for end in ("low", "high") for axis in "xyz")
"""Columns of the table of blocks with the bounds of the parents' positions."""
Columns = Mapping[str, np.ndarray]


def streaming_order(columns: Columns) -> np.ndarray:
    """Return the order (N,) int64 of a level's splats in a file.

    Splats are sorted by octave of the parent's size, largest first, then by space. The parent determines
    where a splat is needed, so that pages have similar sizes and positions, and siblings are adjacent.

    Args:
        columns: of the rule, (N,) each.
    """
    codes = morton_codes(np.stack([columns[name] for name in PARENT], axis=1))
    octaves = -np.floor(np.log2(np.maximum(columns[PARENT_SIZE], 1e-30)))
    return np.lexsort((codes, octaves.astype(np.int16)))


def page_table(columns: Mapping[int, Columns]) -> dict[str, np.ndarray]:
    """Return the table ``blocks`` of a tree.

    For each page of SIZE rows: ``level``, maximum ``parent_size``, and BOUNDS of the parents' positions.

    Args:
        columns: of the rule, (N,) each, by level number.
    """
    parts = [parent_bounds(number, level_columns) for number, level_columns in columns.items()]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def parent_bounds(number: int, columns: Columns) -> dict[str, np.ndarray]:
    """Return the rows of the table of pages for one level."""
    begins = np.arange(0, len(columns[PARENT_SIZE]), SIZE)
    table = {"level": np.full(len(begins), number, np.int32)}
    table[PARENT_SIZE] = np.maximum.reduceat(columns[PARENT_SIZE], begins)
    named = [(f"{end}_{name[-1]}", name) for end in ("low", "high") for name in PARENT]
    extremes = [np.minimum] * 3 + [np.maximum] * 3
    for (bound, name), extreme in zip(named, extremes, strict=True):
        table[bound] = extreme.reduceat(columns[name], begins)
    return table
