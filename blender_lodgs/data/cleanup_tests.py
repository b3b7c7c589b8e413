"""Tests for unwanted splats: one declaration for menus, *Hide Splats* and *Find Clutter*."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import bpy
import numpy as np

from ...training.editing.cleaning import LIMITS, MAX_FLOATER_SHARE, default_gap
from ...training.errors import LodgsError
from ...training.lod.rule import Masks
from ...training.scenes.ground import ground_plane
from ...training.scenes.overview import FAR, LARGE, NEAR, central_ball
from ...training.settings import setting, settings_of
from ..attributes import SCALE
from . import cleaning
from .ground import ground_points
from .placement import placement_of
from .setting_properties import property_of

_DEPTH = 0.05
"""Suggested minimum depth of splats below the ground, as a fraction of the subject's radius."""


@dataclass(frozen=True)
class _SubjectLimits:
    """Limits of the tests that need no cameras, in addition to ``cleaning.LIMITS``."""

    max_reach: float = setting(
        10.0, "Match splats farther than this from the centre of the subject.",
        label="Distance", unit="length", start=10.0,
    )  # fmt: skip
    min_depth: float = setting(
        1.0, "Match splats deeper than this below the detected ground.",
        label="Depth", unit="length", start=1.0,
    )  # fmt: skip


class CleanupTest(NamedTuple):
    """A test for unwanted splats.

    Attributes:
        identifier, label, about: entry of the enum of tests.
        noun: the matching splats, in menus; "" for tests of *Find Clutter* alone.
        limits: names of its settings; empty for the selection.
        find: function of the context, the root and the limits that returns masks by level number.
        clutter: "all" or, without a distant background, "near" in *Find Clutter*; "" if it lacks the test.
    """

    identifier: str
    label: str
    noun: str
    about: str
    limits: tuple[str, ...]
    find: Callable[..., Masks]
    clutter: str = ""


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


TESTS = (
    CleanupTest(
        "LARGE", "Large", "Large Splats", "Splats larger than a length, such as fog", ("max_size",),
        lambda context, root, size: cleaning.find(root, cleaning.size_test(root, size)), clutter="near",
    ),
    CleanupTest(
        "FAINT", "Faint", "Faint Splats", "Splats of low opacity", ("min_opacity",),
        lambda context, root, opacity: cleaning.find(root, cleaning.opacity_test(opacity)),
    ),
    CleanupTest(
        "FAR", "Far", "Far Splats", "Splats far from every camera of the photos", ("max_distance",),
        lambda context, root, limit: cleaning.find(root, cleaning.distance_test(context, root, limit)),
    ),
    CleanupTest(
        "DISTANT", "Far Away", "", "Splats far from the centre of the subject", ("max_reach",),
        lambda context, root, limit: cleaning.find(root, _reach_test(root, limit)), clutter="all",
    ),
    CleanupTest(
        "UNSEEN", "Few Views", "Rarely Seen Splats", "Splats in the frames of few cameras, occluded or not",
        ("min_views",),
        lambda context, root, views: cleaning.find(root, cleaning.views_test(context, root, views)),
    ),
    CleanupTest(
        "FLOATERS", "Floaters", "Floaters", "Small clusters of splats that are far from others",
        ("gap", "share"),
        lambda context, root, gap, percent: cleaning.find_floaters(context, root, gap, percent / 100),
        clutter="near",
    ),
    CleanupTest(
        "BELOW", "Below Ground", "", "Splats below the detected ground", ("min_depth",), _find_below,
        clutter="all",
    ),
    CleanupTest(
        "SELECTED", "Selected", "Selected Splats",
        "Splats selected with the brush, the lasso or in Edit Mode", (),
        lambda context, root: cleaning.find(root, cleaning.selected_mask),
    ),
)  # fmt: skip
HIDE_TESTS = tuple(test for test in TESTS if test.noun)
"""Tests of *Hide Splats* and of menus."""
CLUTTER_TESTS = tuple(test for test in TESTS if test.clutter)
"""Tests of *Find Clutter*, which runs them together."""


def limit_property(name: str) -> str:
    """Return the operator property of a limit: ``size`` for ``max_size``."""
    return name.removeprefix("max_").removeprefix("min_")


def limit_properties(tests: Iterable[CleanupTest]) -> dict[str, Any]:
    """Return the operator properties of the limits of tests."""
    result, settings = {}, LIMITS | settings_of(_SubjectLimits)
    for name in (name for test in tests for name in test.limits):
        f = settings[name]
        start, options = f.metadata["start"], {}
        if name == "share":
            options = {"default": 100 * start, "max": 100.0, "precision": 2, "subtype": "PERCENTAGE"}
        elif f.metadata["unit"] == "length":  # suggested for each scene
            options = {"options": {"SKIP_SAVE"}}
        result[limit_property(name)] = property_of(f, **{"default": start} | options)
    return result


def find_matches(
    test: CleanupTest, context: bpy.types.Context, root: bpy.types.Object, limits: object
) -> Masks:
    """Find the visible splats that match a test.

    Args:
        limits: object with the properties of the test's limits; lengths in the world, shares in percent.

    Returns:
        Masks (N,) bool by level number.

    Raises:
        LodgsError: a level has no splats, or the root is scaled differently along its axes.
    """
    return test.find(context, root, *(getattr(limits, limit_property(name)) for name in test.limits))


def find_clutter(
    test: CleanupTest, context: bpy.types.Context, root: bpy.types.Object, limits: object
) -> Masks:
    """Find the visible splats of a kind of clutter: as :func:`find_matches`, or only near the subject."""
    masks = find_matches(test, context, root, limits)
    if test.clutter != "near":
        return masks
    (center, radius), numbers = _subject(root), _numbers(root)
    return cleaning.find(
        root,
        lambda cloud: masks[numbers[cloud.session_uid]] & (_distances(cloud, center) < NEAR * radius),
    )  # a distant background is large and sparse, too


def union(masks: Mapping[str, Masks], root: bpy.types.Object) -> Masks:
    """Return the splats that match any test."""
    result = {item.number: np.zeros(len(item.object.data.points), bool) for item in cleaning.levels(root)}
    for by_level in masks.values():
        for number, mask in by_level.items():
            result[number] |= mask
    return result


def suggest_limits(context: bpy.types.Context, root: bpy.types.Object) -> dict[str, float]:
    """Suggest limits for *Hide Splats* by name, as lengths in the world.

    About one splat in a hundred of the finest level is larger than ``size``, and one in twenty is farther
    from the cameras than ``distance``.
    """
    cloud, unit = cleaning.levels(root)[-1].object.data, cleaning.unit_length(root)
    means = cleaning.splat_attribute(cloud, "position")
    scales = cleaning.splat_attribute(cloud, SCALE)
    sample = slice(None, None, max(len(means) // 100_000, 1))
    limits = {
        "size": float(np.quantile(scales[sample].max(axis=1), 0.99)) * unit,
        "gap": default_gap(means) * unit,
    }
    try:
        positions = np.array([camera.center for camera in cleaning.cameras(context, root)], np.float32)
    except LodgsError:
        return limits
    distances = np.full(len(means[sample]), np.inf, np.float32)
    for position in positions:
        np.minimum(distances, np.linalg.norm(means[sample] - position, axis=1), out=distances)
    return limits | {"distance": float(np.quantile(distances, 0.95)) * unit}


def suggest_clutter_limits(root: bpy.types.Object) -> dict[str, float]:
    """Suggest limits for *Find Clutter* from the size of the subject, see ``overview.central_ball``."""
    _, radius = _subject(root)
    size = radius * cleaning.unit_length(root)
    return {
        "size": LARGE * size, "reach": FAR * size, "gap": 0.0, "share": 100 * MAX_FLOATER_SHARE,
        "depth": _DEPTH * size,
    }  # fmt: skip


def _reach_test(root: bpy.types.Object, limit: float) -> cleaning.Test:
    """Return a test for splats farther than a length in the world from the centre of the subject."""
    center, _ = _subject(root)
    limit /= cleaning.unit_length(root)
    return lambda cloud: _distances(cloud, center) > limit


def _subject(root: bpy.types.Object) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius of the finest level's subject, in the scene's own space."""
    means = cleaning.splat_attribute(cleaning.levels(root)[-1].object.data, "position")
    means = means[np.isfinite(means).all(axis=1)]
    return central_ball(means) if len(means) else (np.zeros(3), 1.0)


def _numbers(root: bpy.types.Object) -> dict[int, int]:
    """Return the level number of each point cloud, by ``session_uid``."""
    return {item.object.data.session_uid: item.number for item in cleaning.levels(root)}


def _distances(cloud: bpy.types.PointCloud, center: np.ndarray) -> np.ndarray:
    return np.linalg.norm(cleaning.splat_attribute(cloud, "position") - center, axis=1)
