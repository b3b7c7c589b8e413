"""Export of splats to files for other programs, shared by Blender and both command lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import LodgsError
from ..settings import setting, settings_of
from ..splats.coding import MAX_CODES
from ..splats.dialects import comments_from_meta
from ..splats.formats import PLY, find_format, find_level_format, write_splats
from ..splats.formats.glb import FORMAT as GLB
from ..splats.levels import NO_SPLATS, Bundle, Level
from ..splats.origin import NO_ORIGIN
from ..splats.ply import write_ply
from ..splats.portable_levels import ConcatenatedRows
from ..splats.splat_format import require_degree
from ..splats.tiles import write_tiles
from .bake_filter import bake_filter
from .portable import portable_levels


@dataclass(frozen=True)
class SceneOptions:
    """Options of exports that Blender applies to the splats of a scene."""

    placed: bool = setting(
        False,
        "Apply the scene's location, rotation and scale in Blender; otherwise keep COLMAP's coordinates. "
        "Transforms of single levels and instances are ignored.",
        label="As Placed",
    )
    looked: bool = setting(
        True,
        "Apply the colours and opacities of the Look panel; otherwise export the splats as trained.",
        label="With Look",
    )


@dataclass(frozen=True)
class FileOptions:
    """Options of files for other programs, in Blender's dialogs and of ``lodgs edit``."""

    antialiased: bool = setting(
        False,
        "Keep opacities as trained, for viewers with Mip-Splatting's filter. Otherwise reduce them for other "
        "viewers, which draw small splats too bold. SPZ always keeps them.",
    )
    original_place: bool = setting(
        False,
        "Write positions at the scene's original place, in double precision, instead of relative to its "
        "local origin. PLY, USD and glTF only.",
    )
    lod_errors: bool = setting(
        False,
        "Measure the errors of streamed levels in rendered images, for viewers that select levels by error.",
        label="Level Errors",
    )


DEFAULT_OPTIONS = FileOptions()
EXPORT_OPTIONS = settings_of(SceneOptions) | settings_of(FileOptions)
"""The settings of exports, by name."""


@dataclass(frozen=True)
class Compression:
    """Settings of a compression."""

    prune: float = setting(
        0.0,
        "Fraction of each level's splats to remove: those of least significance in the training views. "
        "Levels of drafts have few splats that can be spared.",
        high=0.99,
    )
    distill_steps: int = setting(
        100,
        "Steps that train each level's remaining splats to show the same images as before. Increase it "
        "with the removed fraction.",
        unit="steps",
    )
    sh_degree: int = setting(
        3, "Highest degree of spherical harmonics to keep. Lower degrees hardly reduce the file size.",
        label="SH Degree", high=4,
    )  # fmt: skip
    codes: int = setting(
        4096, "Number of sets of spherical harmonics that all splats share.", low=1, high=MAX_CODES
    )


COMPRESSION_SETTINGS = settings_of(Compression)
"""The settings of compressed bundles, by name."""


def export_finest_level(path: Path, bundle: Bundle, options: FileOptions = DEFAULT_OPTIONS) -> None:
    """Write the finest level of a bundle in the format of the file name.

    Unless ``options.antialiased``, the filter is baked into opacities (:func:`.bake_filter.bake_filter`),
    except in formats that record the filter.

    Raises:
        LodgsError: see :func:`..splats.formats.write_splats`, the level has no splats, or the format has no
            double precision.
    """
    origin = bundle.origin if options.original_place else NO_ORIGIN
    kind = find_format(path)
    rows = ConcatenatedRows.of_level(bundle, bundle.levels[-1].number)
    if not len(rows):
        raise LodgsError(f"Cannot write {path}: the finest level has no splats.", "Make some splats visible.")
    if kind.write_levels is not None:
        finest = replace(bundle, levels=[Level(1, NO_SPLATS, on_disk=rows)], rule="", cumulative=False)
        export_levels(path, finest, options)
        return
    if origin.any() and kind is not PLY:
        raise LodgsError(
            f"Cannot write {path} at the original place: the format has no double precision.",
            "Write a PLY, USD or glTF, or keep the local origin.",
        )
    if not (options.antialiased or kind.antialiased):
        bundle = bake_filter(bundle)
    rows = ConcatenatedRows.of_level(bundle, bundle.levels[-1].number)
    if origin.any():
        meta = {name: value for name, value in bundle.meta.items() if name != "origin"}
        write_ply(path, rows, comments_from_meta(meta), origin)
        return
    write_splats(path, rows, bundle.meta)


def export_levels(path: Path, bundle: Bundle, options: FileOptions = DEFAULT_OPTIONS) -> list[str]:
    """Write all levels of a bundle, selected by distance, in the format of the file name.

    Returns:
        A sentence about each difference from the bundle's own selection.

    Raises:
        LodgsError: the format has no levels or not their degree, or the file cannot be written.
    """
    kind = find_level_format(path)
    assert kind.write_levels is not None, "it is a format of levels"
    for level in bundle.levels:
        require_degree(level.rows, kind.max_degree, kind.label)
    bundle = bundle if options.antialiased else bake_filter(bundle)
    levels, notes = portable_levels(bundle, options.original_place)
    kind.write_levels(path, levels)
    return notes


def export_tiles(folder: Path, bundle: Bundle, options: FileOptions = DEFAULT_OPTIONS) -> list[str]:
    """Write all levels of a bundle as 3D Tiles, at their place on Earth; see :func:`export_levels`.

    Raises:
        LodgsError: the folder has other files or cannot be written, or the degree is not supported.
    """
    for level in bundle.levels:
        require_degree(level.rows, GLB.max_degree, GLB.label)
    levels, notes = portable_levels(bundle if options.antialiased else bake_filter(bundle))
    write_tiles(folder, levels)
    return notes
