"""Clutter of a splat scene: oversized, distant and isolated splats, and those below the ground."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import bpy
import numpy as np

from ...training.editing.cleaning import MAX_FLOATER_SHARE
from ...training.scenes.ground import ground_plane
from ...training.scenes.overview import FAR, LARGE, NEAR, central_ball
from . import cleaning
from .ground import ground_points
from .placement import placement_of

_DEPTH = 0.05
"""Suggested minimum depth of splats below the ground, as a fraction of the subject's radius."""

Masks = dict[int, np.ndarray]
"""Masks (N,) bool by level number."""


class ClutterKind(NamedTuple):
    """A kind of clutter, for the operator.

    Attributes:
        identifier, label, about: entry of the list of kinds.
        limits: names of its limits.
        find: function of the context, the root and the limits that returns masks by level number.
    """

    identifier: str
    label: str
    about: str
    limits: tuple[str, ...]
    find: Callable[..., Masks]


def _find_oversized(context: bpy.types.Context, root: bpy.types.Object, size: float) -> Masks:
    center, radius = _subject(root)
    is_large = cleaning.size_test(root, size)
    return cleaning.find(
        root, lambda cloud: is_large(cloud) & (_distances(cloud, center) < NEAR * radius)
    )  # a distant background is large, too


def _find_distant(context: bpy.types.Context, root: bpy.types.Object, distance: float) -> Masks:
    center, _ = _subject(root)
    limit = distance / cleaning.unit_length(root)
    return cleaning.find(root, lambda cloud: _distances(cloud, center) > limit)


def _find_floaters(context: bpy.types.Context, root: bpy.types.Object, gap: float, share: float) -> Masks:
    masks, (center, radius) = cleaning.find_floaters(context, root, gap, share / 100), _subject(root)
    by_cloud = {item.object.data.session_uid: masks[item.number] for item in cleaning.levels(root)}
    return cleaning.find(
        root, lambda cloud: by_cloud[cloud.session_uid] & (_distances(cloud, center) < NEAR * radius)
    )  # a distant background is sparse, too


def _find_below(context: bpy.types.Context, root: bpy.types.Object, depth: float) -> Masks:
    """Find splats below the detected ground; none without a ground."""
    up = placement_of(root).rotation.T @ (0.0, 0.0, 1.0)
    ground = ground_plane(ground_points(root), up)
    if ground is None:
        return {item.number: np.zeros(len(item.object.data.points), bool) for item in cleaning.levels(root)}
    normal, middle, _ = ground
    limit = depth / cleaning.unit_length(root)
    return cleaning.find(
        root, lambda cloud: (cleaning.splat_attribute(cloud, "position") - middle) @ normal < -limit
    )


KINDS = (
    ClutterKind(
        "oversized", "Oversized", "Splats near the subject that are larger than this, such as fog", ("size",),
        _find_oversized,
    ),
    ClutterKind(
        "distant", "Far Away", "Splats farther than this from the centre of the subject", ("distance",),
        _find_distant,
    ),
    ClutterKind(
        "floaters", "Floaters", "Small clusters of splats near the subject that are far from others",
        ("gap", "share"), _find_floaters,
    ),
    ClutterKind(
        "below", "Below Ground", "Splats deeper than this below the detected ground", ("depth",), _find_below
    ),
)  # fmt: skip


def find_clutter(
    context: bpy.types.Context,
    root: bpy.types.Object,
    kinds: Sequence[str],
    limits: Mapping[str, float],
) -> dict[str, Masks]:
    """Find the visible splats of kinds of clutter.

    Args:
        kinds: identifiers of KINDS.
        limits: values of all limits; lengths in the world, shares in percent.

    Returns:
        Masks by level number for each kind. A splat can be of several kinds.

    Raises:
        LodgsError: a level has no splats, or the root is scaled differently along its axes.
    """
    return {
        kind.identifier: kind.find(context, root, *(limits[name] for name in kind.limits))
        for kind in KINDS
        if kind.identifier in kinds
    }


def union(masks: Mapping[str, Masks], root: bpy.types.Object) -> Masks:
    """Return the splats of any kind."""
    result = {item.number: np.zeros(len(item.object.data.points), bool) for item in cleaning.levels(root)}
    for by_level in masks.values():
        for number, mask in by_level.items():
            result[number] |= mask
    return result


def suggest_limits(root: bpy.types.Object) -> dict[str, float]:
    """Suggest limits from the size of the subject, see ``overview.central_ball``; lengths in the world."""
    _, radius = _subject(root)
    size = radius * cleaning.unit_length(root)
    return {
        "size": LARGE * size, "distance": FAR * size, "gap": 0.0, "share": 100 * MAX_FLOATER_SHARE,
        "depth": _DEPTH * size,
    }  # fmt: skip


def _subject(root: bpy.types.Object) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius of the finest level's subject, in the scene's own space."""
    means = cleaning.splat_attribute(cleaning.levels(root)[-1].object.data, "position")
    means = means[np.isfinite(means).all(axis=1)]
    return central_ball(means) if len(means) else (np.zeros(3), 1.0)


def _distances(cloud: bpy.types.PointCloud, center: np.ndarray) -> np.ndarray:
    return np.linalg.norm(cleaning.splat_attribute(cloud, "position") - center, axis=1)
