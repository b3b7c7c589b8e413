"""``lodgs info``: describe the splats of a file or a run."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ..lod.selection import standalone_levels
from ..runs.folder import find_splats
from ..splats.bundle import open_bundle
from ..splats.bundle_header import json_default
from ..splats.coding import CodedRows
from ..splats.file_rows import DrawableRows, FileRows
from ..splats.level_folder import read_folder
from ..splats.levels import Bundle, bounding_box
from ..splats.ply import Element, all_columns
from .options import SOURCE_HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, help=SOURCE_HELP)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..splats.formats import open_as_ply

    file = find_splats(options.file)
    with open_as_ply(file) as path:
        print(describe(path).replace(str(path), str(file)))
    return 0


def describe(path: str | Path) -> str:
    """Return a few lines of text about a bundle, a plain PLY or a folder of levels.

    Raises:
        LodgsError: as `read_bundle` and `read_folder`.
    """
    warnings: list[str] = []
    rows: dict[int, FileRows] = {}
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
        f"{path}: {bundle.method or 'plain splats'}, {count} level{'s'[: count > 1]}, "
        f"{_completeness(bundle)}, SH degree {bundle.levels[0].sh_degree}",
        f"levels selected by the rule {bundle.rule}" if bundle.rule else "no selection by camera distance",
        f"bounds  ({low}) to ({high})",
        f"{'level':>5}  {'splats':>10}  {'MB':>8}  {''.join(f'{name:>10}  ' for name in names)}extras",
    ]
    for level in bundle.levels:
        size = Element.from_splats("", [level.rows], all_columns).size / 1e6
        if level.number in rows:
            size = rows[level.number].row_size * len(level.rows) / 1e6
        facts = "".join(
            f"{level.facts[name]:>10.6g}  " if name in level.facts else f"{'-':>10}  " for name in names
        )
        extras = ", ".join(level.rows.select(slice(0, 0)).extras) or "-"
        lines.append(f"{level.number:>5}  {len(level.rows):>10,}  {size:>8.2f}  {facts}{extras}")
    if compressed := [part.vertices for part in rows.values() if isinstance(part.vertices, CodedRows)]:
        lines.append(f"compressed: {compressed[0].description}")
    for name, table in bundle.tables.items():
        row_count = len(next(iter(table.values()), ()))
        lines.append(f"table {name}: {row_count:,} rows of {', '.join(table)}")
    header = {**bundle.facts, **bundle.controls, **bundle.meta}
    lines += [f"{name}: {json.dumps(value, default=json_default)}" for name, value in header.items()]
    return "\n".join([*lines, *warnings])


def _completeness(bundle: Bundle) -> str:
    if len(standalone_levels(bundle)) < len(bundle.levels):
        return "only the finest complete"
    return "each level adds to the coarser ones" if bundle.cumulative else "each level complete"
