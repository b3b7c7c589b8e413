"""A file of splats without clutter, in another look, placed, in other forms: ``lodgs edit``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..lod.selection import check_rule
from ..lod.tree.paging import is_tree
from ..lod.tree.shape import complete_levels
from ..splats.bundle import open_bundle, write_bundle
from ..splats.dialects import Warn, comments_from_meta, ignore, meta_from_comments
from ..splats.file_rows import DrawableRows
from ..splats.formats import (
    PLY,
    SPLAT,
    find_format,
    find_splat_transform,
    write_splats,
    write_streamed_levels,
)
from ..splats.gaussians import SplatRows, Splats
from ..splats.level_folder import read_folder, write_folder
from ..splats.levels import Bundle, Level
from ..splats.ply import write_ply
from ..splats.similarity import Similarity
from .bake_filter import bake_filter
from .cleaning import Cleaning, clean_bundle
from .look import Looks, apply_looks_to_levels
from .placement import transform_bundle, upright_placement


def edit(
    source: Path,
    out: Path | None,
    cleaning: Cleaning,
    warn: Warn = ignore,
    *,
    looks: Looks = (),
    placement: Similarity | None = None,
    upright: bool = False,
    ground: bool = False,
    points: np.ndarray | None = None,
    plain: Sequence[Path] = (),
    folder: Path | None = None,
    streamed: Path | None = None,
    antialiased: bool = False,
) -> str:
    """Writes what a cleaning leaves of a bundle, a folder of levels or any 3DGS PLY, placed elsewhere.

    Of a binary PLY only some rows at a time are in memory.

    Args:
        out: written in the source's form; None: not.
        warn: as for ``read_ply``.
        looks: what is made of the colours and opacities of what stays.
        placement: where the scene is put, after it stands; crops and lengths of the cleaning are those of
            the source.
        upright, ground, points: see ``placing.standing``.
        plain: files of the finest level alone, each the kind that its name asks for.
        folder: receives a folder of levels.
        streamed: folder that receives levels as browsers load them.
        antialiased: ``plain`` and ``streamed`` are for programs that know Mip-Splatting's filter; otherwise
            see :func:`.unfiltered.without_filter`, but for kinds of files that say that it is to be used.

    Returns:
        How many splats of each level stay, as a few lines of text.

    Raises:
        LodgsError: it cannot be read or written, contradicts its rule, or nothing is left.
    """
    for path in (out, *plain, folder, streamed):
        if path is not None and path.resolve() == source.resolve():
            raise LodgsError(f"{path} is what is to be edited.", "Give another name.")
    kinds = {find_format(path) for path in plain}
    if streamed is not None or not kinds <= {PLY, SPLAT}:
        find_splat_transform()  # is missed before minutes of work
    if source.is_dir():
        bundle = read_folder(source, warn)
    else:
        bundle, rows = open_bundle(source)
        for level in bundle.levels:
            level.on_disk = DrawableRows(rows[level.number], warn)
    check_rule(bundle)
    found = apply_looks_to_levels(clean_bundle(bundle, cleaning), looks)
    if placement is not None or upright or ground:
        stands = upright_placement(bundle, upright, ground, points)
        found = transform_bundle(found, stands if placement is None else placement.compose(stands))
        if upright or ground:
            found.meta["up_rotation"] = np.eye(3)
    if out is None:
        pass
    elif source.is_dir():
        write_folder(out, found)
    elif bundle == Bundle("", bundle.levels[:1], meta=meta_from_comments(comments_from_meta(bundle.meta))):
        write_ply(out, found.levels[0].rows, comments_from_meta(bundle.meta))
    else:
        write_bundle(out, found)
    lines = [
        f"level {before.number}: {len(after.rows):,} of {len(before.rows):,} splats"
        for before, after in zip(bundle.levels, found.levels, strict=True)
    ]
    for path in plain:
        form = found if antialiased or find_format(path).antialiased else bake_filter(found)
        run_to_end(write_splats(path, ConcatenatedRows.upto(form, form.levels[-1].number), form.meta))
    if folder is not None or streamed is not None:
        levels = complete_levels(_in_memory(found)) if is_tree(found) else found
        if folder is not None:
            write_folder(folder, levels)
        if streamed is not None:
            run_to_end(write_streamed_levels(streamed, levels if antialiased else bake_filter(levels)))
    paths = [path for path in (out, *plain, folder, streamed) if path is not None]
    return "\n".join([*lines, *(f"{path}: written" for path in paths)])


def run_to_end(work: Iterator[str]) -> None:
    """Waits for what goes on beside."""
    for _ in work:
        pass


@dataclass(frozen=True)
class ConcatenatedRows:
    """Splats of several sets, one after the other, as they are read: where levels add up, a whole scene."""

    sets: Sequence[SplatRows]

    @classmethod
    def upto(cls, bundle: Bundle, number: int) -> ConcatenatedRows:
        """All that is drawn at a level."""
        return cls([level.rows for level in bundle.drawn_levels(number)])

    def __len__(self) -> int:
        return sum(map(len, self.sets))

    def select(self, some: slice | np.ndarray, /) -> Splats:
        """The splats of a range of all rows."""
        assert isinstance(some, slice)
        begin, end, _ = some.indices(len(self))
        parts, first = [], 0
        for rows in self.sets:
            here = slice(max(begin - first, 0), max(min(end - first, len(rows)), 0))
            parts.append(rows.select(here))
            first += len(rows)
        return Splats.concatenated(parts)


def _in_memory(bundle: Bundle) -> Bundle:
    levels = [Level(x.number, x.rows.select(slice(0, len(x.rows))), x.facts) for x in bundle.levels]
    return replace(bundle, levels=levels)
