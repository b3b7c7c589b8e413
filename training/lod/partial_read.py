"""Read only some levels of a bundle, or the splats of a region, by ranges of the file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..splats.bundle import read_bundle, read_header, read_tables
from ..splats.dialects import Warn, ignore
from ..splats.gaussians import Splats
from ..splats.levels import Bundle
from ..splats.ply import extra_columns
from ..splats.ply import splat_columns as columns_in_file
from .blocks import SIZE
from .rule import Region, Rule
from .selection import require_rule, rule_columns

BLOCKS = "blocks"
"""Table of blocks of SIZE rows of a level, in the order of rows: ``level``, and the rule's bit columns, each
combined by OR over the rows of a block."""


def block_table(rule: Rule, levels: dict[int, Splats]) -> dict[str, np.ndarray]:
    """Return the table of blocks of levels by number, for a rule whose float32 columns hold bits."""
    table: dict[str, list[np.ndarray]] = {"level": []}
    for number, splats in levels.items():
        begins = np.arange(0, len(splats), SIZE)
        table["level"].append(np.full(len(begins), number, np.int32))
        for name, column in rule_columns(rule, splats).items():
            bits = np.bitwise_or.reduceat(column.astype(np.int32), begins) if len(begins) else np.zeros(0)
            table.setdefault(name, []).append(bits.astype(np.float32))
    return {name: np.concatenate(parts) for name, parts in table.items()}


def read_header_and_tables(path: str | Path) -> Bundle:
    """Return a bundle with its tables and levels, but without splats.

    Raises:
        LodgsError: as ``read_bundle``.
    """
    return replace(read_header(path), tables=read_tables(path))


def read_part(
    path: str | Path, numbers: Collection[int], region: Region | None = None, warn: Warn = ignore
) -> tuple[Bundle, int]:
    """Read some levels of a bundle, or their splats that are visible in a region.

    Skips blocks without such splats. Splats keep the file's order; other levels are empty.

    Args:
        numbers: of the levels.
        region: None: all splats; also if the file has no table of blocks.
        warn: as for ``read_bundle``.

    Returns:
        The bundle, and the number of bytes read.

    Raises:
        LodgsError: as ``read_bundle``; unknown rule, if there is a region.
    """
    size = 0

    def rows_of(bundle: Bundle) -> dict[int, np.ndarray]:
        nonlocal size
        size = sum(column.nbytes for table in bundle.tables.values() for column in table.values())
        rows = {level.number: np.zeros(0, np.int64) for level in bundle.levels if level.number not in numbers}
        table = bundle.tables.get(BLOCKS)
        if table is None or region is None:
            return rows
        rule = require_rule(bundle)
        zeros = np.zeros(len(table["level"]), np.float32)
        columns = {name: table.get(name, zeros) for name in rule.columns}
        needed = rule.visible_in_region(columns, region)
        for number in numbers:
            blocks = np.flatnonzero(needed[table["level"] == number])
            rows[number] = (blocks[:, None] * SIZE + np.arange(SIZE)).reshape(-1)
        return rows

    bundle = read_bundle(path, warn, rows_of)
    rule = None if region is None or BLOCKS not in bundle.tables else require_rule(bundle)
    for level in bundle.levels:
        columns = columns_in_file(level.splats) | extra_columns(level.splats)
        size += sum(column.dtype.itemsize for column in columns.values()) * len(level.splats)
        if rule is not None and region is not None:
            visible = rule.visible_in_region(rule_columns(rule, level.splats), region)
            level.splats = level.splats.select(visible)
    return bundle, size
