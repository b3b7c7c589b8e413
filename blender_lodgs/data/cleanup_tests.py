"""Tests for unwanted splats: one declaration for menus, *Hide Splats* and *Find Clutter*."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import bpy
import numpy as np

from ...training.editing import clutter
from ...training.editing.cleaning import LIMITS, default_gap
from ...training.editing.clutter import KINDS
from ...training.errors import LodgsError
from ...training.lod.rule import Masks
from ..attributes import BASE, SCALE
from . import changes, cleaning
from .ground import finest_levels, ground_points
from .placement import placement_of
from .setting_properties import property_of


class CleanupTest(NamedTuple):
    """A test for unwanted splats.

    Attributes:
        identifier, label, about: entry of the enum of tests.
        noun: the matching splats, in menus; "" for tests that only *Find Clutter* has.
        limits: names of its settings; empty for the selection.
        find: function of the context, the root and the limits that returns masks by level number.
        kind: its entry of ``clutter.KINDS`` in *Find Clutter*; "" if it lacks the test.
    """

    identifier: str
    label: str
    noun: str
    about: str
    limits: tuple[str, ...]
    find: Callable[..., Masks]
    kind: str = ""


def _find_halos(context: bpy.types.Context, root: bpy.types.Object, opacity: float) -> Masks:
    """Find large and faint splats near the subject."""
    subject = subject_of(root)
    return cleaning.find(
        root,
        lambda cloud: subject.find_halos(
            cleaning.splat_attribute(cloud, "position"), cleaning.splat_attribute(cloud, SCALE),
            cleaning.splat_attribute(cloud, BASE)[:, 3], opacity,
        ),
    )  # fmt: skip


def _find_distant(context: bpy.types.Context, root: bpy.types.Object, limit: float) -> Masks:
    """Find splats farther than a length in the world from the centre of the subject."""
    subject, limit = subject_of(root), limit / cleaning.unit_length(root)
    return cleaning.find(
        root, lambda cloud: subject.distances(cleaning.splat_attribute(cloud, "position")) > limit
    )


def _find_below(context: bpy.types.Context, root: bpy.types.Object, depth: float) -> Masks:
    """Find splats below the detected ground; none without a ground."""
    subject, limit = subject_of(root), depth / cleaning.unit_length(root)
    return cleaning.find(
        root, lambda cloud: subject.find_below(cleaning.splat_attribute(cloud, "position"), limit)
    )


TESTS = (
    CleanupTest(
        "LARGE", "Large", "Large Splats", "Splats larger than a length, such as fog", ("max_size",),
        lambda context, root, size: cleaning.find(root, cleaning.size_test(root, size)), kind="max_size",
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
        _find_distant, kind="max_reach",
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
        kind="drop_floaters",
    ),
    CleanupTest(
        "BELOW", "Below Ground", "", "Splats below the detected ground", ("min_depth",), _find_below,
        kind="min_depth",
    ),
    CleanupTest(
        "HALOS", "Halos", "", "Large and faint splats around the subject", ("halo_opacity",), _find_halos,
        kind="halo_opacity",
    ),
    CleanupTest(
        "SELECTED", "Selected", "Selected Splats",
        "Splats selected with the brush, the lasso or in Edit Mode", (),
        lambda context, root: cleaning.find(root, cleaning.selected_mask),
    ),
)  # fmt: skip
HIDE_TESTS = tuple(test for test in TESTS if test.noun)
"""Tests of *Hide Splats* and of menus."""
CLUTTER_TESTS = tuple(test for name in KINDS for test in TESTS if test.kind == name)
"""Tests of *Find Clutter*, which runs them together. A splat has the colour of the first one."""
_SPARES_BACKGROUND = "max_size", "drop_floaters"
"""Kinds of clutter that are only near the subject: a distant background is large and sparse, too."""


def limit_property(name: str) -> str:
    """Return the operator property of a limit: ``size`` for ``max_size``."""
    return name.removeprefix("max_").removeprefix("min_")


def limit_properties(tests: Iterable[CleanupTest], **common: Any) -> dict[str, Any]:
    """Return the properties of the limits of tests.

    Args:
        common: arguments of all properties, see ``property_of``.
    """
    result: dict[str, Any] = {}
    for name in (name for test in tests for name in test.limits):
        f = LIMITS[name]
        start, options = f.metadata["start"], {}
        if name == "share":
            options = {"default": 100 * start, "max": 100.0, "precision": 2, "subtype": "PERCENTAGE"}
        elif f.metadata["unit"] == "length":  # suggested for each scene
            options = {"options": {"SKIP_SAVE"}}
        result[limit_property(name)] = property_of(f, **{"default": start} | options | common)
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
    if test.kind not in _SPARES_BACKGROUND:
        return masks
    subject = subject_of(root)
    numbers = {item.object.data.session_uid: item.number for item in root.lodgs.existing_levels}
    return cleaning.find(
        root,
        lambda cloud: (
            masks[numbers[cloud.session_uid]] & subject.near(cleaning.splat_attribute(cloud, "position"))
        ),
    )


def unite_masks(masks: Mapping[str, Masks], root: bpy.types.Object) -> Masks:
    """Return the splats that match any test."""
    result = {
        item.number: np.zeros(len(item.object.data.points), bool) for item in root.lodgs.existing_levels
    }
    for by_level in masks.values():
        for number, mask in by_level.items():
            result[number] |= mask
    return result


def suggest_limits(context: bpy.types.Context, root: bpy.types.Object) -> dict[str, float]:
    """Suggest limits for *Hide Splats* by name, as lengths in the world.

    About one splat in a hundred of the finest level is larger than ``size``, and one in twenty is farther
    from the cameras than ``distance``.
    """
    cloud, unit = root.lodgs.existing_levels[-1].object.data, cleaning.unit_length(root)
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
    """Suggest limits for *Find Clutter* from the size of the subject, as lengths in the world."""
    unit, limits = cleaning.unit_length(root), subject_of(root).limits()
    return {"gap": default_gap(_finest_means(root)) * unit} | {
        limit_property(name): value * (unit if LIMITS[name].metadata["unit"] == "length" else 1)
        for name, value in limits.items()
    }


def subject_of(root: bpy.types.Object) -> clutter.SceneSubject:
    """Return the subject of the finest level, in the scene's coordinates; the last result is cached.

    Raises:
        LodgsError: the finest level has no splats, or the root is scaled differently along its axes.
    """
    clouds = [obj.data for obj in finest_levels(root)]
    if not any(len(cloud.points) for cloud in clouds):
        raise LodgsError(
            f"Cannot find clutter: the finest level of '{root.name}' has no splats.", "Undo their removal."
        )
    up = placement_of(root).rotation.T @ (0.0, 0.0, 1.0)
    states = [(cloud.session_uid, len(cloud.points), changes.version(cloud)) for cloud in clouds]
    key = tuple(states), tuple(up)
    if not _subject or _subject[0] != key:
        _subject[:] = [key, clutter.find_subject(_finest_means(root), up, ground_points(root))]
    return _subject[1]


def _finest_means(root: bpy.types.Object) -> np.ndarray:
    """Return the means (N, 3) of all splats that the finest level shows."""
    return np.concatenate([cleaning.splat_attribute(obj.data, "position") for obj in finest_levels(root)])


_subject: list[Any] = []
"""Key and subject of the last scene."""
