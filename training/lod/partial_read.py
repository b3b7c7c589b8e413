"""Of a bundle larger than what is wanted of it: the part that a region can show, by ranges of the file."""

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
"""The table of blocks, SIZE rows of a level each, in the order of their rows: ``level``, and the rule's
columns of bits, those of all rows of the block together."""


def block_table(rule: Rule, levels: dict[int, Splats]) -> dict[str, np.ndarray]:
    """The table for levels by number, of a rule whose columns are whole numbers of bits, float32."""
    table: dict[str, list[np.ndarray]] = {"level": []}
    for number, splats in levels.items():
        begins = np.arange(0, len(splats), SIZE)
        table["level"].append(np.full(len(begins), number, np.int32))
        for name, column in rule_columns(rule, splats).items():
            bits = np.bitwise_or.reduceat(column.astype(np.int32), begins) if len(begins) else np.zeros(0)
            table.setdefault(name, []).append(bits.astype(np.float32))
    return {name: np.concatenate(parts) for name, parts in table.items()}


def read_header_and_tables(path: str | Path) -> Bundle:
    """What a bundle says of its levels, which are without splats, with its tables.

    Raises:
        LodgsError: as ``read_bundle``.
    """
    return replace(read_header(path), tables=read_tables(path))


def read_part(
    path: str | Path, numbers: Collection[int], region: Region | None = None, warn: Warn = ignore
) -> tuple[Bundle, int]:
    """Some levels of a bundle, or what eyes in a region may be shown of them; and how many bytes were read.

    Blocks that have none of these are not read. Splats are in the file's order; the other levels have none.

    Args:
        numbers: of the levels.
        region: None, or where the file has no table of blocks: everywhere.
        warn: as for ``read_bundle``.

    Raises:
        LodgsError: as ``read_bundle``; or, for a region, the rule of its levels is not known here.
    """
    size = 0

    def rows_of(bundle: Bundle) -> dict[int, np.ndarray]:
        nonlocal size
        size = sum(column.nbytes for table in bundle.tables.values() for column in table.values())
        found = {
            level.number: np.zeros(0, np.int64) for level in bundle.levels if level.number not in numbers
        }
        table = bundle.tables.get(BLOCKS)
        if table is None or region is None:
            return found
        rule = require_rule(bundle)
        nothing = np.zeros(len(table["level"]), np.float32)
        needed = rule.visible_in_region({name: table.get(name, nothing) for name in rule.columns}, region)
        for number in numbers:
            blocks = np.flatnonzero(needed[table["level"] == number])
            found[number] = (blocks[:, None] * SIZE + np.arange(SIZE)).reshape(-1)
        return found

    bundle = read_bundle(path, warn, rows_of)
    rule = None if region is None or BLOCKS not in bundle.tables else require_rule(bundle)
    for level in bundle.levels:
        columns = columns_in_file(level.splats) | extra_columns(level.splats)
        size += sum(column.dtype.itemsize for column in columns.values()) * len(level.splats)
        if rule is not None and region is not None:
            level.splats = level.splats.select(rule.visible_in_region(rule_columns(rule, level.splats), region))
    return bundle, size
