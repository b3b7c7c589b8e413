"""Dialects of splat PLYs: conversion to the 3DGS layout, or a refusal.

A table in ``docs/reference/bundle.md`` lists the programs, their columns and the treatment of each.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..documents import parse_json
from ..errors import LodgsError
from .batches import batch_slices
from .colors import color_names
from .gaussians import Splats
from .georeference import Georeference

Warn = Callable[[str], object]
"""Receives one sentence for each omission and for each deviation from the look in the original program."""

MAX_COORDINATE = 1e12
"""Largest coordinate and size of a splat. Renderers' intermediate values then fit in single precision."""
MAX_COEFFICIENT = 1e6
"""Largest coefficient of a splat's colour, for the same reason."""

_BLOCK = 1 << 16
_OFFSETS = ("f_offset_0", "f_offset_1", "f_offset_2")
_ANCHOR_SCALES = ("scale_3", "scale_4", "scale_5")
# Columns of time: Spacetime Gaussians, 4D Gaussian Splatting (rotor and two-quaternion forms).
_TEMPORAL = {"trbf_center", "trbf_scale", "motion_0", "scale_t", "scale_t_0", "t_scale", "rot_r_0"}
_MIP = "SplatRenderMode: mip"
_ORIGIN = "lodgs origin "
_Z_UP = "lodgs z up"
_GEOREFERENCE = "lodgs georeference "


def ignore(message: str) -> None:
    """Discard a warning."""


def reject_unsupported(columns: Collection[str], path: str | Path) -> None:
    """Raise a LodgsError for a dialect that cannot be drawn as intended.

    Args:
        columns: names of the columns of ``vertex``.
        path: path of the file, for the message.
    """
    if refusal := _find_refusal(set(columns), Path(path)):
        reason, remedy = refusal
        raise LodgsError(f"Cannot read {path}: {reason}.", remedy)


def drawable_3dgs(splats: Splats, path: str | Path, warn: Warn = ignore) -> Splats:
    """Apply `to_3dgs`, then `drop_undrawable`."""
    return drop_undrawable(to_3dgs(splats, path, warn), path, warn)


@np.errstate(all="ignore")  # NaN stays NaN
def to_3dgs(splats: Splats, path: str | Path, warn: Warn = ignore) -> Splats:
    """Convert splats of any supported dialect to the meaning of the 3DGS columns.

    Converted columns are removed, so that nothing is applied twice when the splats are written and read
    again.

    - ``filter_3D`` (Mip-Splatting before fusing): splats grow and fade by its Eq. 9.
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
                f"{path} has Octree-AnyGS levels, which depend on the distance and are not supported: "
                "all levels are drawn together, as from close by."
            )
    if "filter_3D" in extras:
        log_scales, logits = _apply_filter_3d(
            splats.log_scales, splats.opacity_logits, extras.pop("filter_3D")
        )
        splats = replace(splats, log_scales=log_scales, opacity_logits=logits)
    return replace(splats, extras=extras)


def dropped_message(count: int, path: str | Path) -> str:
    """Return the warning about the splats that `drop_undrawable` has removed."""
    return f"{count:,} splats of {path} are skipped: values are not numbers or too large."


@np.errstate(invalid="ignore")
def drop_undrawable(splats: Splats, path: str | Path, warn: Warn = ignore) -> Splats:
    """Remove splats that cannot be drawn, with a warning.

    Their position, shape or colour is NaN or exceeds MAX_COORDINATE or MAX_COEFFICIENT, or their opacity is
    NaN. Rotations of length zero become the identity, as in the original renderer.

    Args:
        path: path of the file, for the warning.
    """
    drawable, rotated = np.empty((2, len(splats)), bool)
    for block in batch_slices(len(splats), _BLOCK):
        quats = np.abs(splats.quats[block])
        drawable[block] = (np.abs(splats.means[block]) <= MAX_COORDINATE).all(1)
        drawable[block] &= (quats <= MAX_COORDINATE).all(1)
        drawable[block] &= (splats.log_scales[block] <= np.log(MAX_COORDINATE)).all(1)
        drawable[block] &= ~np.isnan(splats.opacity_logits[block])
        sh = splats.sh[block]
        if not (sh.max(initial=0) <= MAX_COEFFICIENT and sh.min(initial=0) >= -MAX_COEFFICIENT):
            drawable[block] &= (np.abs(sh) <= MAX_COEFFICIENT).all((1, 2))
        rotated[block] = (quats > 1 / MAX_COORDINATE).any(1)
    if not (rotated | ~drawable).all():
        quats = np.where((rotated | ~drawable)[:, None], splats.quats, np.array([1, 0, 0, 0], np.float32))
        splats = replace(splats, quats=quats)
    if drawable.all():
        return splats
    warn(dropped_message(int(np.count_nonzero(~drawable)), path))
    return splats.select(drawable)


def _apply_filter_3d(
    log_scales: np.ndarray, opacity_logits: np.ndarray, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Apply a 3D smoothing filter of standard deviation ``std`` (N,) in scene units to splats.

    s' = sqrt(s² + std²) and opacity' = opacity · sqrt(Π s² / Π s'²) (Mip-Splatting, Yu et al. 2024, Eq. 9),
    computed with logarithms so that narrow and faint splats keep their precision. ``rasterize.filter3d`` does
    the same in torch.

    Returns:
        log_scales (N, 3) and opacity_logits (N,), float32.
    """
    growth = 0.5 * np.logaddexp(0, 2 * (np.log(np.abs(std))[:, None] - log_scales))  # log(s' / s)
    log_opacity = -np.logaddexp(0, -opacity_logits) - growth.sum(axis=1)
    logits = log_opacity - np.log(-np.expm1(log_opacity))
    # an opacity that rounds to 1 has an infinite logit; the filter never raises one
    return (log_scales + growth).astype(np.float32), np.minimum(logits, opacity_logits).astype(np.float32)


def meta_from_comments(comments: Iterable[str]) -> dict:
    """Return a bundle's meta for the render mode, z up, local origin and georeference in comments of a PLY.

    ``antialias`` is True for splats trained with Mip-Splatting's 2D filter (Brush, Postshot). The others are
    those of :func:`comments_from_meta`.
    """
    comments = list(comments)
    meta: dict = {"antialias": True} if _render_mode(comments) == "mip" else {}
    if _Z_UP in comments:
        meta["up_rotation"] = np.eye(3).tolist()
    for comment in comments:
        if comment.startswith(_ORIGIN):
            with suppress(ValueError):
                origin = [float(number) for number in comment.removeprefix(_ORIGIN).split()]
                if len(origin) == 3 and max(map(abs, origin)) <= MAX_COORDINATE:
                    meta["origin"] = origin
        elif comment.startswith(_GEOREFERENCE):
            with suppress(ValueError, LodgsError):
                values = parse_json(comment.removeprefix(_GEOREFERENCE), "The comment")
                place = Georeference.from_json(values)
                if place.is_storable:
                    meta["georeference"] = place.to_json()
    return meta


def comments_from_meta(meta: dict) -> list[str]:
    """Return the comments about the render mode, z up, local origin and georeference in a bundle's meta.

    Other up directions have no comment, because readers without it assume -y up.
    """
    comments = [_MIP] if meta.get("antialias") else []
    if "up_rotation" in meta and np.allclose(meta["up_rotation"][2], (0, 0, 1)):  # turned at most about z
        comments.append(_Z_UP)
    if any(origin := meta.get("origin", ())):
        comments.append(_ORIGIN + " ".join(repr(float(number)) for number in origin))
    if "georeference" in meta:
        comments.append(_GEOREFERENCE + json.dumps(meta["georeference"]))
    return comments


def _render_mode(comments: Iterable[str]) -> str:
    """Return "default" or "mip" from the last comment of Brush or Postshot."""
    mode = "default"
    for comment in comments:
        match = re.fullmatch(r"\s*(?:splatrendermode:|antialiased\b)\s*(\w+)\s*", comment.lower())
        modes = {"default": "default", "mip": "mip", "0": "default", "1": "mip"}
        mode = modes.get(match[1] if match else "", mode)
    return mode


def _find_refusal(columns: set[str], path: Path) -> tuple[str, str] | None:
    """Return the reason to refuse a file and the remedy, or None for a supported file."""
    offsets = {name for name in columns if name.startswith("f_offset_")}
    raw_flod = re.fullmatch(r"lod_\d+_iteration_\d+", path.absolute().parent.name)  # level 1 has no ancestry
    if "packed_position" in columns:
        return (
            "it is a compressed PLY of SuperSplat",
            f"Unpack it: lodgs edit {path.name} --out unpacked.ply",
        )
    if any(name.startswith("f_anchor_feat_") for name in columns):
        return (
            "it holds anchors of Scaffold-GS or Octree-GS, and the networks that generate the splats are "
            "not in the file",
            "Train the photos with Octree-GS in LODGS, which writes the splats themselves.",
        )
    if offsets and not (offsets == set(_OFFSETS) and columns.issuperset(_ANCHOR_SCALES)):
        return (
            "it holds anchors of several splats each, and the shapes of these splats are not in the file",
            "Export the splats themselves with the program that wrote the file.",
        )
    if columns & _TEMPORAL:
        return (
            "its splats move in time",
            "Export one moment as a 3DGS PLY with the program that wrote the file.",
        )
    if raw_flod or any(name.startswith("ancestry_lod_") for name in columns):
        return (
            "it is a level of the original FLoD program, whose scales lack s_min",
            "Run that program's convert4viewer.py and choose a PLY in its folder point_cloud_viewer.",
        )
    if color_names(columns) and not columns & {"f_dc_0", "scale_0"}:
        return (
            "it is a coloured point cloud or mesh, not Gaussian splats",
            "Choose a PLY from a 3DGS trainer.",
        )
    return None
