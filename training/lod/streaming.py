"""Of a bundle larger than what is wanted of it: the part that a region can show, by ranges of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..splats.bundle import Bundle, read_bundle
from ..splats.gaussians import Splats
from ..splats.ply import columns_of as columns_in_file
from ..splats.ply import columns_of_extras
from .blocks import SIZE
from .rule import Region, Rule
from .selection import columns_of, rule_of

BLOCKS = "blocks"
"""The table of blocks, SIZE rows of a level each, in the order of their rows: ``level``, and the rule's
columns of bits, those of all rows of the block together."""


def table_of_blocks(rule: Rule, levels: dict[int, Splats]) -> dict[str, np.ndarray]:
    """The table for levels by number, of a rule whose columns are whole numbers of bits, float32."""
    table: dict[str, list[np.ndarray]] = {"level": []}
    for number, splats in levels.items():
        begins = np.arange(0, len(splats), SIZE)
        table["level"].append(np.full(len(begins), number, np.int32))
        for name, column in columns_of(rule, splats).items():
            bits = np.bitwise_or.reduceat(column.astype(np.int32), begins) if len(begins) else np.zeros(0)
            table.setdefault(name, []).append(bits.astype(np.float32))
    return {name: np.concatenate(parts) for name, parts in table.items()}


def read_region(path: str | Path, region: Region) -> tuple[Bundle, int]:
    """The splats of a bundle that eyes in a region may be shown, in its order, and how many bytes were read.

    Blocks that have none of these are not read; of a file without a table of blocks everything is.

    Raises:
        LodgsError: as ``read_bundle``, its levels are not made for distances, or its rule is not known here.
    """
    size = 0

    def rows_of(bundle: Bundle) -> dict[int, np.ndarray]:
        nonlocal size
        size = sum(column.nbytes for table in bundle.tables.values() for column in table.values())
        table = bundle.tables.get(BLOCKS)
        if table is None:
            return {}
        rule, found = rule_of(bundle), {}
        nothing = np.zeros(len(table["level"]), np.float32)
        needed = rule.loaded({name: table.get(name, nothing) for name in rule.columns}, region)
        for level in bundle.levels:
            blocks = np.flatnonzero(needed[table["level"] == level.number])
            found[level.number] = (blocks[:, None] * SIZE + np.arange(SIZE)).reshape(-1)
        return found

    bundle = read_bundle(path, rows_of=rows_of)
    rule = rule_of(bundle)
    for level in bundle.levels:
        columns = columns_in_file(level.splats) | columns_of_extras(level.splats)
        size += sum(column.dtype.itemsize for column in columns.values()) * len(level.splats)
        level.splats = level.splats.select(rule.loaded(columns_of(rule, level.splats), region))
    return bundle, size
