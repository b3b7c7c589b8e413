"""Selection of visible splats: node groups of a scene's rule on every level, driven by the scene's settings.

Every level has a modifier with the node group of the scene's rule (``nodes.rules``), enabled in the mode By
Distance. Scene facts are plain inputs. Controls and camera are driven by expressions of bare names, which
Blender evaluates without handlers and even without permission to run scripts. :func:`evaluated_query`
converts the sockets of an evaluated modifier back to the rule's arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.lod.query import LodQuery
from ...training.lod.rule import Rule, collect_facts, fact_names, find_rule
from .. import compat
from ..attributes import WEIGHT
from ..nodes import crops as crop_groups
from ..nodes import display
from ..nodes import look as look_groups
from ..nodes import rules as groups
from ..nodes.building import add_modifier, read_scene, remove_modifier, replace_driver
from ..nodes.camera_choices import CHOICES, find_choice, position_expression
from . import crops, looks
from .metadata import read_facts
from .placement import axes_of
from .tables import read_table


def evaluated_query(evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> LodQuery | None:
    """Return the arguments of the crops and the rule of an evaluated level, as of the depsgraph.

    Returns:
        None if all splats are shown. Modifiers with edited node groups are ignored; see
        :func:`only_lodgs_modifiers`.
    """
    cropped = crops.modifier_crops(evaluated, depsgraph, lambda modifier: _is_on(modifier, depsgraph))
    modifier = rule_modifier(evaluated)
    rule = None if modifier is None else groups.rule_of_group(modifier.node_group)
    if modifier is None or rule is None or not _is_on(modifier, depsgraph):
        return None if cropped is None else LodQuery.from_crops(cropped)

    def value(name: str):
        return compat.get_input(modifier, name)

    choice = CHOICES[min(max(value(groups.CAMERA_SOURCE), 0), len(CHOICES) - 1)]
    is_stored = value(groups.FREEZE) or choice.viewport
    if is_stored or choice.position:
        position = tuple(value(groups.CAMERA_POSITION))
    else:
        obj = value(choice.object) if choice.object else depsgraph.scene.camera
        position = (0.0, 0.0, 0.0)  # the default of geometry nodes without an object
        if obj is not None:
            location = obj.evaluated_get(depsgraph).matrix_world.translation
            position = tuple(evaluated.matrix_world.inverted_safe() @ location)
    return LodQuery(
        rule.name,
        position,
        value(groups.STORED_FOCAL if is_stored else groups.FOCAL),
        tuple((name, value(name)) for name in fact_names(rule)),
        tuple((control.name, value(control.name)) for control in rule.controls),
        tuple((name, _table_columns(value(groups.table_socket(name)))) for name in rule.tables),
        cropped,
    )


def _table_columns(obj: bpy.types.Object | None) -> tuple[tuple[str, str, bytes], ...]:
    """Return a table's columns in the form of :class:`LodQuery`."""
    columns = read_table(obj.original) if obj is not None else {}
    return tuple((name, values.dtype.str, values.tobytes()) for name, values in columns.items())


def only_lodgs_modifiers(evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if no modifiers other than those of :func:`evaluated_query` act on an evaluated object."""
    return all(
        _is_lodgs_modifier(modifier) for modifier in evaluated.modifiers if _is_on(modifier, depsgraph)
    )


def _is_lodgs_modifier(modifier: bpy.types.Modifier) -> bool:
    return modifier.type == "NODES" and (
        modifier.name in (display.NAME, display.VIEWPORT) or _selects(modifier.node_group)
    )


def _has_other_modifiers(obj: bpy.types.Object) -> bool:
    """Return whether an object has modifiers of artists, which may read every attribute."""
    return not all(display.is_display(item) or _is_lodgs_modifier(item) for item in obj.modifiers)


def _selects(group: bpy.types.NodeTree | None) -> bool:
    """Return True for an unedited node group of a rule, of crops or of a look."""
    return (
        groups.rule_of_group(group) is not None
        or crop_groups.crop_count(group) is not None
        or look_groups.is_unedited_look(group)
    )


def _is_on(modifier: bpy.types.Modifier, depsgraph: bpy.types.Depsgraph) -> bool:
    return modifier.show_render if depsgraph.mode == "RENDER" else modifier.show_viewport


def camera_position(root: bpy.types.Object, scene: bpy.types.Scene) -> tuple[float, float, float]:
    """Return the position of the selected camera in the splats' space, ignoring Freeze.

    For the viewport this is the position of the scene camera.
    """
    settings = root.lodgs
    choice = find_choice(settings.camera_choice)
    if choice.position and not choice.viewport:
        return tuple(getattr(settings, choice.position))
    obj = getattr(settings, choice.object) if choice.object else scene.camera
    if obj is None:
        return (0.0, 0.0, 0.0)  # as in geometry nodes
    x, y, z = axes_of(root).matrix_world.inverted_safe() @ obj.matrix_world.translation
    return x, y, z


def store_camera(root: bpy.types.Object, position: tuple[float, float, float], focal_px: float) -> None:
    """Set the position, in the splats' space, for Freeze and for the viewport as camera.

    Equal values are not set: setting causes an evaluation.
    """
    settings = root.lodgs
    if not np.array_equal(np.float32(position), np.float32(settings.stored_position)):
        settings.stored_position = position
    if np.float32(focal_px) != np.float32(settings.stored_focal):
        settings.stored_focal = focal_px


def attach(root: bpy.types.Object) -> None:
    """Give every level of a splat scene its rule's modifier and drivers, replacing existing ones.

    Call it after changes of the levels, the rule or its facts. Without a known rule, levels are shown one at
    a time.
    """
    settings = root.lodgs
    crops.attach(root)
    looks.attach(root)
    _drive_focal_length(root)
    rule = find_rule(settings.rule)
    levels = [(item.number, read_facts(item.facts)) for item in settings.existing_levels]
    scene = read_facts(settings.facts)
    if rule is None:
        settings.mode = "SINGLE"
    for index, item in enumerate(settings.levels):
        if item.exists:
            _drive_visibility(root, index, item, rule)
            if rule is None:
                _detach(item.object)
                continue
            try:
                facts = collect_facts(rule, scene, levels, item.number)
            except LodgsError:  # training has not written the level's facts yet
                _detach(item.object)
                continue
            _drive_level(root, item.object, rule, facts)
    _order(root)
    update_inputs(root)


def follow_crops(root: bpy.types.Object) -> None:
    """Update the levels' modifiers to the current crops, looks and hidden splats."""
    crops.attach(root)
    looks.attach(root)
    _order(root)
    update_inputs(root)


def _order(root: bpy.types.Object) -> None:
    """Put the modifiers of levels into the order in which they work.

    Crops come before a rule that depends on the number of splats, and otherwise after it, since fewer splats
    remain there. Weights are applied last. Without modifiers of artists, harmonics are dropped first in
    viewports that do not need them: removing splats copies all attributes of the others.
    """
    for item in root.lodgs.existing_levels:
        copies = crops.modifier_of(item.object) or rule_modifier(item.object)
        if copies and not _has_other_modifiers(item.object):
            display.drop_harmonics(item.object)
        display.keep_order(item.object)
    rule = find_rule(root.lodgs.rule)
    for item in root.lodgs.existing_levels if rule else ():
        cropping, selecting = crops.modifier_of(item.object), rule_modifier(item.object)
        if cropping and selecting and rule:
            modifiers = item.object.modifiers
            crop_index, rule_index = modifiers.find(cropping.name), modifiers.find(selecting.name)
            if (crop_index < rule_index) == rule.independent:
                modifiers.move(crop_index, rule_index)


def is_outdated(root: bpy.types.Object) -> bool:
    """Return True if a level's modifier was made by an older version."""
    rule = find_rule(root.lodgs.rule)
    modifiers = [rule_modifier(item.object) for item in root.lodgs.existing_levels]
    if rule is None:
        return any(modifiers)
    return not all(modifier and groups.is_current(modifier.node_group, rule) for modifier in modifiers)


def update_inputs(root: bpy.types.Object) -> None:
    """Set the modifier inputs that cannot be driven: camera object, tables and materials.

    Levels get all points and attributes if modifiers of artists need them.
    """
    for item in root.lodgs.existing_levels:
        if display.VIEWPORT in item.object.modifiers and _has_other_modifiers(item.object):
            display.keep_harmonics(item.object)
        if _needs_points(item.object):
            display.keep_points(item.object)
        else:
            display.reduce_points(item.object)
    for modifier, name, value in _object_inputs(root):
        _set(modifier, name, value, lambda current, value: current == value)


def keep_points_of_copies(scene: bpy.types.Scene) -> None:
    """Keep the points of copies of levels that artists gave modifiers."""
    for obj in scene.objects:
        if obj.type == "POINTCLOUD" and obj.is_editable and _needs_points(obj):
            display.keep_points(obj)


def _needs_points(obj: bpy.types.Object) -> bool:
    """Return whether a splat object is read or edited after its modifiers."""
    return obj.mode == "EDIT" or WEIGHT in obj.data.attributes or _has_other_modifiers(obj)


def detach_references(root: bpy.types.Object) -> None:
    """Remove the levels' references to other objects until :func:`follow_crops` restores them.

    Call it before an undo. Blender keeps objects that are equal in both undo steps, and levels get crops
    after a step is stored, so that a kept level could reference a deleted object and crash Blender.
    """
    for modifier, name, _ in list(_object_inputs(root)):
        _set(modifier, name, None, lambda current, _: current is None)
    for item in root.lodgs.existing_levels:
        crops.detach(item.object)
        looks.detach(item.object)


def _object_inputs(
    root: bpy.types.Object,
) -> Iterator[tuple[bpy.types.NodesModifier, str, bpy.types.ID | None]]:
    """Return the modifier inputs that cannot be driven, as tuples of modifier, name and value."""
    tables = {
        groups.table_socket(item.name): item.object if item.exists else None for item in root.lodgs.tables
    }
    for item in root.lodgs.existing_levels:
        modifier = rule_modifier(item.object)
        slots = item.object.material_slots
        material = {groups.MATERIAL: slots[0].material if slots else None}
        cropping = crops.modifier_of(item.object)
        camera = {choice.object: getattr(root.lodgs, choice.object) for choice in CHOICES if choice.object}
        display_modifier = item.object.modifiers.get(display.NAME)
        points = {display.MATERIAL: material[groups.MATERIAL] or display.points_material()}
        for owner, inputs in (
            (modifier, camera | tables | material),
            (cropping, material),
            (display_modifier, points),
        ):
            if owner is not None:
                yield from ((owner, name, value) for name, value in inputs.items())


def _set(modifier: bpy.types.NodesModifier, name: str, value, is_equal: Callable[[Any, Any], bool]) -> None:
    """Set an input if its value differs: setting causes an evaluation. Edited groups may lack the input."""
    if compat.has_input(modifier, name) and not is_equal(compat.get_input(modifier, name), value):
        compat.set_input(modifier, name, value)


def _drive_focal_length(root: bpy.types.Object) -> None:
    """Drive the focal length in pixels: lens * fitted side in pixels / fitted side of the sensor.

    By default Blender fits the render's longer side to the sensor's width. For non-square pixels the smaller
    of fx and fy is used, as in ``training.scenes.cameras.Camera.focal``. Without a camera, Blender's default
    camera is assumed.
    """
    variables = {
        "lens": ("camera.data.lens", 50.0),
        "fit": ("camera.data.sensor_fit", 0.0),
        "sw": ("camera.data.sensor_width", 36.0),
        "sh": ("camera.data.sensor_height", 24.0),
        "rx": ("render.resolution_x", None),
        "ry": ("render.resolution_y", None),
        "p": ("render.resolution_percentage", None),
        "ax": ("render.pixel_aspect_x", None),
        "ay": ("render.pixel_aspect_y", None),
    }
    width, height = "floor(rx * p / 100)", "floor(ry * p / 100)"
    driver = replace_driver(
        root,
        "lodgs.focal_px",
        f"lens * min(1, ax / ay) * ({width} / sw if fit == 1 or (fit == 0 and ax * {width} >= ay * {height})"
        f" else {height} * ay / ax / (sh if fit == 2 else sw))",
    )
    for name, (path, fallback) in variables.items():
        read_scene(driver, name, path, fallback)


def _drive(
    obj: bpy.types.Object,
    path: str,
    root: bpy.types.Object,
    expression: str,
    without: Mapping[str, float] | None = None,
    index: int = -1,
    **sources: str,
) -> bpy.types.Driver:
    """Drive a property by an expression of the root's properties, and return the driver.

    Args:
        index: component of a vector.
        without: fallback values by name if the extension, and with it the properties, is missing; 0 by
            default.
        sources: paths in ``lodgs`` by variable name.
    """
    driver = replace_driver(obj, path, expression, index)
    for name, source in sources.items():
        variable = driver.variables.new()
        variable.name, variable.type = name, "SINGLE_PROP"
        target = variable.targets[0]
        target.id, target.data_path = root, f"lodgs.{source}"
        if without is not None:
            target.use_fallback_value, target.fallback_value = True, without.get(name, 0)
    return driver


def _drive_visibility(root: bpy.types.Object, index: int, item, rule: Rule | None) -> None:
    """Show a level where its rule uses it, or where it is the single level or adds to it.

    Hiding the root hides all levels, so that artists can hide a scene in the Outliner, also with keyframes.
    If the extension is missing, the finest level is shown, so that the file does not appear empty. A scene
    that renders meshes for another one shows no splats to the camera, also in instances.
    """
    number, sources = item.number, {"show": f"levels[{index}].show"}
    sources |= {name: name for name in ("mode", "single_level", "cumulative")}
    in_use = "mode == 1"
    for control in rule.controls if rule else ():
        if control.follows:  # Blender does not evaluate hidden levels
            sources[control.name] = f"{rule.name}.{control.name}"
            in_use += f" and {control.name} {'<=' if control.follows == 'coarsest' else '>='} {number}"
    is_single = f"{number} == single_level or (cumulative and {number} <= single_level)"
    finest = max(level.number for level in root.lodgs.existing_levels)
    without = {"show": 1, "single_level": finest, "cumulative": root.lodgs.cumulative}
    for path in ("hide_viewport", "hide_render"):
        hidden = "hidden or " if path == "hide_render" else ""
        expression = f"root_hidden or {hidden}not (show and (({in_use}) or (mode == 0 and ({is_single}))))"
        driver = _drive(item.object, path, root, expression, without, **sources)
        variable = driver.variables.new()
        variable.name, variable.targets[0].id, variable.targets[0].data_path = "root_hidden", root, path
        if hidden:
            read_scene(driver, "hidden", "lodgs_render.hides_splats")
    read_scene(
        replace_driver(item.object, "visible_camera", "not hidden"), "hidden", "lodgs_render.is_for_meshes"
    )


def _drive_level(root: bpy.types.Object, obj: bpy.types.Object, rule: Rule, facts: Mapping) -> None:
    modifier = _ensure_modifier(obj, rule)
    for name, value in facts.items():
        _set(modifier, name, float(value), lambda current, value: current == np.float32(value))
    for path in ("show_viewport", "show_render"):
        _drive(obj, f'modifiers["{modifier.name}"].{path}', root, "mode", mode="mode")
    paths = {name: name for name in (groups.CAMERA_SOURCE, groups.FREEZE, groups.FOCAL, groups.STORED_FOCAL)}
    paths |= {control.name: f"{rule.name}.{control.name}" for control in rule.controls}
    for name, source in paths.items():
        if compat.has_input(modifier, name):
            _drive(obj, compat.input_path(modifier, name), root, name, **{name: source})
    # Setting it would mark the points as changed at every move of the viewport.
    expression = position_expression(groups.CAMERA_SOURCE, groups.FREEZE)
    for axis in range(3) if compat.has_input(modifier, groups.CAMERA_POSITION) else ():
        sources = {choice.position: f"{choice.position}[{axis}]" for choice in CHOICES if choice.position}
        sources |= {name: name for name in (groups.CAMERA_SOURCE, groups.FREEZE)}
        _drive(
            obj, compat.input_path(modifier, groups.CAMERA_POSITION), root, expression, index=axis, **sources
        )


def _ensure_modifier(obj: bpy.types.Object, rule: Rule) -> bpy.types.NodesModifier:
    """Return the modifier with a rule's group; create it, or replace one with another group."""
    modifier = rule_modifier(obj)
    index = len(obj.modifiers)
    if modifier is not None and not groups.is_current(
        modifier.node_group, rule
    ):  # of another method or version
        index = obj.modifiers.find(modifier.name)
        _detach(obj)
        modifier = None
    if modifier is None:
        modifier = add_modifier(obj, groups.rule_group(rule))
        obj.modifiers.move(len(obj.modifiers) - 1, min(index, len(obj.modifiers) - 1))
    return modifier


def _detach(obj: bpy.types.Object) -> None:
    """Remove the rule's modifier."""
    remove_modifier(obj, rule_modifier(obj))


def rule_modifier(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """Return the modifier of a rule, of any rule and version."""
    for modifier in obj.modifiers:
        if isinstance(modifier, bpy.types.NodesModifier):
            group = modifier.node_group
            if group and groups.RULE in group:
                return modifier
    return None
