"""Preview of the clutter of a scene: every kind has its colour in viewports, its count and its limits.

The settings are saved; the matching splats are found again whenever a limit or the splats change.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.lod.rule import Masks
from .. import extension
from . import changes, cleaning, roots
from .cleanup_tests import (
    CLUTTER_TESTS,
    CleanupTest,
    find_clutter,
    limit_properties,
    limit_property,
    suggest_clutter_limits,
)
from .placement import axes_of, world_matrix

_matches: dict[int, dict[str, tuple[tuple, Masks]]] = {}
"""Key and masks of each test, by the ``session_uid`` of the scene root and the identifier of the test."""


def _changed(settings: ClutterSettings, context: bpy.types.Context) -> None:
    if settings.preview:
        _refresh_or_stop(context, settings.id_data)


class ClutterSettings(bpy.types.PropertyGroup):
    """Kinds of clutter of a scene root, and their limits."""

    preview: bpy.props.BoolProperty(
        name="Preview", description="Show clutter in the colours of its kinds", options=set()
    )


def use_property(test: CleanupTest) -> str:
    """Return the property that enables a test."""
    return f"use_{test.identifier.lower()}"


def _properties() -> dict[str, Any]:
    result: dict[str, Any] = {}
    for test in CLUTTER_TESTS:
        result[use_property(test)] = bpy.props.BoolProperty(
            name=test.label, description=test.about, default=test.identifier != "BELOW", update=_changed
        )
    return result | limit_properties(CLUTTER_TESTS, update=_changed, options=set())


ClutterSettings.__annotations__ |= _properties()


def start(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Show the clutter of a scene; limits that were never set get values that suit the scene."""
    settings = root.lodgs_clutter
    for name, value in suggest_clutter_limits(root).items():
        if not settings.is_property_set(name):
            setattr(settings, name, value)
    settings.preview = True
    refresh(context, root)


def stop(root: bpy.types.Object) -> None:
    """End the preview of a scene."""
    root.lodgs_clutter.preview = False
    _matches.pop(root.session_uid, None)
    _show()


def refresh(context: bpy.types.Context, root: bpy.types.Object) -> dict[str, Masks]:
    """Find the clutter of a scene and show it in the viewports; only changed tests run again.

    Returns:
        Masks (N,) bool by level number of each enabled test, by its identifier.
    """
    settings, previous = root.lodgs_clutter, _matches.get(root.session_uid, {})
    current = {}
    for test in CLUTTER_TESTS:
        if getattr(settings, use_property(test)):
            key = _key(root, test)
            name = test.identifier
            if name in previous and previous[name][0] == key:
                current[name] = previous[name]
            else:
                current[name] = key, find_clutter(test, context, root, settings)
    _matches[root.session_uid] = current
    _show()
    return {name: masks for name, (_, masks) in current.items()}


def count_by_kind(root: bpy.types.Object) -> dict[str, int] | None:
    """Return the number of splats of each enabled test in all levels; None if splats or limits changed."""
    current = _matches.get(root.session_uid, {})
    enabled = {test for test in CLUTTER_TESTS if getattr(root.lodgs_clutter, use_property(test))}
    if {test.identifier for test in enabled} != current.keys():
        return None
    if any(current[test.identifier][0] != _key(root, test) for test in enabled):
        return None
    return {name: sum(int(mask.sum()) for mask in masks.values()) for name, (_, masks) in current.items()}


def count_clutter(root: bpy.types.Object) -> int:
    """Return the number of coloured splats in all levels."""
    marks = [cleaning.displayed_marks(item.object.data) for item in root.lodgs.existing_levels]
    return sum(int(np.count_nonzero((mark > 1) & (mark != cleaning.mark_of("")))) for mark in marks)


def refresh_later() -> None:
    """Refresh the preview of every scene as soon as possible, for use while drawing."""
    if not bpy.app.timers.is_registered(_refresh_all):
        bpy.app.timers.register(_refresh_all, first_interval=0)


def _refresh_all() -> None:
    for root in roots.roots(bpy.context.scene):
        if root.lodgs_clutter.preview and root.lodgs.existing_levels:
            _refresh_or_stop(bpy.context, root)
        elif root.session_uid in _matches:  # undo has ended the preview
            stop(root)


def _refresh_or_stop(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Refresh the preview of a scene; end it if a level lost its splats or the scene was stretched."""
    try:
        refresh(context, root)
    except LodgsError:  # Find Clutter states the reason
        stop(root)


def _key(root: bpy.types.Object, test: CleanupTest) -> tuple:
    """Return a key that changes with the limits of a test, and the splats, scale and rotation of a scene."""
    clouds = [item.object.data for item in root.lodgs.existing_levels]
    limits = tuple(getattr(root.lodgs_clutter, limit_property(name)) for name in test.limits)
    return (
        limits, cleaning.unit_length(root), tuple(world_matrix(axes_of(root)).to_quaternion()),
        *((cloud.session_uid, len(cloud.points), changes.version(cloud)) for cloud in clouds),
    )  # fmt: skip


def _show() -> None:
    """Show the matching splats of all scenes in the viewports, and the others in grey."""
    marks: dict[int, np.ndarray] = {}
    for root in roots.roots(bpy.context.scene):
        matches = _matches.get(root.session_uid, {}) if root.lodgs_clutter.preview else {}
        for item in root.lodgs.existing_levels if matches else ():
            cloud = item.object.data
            mark = marks[cloud.session_uid] = np.full(len(cloud.points), cleaning.mark_of(""), np.uint8)
            for test in reversed(CLUTTER_TESTS):
                mask = matches[test.identifier][1].get(item.number) if test.identifier in matches else None
                if mask is not None and len(mask) == len(mark):
                    mark[mask] = cleaning.mark_of(test.kind)
    cleaning.show_marks(marks)
    extension.redraw()


@bpy.app.handlers.persistent
def _on_undo(*_) -> None:
    """Find the clutter again: undo has restored other limits or splats."""
    refresh_later()


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    _matches.clear()
    cleaning.show_marks({})
    refresh_later()


CLASSES = (ClutterSettings,)
_HANDLERS = {"undo_post": _on_undo, "redo_post": _on_undo, "load_post": _on_load}


def register() -> None:
    bpy.types.Object.lodgs_clutter = bpy.props.PointerProperty(type=ClutterSettings)
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    if bpy.app.timers.is_registered(_refresh_all):
        bpy.app.timers.unregister(_refresh_all)
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    del bpy.types.Object.lodgs_clutter
