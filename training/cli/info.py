"""What files of splats hold, in words: ``lodgs info``."""

from __future__ import annotations

import json
from pathlib import Path

from ..lod.rule import find_rule
from ..splats.bundle import Bundle, DrawableRows, bounding_box, json_default, open_bundle, read_folder
from ..splats.ply import Element, all_columns


def describe(path: str | Path) -> str:
    """What a bundle, a plain PLY or a folder of levels holds, as a few lines of text.

    Raises:
        LodgsError: as `read_bundle` and `read_folder`.
    """
    warnings: list[str] = []
    if Path(path).is_dir():
        bundle = read_folder(path, warnings.append)
    else:
        bundle, rows = open_bundle(path)
        for level in bundle.levels:
            level.on_disk = DrawableRows(rows[level.number], warnings.append)
    count = len(bundle.levels)
    low, high = (
        ", ".join(f"{x:.4g}" for x in corner)
        for corner in bounding_box([level.rows for level in bundle.levels])
    )
    names = sorted({name for level in bundle.levels for name in level.facts})
    lines = [
        f"{path}: {bundle.method or 'plain 3DGS PLY'}, {count} level{'s'[: count > 1]}, "
        f"{_completeness(bundle)}, SH degree {bundle.levels[0].sh_degree}",
        f"chosen by the rule {bundle.rule}" if bundle.rule else "not made for distances",
        f"bounds  ({low}) to ({high})",
        f"{'level':>5}  {'splats':>10}  {'MB':>8}  {''.join(f'{name:>10}  ' for name in names)}extras",
    ]
    for level in bundle.levels:
        size = Element.of_splats("", [level.rows], all_columns).size / 1e6
        facts = "".join(
            f"{level.facts[name]:>10.6g}  " if name in level.facts else f"{'-':>10}  " for name in names
        )
        extras = ", ".join(level.rows.select(slice(0, 0)).extras) or "-"
        lines.append(f"{level.number:>5}  {len(level.rows):>10,}  {size:>8.2f}  {facts}{extras}")
    for name, table in bundle.tables.items():
        rows_of_table = len(next(iter(table.values()), ()))
        lines.append(f"table {name}: {rows_of_table:,} rows of {', '.join(table)}")
    said = {**bundle.facts, **bundle.controls, **bundle.meta}
    lines += [f"{name}: {json.dumps(value, default=json_default)}" for name, value in said.items()]
    return "\n".join([*lines, *warnings])


def _completeness(bundle: Bundle) -> str:
    rule = find_rule(bundle.rule)
    if rule is not None and not rule.complete and len(bundle.levels) > 1:
        return "the finest complete, coarser ones to choose from"
    return "each adding to the coarser ones" if bundle.cumulative else "each complete"
