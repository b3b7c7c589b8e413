"""What is shown of a splat scene: its rule's node groups on every level, driven by the scene's settings.

Every level has one modifier that is on where levels are chosen by distance: the group of the scene's rule
(``nodes.rules``). Its facts are set, its controls and the eye are driven by bare names, so that Blender
evaluates them even where it may not run scripts, and without any handler. Reading the sockets of an evaluated
modifier gives the rule's arguments back: :func:`choice`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.lod.query import LodQuery
from ...training.lod.rule import Rule, collect_facts, fact_names, find_rule
from .. import compat
from ..nodes import crops as crop_groups
from ..nodes import display
from ..nodes import look as look_groups
from ..nodes import rules as groups
from ..nodes.building import remove_modifier, replace_driver
from . import crops, looks
from .placement import axes_of
from .tables import read_table


def choice(evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> LodQuery | None:
    """What the modifiers of an evaluated level choose by, as of the depsgraph: its crops, then its rule.

    None where all is shown. A modifier whose group somebody has changed counts as none (:func:`only_chosen`).
    """
    cropped = crops.of_modifier(evaluated, depsgraph, lambda modifier: _is_on(modifier, depsgraph))
    modifier = rule_modifier(evaluated)
    rule = None if modifier is None else groups.rule_of_group(modifier.node_group)
    if modifier is None or rule is None or not _is_on(modifier, depsgraph):
        return None if cropped is None else LodQuery.from_crops(cropped)

    def value(name: str):
        return compat.get_input(modifier, name)

    held = value(groups.FREEZE) or value(groups.CAMERA_SOURCE) >= groups.VIEW_SOURCE
    whose = groups.CAMERA_SOURCES[min(max(value(groups.CAMERA_SOURCE), 0), groups.VIEW_SOURCE)]
    if held or whose == "TRAINING":
        eye = tuple(value(groups.CAMERA_POSITION))
    else:
        obj = depsgraph.scene.camera if whose == "CAMERA" else value(groups.CAMERA_OBJECT)
        eye = (0.0, 0.0, 0.0)  # as geometry nodes have it without an object
        if obj is not None:
            place = obj.evaluated_get(depsgraph).matrix_world.translation
            eye = tuple(evaluated.matrix_world.inverted_safe() @ place)
    return LodQuery(
        rule.name,
        eye,
        value(groups.STORED_FOCAL if held else groups.FOCAL),
        tuple((name, value(name)) for name in fact_names(rule)),
        tuple((control.name, value(control.name)) for control in rule.controls),
        tuple((name, _frozen(value(groups.table_socket(name)))) for name in rule.tables),
        cropped,
    )


def _frozen(obj: bpy.types.Object | None) -> tuple[tuple[str, str, bytes], ...]:
    """A table's columns as :class:`LodQuery` keeps them."""
    columns = read_table(obj.original) if obj is not None else {}
    return tuple((name, values.dtype.str, values.tobytes()) for name, values in columns.items())


def only_chosen(evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether an evaluated object shows its own splats as they are, chosen by nothing but :func:`choice`."""
    return all(
        modifier.type == "NODES" and (modifier.name == display.NAME or _chooses(modifier.node_group))
        for modifier in evaluated.modifiers
        if _is_on(modifier, depsgraph)
    )


def _chooses(group: bpy.types.NodeTree | None) -> bool:
    """Whether a modifier's group is a rule's, the crops' or the look's, and what they made it."""
    return (
        groups.rule_of_group(group) is not None
        or crop_groups.crop_count(group) is not None
        or look_groups.is_unedited_look(group)
    )


def _is_on(modifier: bpy.types.Modifier, depsgraph: bpy.types.Depsgraph) -> bool:
    return modifier.show_render if depsgraph.mode == "RENDER" else modifier.show_viewport


def read_json(text: str) -> dict:
    """What a property holds as JSON; nothing where somebody has made something else of it."""
    try:
        found = json.loads(text or "{}")
        json.dumps(found, allow_nan=False)  # what files can hold
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def read_facts(text: str) -> dict[str, float]:
    """The numbers of :func:`read_json`, by name."""
    return {name: value for name, value in read_json(text).items() if isinstance(value, int | float)}


def eye_place(root: bpy.types.Object, scene: bpy.types.Scene) -> tuple[float, float, float]:
    """Where the chosen eye is, in the splats' space, frozen or not. The viewport's starts at the camera's."""
    settings = root.lodgs
    if settings.eye == "TRAINING":
        return tuple(settings.camera_center)
    obj = settings.eye_object if settings.eye == "OBJECT" else scene.camera
    if obj is None:
        return (0.0, 0.0, 0.0)  # as geometry nodes have it
    return tuple(axes_of(root).matrix_world.inverted_safe() @ obj.matrix_world.translation)


def hold(root: bpy.types.Object, eye: tuple[float, float, float], focal_px: float) -> None:
    """Has distances measured from a place in the splats' own space, while they are frozen or the viewport's.

    Nothing happens where that is the case already: setting evaluates the scene anew.
    """
    settings = root.lodgs
    if not np.array_equal(np.float32(eye), np.float32(settings.held_eye)):
        settings.held_eye = eye
    if np.float32(focal_px) != np.float32(settings.held_focal):
        settings.held_focal = focal_px


def attach(root: bpy.types.Object) -> None:
    """Gives every level of a splat scene its rule's modifier and its drivers, anew where they exist already.

    Needed after the list of levels, the rule or its facts have changed. Levels whose rule is unknown, or
    which have none, are shown one at a time.
    """
    settings = root.lodgs
    crops.attach(root)
    looks.attach(root)
    _drive_focal_length(root)
    rule = find_rule(settings.rule)
    levels = [(item.number, read_facts(item.facts)) for item in settings.levels if item.exists]
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
            except LodgsError:  # of a level that is still on its way
                _detach(item.object)
                continue
            _drive_level(root, item.object, rule, facts)
    _order(root)
    update_inputs(root)


def follow_crops(root: bpy.types.Object) -> None:
    """Has the levels' modifiers follow the crops, looks and hidden splats that there are now."""
    crops.attach(root)
    looks.attach(root)
    _order(root)
    update_inputs(root)


def _order(root: bpy.types.Object) -> None:
    """Put the modifiers of levels into the order in which they work.

    Crops come before a rule that asks how many splats there are; else after it, where fewer are left. Weights
    are applied last.
    """
    for item in root.lodgs.levels:
        if item.exists:
            display.keep_last(item.object)
    rule = find_rule(root.lodgs.rule)
    for item in root.lodgs.levels if rule else ():
        cropping, own = (
            (crops.modifier_of(item.object), rule_modifier(item.object)) if item.exists else (None, None)
        )
        if cropping and own and rule:
            modifiers = item.object.modifiers
            place, there = modifiers.find(cropping.name), modifiers.find(own.name)
            if (place < there) == rule.apart:
                modifiers.move(place, there)


def outdated(root: bpy.types.Object) -> bool:
    """Whether a level's modifier is not the one that this version makes: its file is an older one's."""
    rule = find_rule(root.lodgs.rule)
    modifiers = [rule_modifier(item.object) for item in root.lodgs.levels if item.exists]
    if rule is None:
        return any(modifiers)
    return not all(modifier and groups.is_current(modifier.node_group, rule) for modifier in modifiers)


def update_inputs(root: bpy.types.Object) -> None:
    """Hands on to the modifiers what cannot be driven: the chosen eye, tables, a level's material."""
    for modifier, name, value in _given(root):
        _set(modifier, name, value, lambda there, value: there == value)


def let_go(root: bpy.types.Object) -> None:
    """Has the levels point at nothing of their scene, until :func:`follow_crops` gives it to them again.

    Before an undo: Blender keeps in memory every object that its two steps hold alike. Levels are given crops
    and all else after a step is made, so that such a one may point at an object that goes: a crash.
    """
    for modifier, name, _ in list(_given(root)):
        _set(modifier, name, None, lambda there, _: there is None)
    for item in root.lodgs.levels:
        if item.exists:
            crops.detach(item.object)
            looks.detach(item.object)


def _given(root: bpy.types.Object) -> Iterator[tuple[bpy.types.NodesModifier, str, bpy.types.ID | None]]:
    """The inputs of the levels' modifiers that cannot be driven, by name, and what they are to be."""
    tables = {
        groups.table_socket(item.name): item.object if item.exists else None for item in root.lodgs.tables
    }
    for item in root.lodgs.levels:
        modifier = rule_modifier(item.object) if item.exists else None
        slots = item.object.material_slots if item.exists else ()
        material = {groups.MATERIAL: slots[0].material if slots else None}
        cropping = crops.modifier_of(item.object) if item.exists else None
        eye = {groups.CAMERA_OBJECT: root.lodgs.eye_object}
        showing = item.object.modifiers.get(display.NAME) if item.exists else None
        points = {display.MATERIAL: material[groups.MATERIAL] or display.points_material()}
        for each, given in ((modifier, eye | tables | material), (cropping, material), (showing, points)):
            if each is not None:
                yield from ((each, name, value) for name, value in given.items())


def _set(modifier: bpy.types.NodesModifier, name: str, value, same: Callable[[Any, Any], bool]) -> None:
    """Sets an input that is another: setting evaluates anew. A changed group may have lost it."""
    if compat.has_input(modifier, name) and not same(compat.get_input(modifier, name), value):
        compat.set_input(modifier, name, value)


def _drive_focal_length(root: bpy.types.Object) -> None:
    """f = lens * fitted side in pixels / fitted side of the sensor, as Blender's render has it.

    Blender fits the render's longer side to the sensor's width unless told otherwise; where pixels are not
    square, the smaller of fx and fy counts, as in ``training.scenes.cameras.Camera.focal``. Without a camera,
    Blender's standard one is assumed.
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
        variable = driver.variables.new()
        variable.name, variable.type = name, "CONTEXT_PROP"
        target = variable.targets[0]
        target.context_property, target.data_path = "ACTIVE_SCENE", path
        if fallback is not None:
            target.use_fallback_value, target.fallback_value = True, fallback


def _drive(
    obj: bpy.types.Object,
    path: str,
    root: bpy.types.Object,
    expression: str,
    without: Mapping[str, float] | None = None,
    index: int = -1,
    **sources: str,
) -> None:
    """Drives a property by an expression of the root's properties: names, and their paths in ``lodgs``.

    Args:
        index: of a vector's component.
        without: values of names where this extension, and with it the properties, are missing; others are 0.
    """
    driver = replace_driver(obj, path, expression, index)
    for name, source in sources.items():
        variable = driver.variables.new()
        variable.name, variable.type = name, "SINGLE_PROP"
        target = variable.targets[0]
        target.id, target.data_path = root, f"lodgs.{source}"
        if without is not None:
            target.use_fallback_value, target.fallback_value = True, without.get(name, 0)


def _drive_visibility(root: bpy.types.Object, index: int, item, rule: Rule | None) -> None:
    """A level is there where its rule has use for it, or where it is the one shown or adds to that.

    Where this extension is missing, the finest one is there, so that nobody opens an empty file.
    """
    number, sources = item.number, {"show": f"levels[{index}].show"}
    sources |= {name: name for name in ("mode", "single_level", "cumulative")}
    in_use = "mode == 1"
    for control in rule.controls if rule else ():
        if control.follows:  # what is not in use is not even evaluated
            sources[control.name] = f"{rule.name}.{control.name}"
            in_use += f" and {control.name} {'<=' if control.follows == 'coarsest' else '>='} {number}"
    alone = f"{number} == single_level or (cumulative and {number} <= single_level)"
    finest = max(one.number for one in root.lodgs.levels if one.exists)
    without = {"show": 1, "single_level": finest, "cumulative": root.lodgs.cumulative}
    for path in ("hide_viewport", "hide_render"):
        expression = f"0 if show and (({in_use}) or (mode == 0 and ({alone}))) else 1"
        _drive(item.object, path, root, expression, without, **sources)


def _drive_level(root: bpy.types.Object, obj: bpy.types.Object, rule: Rule, facts: Mapping) -> None:
    modifier = _modifier_of(obj, rule)
    for name, value in facts.items():
        _set(modifier, name, float(value), lambda there, value: there == np.float32(value))
    for path in ("show_viewport", "show_render"):
        _drive(obj, f'modifiers["{modifier.name}"].{path}', root, "mode", mode="mode")
    driven = {name: name for name in (groups.CAMERA_SOURCE, groups.FREEZE, groups.FOCAL, groups.STORED_FOCAL)}
    driven |= {control.name: f"{rule.name}.{control.name}" for control in rule.controls}
    for name, source in driven.items():
        if compat.has_input(modifier, name):
            _drive(obj, compat.input_path(modifier, name), root, name, **{name: source})
    # Setting it would tell Blender that the points have changed, at every step of the viewport's eye.
    for axis in range(3) if compat.has_input(modifier, groups.CAMERA_POSITION) else ():
        sources = {"held": f"held_eye[{axis}]", "center": f"camera_center[{axis}]"}
        sources |= {name: name for name in (groups.CAMERA_SOURCE, groups.FREEZE)}
        expression = f"held if {groups.FREEZE} or {groups.CAMERA_SOURCE} == {groups.VIEW_SOURCE} else center"
        _drive(
            obj, compat.input_path(modifier, groups.CAMERA_POSITION), root, expression, index=axis, **sources
        )


def _modifier_of(obj: bpy.types.Object, rule: Rule) -> bpy.types.NodesModifier:
    """The modifier with a rule's group, made where there is none, in the place of one with another rule."""
    modifier = rule_modifier(obj)
    place = len(obj.modifiers)
    if modifier is not None and not groups.is_current(
        modifier.node_group, rule
    ):  # another method's, or older
        place = obj.modifiers.find(modifier.name)
        _detach(obj)
        modifier = None
    if modifier is None:
        group = groups.rule_group(rule)
        modifier = obj.modifiers.new(group.name, "NODES")
        assert isinstance(modifier, bpy.types.NodesModifier)
        modifier.node_group, modifier.show_expanded = group, False
        obj.modifiers.move(len(obj.modifiers) - 1, min(place, len(obj.modifiers) - 1))
    return modifier


def _detach(obj: bpy.types.Object) -> None:
    """Takes away the modifier that chooses by distance."""
    modifier = rule_modifier(obj)
    if modifier is not None:
        remove_modifier(obj, modifier)


def rule_modifier(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The modifier that chooses by distance, whichever rule and version it is of."""
    for modifier in obj.modifiers:
        group = modifier.node_group if isinstance(modifier, bpy.types.NodesModifier) else None
        if group and groups.RULE in group:
            return modifier
    return None
