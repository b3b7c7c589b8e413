"""What LODGS keeps in a .blend file: on each scene root (``Object.lodgs``) and on each of its cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import bpy

from ...training.lod.rule import Control, Rule, rules
from .. import compat
from .selection import read_json
from .training import PARAMETERS, TrainingCell, TrainingSettings
from .viewpoints import ViewsSettings

ON_CHANGE: dict[str, Callable[[Any, bpy.types.Context], None]] = {}
"""What is done when a property has changed, with its owner, by name; ``updates`` says what."""


def _look_up(name: str) -> Callable[[Any, bpy.types.Context], None]:
    return lambda owner, context: ON_CHANGE[name](owner, context)


_redraw = _look_up("redraw")
_view_chosen = _look_up("active_view")
_eye_changed = _look_up("eye_input")
_whose_eye_changed = _look_up("eye")
_freeze_changed = _look_up("freeze")
_ellipsoids_changed = _look_up("ellipsoids")


def _changed(self, context) -> None:
    """Properties set from scripts do not evaluate the scene anew by themselves."""
    self.id_data.update_tag()


def _finest(self) -> int:
    """The finest level that there is; without levels there is no limit yet."""
    return max((item.number for item in self.levels), default=2**31 - 1)


def _single_changed(self, context) -> None:
    most = _finest(self)
    if self.single_level > most or (self.levels and not self.complete and self.single_level < most):
        self.single_level = most
    _changed(self, context)


def _became_root(self, context) -> None:
    self.itself = self.id_data if self.is_root else None


def _is_native(self) -> bool:
    return compat.NATIVE_SPLATS is not None and self.splats and self.drawn_by == "BLENDER"


def _hides_blender(self) -> bool:
    return self.splats if compat.NATIVE_SPLATS is None else not _is_native(self)


def _antialias(self) -> bool:
    return bool(read_json(self.meta).get("antialias"))


def _set_antialias(self, value: bool) -> None:
    meta = {name: each for name, each in read_json(self.meta).items() if name != "antialias"}
    self.meta = json.dumps(meta | ({"antialias": True} if value else {}))
    _changed(self, bpy.context)


def _can_be_eye(self, obj: bpy.types.Object) -> bool:
    return not obj.lodgs.is_root


class SplatLevel(bpy.types.PropertyGroup):
    """One level of detail of a splat scene. Level 1 is the coarsest."""

    number: bpy.props.IntProperty(name="Level", description="Number of the level; 1 is the coarsest", min=1)
    object: bpy.props.PointerProperty(
        name="Object", description="The point cloud that holds the level's splats", type=bpy.types.Object
    )
    show: bpy.props.BoolProperty(
        name="Show",
        description="Show the level where the detail settings call for it",
        default=True,
        update=_changed,
        options=set(),
    )
    facts: bpy.props.StringProperty(
        name="Facts", description="What the rule needs to know of the level, as JSON", options={"HIDDEN"}
    )

    lost: bpy.props.IntProperty(
        name="No Longer Hidden",
        description="How many splats were hidden of the level whose place this one has taken",
        options={"HIDDEN"},
    )

    @property
    def exists(self) -> bool:
        """False once an artist has deleted the level's object, which the list still remembers, or changed
        its type."""
        obj = self.object
        return obj is not None and obj.type == "POINTCLOUD" and bool(obj.users_collection)


class SplatTable(bpy.types.PropertyGroup):
    """A table that came with a splat scene, by its name; see ``tables``."""

    object: bpy.props.PointerProperty(
        name="Object", description="The mesh that holds the table's rows", type=bpy.types.Object
    )
    collection: bpy.props.PointerProperty(
        name="Collection", description="What is to be seen of the table", type=bpy.types.Collection
    )

    @property
    def exists(self) -> bool:
        """False once an artist has deleted the table's object."""
        obj = self.object
        return obj is not None and obj.type == "MESH" and bool(obj.users_collection)


class SplatStream(bpy.types.PropertyGroup):
    """The file of a tree of which a splat scene holds the top; see ``streams``."""

    file: bpy.props.StringProperty(
        name="File",
        description="The bundle from which finer splats are read as the eye comes near",
        subtype="FILE_PATH",
        update=_changed,
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    budget: bpy.props.IntProperty(
        name="Splats at Most",
        description="How many splats of a tree are in memory at most: those that the scene holds, and those "
        "that are read from the file. Where the view needs more, they are coarser everywhere",
        default=1_000_000,
        min=1024,
        soft_max=16_000_000,
        max=16_000_000,
        step=10_000,
        update=_changed,
        options=set(),
    )
    total: bpy.props.IntProperty(name="Splats", description="How many splats the file has")
    here: bpy.props.IntProperty(name="Splats Here", description="How many of them the scene's levels hold")
    begun: bpy.props.IntProperty(name="Begun", description="How often a file has taken the place of another")


def _level_set(rule: Rule, control: Control):
    """For a control that names a level: it stays among those that there are, and takes the other along."""

    def update(self, context) -> None:
        value, finest = getattr(self, control.name), _finest(self.id_data.lodgs)
        if value > finest:
            setattr(self, control.name, finest)
            return
        for other in rule.controls:
            there = getattr(self, other.name)
            if (other.follows == "finest" and there < value) or (
                other.follows == "coarsest" and there > value
            ):
                setattr(self, other.name, value)
        _changed(self, context)

    return update


def _controls_of(rule: Rule) -> type[bpy.types.PropertyGroup]:
    """A group with a property for each control of a rule."""

    def property_of(control: Control):
        update = _level_set(rule, control) if control.follows else _changed
        options = {"name": control.label, "description": control.about, "update": update}
        if control.flag:
            return bpy.props.BoolProperty(default=bool(control.default), **options)
        soft = control.soft or (control.low, control.high)
        number, make = (int, bpy.props.IntProperty) if control.whole else (float, bpy.props.FloatProperty)
        options |= {"step": control.step} if control.whole else {}
        return make(
            subtype=control.unit, default=number(control.default),
            min=number(control.low), max=number(control.high),
            soft_min=number(soft[0]), soft_max=number(soft[1]), **options,
        )  # fmt: skip

    annotations = {control.name: property_of(control) for control in rule.controls}
    return type(f"LODGS_{rule.name}", (bpy.types.PropertyGroup,), {"__annotations__": annotations})


CONTROLS = {rule.name: _controls_of(rule) for rule in rules().values()}
"""The groups of all rules by name; each is a property of ``SplatScene`` of that name."""


class SplatScene(bpy.types.PropertyGroup):
    """A splat scene, kept on its scene root: the empty that all its objects are children of.

    Children keep COLMAP coordinates; the root's transform stands it upright, scales and places it.
    """

    is_root: bpy.props.BoolProperty(update=_became_root, options={"HIDDEN"})
    itself: bpy.props.PointerProperty(
        name="Itself",
        description="The root, which so outlives its deletion until all that belongs to it is removed",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    flight_of: bpy.props.PointerProperty(
        name="Flight of",
        description="The root of the scene that this object carries a moving camera along or around, and "
        "with which it is removed",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    scene_folder: bpy.props.StringProperty(
        name="Scene", description="Folder of the COLMAP scene", subtype="DIR_PATH"
    )
    method: bpy.props.StringProperty(
        name="Method", description="Name of the method that made the levels; empty for a plain splat file"
    )
    rule: bpy.props.StringProperty(
        name="Rule",
        description="What chooses the levels by distance; empty where they are not made for distances",
    )
    facts: bpy.props.StringProperty(
        name="Facts", description="What the rule needs to know of the scene, as JSON", options={"HIDDEN"}
    )
    meta: bpy.props.StringProperty(
        name="Further Facts", description="What else is known of the levels, as JSON", options={"HIDDEN"}
    )
    recorded: bpy.props.StringProperty(
        name="Recorded",
        description="What the file or the run records of the rule's controls, as JSON",
        options={"HIDDEN"},
    )
    begun: bpy.props.StringProperty(
        name="Begun With",
        description="What the rule's controls began with, recorded or by the levels, as JSON",
        options={"HIDDEN"},
    )
    cumulative: bpy.props.BoolProperty(
        name="Cumulative",
        description="Each level only holds what it adds to the coarser ones",
        update=_changed,
        options=set(),
    )
    antialias: bpy.props.BoolProperty(
        name="Antialiased",
        description="Draw the splats through Mip-Splatting's 2D filter, as those need it that were trained "
        "with it: what is smaller than a pixel then grows no thicker than it is",
        get=_antialias,
        set=_set_antialias,
        options=set(),
    )
    camera_center: bpy.props.FloatVectorProperty(
        name="Mean Training Camera",
        description="Mean position of the training cameras, in the scene's own units",
        size=3,
        subtype="XYZ",
        precision=4,
        update=_eye_changed,
    )

    axes: bpy.props.PointerProperty(
        name="Axes",
        description="The empty in whose space the coordinates of the scene's files are",
        type=bpy.types.Object,
    )
    points: bpy.props.PointerProperty(
        name="Points", description="The points of the COLMAP scene", type=bpy.types.Object
    )
    cameras: bpy.props.PointerProperty(
        name="Cameras", description="The cameras of the COLMAP scene", type=bpy.types.Collection
    )
    active_view: bpy.props.IntProperty(
        name="Chosen View", description="Line of the list of views", options=set(), update=_view_chosen
    )
    levels: bpy.props.CollectionProperty(type=SplatLevel)
    active_level: bpy.props.IntProperty(
        name="Chosen Level", description="Line of the list of levels", options=set()
    )
    tables: bpy.props.CollectionProperty(
        type=SplatTable, name="Tables", description="What the rule knows besides the splats"
    )

    painted: bpy.props.PointerProperty(
        name="Paint",
        description="The finest level's places and paint, from before all levels were replaced",
        type=bpy.types.PointCloud,
        options={"HIDDEN"},
    )
    stream: bpy.props.PointerProperty(
        name="Streaming", description="The file of which the levels are the top", type=SplatStream
    )

    mode: bpy.props.EnumProperty(
        name="Detail",
        description="Which levels are shown",
        items=[
            ("SINGLE", "One Level", "Show one level everywhere"),
            ("SELECTIVE", "By Distance", "Near the eye show fine levels, far from it coarse ones"),
        ],
        update=_changed,
    )
    single_level: bpy.props.IntProperty(
        name="Level",
        description="The level that is shown; 1 is the coarsest. Where levels add up, all coarser ones are "
        "shown with it",
        default=1,
        min=1,
        update=_single_changed,
    )
    eye: bpy.props.EnumProperty(
        name="Eye",
        description="From where distances are measured",
        items=[
            ("CAMERA", "Scene Camera", "The scene's active camera, wherever it moves"),
            ("OBJECT", "Object", "An object of your choice"),
            (
                "TRAINING",
                "Training Cameras",
                "The mean position of the training cameras: the choice stays put",
            ),
            (
                "VIEW",
                "Viewport",
                "Your own view, of the 3D viewport that moved last. Renders keep what it saw: choose the "
                "scene camera for them. Of a scene that is read from its file they show what their camera "
                "needs",
            ),
        ],
        update=_whose_eye_changed,
    )
    freeze: bpy.props.BoolProperty(
        name="Freeze",
        description="Keep the choice of detail as it is now, to look at it from elsewhere",
        update=_freeze_changed,
        options=set(),
    )
    held_eye: bpy.props.FloatVectorProperty(
        name="Held Eye",
        description="Where the eye is held, or the viewport's was last, in the scene's own units",
        size=3,
        subtype="XYZ",
        update=_eye_changed,
        options={"HIDDEN"},
    )
    held_focal: bpy.props.FloatProperty(
        name="Held Focal Length", default=1000.0, subtype="PIXEL", update=_changed, options={"HIDDEN"}
    )
    eye_object: bpy.props.PointerProperty(
        name="Object",
        description="Object from whose origin distances are measured",
        type=bpy.types.Object,
        poll=_can_be_eye,
        update=_eye_changed,
    )
    focal_px: bpy.props.FloatProperty(
        name="Focal Length",
        description="Focal length of the scene camera in pixels of the render; follows the camera by itself",
        subtype="PIXEL",
        options={"ANIMATABLE"},
    )

    tell: bpy.props.EnumProperty(
        name="Colours",
        description="What the colours tell in the viewport",
        items=[
            ("OWN", "Own", "The splats' own colours"),
            (
                "LEVELS",
                "Levels",
                "Which level is where: violet (coarse), blue, teal, yellow, red and on. In a tree of splats, "
                "how large what a splat stands for is: each colour is half the size of the one before, white "
                "the finest level",
            ),
            (
                "BANDS",
                "Bands",
                "Which level is wanted at which distance from the eye, in the same colours",
            ),
            ("CHUNKS", "Chunks", "Which chunk is the nearest where, in colours that repeat"),
        ],
        options=set(),
    )

    training: bpy.props.PointerProperty(type=TrainingSettings)

    @property
    def by_distance(self) -> bool:
        """Whether the levels say at which distances they are to be shown, in a way that is known here."""
        return self.rule in rules()

    @property
    def complete(self) -> bool:
        """Whether each level is a scene by itself, see ``Rule.complete``; else only the finest is."""
        return not self.by_distance or rules()[self.rule].complete

    @property
    def controls(self) -> bpy.types.PropertyGroup | None:
        """What an eye may turn: the properties of the scene's rule."""
        return getattr(self, self.rule) if self.by_distance else None


class ViewportSettings(bpy.types.PropertyGroup):
    """How 3D viewports draw splats, on the Blender scene (``Scene.lodgs_viewport``)."""

    splats: bpy.props.BoolProperty(
        name="Gaussian Splats",
        description="Draw splats as the photographs show them, not as points. Wireframe shading has none",
        default=True,
        update=_changed,
        options=set(),
    )
    drawn_by: bpy.props.EnumProperty(
        name="Drawn By",
        description="Program part that draws splats in the 3D viewport",
        items=[
            (
                "LODGS", "LODGS",
                "Levels of detail with a splat budget, streaming, level colours and the selection overlay",
            ),
            (
                "BLENDER", "Blender",
                "Blender's own splats with the same levels, without splat budget, streaming, level colours "
                "and selection overlay",
            ),
        ],
        default="LODGS",
        update=_changed,
        options=set(),
    )  # fmt: skip
    native: bpy.props.BoolProperty(
        description="Blender draws splats in viewports itself",
        get=_is_native,
        options={"HIDDEN"},
    )
    points: bpy.props.BoolProperty(
        description="Blender draws splat objects in viewports, as points or as splats of its own",
        get=lambda self: not self.splats or self.native,
        options={"HIDDEN"},
    )
    hides_blender: bpy.props.BoolProperty(
        description="Blender's own drawing of splat objects is hidden or reduced to points in viewports",
        get=_hides_blender,
        options={"HIDDEN"},
    )
    budget: bpy.props.IntProperty(
        name="Splats at Most",
        description="How many splats a viewport draws at most. Where there are more, coarser levels stand "
        "in for the finest, and of a single level the most visible splats are drawn",
        default=2_000_000,
        min=1000,
        max=16_000_000,
        step=10_000,
        options=set(),
    )
    moving: bpy.props.FloatProperty(
        name="While Moving",
        description="Resolution of the splats while the view moves",
        default=50.0,
        min=10.0,
        max=100.0,
        precision=0,
        subtype="PERCENTAGE",
        options=set(),
    )


class CaptureSettings(ViewsSettings, bpy.types.PropertyGroup):
    """How a Blender scene becomes photographs to train from, on the scene (``Scene.lodgs_capture``)."""

    folder: bpy.props.StringProperty(
        name="Folder",
        description="Folder that receives the pictures and becomes a COLMAP scene; empty: lodgs_capture "
        "beside the .blend file. What is there already is not rendered again",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )


class ViewSettings(bpy.types.PropertyGroup):
    """What an imported camera knows of its photograph, on its data (``Camera.lodgs``); all 0 on others."""

    width: bpy.props.IntProperty(name="Width", description="Width of the photograph", subtype="PIXEL")
    height: bpy.props.IntProperty(name="Height", description="Height of the photograph", subtype="PIXEL")
    fx: bpy.props.FloatProperty(name="Focal Length X", description="In pixels", subtype="PIXEL")
    fy: bpy.props.FloatProperty(name="Focal Length Y", description="In pixels", subtype="PIXEL")
    photograph: bpy.props.StringProperty(
        name="Photograph", description="File of the photograph", subtype="FILE_PATH"
    )
    mask: bpy.props.StringProperty(
        name="Mask",
        description="File of a picture that is black where the photograph does not count; empty for none",
        subtype="FILE_PATH",
    )
    distorted: bpy.props.BoolProperty(
        name="Distorted", description="The lens bends lines in the photograph, which the camera does not show"
    )
    place: bpy.props.IntProperty(
        name="Place", description="Place by name among the views of the COLMAP model, from 0", default=-1
    )
    held_out: bpy.props.BoolProperty(
        name="Held Out", description="The splats that it came with were not trained on it"
    )
    psnr: bpy.props.FloatProperty(
        name="PSNR",
        description="How alike the splats and the photograph were when last measured, in dB; 0 before",
    )


class CropSettings(bpy.types.PropertyGroup):
    """What an empty under a scene root crops (``Object.lodgs_crop``); see ``crops``."""

    is_crop: bpy.props.BoolProperty(
        name="Crop", description="Whether the empty crops the splats of its scene", options={"HIDDEN"}
    )
    keep: bpy.props.EnumProperty(
        name="Keep",
        description="What is left of the splats, at every level",
        items=[
            ("INSIDE", "Keep Inside", "Splats in this crop stay, and those in others that keep theirs"),
            ("OUTSIDE", "Cut Out", "Splats in this crop go"),
            ("ALL", "Keep All", "None go: only the look of the splats in it is its own"),
        ],
        update=_changed,
    )
    use: bpy.props.BoolProperty(
        name="Use", description="Whether the crop has an effect", default=True, update=_changed
    )


class BrushSettings(bpy.types.PropertyGroup):
    """How strokes select and paint splats, on the Blender scene (``Scene.lodgs_brush``)."""

    radius: bpy.props.IntProperty(
        name="Radius",
        description="Of the brush, in pixels of the viewport; press F over it to change it there",
        default=40,
        min=1,
        max=2000,
        soft_max=400,
        subtype="PIXEL",
        options=set(),
    )
    through: bpy.props.BoolProperty(
        name="Through",
        description="Select and paint what other splats hide from the view as well, to any depth",
        options=set(),
    )
    color: bpy.props.FloatVectorProperty(
        name="Colour",
        description="What is painted, as the display shows it before the look",
        default=(0.8, 0.1, 0.1),
        min=0,
        max=1,
        size=3,
        subtype="COLOR_GAMMA",
        options=set(),
    )
    strength: bpy.props.FloatProperty(
        name="Strength",
        description="How much of the colour one stroke puts over the splats' own; press Shift F to change it",
        default=1.0,
        min=0,
        max=1,
        subtype="FACTOR",
        options=set(),
    )
    hardness: bpy.props.FloatProperty(
        name="Hardness",
        description="Share of the radius in which the brush has its full strength; beyond it falls off",
        default=0.5,
        min=0,
        max=1,
        subtype="FACTOR",
        options=set(),
    )


class RenderSettings(bpy.types.PropertyGroup):
    """How the engine LODGS renders a Blender scene (``Scene.lodgs_render``)."""

    background: bpy.props.FloatVectorProperty(
        name="Background",
        description="Colour behind the splats, as the display shows it. Splats of photographs are trained "
        "over black",
        size=3,
        min=0.0,
        max=1.0,
        subtype="COLOR_GAMMA",
    )
    use_pass_levels: bpy.props.BoolProperty(
        name="Levels",
        description="Passes that tell which level each pixel shows, and how much of it every level fills",
    )
    ellipsoids: bpy.props.BoolProperty(
        name="Splats as Ellipsoids",
        description="Let Cycles and EEVEE render splats as ellipsoids that fade outwards, for shadows and "
        "reflections. Fine up to some hundred thousand splats",
        update=_ellipsoids_changed,
    )
    draws_points: bpy.props.BoolProperty(
        description="Whether renders of this scene are Blender's, which show points or ellipsoids",
        get=lambda self: self.id_data.render.engine != "LODGS",
        options={"HIDDEN"},
    )
    draws_ellipsoids: bpy.props.BoolProperty(
        description="Whether renders of this scene show ellipsoids: LODGS draws true splats instead",
        get=lambda self: self.ellipsoids and self.draws_points,
        options={"HIDDEN"},
    )
    holdout: bpy.props.StringProperty(
        name="Hold Out",
        description="OpenEXR files with the Depth pass of the meshes, #### for the frame's number: splats "
        "behind that depth are left out, and the film is transparent there",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    show_comparison: bpy.props.BoolProperty(
        name="Wipe",
        description="Show the photograph over the rendered picture of the view that was compared",
        update=_redraw,
        options=set(),
    )
    wipe: bpy.props.FloatProperty(
        name="Photograph",
        description="How much of the width shows the photograph, from the left; the rest is rendered",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=_redraw,
        options=set(),
    )
    meshes: bpy.props.PointerProperty(
        name="Meshes",
        description="Scene that renders the meshes, joined with the splats by depth in the compositor",
        type=bpy.types.Scene,
    )
    before_meshes: bpy.props.StringProperty(
        name="Before Meshes",
        description="What combining with meshes has switched on, to be switched off again, as JSON",
        options={"HIDDEN"},
    )


SplatScene.__annotations__ |= {
    name: bpy.props.PointerProperty(
        name=name.title(), description="How much detail an eye asks for", type=controls
    )
    for name, controls in CONTROLS.items()
}

CLASSES = (
    ViewSettings, ViewportSettings, *PARAMETERS.values(), TrainingCell, TrainingSettings, SplatLevel,
    SplatTable, SplatStream, *CONTROLS.values(), SplatScene, CropSettings, BrushSettings, RenderSettings,
    CaptureSettings,
)  # fmt: skip


def register() -> None:
    """Attach the groups to Blender's objects, cameras and scenes."""
    bpy.types.Object.lodgs = bpy.props.PointerProperty(type=SplatScene)
    bpy.types.Object.lodgs_crop = bpy.props.PointerProperty(type=CropSettings)
    bpy.types.Camera.lodgs = bpy.props.PointerProperty(type=ViewSettings)
    bpy.types.Scene.lodgs_render = bpy.props.PointerProperty(type=RenderSettings)
    bpy.types.Scene.lodgs_viewport = bpy.props.PointerProperty(type=ViewportSettings)
    bpy.types.Scene.lodgs_brush = bpy.props.PointerProperty(type=BrushSettings)
    bpy.types.Scene.lodgs_capture = bpy.props.PointerProperty(type=CaptureSettings)


def unregister() -> None:
    """Detach them again."""
    del bpy.types.Scene.lodgs_capture
    del bpy.types.Scene.lodgs_brush
    del bpy.types.Scene.lodgs_render
    del bpy.types.Scene.lodgs_viewport
    del bpy.types.Camera.lodgs
    del bpy.types.Object.lodgs_crop
    del bpy.types.Object.lodgs
