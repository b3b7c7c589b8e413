"""Files that older versions saved: they open, and choose their levels as before."""

from __future__ import annotations

import json
from contextlib import suppress

import bpy

from ...training.lod.rule import find_rule
from ...training.splats.bundle import rule_of_v1
from .. import compat
from ..attributes import BASE, LOG_SCALE, rename_sh
from ..nodes import display
from . import looks, selection
from .training import offered


def bring_up_to_date(root: bpy.types.Object) -> None:
    """Renews a splat scene that an older version saved; one of this version stays as it is."""
    group = compat.stored_properties(root, "lodgs")
    stored = {} if group is None else group.to_dict()
    if stored.get("levels") and "rule" not in stored:
        with suppress(KeyError, TypeError, ValueError):  # then its levels are shown one by one
            _from_0_1_0(root, stored)
    if "training" in stored:
        _training_from_0_1_0(root, group["training"])
    if root.lodgs.itself is None:
        root.lodgs.itself = root
    rule, levels = find_rule(root.lodgs.rule), [item.number for item in root.lodgs.levels if item.exists]
    if rule is not None and levels and not root.lodgs.begun:  # as long as nobody had set it, it went along
        finest = {control.name: levels[-1] for control in rule.controls if control.follows == "finest"}
        root.lodgs.begun = json.dumps(finest)
    if selection.outdated(root) or looks.outdated(root):
        selection.attach(root)


def _from_0_1_0(root: bpy.types.Object, stored: dict) -> None:
    """Version 0.1.0 had properties of each method in one bag, and no rule."""
    settings = root.lodgs
    levels = stored["levels"]
    s_min = [float(level["exact_s_min"]) if level.get("exact_s_min") else None for level in levels]
    meta = selection.read_json(settings.meta)
    if stored.get("gamma"):
        meta["gamma"] = stored["gamma"]
    rule, facts, _, of_levels = rule_of_v1(meta, s_min, settings.cumulative)
    settings.rule, settings.facts = rule, json.dumps(facts)
    for item, level_facts in zip(settings.levels, of_levels, strict=True):
        item.facts = json.dumps(level_facts)
    now_called = {
        "gamma": "gamma", "level_start": "first", "level_end": "last", "level_offset": "offset",
    }  # fmt: skip
    for before, name in now_called.items():
        if before in stored and settings.controls is not None and hasattr(settings.controls, name):
            setattr(settings.controls, name, stored[before])


def _training_from_0_1_0(root: bpy.types.Object, stored) -> None:
    """Version 0.1.0 kept one value of each parameter for all of its methods, where 0 meant the preset's."""
    methods = ("flod", "octree", "octree_neural", "3dgs")
    for name in ("levels", "footprint", "max_splats"):
        value = stored.pop(name, 0)
        for method in methods if value else ():
            if name in {f.name for f in offered(method)}:
                setattr(getattr(root.lodgs.training, f"parameters_{method}"), name, value)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    """After opening a file, and after appending from one. What is linked stays as its own file has it."""
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
            bring_up_to_date(obj)


_HANDLERS = (bpy.app.handlers.load_post, bpy.app.handlers.blend_import_post)


def register() -> None:
    for handlers in _HANDLERS:
        handlers.append(_on_load)


def unregister() -> None:
    for handlers in _HANDLERS:
        handlers.remove(_on_load)
