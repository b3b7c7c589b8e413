"""A file of splats without clutter, or in another look: ``lodgs edit``."""

from __future__ import annotations

from pathlib import Path

from ..errors import LodgsError
from ..splats.bundle import DrawableRows, open_bundle, read_folder, write_bundle, write_folder
from ..splats.dialects import Warn, comments_of, silent
from ..splats.ply import write_ply
from .cleaning import Cleaning, cleaned
from .look import Looks, looked_levels
from .selection import known_rule


def edit(source: Path, out: Path, cleaning: Cleaning, warn: Warn = silent, *, looks: Looks = ()) -> str:
    """Writes what a cleaning leaves of a bundle, a folder of levels or any 3DGS PLY, as such a file.

    Of a binary PLY only some rows at a time are in memory.

    Args:
        warn: as for ``read_ply``.
        looks: what is made of the colours and opacities of what stays.

    Returns:
        How many splats of each level stay, as a few lines of text.

    Raises:
        LodgsError: it cannot be read or written, contradicts its rule, or nothing is left.
    """
    if out.resolve() == source.resolve():
        raise LodgsError(f"{out} is what is to be edited.", "Give another name with --out.")
    if source.is_dir():
        bundle = read_folder(source, warn)
    else:
        bundle, rows = open_bundle(source)
        for level in bundle.levels:
            level.elsewhere = DrawableRows(rows[level.number], warn)
    known_rule(bundle)
    found = looked_levels(cleaned(bundle, cleaning), looks)
    if source.is_dir():
        write_folder(out, found)
    elif bundle.method or bundle.rule or len(bundle.levels) > 1:
        write_bundle(out, found)
    else:
        write_ply(out, found.levels[0].rows, comments_of(bundle.meta))
    lines = [
        f"level {before.number}: {len(after.rows):,} of {len(before.rows):,} splats"
        for before, after in zip(bundle.levels, found.levels, strict=True)
    ]
    return "\n".join([*lines, f"{out}: written"])
