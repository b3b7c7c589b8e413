"""Properties of splat scenes, stored on their roots (``Object.lodgs``)."""

from __future__ import annotations

import json

import bpy

from ...training.lod.rule import Control, Rule, resolve_rule, rules
from ..nodes.camera_choices import CHOICES, find_choice
from .metadata import read_json
from .objects import root_of
from .property_callbacks import look_up, tag_owner
from .setting_properties import SUBTYPES
from .training_settings import TrainingSettings

_view_chosen = look_up("active_view")
_camera_input_changed = look_up("camera_input")
_camera_changed = look_up("camera_choice")
_freeze_changed = look_up("freeze")


def _finest(self) -> int:
    """Return the number of the finest level, or no limit if there are no levels yet."""
    return max((item.number for item in self.levels), default=2**31 - 1)


def _single_changed(self, context) -> None:
    finest = _finest(self)
    if self.single_level > finest or (self.levels and not self.complete and self.single_level < finest):
        self.single_level = finest
    tag_owner(self, context)


def _became_root(self, context) -> None:
    self.itself = self.id_data if self.is_root else None


def _antialias(self) -> bool:
    return bool(read_json(self.meta).get("antialias"))


def _set_antialias(self, value: bool) -> None:
    meta = {name: entry for name, entry in read_json(self.meta).items() if name != "antialias"}
    self.meta = json.dumps(meta | ({"antialias": True} if value else {}))
    tag_owner(self, bpy.context)


def _can_be_camera(self, obj: bpy.types.Object) -> bool:
    return not obj.lodgs.is_root


def _is_in_collection(obj: object, kind: str) -> bool:
    """Return whether a value is an object of a type in a collection; damaged files refer to other data."""
    return isinstance(obj, bpy.types.Object) and obj.type == kind and bool(obj.users_collection)


class SplatLevel(bpy.types.PropertyGroup):
    """One level of detail of a splat scene. Level 1 is the coarsest."""

    number: bpy.props.IntProperty(name="Level", description="Number of the level; 1 is the coarsest", min=1)
    object: bpy.props.PointerProperty(
        name="Object", description="Point cloud with the splats of the level", type=bpy.types.Object
    )
    show: bpy.props.BoolProperty(
        name="Show",
        description="Show the level if the detail settings select it",
        default=True,
        update=tag_owner,
        options=set(),
    )
    facts: bpy.props.StringProperty(
        name="Facts", description="Facts of the level for the rule, as JSON", options={"HIDDEN"}
    )

    lost: bpy.props.IntProperty(
        name="No Longer Hidden",
        description="Number of hidden splats of the level that this one replaced",
        options={"HIDDEN"},
    )

    @property
    def exists(self) -> bool:
        """False if the artist deleted the level's object, changed its type or copied the root without it.

        The list keeps the entry.
        """
        if not _is_in_collection(self.object, "POINTCLOUD"):
            return False
        owner = root_of(self.object)
        return owner is None or owner.original == self.id_data.original


class SplatTable(bpy.types.PropertyGroup):
    """A named table of a splat scene's bundle; see ``tables``."""

    object: bpy.props.PointerProperty(
        name="Object", description="Mesh with the rows of the table", type=bpy.types.Object
    )
    collection: bpy.props.PointerProperty(
        name="Collection", description="Visible objects of the table", type=bpy.types.Collection
    )

    @property
    def exists(self) -> bool:
        """False if the artist deleted the table's object."""
        return _is_in_collection(self.object, "MESH")


class SplatStream(bpy.types.PropertyGroup):
    """File whose coarsest splats are in the splat scene; see ``streams``."""

    file: bpy.props.StringProperty(
        name="File",
        description="Bundle from which finer splats are streamed as the camera approaches",
        subtype="FILE_PATH",
        update=tag_owner,
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    budget: bpy.props.IntProperty(
        name="Memory Budget",
        description="Maximum number of splats of the tree in memory, in the scene and streamed. If the view "
        "needs more, all of it becomes coarser",
        default=1_000_000,
        min=1024,
        soft_max=16_000_000,
        max=16_000_000,
        step=10_000,
        update=tag_owner,
        options=set(),
    )
    total: bpy.props.IntProperty(name="Splats", description="Number of splats in the file")
    scene_splats: bpy.props.IntProperty(
        name="Splats in Scene", description="Number of splats of the file in the scene's levels"
    )
    file_changes: bpy.props.IntProperty(
        name="File Changes", description="Number of times that the file was replaced"
    )


class SplatSource(bpy.types.PropertyGroup):
    """File from which a splat scene was imported; see ``reloading``."""

    file: bpy.props.StringProperty(
        name="File",
        description="File with the splats of the scene",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    watch: bpy.props.BoolProperty(
        name="Reload on Change",
        description="Replace the splats when another program has written the file again",
        options=set(),
    )
    file_version: bpy.props.StringProperty(
        name="Version", description="Size and time of the file when it was read", options={"HIDDEN"}
    )
    count: bpy.props.IntProperty(
        name="Splats in File", description="Number of splats that were read", options={"HIDDEN"}
    )


def _level_callback(rule: Rule, control: Control):
    """Return the update callback of a control that names a level.

    It keeps the control within the existing levels and moves the opposite limit along.
    """

    def update(self, context) -> None:
        value, finest = getattr(self, control.name), _finest(self.id_data.lodgs)
        if value > finest:
            setattr(self, control.name, finest)
            return
        for other in rule.controls:
            limit = getattr(self, other.name)
            if (other.follows == "finest" and limit < value) or (
                other.follows == "coarsest" and limit > value
            ):
                setattr(self, other.name, value)
        tag_owner(self, context)

    return update


def _control_group(rule: Rule) -> type[bpy.types.PropertyGroup]:
    """Return a property group with a property for each control of a rule."""

    def make_property(control: Control):
        update = _level_callback(rule, control) if control.follows else tag_owner
        options = {"name": control.label, "description": control.about, "update": update}
        if control.flag:
            return bpy.props.BoolProperty(default=bool(control.default), **options)
        soft = control.soft or (control.low, control.high)
        number = int if control.integer else float
        make = bpy.props.IntProperty if control.integer else bpy.props.FloatProperty
        options |= {"step": control.step} if control.integer else {}
        return make(
            subtype=SUBTYPES.get(control.unit, "NONE"), default=number(control.default),
            min=number(control.low), max=number(control.high),
            soft_min=number(soft[0]), soft_max=number(soft[1]), **options,
        )  # fmt: skip

    annotations = {control.name: make_property(control) for control in rule.controls}
    return type(f"LODGS_{rule.name}", (bpy.types.PropertyGroup,), {"__annotations__": annotations})


CONTROLS = {rule.name: _control_group(rule) for rule in rules().values()}
"""Property groups of all rules by name; ``SplatScene`` has a property of each name."""


class SplatScene(bpy.types.PropertyGroup):
    """Settings of a splat scene, stored on its scene root: the empty that is parent of all its objects.

    Children keep COLMAP coordinates; the root's transform orients, scales and places the scene.
    """

    is_root: bpy.props.BoolProperty(update=_became_root, options={"HIDDEN"})
    itself: bpy.props.PointerProperty(
        name="Itself",
        description="Keeps the deleted root alive until its objects are removed",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    is_appended: bpy.props.BoolProperty(
        name="Appended",
        description="The root was appended with another object, and has no collection yet",
        options={"HIDDEN"},
    )
    flight_of: bpy.props.PointerProperty(
        name="Path of",
        description="Root of the scene that this camera path or turntable belongs to",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    scene_folder: bpy.props.StringProperty(
        name="Scene",
        description="Folder of the COLMAP scene on disk",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    method: bpy.props.StringProperty(
        name="Method", description="Method that trained the levels. Empty for a plain splat file"
    )
    rule: bpy.props.StringProperty(
        name="Rule",
        description="Rule that selects levels by camera distance. Empty if the method has none",
    )
    facts: bpy.props.StringProperty(
        name="Facts", description="Facts of the scene for the rule, as JSON", options={"HIDDEN"}
    )
    meta: bpy.props.StringProperty(
        name="Metadata", description="Metadata of the levels, as JSON", options={"HIDDEN"}
    )
    recorded_controls: bpy.props.StringProperty(
        name="Recorded",
        description="Values of the rule's controls that the file or run recorded, as JSON",
        options={"HIDDEN"},
    )
    initial_controls: bpy.props.StringProperty(
        name="Initial Controls",
        description="Initial values of the rule's controls, as JSON",
        options={"HIDDEN"},
    )
    cumulative: bpy.props.BoolProperty(
        name="Cumulative",
        description="Each level adds its splats to those of the coarser levels",
        update=tag_owner,
        options=set(),
    )
    antialias: bpy.props.BoolProperty(
        name="Antialiased",
        description="Draw splats with Mip-Splatting's 2D filter. Enable it for splats that were trained with "
        "this filter",
        get=_antialias,
        set=_set_antialias,
        options=set(),
    )
    camera_center: bpy.props.FloatVectorProperty(
        name="Mean Training Camera",
        description="Mean position of the training cameras, in scene units",
        size=3,
        subtype="XYZ",
        precision=4,
        update=_camera_input_changed,
    )

    axes: bpy.props.PointerProperty(
        name="Axes",
        description="Empty whose local space has the coordinates of the scene's files",
        type=bpy.types.Object,
    )
    points: bpy.props.PointerProperty(
        name="Points", description="Points of the COLMAP scene", type=bpy.types.Object
    )
    cameras: bpy.props.PointerProperty(
        name="Cameras", description="Cameras of the COLMAP scene", type=bpy.types.Collection
    )
    active_view: bpy.props.IntProperty(
        name="Active View", description="Active row of the list of views", options=set(), update=_view_chosen
    )
    levels: bpy.props.CollectionProperty(type=SplatLevel)
    active_level: bpy.props.IntProperty(
        name="Active Level", description="Active row of the list of levels", options=set()
    )
    tables: bpy.props.CollectionProperty(
        type=SplatTable, name="Tables", description="Scene facts of the rule in tables, such as chunks"
    )

    painted: bpy.props.PointerProperty(
        name="Paint",
        description="Positions and paint of the finest level before all levels were replaced",
        type=bpy.types.PointCloud,
        options={"HIDDEN"},
    )
    source: bpy.props.PointerProperty(
        name="Source", description="File from which the scene was imported", type=SplatSource
    )
    stream: bpy.props.PointerProperty(
        name="Streaming", description="File with the finer levels of the tree", type=SplatStream
    )

    mode: bpy.props.EnumProperty(
        name="Detail",
        description="Levels to show",
        items=[
            ("SINGLE", "One Level", "Show one level everywhere"),
            ("SELECTIVE", "By Distance", "Show fine levels near the camera and coarse levels far away"),
        ],
        update=tag_owner,
    )
    single_level: bpy.props.IntProperty(
        name="Level",
        description="Level to show, with all coarser ones if levels add up; 1 is the coarsest",
        default=1,
        min=1,
        update=_single_changed,
    )
    camera_choice: bpy.props.EnumProperty(
        name="Camera",
        description="Camera from which distances are measured",
        items=[(choice.identifier, choice.label, choice.about) for choice in CHOICES],
        update=_camera_changed,
    )
    freeze: bpy.props.BoolProperty(
        name="Freeze",
        description="Keep the current selection of detail while the camera moves",
        update=_freeze_changed,
        options=set(),
    )
    stored_position: bpy.props.FloatVectorProperty(
        name="Frozen Position",
        description="Frozen camera position, or the last one of the viewport, in scene units",
        size=3,
        subtype="XYZ",
        update=_camera_input_changed,
        options={"HIDDEN"},
    )
    stored_focal: bpy.props.FloatProperty(
        name="Frozen Focal Length", default=1000.0, subtype="PIXEL", update=tag_owner, options={"HIDDEN"}
    )
    focal_px: bpy.props.FloatProperty(
        name="Focal Length",
        description="Focal length of the scene camera in render pixels. Updates with the camera",
        subtype="PIXEL",
        options={"ANIMATABLE"},
    )

    colors: bpy.props.EnumProperty(
        name="Colours",
        description="Meaning of the splat colours in the viewport",
        items=[
            ("OWN", "Own", "The splats' own colours"),
            (
                "LEVELS",
                "Levels",
                "Level of each splat: violet (coarse), blue, teal, yellow, red and on. For a tree, node "
                "size: each colour is half the size of the previous one, white is the finest level",
            ),
            (
                "BANDS",
                "Bands",
                "Level that the rule requests at each distance from the camera, in the same colours",
            ),
            ("CHUNKS", "Chunks", "Nearest chunk at each position, in repeating colours"),
        ],
        options=set(),
    )

    training: bpy.props.PointerProperty(type=TrainingSettings)

    @property
    def existing_levels(self) -> list[SplatLevel]:
        """Levels whose objects exist, coarse to fine; ``levels`` also has those that the artist deleted."""
        return [item for item in self.levels if item.exists]

    @property
    def by_distance(self) -> bool:
        """True if the scene has a known rule that selects levels by distance."""
        return self.rule in rules()

    @property
    def complete(self) -> bool:
        """True if every level is a complete scene (``Rule.complete``); otherwise only the finest is."""
        return resolve_rule(self.rule).complete

    @property
    def follows_viewport(self) -> bool:
        """True if the camera for levels of detail is the viewport's and moves with it."""
        return find_choice(self.camera_choice).viewport and not self.freeze

    @property
    def controls(self) -> bpy.types.PropertyGroup | None:
        """The properties of the rule's controls, or None without a rule."""
        return getattr(self, self.rule) if self.by_distance else None


SplatScene.__annotations__ |= {
    name: bpy.props.PointerProperty(
        name=name.title(), description="Level of detail that a camera requests", type=controls
    )
    for name, controls in CONTROLS.items()
}
SplatScene.__annotations__ |= {
    choice.object: bpy.props.PointerProperty(
        name=choice.label,
        description="Object from whose origin distances are measured",
        type=bpy.types.Object,
        poll=_can_be_camera,
        update=_camera_input_changed,
    )
    for choice in CHOICES
    if choice.object
}
