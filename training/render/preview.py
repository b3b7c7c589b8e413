"""Preview of a clean-up: an image with the splats to remove in one colour per test, for ``lodgs edit``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..editing.cleaning import Cleaning, find_unwanted
from ..editing.clutter import KINDS, Kind
from ..editing.edit import open_levels
from ..errors import LodgsError
from ..lod.rule import Masks
from ..lod.selection import check_rule
from ..rasterize.resident import ResidentBundle
from ..scenes.cameras import Camera, pick_evenly
from ..scenes.images import check_suffix
from ..scenes.overview import overview_camera
from ..scenes.view_tables import read_view_tables
from ..splats.batches import read_batches
from ..splats.dialects import Warn, ignore
from ..splats.gaussians import SH_C0, SplatRows, Splats
from ..splats.levels import Bundle, Level
from .command import draw_bundle
from .image import write_image

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_GRAY = 0.12, 0.55
"""Brightness of black remaining splats, and the additional brightness of white ones."""
_SIDE = 1280
"""Longer side of the image in pixels."""
_MAX_POINTS, _MAX_VIEWS = 20_000, 200
"""Numbers of splats and views from which the view is chosen."""


def preview(
    source: Path,
    cleaning: Cleaning,
    out: Path,
    warn: Warn = ignore,
    *,
    views: tuple[list[Camera], float] | None = None,
    backend: str = "auto",
) -> str:
    """Render the finest level, with the splats that a clean-up removes in colours and the others in grey.

    The view is the one with most of these splats; without views, that of ``overview.choose_view``. All
    splats are in memory, without their view-dependent colours.

    Args:
        source: bundle, folder of levels or any 3DGS PLY.
        out: PNG to write.
        warn: see ``read_ply``.
        views: cameras in the splats' space and their near depth; None means those of the bundle.

    Returns:
        One line for each kind of removed splats with their number in all levels, and one for the file.

    Raises:
        LodgsError: no test is enabled, or a file cannot be read or written.
    """
    check_suffix(out, ".png")
    bundle = open_levels(source, warn)
    check_rule(bundle)
    unwanted = find_unwanted(bundle, cleaning).matches
    if not unwanted:
        raise LodgsError(
            "Cannot preview the clean-up: no splats are tested.",
            "Add a crop or a limit, such as --drop-floaters.",
        )
    colored = _colored(bundle, unwanted)
    camera, near = _choose_view(colored, unwanted, views or read_view_tables(bundle.tables)[:2])
    write_image(out, draw_bundle(ResidentBundle(colored, backend, warn), camera, near=near, backend=backend))
    lines = [_describe(KINDS[name], unwanted[name]) for name in KINDS if name in unwanted]
    name = f", as seen in {camera.name}" if camera.name else ""
    return "\n".join([*lines, f"{out}: written{name}"])


def _describe(kind: Kind, masks: Masks) -> str:
    count = sum(int(mask.sum()) for mask in masks.values())
    return f"{count:,} {kind.noun}{'' if count == 1 else 's'} ({kind.tint})"


def _colored(bundle: Bundle, unwanted: Mapping[str, Masks]) -> Bundle:
    """Return a bundle in memory with the colours of the preview."""
    levels = []
    for level in bundle.levels:
        tints = np.full((len(level.rows), 3), np.nan, np.float32)
        for name in reversed([name for name in KINDS if name in unwanted]):
            tints[unwanted[name][level.number]] = KINDS[name].color
        levels.append(Level(level.number, _paint(level.rows, tints), level.facts))
    return replace(bundle, levels=levels, meta=dict(bundle.meta))


def _paint(rows: SplatRows, tints: np.ndarray) -> Splats:
    """Read splats with the colours (N, 3), or in grey where these are NaN."""
    batches, begin = [], 0
    for splats in read_batches(rows):
        colors = tints[begin : begin + len(splats)]
        begin += len(splats)
        brightness = (0.5 + SH_C0 * splats.sh[:, 0]) @ _LUMINANCE
        gray = _GRAY[0] + _GRAY[1] * brightness.clip(0, 1)[:, None]
        colors = np.where(np.isnan(colors), gray, colors)
        batches.append(replace(splats, sh=((colors - 0.5) / SH_C0).astype(np.float32)[:, None]))
    return Splats.concatenated(batches)


def _choose_view(
    bundle: Bundle, unwanted: Mapping[str, Masks], views: tuple[list[Camera], float]
) -> tuple[Camera, float]:
    """Return the camera and near depth of the image."""
    cameras, near = views
    if not cameras:
        return overview_camera(bundle, _SIDE)
    drawn = bundle.drawn_levels(bundle.levels[-1].number)
    removed = [np.logical_or.reduce([masks[level.number] for masks in unwanted.values()]) for level in drawn]
    points = np.concatenate(
        [level.splats.means[mask] for level, mask in zip(drawn, removed, strict=True)]
    )[:: max(sum(mask.sum() for mask in removed) // _MAX_POINTS, 1)]  # fmt: skip
    camera = max(pick_evenly(cameras, _MAX_VIEWS), key=lambda camera: int(camera.sees(points, near).sum()))
    return camera.scaled(_SIDE / max(camera.width, camera.height)), near
