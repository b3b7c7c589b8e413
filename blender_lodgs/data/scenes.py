"""Splat scenes in Blender: a root, a collection, and in it cameras, points and levels.

The scene root is an empty; ``root.lodgs`` holds what belongs to the scene (see ``properties.SplatScene``).
Everything else hangs on its axes in COLMAP coordinates (see ``placement``). These functions are what
operators call and what scripts may call.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from ...training.editing import look, placement
from ...training.errors import LodgsError
from ...training.lod.rule import Tables, find_rule
from ...training.lod.selection import check_rule, complete_splats, standalone_error
from ...training.scenes.view_tables import VIEWS, make_view_tables
from ...training.scenes.view_tables import transform_views as placed_views
from ...training.splats.gaussians import Splats
from ...training.splats.levels import Bundle, Level
from .. import compat, extension
from ..nodes import ellipsoids
from . import cleaning, crops, looks, objects, painting, selection, streams, tables
from .controls import changed_controls, update_controls
from .photographs import camera_of, is_held_out, photographed, views
from .placement import axes_of, placement_of
from .roots import collection_of, roots


def set_bundle_facts(root: bpy.types.Object, bundle: Bundle) -> None:
    """Takes over what a bundle says beside its splats. Levels whose objects are gone leave the list.

    Controls take the values that it records, but for those that somebody has set. The bundle may have levels
    without splats, or none at all while they are on their way.

    Raises:
        LodgsError: a value that it records is not possible, or it contradicts its rule. Nothing is taken over
            in that case.
    """
    settings, rule = root.lodgs, check_rule(bundle)
    for control in rule.controls if rule else ():
        control.validate(bundle.controls.get(control.name, control.default))
    if rule is not None and (rule.always_active or not rule.complete) and settings.rule != bundle.rule:
        settings.mode = "SELECTIVE"
    settings.method, settings.rule, settings.cumulative = bundle.method, bundle.rule, bundle.cumulative
    settings.facts, settings.meta = json.dumps(bundle.facts), json.dumps(bundle.meta)
    for view in views(root):
        view.data.lodgs.property_unset("held_out")
    update_controls(root, bundle.controls)
    facts = {level.number: level.facts for level in bundle.levels}
    for item in settings.levels:
        if item.number in facts:
            item.facts = json.dumps(facts[item.number])
    if "camera_center" in bundle.meta:
        settings.camera_center = bundle.meta["camera_center"]
    levels_changed(root)


def set_tables(root: bpy.types.Object, given: Tables) -> None:
    """Gives a splat scene the tables of its bundle, in place of those that it has.

    Apart from :func:`set_bundle_facts`: while levels are on their way, there are none yet.
    """
    tables.set_tables(root, given)
    selection.update_inputs(root)


def set_level(root: bpy.types.Object, level: Level) -> bpy.types.Object:
    """Adds a level to a splat scene, or replaces the one of its number; a new finest one is shown.

    COLMAP's points are hidden when the first level arrives.

    Returns:
        The level's object.
    """
    first = not root.lodgs.levels
    obj = put_level(root, level)
    levels_changed(root)
    if level.number == root.lodgs.levels[-1].number:
        root.lodgs.single_level = level.number
        root.lodgs.active_level = len(root.lodgs.levels) - 1
    if first and root.lodgs.points:  # the splats stand where the points were
        root.lodgs.points.hide_viewport = root.lodgs.points.hide_render = True
    return obj


def contents(root: bpy.types.Object) -> str:
    """What a splat scene holds, in a few words: photographs, points, levels and their splats."""
    levels = [item.object for item in root.lodgs.levels if item.exists]
    counts = (
        (len(photographed(root)), "photograph"),
        (len(views(root)) - len(photographed(root)), "view"),
        (len(root.lodgs.points.data.points) if root.lodgs.points else 0, "point"),
        (len(levels), "level"),
        (sum(len(obj.data.points) for obj in levels), "splat"),
    )
    return ", ".join(f"{count:,} {what}{'s' * (count != 1)}" for count, what in counts if count)


def make_room(root: bpy.types.Object, number: int) -> None:
    """Removes tables and all levels but one, whose object the next set's first level takes over, and ends
    reading from a file.

    Args:
        number: of that level. Where there is none of this number, the finest of those here takes it.
    """
    tables.remove_tables(root)
    streams.end(root)
    painting.keep(root)
    there = [item for item in root.lodgs.levels if item.exists]
    kept = next((item for item in there if item.number == number), there[-1] if there else None)
    for item in there:
        if item != kept:
            cloud = item.object.data
            bpy.data.objects.remove(item.object)
            if not cloud.users:
                bpy.data.pointclouds.remove(cloud)
    if kept is not None:
        if kept.object.name == _level_name(root, kept.number):
            kept.object.name = _level_name(root, number)
        kept.number = number
    levels_changed(root)


def read_levels(root: bpy.types.Object, placed: bool = False, looked: bool = False) -> Bundle:
    """The levels of a splat scene with all that artists have changed in them, modifiers not applied.

    What is hidden, and what crops leave out, is not among them.

    Args:
        placed: where the scene stands in Blender, upright there; otherwise in the splats' own world. What of
            its objects has been moved by itself counts in neither.
        looked: as paint and the scene's look have them (``looks``); otherwise as they were trained, with
            their paint beside.

    Raises:
        LodgsError: there are none, or crops leave nothing; or of a placed one, its root is stretched or its
            rule unknown.
    """
    levels = [
        Level(item.number, objects.read_splats(item.object), selection.read_facts(item.facts))
        for item in root.lodgs.levels
        if item.exists
    ]
    if not levels:
        raise LodgsError(f"{root.name} has no levels yet.", "Train it or import splats first.")
    settings = root.lodgs
    facts, meta = selection.read_facts(settings.facts), selection.read_json(settings.meta)
    bundle = Bundle(
        settings.method, levels, settings.rule, facts, changed_controls(root), settings.cumulative, meta,
        tables.read_tables(root) | view_tables(root),
    )  # fmt: skip
    bundle = cleaning.left(root, bundle, bpy.context.evaluated_depsgraph_get())
    if looked:
        bundle = look.apply_looks_to_levels(bundle, _looks(root))
    if placed:
        bundle = placement.transform_bundle(bundle, placement_of(root))
        bundle.meta["up_rotation"] = np.eye(3)
    return bundle


def view_tables(root: bpy.types.Object, placed: bool = False) -> dict[str, dict[str, np.ndarray]]:
    """A scene's views as tables of its bundle, in the order in which they came.

    Args:
        placed: see :func:`read_levels`.
    """
    found = sorted(
        (view for view in views(root) if view.data.lodgs.width), key=lambda view: view.data.lodgs.place
    )
    near = min((view.data.clip_start for view in found), default=0.0)
    axes = axes_of(root)
    unit = 1.0 if axes == root else axes.matrix_basis.to_scale().x  # ``ground.scale`` takes clips along
    unseen = {view.name for view in found if is_held_out(root, view)}
    made = make_view_tables([camera_of(view) for view in found], near / unit, unseen)
    if placed and VIEWS in made:
        made[VIEWS] = placed_views(made[VIEWS], placement_of(root))
    return made


def delete_left_out(root: bpy.types.Object) -> int:
    """Deletes what is hidden and what crops leave out, of every level, and the crops, but for their looks;
    how many splats.

    Raises:
        LodgsError: as :func:`read_levels`, or the levels are only the top of a tree in a file.
    """
    file = streams.file_of(root)
    if file is not None:
        raise LodgsError(
            f"Most of these splats are in {file.name}, which stays as it is.",
            "Keep the crops; or edit the file with the command lodgs edit, and import what that writes.",
        )
    before = sum(len(item.object.data.points) for item in root.lodgs.levels if item.exists)
    bundle = read_levels(root)
    for level in bundle.levels:
        put_level(root, level)
    for item in root.lodgs.levels:
        item.lost = 0
    for obj in crops.cutting(root):
        if looks.is_set(obj):  # which stays with what is left there
            obj.lodgs_crop.keep = "ALL"
        else:
            bpy.data.objects.remove(obj)
    levels_changed(root)
    return before - sum(len(level.splats) for level in bundle.levels)


def read_level(root: bpy.types.Object, number: int, placed: bool = False, looked: bool = False) -> Splats:
    """One level with all that artists have changed in it; where levels add up, with all coarser ones.

    Args:
        placed, looked: see :func:`read_levels`.

    Raises:
        LodgsError: there is no such level, or it is no scene by itself; or as :func:`read_levels`.
    """
    bundle = read_levels(root, placed, looked)
    for level in bundle.levels:
        if level.number == number:
            _require_alone(root, number)
            return complete_splats(bundle, level)
    raise LodgsError(f"{root.name} has no level {number}.", "Choose one from the list of levels.")


def shown_splats(
    context: bpy.types.Context, root: bpy.types.Object, placed: bool = False, looked: bool = False
) -> Splats:
    """The splats that the detail settings, and artists' own modifiers, leave visible in the view layer.

    Columns that not every visible level has are left out.

    Args:
        placed, looked: see :func:`read_levels`.

    Raises:
        LodgsError: nothing is visible, or the levels have spherical harmonics of different degrees; or of
            placed ones, the root is stretched.
    """
    with _drawn_by_lodgs(context):
        depsgraph = context.evaluated_depsgraph_get()
        parts = [
            objects.read_splats(item.object, depsgraph)
            for item in root.lodgs.levels
            if _visible(context, item)
        ]
    if looked:
        parts = [look.apply_looks(part, _looks(root)) for part in parts]
    if not any(len(part) for part in parts):
        raise LodgsError(f"No splats of {root.name} are shown.", "Look at the detail settings.")
    if len({part.sh_degree for part in parts}) > 1:
        raise LodgsError(
            f"The levels of {root.name} have spherical harmonics of different degrees.", "Export one level."
        )
    shared = [name for name in parts[0].extras if all(name in part.extras for part in parts)]
    arrays = ("means", "quats", "log_scales", "opacity_logits", "sh")
    splats = Splats(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays},
        extras={name: np.concatenate([part.extras[name] for part in parts]) for name in shared},
    )
    rule = find_rule(root.lodgs.rule)
    if not placed:
        return splats
    return placement_of(root).transform_splats(splats, *((rule.lengths, rule.places) if rule else ()))


@contextmanager
def _drawn_by_lodgs(context: bpy.types.Context) -> Iterator[None]:
    """Evaluate objects without the modifiers that apply weights and looks for Blender's own drawing."""
    settings = context.scene.lodgs_viewport
    before = settings.splats, settings.drawn_by
    if compat.NATIVE_SPLATS is None or not settings.points:
        yield
        return
    settings.splats, settings.drawn_by = True, "LODGS"
    try:
        context.view_layer.update()
        yield
    finally:
        settings.splats, settings.drawn_by = before


def count_shown(context: bpy.types.Context, root: bpy.types.Object) -> tuple[int, int]:
    """How many splats are visible as of the last evaluation, and how many there are in all levels."""
    depsgraph, shown, everything = context.view_layer.depsgraph, 0, 0
    for item in root.lodgs.levels:
        if item.exists:
            everything += len(item.object.data.points)
            if depsgraph is not None and _visible(context, item):
                shown += len(item.object.evaluated_get(depsgraph).data.points)
    return shown, everything


def show_only(root: bpy.types.Object, number: int) -> None:
    """Shows one level everywhere; where levels add up, with all coarser ones.

    Raises:
        LodgsError: it is no scene by itself.
    """
    _require_alone(root, number)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", number
    for item in root.lodgs.levels:
        if item.number == number or (root.lodgs.cumulative and item.number < number):
            item.show = True


def offer_ellipsoids(scene: bpy.types.Scene) -> None:
    """Gives every level of a scene's splats the modifier that makes ellipsoids where they are wanted."""
    for root in roots(scene):
        for item in root.lodgs.levels:
            if item.exists:
                ellipsoids.attach(item.object)
    cycles = getattr(scene, "cycles", None)
    for limit in ("transparent_max_bounces", "min_transparent_bounces") if cycles else ():
        setattr(cycles, limit, max(getattr(cycles, limit), ellipsoids.BOUNCES))


def _looks(root: bpy.types.Object) -> look.Looks:
    """The looks of a scene as it stands now."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    to_own = axes_of(root).evaluated_get(depsgraph).matrix_world.inverted_safe()
    return looks.looks_of(root, depsgraph, to_own)


def _require_alone(root: bpy.types.Object, number: int) -> None:
    finest = max((item.number for item in root.lodgs.levels if item.exists), default=number)
    if number < finest and not root.lodgs.complete:
        raise LodgsError(*standalone_error(number, finest))


def _visible(context: bpy.types.Context, item) -> bool:
    return item.exists and item.object.visible_get(view_layer=context.view_layer)


def put_level(root: bpy.types.Object, level: Level, made: bpy.types.Object | None = None) -> bpy.types.Object:
    """The level's object in the scene and its entry in the list, without what depends on the whole list.

    Args:
        made: an object of the level's splats that is in no collection; None: there is none yet.
    """
    settings = root.lodgs
    fresh = made or objects.new_splats("", painting.carried(root, level).splats)
    fresh.name = fresh.data.name = _level_name(root, level.number)
    item = next((entry for entry in settings.levels if entry.number == level.number), None)
    if item is None:
        item = settings.levels.add()
        item.number = level.number
        position = sum(entry.number < level.number for entry in settings.levels)
        settings.levels.move(len(settings.levels) - 1, position)
        item = settings.levels[position]
    elif item.exists:
        # The object stays, with all that artists have hung on it; only its splats change.
        old, obj = item.object.data, item.object
        if obj.mode != "OBJECT":  # where Blender gives it no other splats
            with extension.in_window():
                bpy.ops.object.mode_set(mode="OBJECT")
        item.lost = int(cleaning.hidden(old).sum())
        obj.data, obj.color = fresh.data, fresh.color
        bpy.data.objects.remove(fresh)
        name = old.name
        bpy.data.pointclouds.remove(old)
        obj.data.name = name
        fresh = obj
    if fresh.parent is None:
        fresh.parent = axes_of(root)
        collection_of(root).objects.link(fresh)
    item.object = fresh
    item.facts = json.dumps(level.facts)
    return fresh


def _level_name(root: bpy.types.Object, number: int) -> str:
    return f"{root.name} level {number}"


def levels_changed(root: bpy.types.Object) -> None:
    """Drops levels whose objects are gone, keeps the settings within the rest, and renews the drivers."""
    settings = root.lodgs
    for index in reversed(range(len(settings.levels))):
        if not settings.levels[index].exists:
            settings.levels.remove(index)
    if settings.levels:
        finest = settings.levels[-1].number
        settings.single_level = min(settings.single_level, finest)
        update_controls(root)
        rule = find_rule(settings.rule)
        for control in rule.controls if rule else ():
            if control.follows and getattr(settings.controls, control.name) > finest:
                setattr(settings.controls, control.name, finest)
    settings.active_level = min(settings.active_level, len(settings.levels) - 1)
    selection.attach(root)
    for scene in root.users_scene:
        if scene.lodgs_render.ellipsoids:
            offer_ellipsoids(scene)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Follows artists: a deleted level leaves no gap in the distances, a new material is shown."""
    editable = [root for root in roots(scene) if root.is_editable]  # others are linked from their own file
    if depsgraph.id_type_updated("COLLECTION"):
        for root in editable:
            if not all(item.exists for item in root.lodgs.levels):
                levels_changed(root)
    if depsgraph.id_type_updated("OBJECT"):
        for root in editable:
            if crops.outdated(root) or looks.outdated(root):
                selection.follow_crops(root)
    if any(update.is_updated_geometry for update in depsgraph.updates):
        for root in editable:
            selection.update_inputs(root)


@bpy.app.handlers.persistent
def _before_undo(*_) -> None:
    for root in _all_editable():
        selection.let_go(root)


@bpy.app.handlers.persistent
def _after_undo(*_) -> None:
    for root in _all_editable():
        selection.follow_crops(root)


def _all_editable() -> list[bpy.types.Object]:
    return [obj for obj in bpy.data.objects if obj.lodgs.is_root and obj.is_editable]


def _handlers():
    """Lists of Blender's handlers, and ours for each."""
    handlers = bpy.app.handlers
    yield handlers.depsgraph_update_post, _on_update
    for before in (handlers.undo_pre, handlers.redo_pre):
        yield before, _before_undo
    for after in (handlers.undo_post, handlers.redo_post):
        yield after, _after_undo


def register() -> None:
    for handlers, ours in _handlers():
        handlers.append(ours)


def unregister() -> None:
    for handlers, ours in _handlers():
        handlers.remove(ours)
