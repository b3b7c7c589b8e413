"""What is shown of a splat scene: drivers that turn its detail settings into visible levels and distances.

Every level has one modifier that is on where levels are chosen by distance: the group of its method's rule,
"LODGS Distance Band" (FLoD) or "LODGS Octree Level" (Octree-GS).
All drivers are simple expressions, which Blender evaluates even where it may not run scripts, and they
follow ``root.lodgs`` and the scene's camera without any handler.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ..training.lod.rules import band_mask, octree_wanted, octree_weights
from . import compat
from .nodes import distance_band as band
from .nodes import octree_level as octree
from .nodes.building import EYE, EYE_OBJECT, EYE_POSITION, EYES, MATERIAL
from .nodes.display import NAME as DISPLAY

NEVER = 1e30
"""A distance beyond every scene, in place of infinity, which driver expressions cannot say."""


@dataclass(frozen=True)
class BandRule:
    """Splats with near <= distance < far from the eye, all in the splats' space: a level's band (FLoD)."""

    eye: tuple[float, float, float]
    near: float
    far: float

    def weights(self, means: np.ndarray, bias: np.ndarray) -> np.ndarray:
        """(N,) weights of splats at means (N, 3)."""
        return band_mask(_distances(means, self.eye), np.float32(self.near), np.float32(self.far))

    def bands(self, means: np.ndarray, level: int) -> np.ndarray:
        """(N,) the band that each lies in, by the level that serves it."""
        return np.full(len(means), level)


@dataclass(frozen=True)
class OctreeRule:
    """Levels that add up and fade in, see ``training.lod.rules.octree_weights`` (Octree-GS)."""

    eye: tuple[float, float, float]
    farthest: float
    level: int
    levels: int
    offset: float

    def weights(self, means: np.ndarray, bias: np.ndarray) -> np.ndarray:
        """(N,) weights of splats at means (N, 3), with a bias (N,) in levels each."""
        return octree_weights(self._wanted(means, bias + np.float32(self.offset)), self.level)

    def bands(self, means: np.ndarray, level: int) -> np.ndarray:
        """(N,) the finest level that is wholly wanted so far away."""
        return np.floor(self._wanted(means, np.float32(self.offset)))

    def _wanted(self, means: np.ndarray, bias) -> np.ndarray:
        return octree_wanted(_distances(means, self.eye), bias, np.float32(self.farthest), self.levels)


Rule = BandRule | OctreeRule


def _distances(means: np.ndarray, eye) -> np.ndarray:
    away = means - np.float32(eye)
    return np.sqrt(np.einsum("ij,ij->i", away, away))


def rule(evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Rule | None:
    """What the modifier of an evaluated level chooses by, as of the depsgraph; None where all is shown."""
    modifier = _modifier(evaluated)
    render = depsgraph.mode == "RENDER"
    if modifier is None or not (modifier.show_render if render else modifier.show_viewport):
        return None

    def value(name: str):
        return compat.get_input(modifier, name)

    whose = EYES[min(max(value(EYE), 0), len(EYES) - 1)]
    if whose == "TRAINING":
        eye = tuple(value(EYE_POSITION))
    else:
        thing = depsgraph.scene.camera if whose == "CAMERA" else value(EYE_OBJECT)
        eye = (0.0, 0.0, 0.0)  # as geometry nodes have it without an object
        if thing is not None:
            place = thing.evaluated_get(depsgraph).matrix_world.translation
            eye = tuple(evaluated.matrix_world.inverted_safe() @ place)
    if modifier.name.startswith(band.NAME):
        return BandRule(eye, value(band.NEAR), value(band.FAR))
    return OctreeRule(
        eye, value(octree.FARTHEST), value(octree.LEVEL), value(octree.LEVELS), value(octree.OFFSET)
    )


def only_chosen(evaluated: bpy.types.Object) -> bool:
    """Whether an evaluated object shows its own splats as they are, chosen by nothing but :func:`rule`."""
    return all(
        modifier.type == "NODES" and modifier.name in {band.NAME, octree.NAME, DISPLAY}
        for modifier in evaluated.modifiers
        if modifier.show_viewport
    )


def eye_place(root: bpy.types.Object, scene: bpy.types.Scene) -> tuple[float, float, float]:
    """Where the chosen eye is, in the splats' space, frozen or not. The viewport's starts at the camera's."""
    settings = root.lodgs
    if settings.eye == "TRAINING":
        return tuple(settings.camera_center)
    thing = settings.eye_object if settings.eye == "OBJECT" else scene.camera
    if thing is None:
        return (0.0, 0.0, 0.0)  # as geometry nodes have it
    return tuple(root.matrix_world.inverted_safe() @ thing.matrix_world.translation)


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
    """Gives every level of a splat scene its modifier and its drivers, anew where they exist already.

    Needed after the list of levels has changed. ``root.lodgs.focal_px`` becomes the scene camera's focal
    length in pixels; near and far follow ``training.lod.rules.flod_bands``.
    """
    _drive_focal_length(root)
    for index, item in enumerate(root.lodgs.levels):
        if item.exists:
            _drive_level(root, index, item)
    update_inputs(root)


def update_inputs(root: bpy.types.Object) -> None:
    """Hands on to the modifiers what cannot be driven: the chosen or held eye, and each level's material."""
    for item in root.lodgs.levels:
        modifier = item.exists and _modifier(item.object)
        if modifier:
            slots = item.object.material_slots
            for name, value in (
                (EYE_OBJECT, root.lodgs.eye_object),
                (MATERIAL, slots[0].material if slots else None),
            ):
                if compat.get_input(modifier, name) != value:  # setting evaluates anew
                    compat.set_input(modifier, name, value)
            held = root.lodgs.freeze or root.lodgs.eye == "VIEW"
            position = root.lodgs.held_eye if held else root.lodgs.camera_center
            if tuple(compat.get_input(modifier, EYE_POSITION)) != tuple(position):
                compat.set_input(modifier, EYE_POSITION, position)


def _drive_focal_length(root: bpy.types.Object) -> None:
    """f = lens * fitted side in pixels / fitted side of the sensor, as Blender's render has it.

    Blender measures in widths of a pixel and fits the render's longer side to the sensor's width unless told
    otherwise. Without a camera, Blender's standard one is assumed.
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
    driver = _driver(
        root,
        "lodgs.focal_px",
        f"lens * ({width} / sw if fit == 1 or (fit == 0 and ax * {width} >= ay * {height})"
        f" else {height} * ay / ax / (sh if fit == 2 else sw))",
    )
    for name, (path, fallback) in variables.items():
        variable = driver.variables.new()
        variable.name, variable.type = name, "CONTEXT_PROP"
        target = variable.targets[0]
        target.context_property, target.data_path = "ACTIVE_SCENE", path
        if fallback is not None:
            target.use_fallback_value, target.fallback_value = True, fallback


def _drive_level(root: bpy.types.Object, index: int, item) -> None:
    thing, number = item.object, item.number
    by_octree = root.lodgs.d_max > 0
    modifier = _modifier_of(thing, octree.octree_level() if by_octree else band.distance_band())

    def drive(path: str, expression: str, *names: str, **paths: str) -> None:
        driver = _driver(thing, path, expression)
        for name, source in ({name: name for name in names} | paths).items():
            variable = driver.variables.new()
            variable.name, variable.type = name, "SINGLE_PROP"
            variable.targets[0].id, variable.targets[0].data_path = root, f"lodgs.{source}"

    in_range = f"level_start <= {number} and {number} <= level_end"
    alone = f"{number} == single_level or (cumulative and {number} <= single_level)"
    for path in ("hide_viewport", "hide_render"):
        drive(
            path,
            f"0 if show and (({'1' if by_octree else in_range}) if mode == 1 else ({alone})) else 1",
            "mode", "single_level", "level_start", "level_end", "cumulative", show=f"levels[{index}].show",
        )  # fmt: skip
    for path in ("show_viewport", "show_render"):
        drive(f'modifiers["{modifier.name}"].{path}', "mode == 1", "mode")
    drive(compat.input_path(modifier, EYE), "2 if freeze or eye > 2 else eye", "eye", "freeze")

    focal = "(held_focal if freeze or eye == 3 else focal_px)"
    focals = ("focal_px", "held_focal", "freeze", "eye")
    if by_octree:
        compat.set_input(modifier, octree.LEVEL, number)
        compat.set_input(modifier, octree.LEVELS, root.lodgs.levels[-1].number)
        drive(
            compat.input_path(modifier, octree.FARTHEST),
            f"d_max * {focal} / d_max_focal",
            "d_max", "d_max_focal", *focals,
        )  # fmt: skip
        drive(compat.input_path(modifier, octree.OFFSET), "level_offset", "level_offset")
        return

    # The finest level in use reaches up to the eye and the coarsest one for ever, whichever numbers exist.
    levels = root.lodgs.levels
    finer = levels[index + 1].number if index + 1 < len(levels) else NEVER
    coarser = levels[index - 1].number if index else 0
    near, far = compat.input_path(modifier, band.NEAR), compat.input_path(modifier, band.FAR)
    drive(
        near,
        f"(s_min / gamma * {focal} if {finer:g} <= level_end else 0) if {in_range} else {NEVER:g}",
        "gamma", "level_start", "level_end", *focals, s_min=f"levels[{index}].s_min",
    )  # fmt: skip
    drive(
        far,
        f"s_min / gamma * {focal} if {coarser} >= level_start and {number} <= level_end else {NEVER:g}",
        "gamma", "level_start", "level_end", *focals, s_min=f"levels[{max(index - 1, 0)}].s_min",
    )  # fmt: skip


def _modifier_of(thing: bpy.types.Object, group: bpy.types.GeometryNodeTree) -> bpy.types.NodesModifier:
    """The modifier with this rule, made where there is none, in the place of one with another rule."""
    modifier = _modifier(thing)
    place = len(thing.modifiers)
    if modifier is not None and modifier.node_group != group:  # trained again, with another method
        place = thing.modifiers.find(modifier.name)
        for driver in list(thing.animation_data.drivers if thing.animation_data else ()):
            if driver.data_path.startswith(f'modifiers["{modifier.name}"]'):
                thing.animation_data.drivers.remove(driver)
        thing.modifiers.remove(modifier)
        modifier = None
    if modifier is None:
        modifier = thing.modifiers.new(group.name, "NODES")
        assert isinstance(modifier, bpy.types.NodesModifier)
        modifier.node_group, modifier.show_expanded = group, False
        thing.modifiers.move(len(thing.modifiers) - 1, min(place, len(thing.modifiers) - 1))
    return modifier


def _modifier(thing: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The modifier that chooses by distance, whichever rule it has."""
    return thing.modifiers.get(band.NAME) or thing.modifiers.get(octree.NAME)


def _driver(thing: bpy.types.Object, path: str, expression: str) -> bpy.types.Driver:
    """A fresh driver of the property at ``path``, without variables."""
    thing.driver_remove(path)
    driver = thing.driver_add(path).driver
    assert driver is not None
    driver.type, driver.expression = "SCRIPTED", expression
    return driver
