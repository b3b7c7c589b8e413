"""What other programs write into splat PLYs beside or instead of the 3DGS layout: read rightly, or refused.

Who writes what, and what becomes of it, is a table in ``docs/bundle.md``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .gaussians import Splats

Warn = Callable[[str], object]
"""Receives one sentence for each thing that was left out or is shown otherwise than its maker shows it."""

MAX_COORDINATE, MAX_COEFFICIENT = 1e12, 1e6
"""The largest coordinate and size, and the largest coefficient of a colour, that are read of a splat: single
precision then holds whatever a renderer makes of them."""

_BLOCK = 1 << 16
_OFFSETS = ("f_offset_0", "f_offset_1", "f_offset_2")
_ANCHOR_SCALES = ("scale_3", "scale_4", "scale_5")
# Columns of time: Spacetime Gaussians, 4D Gaussian Splatting (rotor and two-quaternion forms).
_TEMPORAL = {"trbf_center", "trbf_scale", "motion_0", "scale_t", "scale_t_0", "t_scale", "rot_r_0"}
_MIP = "SplatRenderMode: mip"


def ignore(message: str) -> None:
    """Warnings that nobody asked for."""


def reject_unsupported(columns: Collection[str], comments: Iterable[str], path: str | Path) -> None:
    """Raise a LodgsError for a dialect that cannot be drawn as it was meant; ``path`` is for the message.

    Args:
        columns: names of the columns of ``vertex``.
        comments: of the header.
    """
    if found := _refusal(set(columns), comments, Path(path)):
        what, remedy = found
        raise LodgsError(f"{path} {what}", remedy)


def drawable_3dgs(splats: Splats, path: str | Path, warn: Warn = ignore) -> Splats:
    """`in_3dgs`, without what cannot be drawn (`drawable`)."""
    return drop_undrawable(to_3dgs(splats, path, warn), path, warn)


@np.errstate(all="ignore")  # what is no number stays none
def to_3dgs(splats: Splats, path: str | Path, warn: Warn = ignore) -> Splats:
    """Splats of any dialect that `refuse` lets pass, in the meaning of the 3DGS columns.

    The columns that are worked into others are gone, so that nothing is applied twice when the splats are
    written and read again.

    - ``filter_3D`` (Mip-Splatting, before fusing): widened and fainter by its Eq. 9.
    - ``f_offset_0..2`` and six scales (Octree-AnyGS, explicit): mean = anchor + offset · exp(scale_0..2), and
      scale_3..5 are the splat's own.
    """
    extras = dict(splats.extras)
    if set(_OFFSETS) <= extras.keys():
        offsets, log_scales = ([extras.pop(name) for name in names] for names in (_OFFSETS, _ANCHOR_SCALES))
        means = splats.means + np.stack(offsets, 1, dtype=np.float32) * np.exp(splats.log_scales)
        splats = replace(splats, means=means, log_scales=np.stack(log_scales, 1, dtype=np.float32))
        if "level" in extras:
            warn(
                f"{path} has levels by distance, as Octree-AnyGS chooses them, which are not read: "
                "all levels are drawn together, as from close by."
            )
    if "filter_3D" in extras:
        log_scales, logits = _smoothed(splats.log_scales, splats.opacity_logits, extras.pop("filter_3D"))
        splats = replace(splats, log_scales=log_scales, opacity_logits=logits)
    return replace(splats, extras=extras)


def dropped_message(count: int, path: str | Path) -> str:
    """What to say of so many splats that `drawable` has left out."""
    return f"{count:,} splats of {path} have values that are no numbers, or too large to draw: left out."


@np.errstate(invalid="ignore")
def drop_undrawable(splats: Splats, path: str | Path, warn: Warn = ignore) -> Splats:
    """The splats that can be drawn; the others are left out with a warning.

    Those have a place, shape or colour that is no number or beyond FARTHEST and BRIGHTEST, or an opacity that
    is no number. Rotations of length zero are none, as the original renderer has them.

    Args:
        path: for the warning.
    """
    kept, turned = np.empty((2, len(splats)), bool)
    for start in range(0, len(splats), _BLOCK):  # what is compared takes little memory then
        block = slice(start, start + _BLOCK)
        quats = np.abs(splats.quats[block])
        kept[block] = (np.abs(splats.means[block]) <= MAX_COORDINATE).all(1) & (quats <= MAX_COORDINATE).all(
            1
        )
        kept[block] &= (splats.log_scales[block] <= np.log(MAX_COORDINATE)).all(1)
        kept[block] &= ~np.isnan(splats.opacity_logits[block])
        kept[block] &= (np.abs(splats.sh[block]) <= MAX_COEFFICIENT).all((1, 2))
        turned[block] = (quats > 1 / MAX_COORDINATE).any(1)
    if not (turned | ~kept).all():
        quats = np.where((turned | ~kept)[:, None], splats.quats, np.array([1, 0, 0, 0], np.float32))
        splats = replace(splats, quats=quats)
    if kept.all():
        return splats
    warn(dropped_message(int(np.count_nonzero(~kept)), path))
    return splats.select(kept)


def _smoothed(
    log_scales: np.ndarray, opacity_logits: np.ndarray, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Splats under a 3D smoothing filter of standard deviation ``std`` (N,) in scene units (in torch:
    ``rasterize.filter3d``).

    s' = sqrt(s² + std²) and opacity' = opacity · sqrt(Π s² / Π s'²) (Mip-Splatting, Yu et al. 2024, Eq. 9),
    of which the logarithms are taken so that narrow splats and faint ones lose nothing.

    Returns:
        log_scales (N, 3) and opacity_logits (N,), float32.
    """
    grown = 0.5 * np.logaddexp(0, 2 * (np.log(np.abs(std))[:, None] - log_scales))  # log(s' / s)
    log_opacity = -np.logaddexp(0, -opacity_logits) - grown.sum(axis=1)
    logits = log_opacity - np.log(-np.expm1(log_opacity))
    # an opacity that rounds to 1 has an infinite logit; none rises
    return (log_scales + grown).astype(np.float32), np.minimum(logits, opacity_logits).astype(np.float32)


def meta_from_comments(comments: Iterable[str]) -> dict:
    """What the comments of a foreign PLY say of how it is drawn, as a bundle's meta has it.

    ``{"antialias": True}`` for splats that were trained with Mip-Splatting's 2D filter (Brush, Postshot).
    """
    return {"antialias": True} if _render_mode(comments) == "mip" else {}


def comments_from_meta(meta: dict) -> list[str]:
    """The comments by which other programs know what `meta_of` read."""
    return [_MIP] if meta.get("antialias") else []


def _render_mode(comments: Iterable[str]) -> str:
    """ "default", "mip" or "2dgs", by Brush's comment or Postshot's; the last one counts."""
    mode = "default"
    for comment in comments:
        found = re.fullmatch(r"\s*(?:splatrendermode:|antialiased\b)\s*(\w+)\s*", comment.lower())
        mode = {"default": "default", "mip": "mip", "2dgs": "2dgs", "0": "default", "1": "mip"}.get(
            found[1] if found else "", mode
        )
    return mode


def _refusal(columns: set[str], comments: Iterable[str], path: Path) -> tuple[str, str] | None:
    """What the file is and what to do, or None."""
    offsets = {name for name in columns if name.startswith("f_offset_")}
    raw_flod = re.fullmatch(r"lod_\d+_iteration_\d+", path.absolute().parent.name)  # level 1 has no ancestry
    if "packed_position" in columns:
        return (
            "is a compressed PLY, as SuperSplat writes it.",
            f"Unpack it: splat-transform {path.name} unpacked.ply",
        )
    if any(name.startswith("f_anchor_feat_") for name in columns):
        return (
            "holds anchors of Scaffold-GS or Octree-GS: networks that are not in the file make their splats.",
            "Train the photographs with LODGS's Octree-GS, which writes the splats themselves.",
        )
    if offsets and not (offsets == set(_OFFSETS) and columns.issuperset(_ANCHOR_SCALES)):
        return (
            "holds anchors of several splats each, whose shapes are not in the file.",
            "Export the splats themselves with the program that made it.",
        )
    if columns & _TEMPORAL:
        return (
            "holds splats that move in time.",
            "Export one moment of it as a 3DGS PLY with the program that made it.",
        )
    if raw_flod or any(name.startswith("ancestry_lod_") for name in columns):
        return (
            "is a level of FLoD's own program: its scales lack s_min, which is not in the file.",
            "Run that program's convert4viewer.py and choose a PLY of its folder point_cloud_viewer.",
        )
    splats = {"scale_0", "scale_1", "rot_0", "opacity"} <= columns
    if _render_mode(comments) == "2dgs" or (splats and "scale_2" not in columns):
        return (
            "is of 2D Gaussian Splatting: its splats are flat discs, which are drawn in another way.",
            "Train the photographs with a method of LODGS or another 3DGS trainer.",
        )
    if {"red", "green", "blue"} <= columns and not columns & {"f_dc_0", "scale_0"}:
        return (
            "is a point cloud or a mesh with colours, not Gaussian splats.",
            "Choose a PLY that a 3DGS trainer wrote.",
        )
    return None
