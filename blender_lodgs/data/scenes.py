"""Levels and contents of splat scenes: API for operators and scripts.

The scene root is an empty; ``root.lodgs`` stores the scene's settings (see ``scene_properties.SplatScene``).
All other objects are children of its axes, in COLMAP coordinates (see ``placement``).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from ...training.editing import look, placement
from ...training.editing.cleaning import same_rows
from ...training.errors import LodgsError
from ...training.lod.rule import Rule, Tables, find_rule
from ...training.lod.selection import check_rule, complete_splats, standalone_error
from ...training.scenes.view_tables import VIEWS, make_view_tables, transform_views
from ...training.splats.gaussians import Splats
from ...training.splats.levels import Bundle, Level
from ...training.splats.origin import describe_origin
from .. import compat, extension
from ..attributes import HIDDEN, write_attribute
from ..nodes import display, ellipsoids
from . import cleaning, crops, looks, metadata, objects, painting, selection, streams, tables
from .controls import changed_controls, update_controls
from .photographs import camera_of, is_held_out, views, views_with_photo
from .placement import axes_of, lock_transform, placement_of, world_matrix
from .roots import levels_collection, roots


def check_facts(root: bpy.types.Object, bundle: Bundle) -> Rule | None:
    """Check a bundle's metadata for a scene and return its rule.

    Raises:
        LodgsError: a recorded value is invalid or contradicts the rule, or the local origin is not that of
            the scene's views.
    """
    rule = check_rule(bundle)
    if views(root) and not np.array_equal(bundle.origin, metadata.origin_of(root)):
        raise LodgsError(
            f"Cannot show levels in '{root.name}': their local origin is not that of the scene's cameras.",
            "Import the splats as a new scene.",
        )
    for control in rule.controls if rule else ():
        control.validate(bundle.controls.get(control.name, control.default))
    return rule


def set_bundle_facts(root: bpy.types.Object, bundle: Bundle) -> None:
    """Store a bundle's metadata. Levels whose objects were deleted leave the list.

    Controls that the user has not set take the recorded values. During training, the bundle may have no
    levels or levels without splats.

    Raises:
        LodgsError: see :func:`check_facts`. Nothing is changed in that case.
    """
    settings, rule = root.lodgs, check_facts(root, bundle)
    if rule is not None and (rule.weights_full_detail or not rule.complete) and settings.rule != bundle.rule:
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


def set_tables(root: bpy.types.Object, new_tables: Tables) -> None:
    """Replace the tables of a splat scene by those of its bundle.

    Separate from :func:`set_bundle_facts` because tables arrive after the levels.
    """
    tables.set_tables(root, new_tables)
    selection.update_inputs(root)


def set_level(root: bpy.types.Object, level: Level) -> bpy.types.Object:
    """Add a level to a splat scene, or replace the level of the same number; a new finest one is shown.

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
    if first and root.lodgs.points:  # the splats replace the points
        root.lodgs.points.hide_viewport = root.lodgs.points.hide_render = True
    return obj


def contents(root: bpy.types.Object) -> str:
    """Describe the contents of a splat scene briefly: photos, views, points, levels, splats, local origin."""
    levels = [item.object for item in root.lodgs.existing_levels]
    counts = (
        (len(views_with_photo(root)), "photo"),
        (len(views(root)) - len(views_with_photo(root)), "view"),
        (len(root.lodgs.points.data.points) if root.lodgs.points else 0, "point"),
        (len(levels), "level"),
        (sum(len(obj.data.points) for obj in levels), "splat"),
    )
    text = ", ".join(f"{count:,} {noun}{'s' * (count != 1)}" for count, noun in counts if count)
    origin = describe_origin(metadata.origin_of(root))
    return f"{text}. {origin}" if origin else text


def prepare_refill(root: bpy.types.Object, numbers: Collection[int]) -> None:
    """Remove tables, streaming and the levels that new ones do not replace, and stop watching the source.

    Args:
        numbers: numbers of the new levels, which reuse the objects of these levels. If none of them exists,
            the finest level takes the last number.
    """
    tables.remove_tables(root)
    streams.stop_streaming(root)
    painting.save_paint(root)
    root.lodgs.source.watch = False
    existing = root.lodgs.existing_levels
    reused = [item for item in existing if item.number in numbers] or existing[-1:]
    for item in existing:
        if item not in reused:
            cloud = item.object.data
            bpy.data.objects.remove(item.object)
            if not cloud.users:
                bpy.data.pointclouds.remove(cloud)
    for item in reused:
        if item.number not in numbers:
            number = list(numbers)[-1]
            if item.object.name == _level_name(root, item.number):
                item.object.name = _level_name(root, number)
            item.number = number
    levels_changed(root)


def read_levels(root: bpy.types.Object, placed: bool = False, looked: bool = False) -> Bundle:
    """Return the edited levels of a splat scene, without modifiers, hidden splats and cropped splats.

    Args:
        placed: apply the scene's placement in Blender, so that the result is upright; otherwise use the
            splats' space. Transforms of single level objects are ignored.
        looked: apply paint and looks (``looks``); otherwise return trained colours, with paint in separate
            columns.

    Raises:
        LodgsError: there are no levels, or crops remove all splats; for a placed bundle also if the root is
            scaled differently along its axes or the rule is unknown.
    """
    levels = [
        Level(item.number, objects.read_splats(item.object), metadata.read_facts(item.facts))
        for item in root.lodgs.existing_levels
    ]
    if not levels:
        raise LodgsError(
            f"Cannot read the levels of '{root.name}': it has no levels.", "Train it or import splats first."
        )
    settings = root.lodgs
    facts, meta = metadata.read_facts(settings.facts), metadata.meta_of(root)
    bundle = Bundle(
        settings.method, levels, settings.rule, facts, changed_controls(root), settings.cumulative, meta,
        tables.read_tables(root) | view_tables(root),
    )  # fmt: skip
    bundle = cleaning.remaining(root, bundle, bpy.context.evaluated_depsgraph_get())
    if looked:
        bundle = look.apply_looks_to_levels(bundle, _looks(root))
    if placed:
        bundle = placement.transform_bundle(bundle, placement_of(root))
        bundle.meta["up_rotation"] = np.eye(3)
    return bundle


def view_tables(root: bpy.types.Object, placed: bool = False) -> dict[str, dict[str, np.ndarray]]:
    """Return a scene's views as tables of its bundle, in their original order.

    Args:
        placed: see :func:`read_levels`.
    """
    cameras = sorted(
        (view for view in views(root) if view.data.lodgs.width), key=lambda view: view.data.lodgs.model_index
    )
    near = min((view.data.clip_start for view in cameras), default=0.0)
    axes = axes_of(root)
    unit = 1.0 if axes == root else axes.matrix_basis.to_scale().x  # ``ground.scale`` scales clip distances
    held_out = {view.name for view in cameras if is_held_out(root, view)}
    result = make_view_tables([camera_of(view) for view in cameras], near / unit, held_out)
    if placed and VIEWS in result:
        result[VIEWS] = transform_views(result[VIEWS], placement_of(root))
    return result


def delete_excluded(root: bpy.types.Object) -> int:
    """Delete the hidden and cropped splats of every level, and the crops; crops with a look stay as regions.

    Returns:
        The number of deleted splats.

    Raises:
        LodgsError: see :func:`read_levels`, or the levels are only the coarsest splats of a file.
    """
    file = streams.file_of(root)
    if file is not None:
        raise LodgsError(
            f"Cannot delete splats of '{root.name}': most of them are in {file.name}.",
            "Keep the crops, or edit the file with the command lodgs edit and import the result.",
        )
    count_before = sum(len(item.object.data.points) for item in root.lodgs.existing_levels)
    bundle = read_levels(root)
    for level in bundle.levels:
        put_level(root, level)
    for item in root.lodgs.levels:
        item.lost = 0
    for obj in crops.removing_crops(root):
        if looks.is_set(obj):  # keep the look as a region
            obj.lodgs_crop.keep = "ALL"
        else:
            bpy.data.objects.remove(obj)
    levels_changed(root)
    return count_before - sum(len(level.splats) for level in bundle.levels)


def read_level(root: bpy.types.Object, number: int, placed: bool = False, looked: bool = False) -> Splats:
    """Return one edited level; if levels are cumulative, with all coarser ones.

    Args:
        placed: see :func:`read_levels`.
        looked: see :func:`read_levels`.

    Raises:
        LodgsError: the level does not exist or is not a complete scene; or as :func:`read_levels`.
    """
    bundle = read_levels(root, placed, looked)
    for level in bundle.levels:
        if level.number == number:
            _require_complete(root, number)
            return complete_splats(bundle, level)
    raise LodgsError(
        f"Cannot read level {number}: '{root.name}' has no level {number}.", "Choose a level from the list."
    )


def visible_splats(
    context: bpy.types.Context, root: bpy.types.Object, placed: bool = False, looked: bool = False
) -> Splats:
    """Return the splats that detail settings and modifiers leave visible in the view layer.

    Columns that some visible levels lack are dropped.

    Args:
        placed: see :func:`read_levels`.
        looked: see :func:`read_levels`.

    Raises:
        LodgsError: no splats are visible, or the levels differ in their degree of spherical harmonics; for
            placed splats also if the root is scaled differently along its axes.
    """
    levels = [item.object for item in root.lodgs.existing_levels]
    with without_native_drawing(context), display.with_all_attributes(context, levels):
        depsgraph = context.evaluated_depsgraph_get()
        parts = [
            objects.read_splats(item.object, depsgraph)
            for item in root.lodgs.levels
            if _visible(context, item)
        ]
    if looked:
        parts = [look.apply_looks(part, _looks(root)) for part in parts]
    if not any(len(part) for part in parts):
        raise LodgsError(
            f"Cannot read visible splats: no splats of '{root.name}' are shown.", "Check the detail settings."
        )
    if len({part.sh_degree for part in parts}) > 1:
        raise LodgsError(
            f"Cannot combine the levels of '{root.name}': their degrees of spherical harmonics differ.",
            "Export a single level.",
        )
    splats = Splats.concatenated(parts)
    if not placed:
        return splats
    rule = find_rule(root.lodgs.rule)
    return placement_of(root).transform_splats(splats, *((rule.lengths, rule.places) if rule else ()))


@contextmanager
def without_native_drawing(context: bpy.types.Context) -> Iterator[None]:
    """Evaluate objects without the modifiers that apply weights and looks for Blender's own drawing."""
    settings = context.scene.lodgs_viewport
    previous = settings.splats, settings.drawn_by
    if compat.NATIVE_SPLATS is None or not settings.points:
        yield
        return
    settings.splats, settings.drawn_by = True, "LODGS"
    try:
        context.view_layer.update()
        yield
    finally:
        settings.splats, settings.drawn_by = previous


def count_visible(context: bpy.types.Context, root: bpy.types.Object) -> tuple[int, int]:
    """Return the number of visible splats as of the last evaluation, and of all splats."""
    depsgraph, visible, total = context.view_layer.depsgraph, 0, 0
    for item in root.lodgs.existing_levels:
        total += len(item.object.data.points)
        if depsgraph is not None and _visible(context, item):
            visible += display.point_count(item.object.evaluated_get(depsgraph).data)
    return visible, total


def show_only(root: bpy.types.Object, number: int) -> None:
    """Show one level everywhere; if levels are cumulative, with all coarser ones.

    Raises:
        LodgsError: the level is not a complete scene.
    """
    _require_complete(root, number)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", number
    for item in root.lodgs.levels:
        if item.number == number or (root.lodgs.cumulative and item.number < number):
            item.show = True


def attach_ellipsoids(scene: bpy.types.Scene) -> None:
    """Give every level of a Blender scene the ellipsoid modifier, and raise Cycles' transparent bounces."""
    for root in roots(scene):
        for item in root.lodgs.existing_levels:
            ellipsoids.attach(item.object)
    if hasattr(scene, "cycles"):
        ellipsoids.raise_bounces(scene.cycles, bounced_light_only=scene.lodgs_render.is_for_meshes)


def _looks(root: bpy.types.Object) -> look.Looks:
    """Return the current looks of a scene."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    from_world = world_matrix(axes_of(root), depsgraph).inverted_safe()
    return looks.looks_of(root, depsgraph, from_world)


def _require_complete(root: bpy.types.Object, number: int) -> None:
    finest = max((item.number for item in root.lodgs.existing_levels), default=number)
    if number < finest and not root.lodgs.complete:
        raise LodgsError(*standalone_error(number, finest))


def _visible(context: bpy.types.Context, item) -> bool:
    return item.exists and item.object.visible_get(view_layer=context.view_layer)


def put_level(
    root: bpy.types.Object, level: Level, level_object: bpy.types.Object | None = None
) -> bpy.types.Object:
    """Add or replace a level's object and list entry, without updating list-wide settings and drivers.

    Args:
        level_object: new object with the level's splats, in no collection; None to create it.
    """
    settings = root.lodgs
    new_object = level_object or objects.new_splats("", painting.transfer(root, level).splats)
    new_object.name = new_object.data.name = _level_name(root, level.number)
    item = next((entry for entry in settings.levels if entry.number == level.number), None)
    if item is None:
        item = settings.levels.add()
        item.number = level.number
        position = sum(entry.number < level.number for entry in settings.levels)
        settings.levels.move(len(settings.levels) - 1, position)
        item = settings.levels[position]
    elif item.exists:
        # Keep the object with its children and modifiers; replace only its splats.
        old_cloud, obj = item.object.data, item.object
        if obj.mode != "OBJECT":  # Blender cannot exchange data in other modes
            with extension.in_window():
                bpy.ops.object.mode_set(mode="OBJECT")
        item.lost = _carry_over(old_cloud, new_object.data)
        obj.data, obj.color = new_object.data, new_object.color
        bpy.data.objects.remove(new_object)
        if not old_cloud.users:  # linked duplicates keep it
            name = old_cloud.name
            bpy.data.pointclouds.remove(old_cloud)
            obj.data.name = name
        new_object = obj
    if not new_object.users_collection:  # an existing object keeps its parent, or none after Alt-P
        new_object.parent = axes_of(root)
        lock_transform(new_object)  # Blender's Apply would change positions only, and exports ignore it
        levels_collection(root).objects.link(new_object)
    item.object = new_object
    item.facts = json.dumps(level.facts)
    return new_object


def _carry_over(old: bpy.types.PointCloud, new: bpy.types.PointCloud) -> int:
    """Copy materials and, to the same splats, hidden marks. Return the number of splats shown again."""
    new.materials.clear()
    for material in old.materials:
        new.materials.append(material)
    hidden = cleaning.hidden_mask(old)
    if not hidden.any():
        return 0
    if not same_rows(cleaning.splat_attribute(old, "position"), cleaning.splat_attribute(new, "position")):
        return int(hidden.sum())
    write_attribute(new, HIDDEN, "BOOLEAN", hidden)
    return 0


def _level_name(root: bpy.types.Object, number: int) -> str:
    return f"{root.name} level {number}"


def levels_changed(root: bpy.types.Object) -> None:
    """Update the list of levels: drop deleted ones, clamp settings and renew drivers."""
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
            attach_ellipsoids(scene)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """React to artists' edits: deleted levels, changed crops and looks, new materials."""
    editable = [root for root in roots(scene) if root.is_editable]
    if depsgraph.id_type_updated("COLLECTION"):
        for root in editable:
            if not all(item.exists for item in root.lodgs.levels):
                levels_changed(root)
    if depsgraph.id_type_updated("OBJECT"):
        for root in editable:
            if crops.is_outdated(root) or looks.is_outdated(root):
                selection.follow_crops(root)
    if any(update.is_updated_geometry for update in depsgraph.updates):
        for root in editable:
            selection.update_inputs(root)
        selection.keep_points_of_copies(scene)


@bpy.app.handlers.persistent
def _before_undo(*_) -> None:
    for root in _all_editable():
        selection.detach_references(root)


@bpy.app.handlers.persistent
def _after_undo(*_) -> None:
    for root in _all_editable():
        selection.follow_crops(root)


def _all_editable() -> list[bpy.types.Object]:
    return [obj for obj in bpy.data.objects if obj.lodgs.is_root and obj.is_editable]


def _handlers():
    """Return pairs of Blender's handler lists and our handlers."""
    handlers = bpy.app.handlers
    yield handlers.depsgraph_update_post, _on_update
    for callbacks in (handlers.undo_pre, handlers.redo_pre):
        yield callbacks, _before_undo
    for callbacks in (handlers.undo_post, handlers.redo_post):
        yield callbacks, _after_undo


def register() -> None:
    for handlers, callback in _handlers():
        handlers.append(callback)


def unregister() -> None:
    for handlers, callback in _handlers():
        handlers.remove(callback)
