"""Edit a file of splats: clean-up, looks, placement and export, for ``lodgs edit``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..lod.rule import resolve_rule
from ..lod.selection import check_rule
from ..splats.bundle import open_bundle, write_bundle
from ..splats.dialects import Warn, comments_from_meta, ignore, meta_from_comments
from ..splats.file_rows import DrawableRows
from ..splats.formats import MAIN_FILES, find_format, find_level_format
from ..splats.level_folder import read_folder, write_folder
from ..splats.levels import Bundle
from ..splats.origin import describe_origin
from ..splats.ply import write_ply
from ..splats.similarity import Similarity
from ..splats.sog import load_packages
from ..splats.streamed_levels import MeasureLeaf, write_streamed_levels
from .bake_filter import bake_filter
from .cleaning import NO_CLEANING, Cleaning, clean_bundle
from .export import DEFAULT_OPTIONS, FileOptions, export_finest_level, export_levels, export_tiles
from .look import LimitedLooks, apply_looks_to_levels
from .placement import transform_bundle, upright_placement


@dataclass(frozen=True)
class Outputs:
    """Files and folders to write.

    Attributes:
        out: result in the format of the source.
        plain, levels: files for the finest level only, and for all levels, in the formats of their names.
        folder, streamed, tiles: folders for a PLY of each level, for levels that browsers stream, and for 3D
            Tiles.
    """

    out: Path | None = None
    plain: Sequence[Path] = ()
    levels: Sequence[Path] = ()
    folder: Path | None = None
    streamed: Path | None = None
    tiles: Path | None = None

    @property
    def paths(self) -> list[Path]:
        """All of them."""
        paths = (self.out, *self.plain, *self.levels, self.folder, self.streamed, self.tiles)
        return [path for path in paths if path is not None]


def edit(
    source: Path,
    outputs: Outputs,
    cleaning: Cleaning = NO_CLEANING,
    warn: Warn = ignore,
    *,
    looks: LimitedLooks = (),
    placement: Similarity | None = None,
    upright: bool = False,
    ground: bool = False,
    points: np.ndarray | None = None,
    options: FileOptions = DEFAULT_OPTIONS,
    measure: MeasureLeaf | None = None,
) -> str:
    """Edit a bundle, a folder of levels or any 3DGS PLY, and write the result.

    Binary PLYs are processed in batches of rows.

    Args:
        warn, measure: see ``read_ply`` and ``write_streamed_levels``.
        looks: applied to the remaining splats.
        placement: applied after upright and ground; crops and lengths of the cleaning are the source's.
        upright, ground, points: see ``placement.upright_placement``.
        options: for all outputs but ``out`` and ``folder``.

    Returns:
        A report of the remaining splats of each level, and of the files.

    Raises:
        LodgsError: cannot read or write a file, the source contradicts its rule, or no splats remain.
    """
    _check_outputs(source, outputs)
    bundle = open_levels(source, warn)
    check_rule(bundle)
    edited = apply_looks_to_levels(clean_bundle(bundle, cleaning), looks)
    if placement is not None or upright or ground:
        first = upright_placement(bundle, upright, ground, points)
        edited = transform_bundle(edited, first if placement is None else placement.compose(first))
        if upright or ground:
            edited.meta["up_rotation"] = np.eye(3)
    if outputs.out is not None:
        _write_like(source, bundle, outputs.out, edited)
    for path in outputs.plain:
        export_finest_level(path, edited, options)
    notes = [note for path in outputs.levels for note in export_levels(path, edited, options)]
    notes += [] if outputs.tiles is None else export_tiles(outputs.tiles, edited, options)
    if outputs.folder is not None or outputs.streamed is not None:
        complete = resolve_rule(edited.rule).complete_levels(edited)
        if outputs.folder is not None:
            write_folder(outputs.folder, complete)
        if outputs.streamed is not None:
            complete = complete if options.antialiased else bake_filter(complete)
            write_streamed_levels(outputs.streamed, complete, measure)
    keeps_place = options.original_place and outputs.paths == [*outputs.plain, *outputs.levels]
    return "\n".join([*notes, *_report(bundle, edited, outputs.paths, keeps_place)])


def _report(bundle: Bundle, edited: Bundle, outputs: Sequence[Path], keeps_place: bool) -> list[str]:
    """Report the remaining splats, the files, and a change of the origin.

    Args:
        keeps_place: all files have the original positions.
    """
    lines = [
        f"level {level.number}: {len(result.rows):,} of {len(level.rows):,} splats"
        for level, result in zip(bundle.levels, edited.levels, strict=True)
    ]
    lines += [f"{path}: written" for path in outputs]
    if edited.origin.any() and not keeps_place:
        lines.append(describe_origin(edited.origin))
    elif bundle.origin.any() and not edited.origin.any():
        lines.append("The placement drops the local origin: positions are no longer those of the original.")
    return lines


def check_paths(source: Path, outputs: Outputs) -> None:
    """Raise a LodgsError if an output would replace the source or another output.

    Args:
        source: file or folder, or the main file of a folder.
    """
    places = {source.resolve(), source.resolve().parent} if source.name in MAIN_FILES else {source.resolve()}
    for path in outputs.paths:
        if path.resolve() in places:
            raise LodgsError(f"Cannot write {path}: it is the source.", "Choose another output file.")
    resolved = [path.resolve() for path in outputs.paths]
    if twice := next((path for path in outputs.paths if resolved.count(path.resolve()) > 1), None):
        raise LodgsError(f"Cannot write {twice}: two outputs have this name.", "Choose another output file.")


def _check_outputs(source: Path, outputs: Outputs) -> None:
    """Raise an error before minutes of work if an output cannot be written."""
    check_paths(source, outputs)
    if outputs.out is not None and not source.is_dir() and outputs.out.suffix.lower() != ".ply":
        raise LodgsError(
            f"Cannot write {outputs.out}: it would be a PLY, the format of the source.",
            "End its name with .ply, or use --plain or --levels for other formats.",
        )
    kinds = [*map(find_format, outputs.plain), *map(find_level_format, outputs.levels)]
    for kind in kinds:
        if kind.require is not None:
            kind.require()
    if outputs.streamed is not None:
        load_packages()


def open_levels(source: Path, warn: Warn) -> Bundle:
    """Open a bundle or PLY on disk; read a folder of levels.

    Args:
        warn: see ``read_ply``.
    """
    if source.is_dir():
        return read_folder(source, warn)
    bundle, rows = open_bundle(source)
    for level in bundle.levels:
        level.on_disk = DrawableRows(rows[level.number], warn)
    return bundle


def _write_like(source: Path, bundle: Bundle, out: Path, edited: Bundle) -> None:
    """Write an edited bundle in the format of its source: folder of levels, plain PLY or bundle."""
    comments = comments_from_meta(edited.meta)
    if source.is_dir():
        write_folder(out, edited)
    elif bundle == Bundle("", bundle.levels[:1], meta=meta_from_comments(comments_from_meta(bundle.meta))):
        write_ply(out, edited.levels[0].rows, comments)
    else:
        write_bundle(out, edited)
