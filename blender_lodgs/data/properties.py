"""Properties that LODGS stores in a .blend file: on scene roots (``Object.lodgs``), cameras and scenes."""

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
"""Update callbacks by name, called with the property's owner; ``updates`` fills the table."""


def _look_up(name: str) -> Callable[[Any, bpy.types.Context], None]:
    return lambda owner, context: ON_CHANGE[name](owner, context)


_redraw = _look_up("redraw")
_view_chosen = _look_up("active_view")
_eye_changed = _look_up("eye_input")
_whose_eye_changed = _look_up("eye")
_freeze_changed = _look_up("freeze")
_ellipsoids_changed = _look_up("ellipsoids")


def _changed(self, context) -> None:
    """Tag the owner: properties set from scripts do not trigger an evaluation by themselves."""
    self.id_data.update_tag()


def _finest(self) -> int:
    """Return the number of the finest level, or no limit if there are no levels yet."""
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
    meta = {name: entry for name, entry in read_json(self.meta).items() if name != "antialias"}
    self.meta = json.dumps(meta | ({"antialias": True} if value else {}))
    _changed(self, bpy.context)


def _can_be_eye(self, obj: bpy.types.Object) -> bool:
    return not obj.lodgs.is_root


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
        update=_changed,
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
        """False if the artist deleted the level's object or changed its type; the list keeps the entry."""
        obj = self.object
        return obj is not None and obj.type == "POINTCLOUD" and bool(obj.users_collection)


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
        obj = self.object
        return obj is not None and obj.type == "MESH" and bool(obj.users_collection)


class SplatStream(bpy.types.PropertyGroup):
    """File of a tree whose top levels are in the splat scene; see ``streams``."""

    file: bpy.props.StringProperty(
        name="File",
        description="Bundle from which finer splats are streamed as the camera approaches",
        subtype="FILE_PATH",
        update=_changed,
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
        update=_changed,
        options=set(),
    )
    total: bpy.props.IntProperty(name="Splats", description="Number of splats in the file")
    here: bpy.props.IntProperty(
        name="Splats in Scene", description="Number of splats of the file in the scene's levels"
    )
    begun: bpy.props.IntProperty(
        name="File Changes", description="Number of times that the file was replaced"
    )


def _level_set(rule: Rule, control: Control):
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
        _changed(self, context)

    return update


def _controls_of(rule: Rule) -> type[bpy.types.PropertyGroup]:
    """Return a property group with a property for each control of a rule."""

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
    flight_of: bpy.props.PointerProperty(
        name="Path of",
        description="Root of the scene that this camera path or turntable belongs to",
        type=bpy.types.Object,
        options={"HIDDEN"},
    )
    scene_folder: bpy.props.StringProperty(
        name="Scene", description="Folder of the COLMAP scene on disk", subtype="DIR_PATH"
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
    recorded: bpy.props.StringProperty(
        name="Recorded",
        description="Values of the rule's controls that the file or run recorded, as JSON",
        options={"HIDDEN"},
    )
    begun: bpy.props.StringProperty(
        name="Initial Controls",
        description="Initial values of the rule's controls, as JSON",
        options={"HIDDEN"},
    )
    cumulative: bpy.props.BoolProperty(
        name="Cumulative",
        description="Each level adds its splats to those of the coarser levels",
        update=_changed,
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
        description="Mean position of the training cameras, in the scene's own units",
        size=3,
        subtype="XYZ",
        precision=4,
        update=_eye_changed,
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
        update=_changed,
    )
    single_level: bpy.props.IntProperty(
        name="Level",
        description="Level to show; 1 is the coarsest. If levels are cumulative, all coarser levels are "
        "shown with it",
        default=1,
        min=1,
        update=_single_changed,
    )
    eye: bpy.props.EnumProperty(
        name="Camera",
        description="Camera from which distances are measured",
        items=[
            ("CAMERA", "Scene Camera", "Active camera of the scene"),
            ("OBJECT", "Object", "Origin of an object"),
            (
                "TRAINING",
                "Training Cameras",
                "Mean position of the training cameras, which never moves",
            ),
            (
                "VIEW",
                "Viewport",
                "View of the 3D viewport that moved last. Renders keep its selection: choose Scene Camera "
                "before rendering",
            ),
        ],
        update=_whose_eye_changed,
    )
    freeze: bpy.props.BoolProperty(
        name="Freeze",
        description="Keep the current selection of detail while the camera moves",
        update=_freeze_changed,
        options=set(),
    )
    held_eye: bpy.props.FloatVectorProperty(
        name="Frozen Position",
        description="Frozen camera position, or the last one of the viewport, in the scene's own units",
        size=3,
        subtype="XYZ",
        update=_eye_changed,
        options={"HIDDEN"},
    )
    held_focal: bpy.props.FloatProperty(
        name="Frozen Focal Length", default=1000.0, subtype="PIXEL", update=_changed, options={"HIDDEN"}
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
        description="Focal length of the scene camera in render pixels. Updates with the camera",
        subtype="PIXEL",
        options={"ANIMATABLE"},
    )

    tell: bpy.props.EnumProperty(
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
    def by_distance(self) -> bool:
        """True if the scene has a known rule that selects levels by distance."""
        return self.rule in rules()

    @property
    def complete(self) -> bool:
        """True if every level is a complete scene (``Rule.complete``); otherwise only the finest is."""
        return not self.by_distance or rules()[self.rule].complete

    @property
    def controls(self) -> bpy.types.PropertyGroup | None:
        """The properties of the rule's controls, or None without a rule."""
        return getattr(self, self.rule) if self.by_distance else None


class ViewportSettings(bpy.types.PropertyGroup):
    """Drawing of splats in 3D viewports, on the Blender scene (``Scene.lodgs_viewport``)."""

    splats: bpy.props.BoolProperty(
        name="Gaussian Splats",
        description="Draw Gaussian splats instead of points. Wireframe shading always shows points",
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
        name="Splat Budget",
        description="Maximum number of splats that a viewport draws. Beyond it, coarser levels replace finer "
        "ones, and a single level shows its most visible splats",
        default=2_000_000,
        min=1000,
        max=16_000_000,
        step=10_000,
        options=set(),
    )
    moving: bpy.props.FloatProperty(
        name="While Moving",
        description="Resolution of splats while the view moves. Lower it for smoother navigation",
        default=50.0,
        min=10.0,
        max=100.0,
        precision=0,
        subtype="PERCENTAGE",
        options=set(),
    )


class CaptureSettings(ViewsSettings, bpy.types.PropertyGroup):
    """Capture of training images from a Blender scene (``Scene.lodgs_capture``)."""

    folder: bpy.props.StringProperty(
        name="Folder",
        description="Folder for the images and the COLMAP model. If empty, lodgs_capture next to the .blend "
        "file. Existing images are not rendered again",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )


class ViewSettings(bpy.types.PropertyGroup):
    """Photo of an imported camera, on its data (``Camera.lodgs``); all 0 for other cameras."""

    width: bpy.props.IntProperty(name="Width", description="Width of the photo", subtype="PIXEL")
    height: bpy.props.IntProperty(name="Height", description="Height of the photo", subtype="PIXEL")
    fx: bpy.props.FloatProperty(name="Focal Length X", description="Horizontal focal length", subtype="PIXEL")
    fy: bpy.props.FloatProperty(name="Focal Length Y", description="Vertical focal length", subtype="PIXEL")
    photograph: bpy.props.StringProperty(
        name="Photo", description="Image file of the photo", subtype="FILE_PATH"
    )
    mask: bpy.props.StringProperty(
        name="Mask",
        description="Image that is black where training ignores the photo. Empty for none",
        subtype="FILE_PATH",
    )
    distorted: bpy.props.BoolProperty(
        name="Distorted", description="The photo has lens distortion, which the camera does not show"
    )
    place: bpy.props.IntProperty(
        name="Index", description="Index of the view in the COLMAP model, sorted by name, from 0", default=-1
    )
    held_out: bpy.props.BoolProperty(name="Held Out", description="Training did not use this photo")
    psnr: bpy.props.FloatProperty(
        name="PSNR",
        description="Similarity of splats and photo at the last measurement, in dB. 0 before the first",
    )


class CropSettings(bpy.types.PropertyGroup):
    """Crop of splats by an empty below the scene root (``Object.lodgs_crop``); see ``crops``."""

    is_crop: bpy.props.BoolProperty(
        name="Crop", description="The empty crops the splats of its scene", options={"HIDDEN"}
    )
    keep: bpy.props.EnumProperty(
        name="Keep",
        description="Splats to keep, at every level",
        items=[
            ("INSIDE", "Keep Inside", "Keep splats inside this crop and inside other crops of this kind"),
            ("OUTSIDE", "Cut Out", "Remove splats inside this crop"),
            ("ALL", "Keep All", "Keep all splats; the crop only has a look of its own"),
        ],
        update=_changed,
    )
    use: bpy.props.BoolProperty(name="Use", description="Enable the crop", default=True, update=_changed)


class BrushSettings(bpy.types.PropertyGroup):
    """Brush that selects and paints splats, on the Blender scene (``Scene.lodgs_brush``)."""

    radius: bpy.props.IntProperty(
        name="Radius",
        description="Radius of the brush in the viewport. Press F in the viewport to change it",
        default=40,
        min=1,
        max=2000,
        soft_max=400,
        subtype="PIXEL",
        options=set(),
    )
    through: bpy.props.BoolProperty(
        name="Through",
        description="Select and paint hidden splats as well, at any depth",
        options=set(),
    )
    color: bpy.props.FloatVectorProperty(
        name="Colour",
        description="Colour of the paint on the display, before the look",
        default=(0.8, 0.1, 0.1),
        min=0,
        max=1,
        size=3,
        subtype="COLOR_GAMMA",
        options=set(),
    )
    strength: bpy.props.FloatProperty(
        name="Strength",
        description="Opacity of the paint in one stroke. Press Shift F to change it",
        default=1.0,
        min=0,
        max=1,
        subtype="FACTOR",
        options=set(),
    )
    hardness: bpy.props.FloatProperty(
        name="Hardness",
        description="Fraction of the radius with full strength. The brush falls off beyond it",
        default=0.5,
        min=0,
        max=1,
        subtype="FACTOR",
        options=set(),
    )


class RenderSettings(bpy.types.PropertyGroup):
    """Settings of the render engine LODGS (``Scene.lodgs_render``)."""

    background: bpy.props.FloatVectorProperty(
        name="Background",
        description="Display colour behind the splats. Splats are trained over black",
        size=3,
        min=0.0,
        max=1.0,
        subtype="COLOR_GAMMA",
    )
    use_pass_levels: bpy.props.BoolProperty(
        name="Levels",
        description="Passes with the main level of each pixel and the coverage of every level",
    )
    ellipsoids: bpy.props.BoolProperty(
        name="Splats as Ellipsoids",
        description="Render splats as soft ellipsoids in Cycles and EEVEE, for shadows and reflections. Suits "
        "up to some hundred thousand splats",
        update=_ellipsoids_changed,
    )
    draws_points: bpy.props.BoolProperty(
        description="Blender renders this scene, with points, ellipsoids or splats of its own",
        get=lambda self: self.id_data.render.engine != "LODGS",
        options={"HIDDEN"},
    )
    draws_ellipsoids: bpy.props.BoolProperty(
        description="Renders of this scene show ellipsoids. LODGS draws splats instead",
        get=lambda self: self.ellipsoids and self.draws_points,
        options={"HIDDEN"},
    )
    holdout: bpy.props.StringProperty(
        name="Hold Out",
        description="OpenEXR files with the Depth pass of the meshes, #### for the frame number. Splats "
        "behind that depth are not rendered, and the film is transparent there",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    show_comparison: bpy.props.BoolProperty(
        name="Wipe",
        description="Show the photo over the render of the compared view",
        update=_redraw,
        options=set(),
    )
    wipe: bpy.props.FloatProperty(
        name="Photo",
        description="Fraction of the width that shows the photo, from the left",
        default=0.5,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=_redraw,
        options=set(),
    )
    meshes: bpy.props.PointerProperty(
        name="Meshes",
        description="Scene that renders the meshes. The compositor combines them with the splats by depth",
        type=bpy.types.Scene,
    )
    before_meshes: bpy.props.StringProperty(
        name="Before Meshes",
        description="Settings that Combine With Meshes changed and Remove restores, as JSON",
        options={"HIDDEN"},
    )


SplatScene.__annotations__ |= {
    name: bpy.props.PointerProperty(
        name=name.title(), description="Level of detail that a camera requests", type=controls
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
