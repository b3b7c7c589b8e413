"""Upgrade of files saved by older versions."""

from __future__ import annotations

import json

import bpy

from ...training.lod.rule import find_rule
from ..attributes import BASE, LOG_SCALE, rename_sh
from ..nodes import display
from . import looks, selection


def upgrade_scene(root: bpy.types.Object) -> None:
    """Upgrade a splat scene of an older version; scenes of this version stay unchanged."""
    if root.lodgs.itself is None:
        root.lodgs.itself = root
    rule, levels = find_rule(root.lodgs.rule), [item.number for item in root.lodgs.levels if item.exists]
    if rule is not None and levels and not root.lodgs.begun:  # older versions moved the unset control along
        finest = {control.name: levels[-1] for control in rule.controls if control.follows == "finest"}
        root.lodgs.begun = json.dumps(finest)
    if selection.outdated(root) or looks.outdated(root):
        selection.attach(root)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    """Upgrade editable data after a file is opened or appended from; linked data stay unchanged."""
    for cloud in bpy.data.pointclouds:
        if cloud.is_editable and BASE in cloud.attributes:
            rename_sh(cloud)
    for obj in bpy.data.objects:
        if (
            obj.type == "POINTCLOUD"
            and obj.is_editable
            and obj.data.is_editable
            and LOG_SCALE in obj.data.attributes
        ):
            display.attach(obj)
    for obj in bpy.data.objects:
        if obj.lodgs.is_root and obj.is_editable:
            upgrade_scene(obj)


_HANDLERS = (bpy.app.handlers.load_post, bpy.app.handlers.blend_import_post)


def register() -> None:
    for handlers in _HANDLERS:
        handlers.append(_on_load)


def unregister() -> None:
    for handlers in _HANDLERS:
        handlers.remove(_on_load)
