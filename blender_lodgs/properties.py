"""What LODGS keeps in a .blend file: on each scene root (``Object.lodgs``) and on each of its cameras."""

from __future__ import annotations

import bpy

from ..training.lod.octree import MOST_LEVELS
from ..training.methods.parameters import METHODS, PRESETS


class TrainingSettings(bpy.types.PropertyGroup):
    """Choices of the training panel, and the scene root's newest run (``root.lodgs.training``).

    A 0 for ``levels``, ``footprint`` and ``max_splats`` means the preset's own value. ``run`` is the folder
    of that run, relative to the .blend where possible; all else about it is read from there.
    """

    method: bpy.props.EnumProperty(
        name="Method",
        description="What is trained",
        items=[(name, text.split(":")[0], text) for name, text in METHODS.items()],
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        description="How long the training takes",
        items=[(name, name.title(), text) for name, text in PRESETS.items()],
    )
    image_scale: bpy.props.FloatProperty(
        name="Image Scale",
        description="Size of the training images over the size of the photographs",
        default=0.5,
        min=0.01,
        soft_min=0.1,
        max=1.0,
        subtype="FACTOR",
    )
    test_every: bpy.props.IntProperty(
        name="Hold Out Every",
        description="Every n-th view by name is kept out of training to measure quality; 0 trains on all",
        default=8,
        min=0,
        soft_max=16,
    )
    seed: bpy.props.IntProperty(
        name="Seed", description="Two runs with the same seed are equal", default=0, min=0
    )
    levels: bpy.props.IntProperty(
        name="Levels",
        description="Number of levels of detail; 0 takes the preset's, or with Octree-GS what the distances "
        "in the scene ask for",
        default=0,
        min=0,
        max=MOST_LEVELS,
    )
    footprint: bpy.props.FloatProperty(
        name="Coarsest Detail",
        description="Pixels that the smallest detail of level 1 covers at the scene's median depth; "
        "0 takes the preset's",
        default=0.0,
        min=0.0,
        soft_max=64.0,
        subtype="PIXEL",
    )
    max_splats: bpy.props.IntProperty(
        name="Most Splats",
        description="Most splats at full detail; 0 takes the preset's",
        default=0,
        min=0,
        step=1000,
    )
    output: bpy.props.StringProperty(
        name="Run Folders In",
        description="Folder that receives the folders of the runs; empty: lodgs_runs beside the .blend file",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    model: bpy.props.StringProperty(
        name="Model",
        description="Folder of the COLMAP model; empty: the scene's largest",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    images: bpy.props.StringProperty(
        name="Photographs",
        description="Folder of the photographs; empty: found beside the model",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    run: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder of this scene's newest run",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    read: bpy.props.IntProperty(
        name="Events Read",
        description="Bytes of the run's events that this file has taken in",
        options={"HIDDEN"},
    )


def _changed(self, context) -> None:
    """Properties set from scripts do not evaluate the scene anew by themselves."""
    self.id_data.update_tag()


def _redraw(self, context) -> None:
    from . import processes

    processes.redraw()


def _view_chosen(self, context) -> None:
    from . import scenes

    things = self.cameras.objects if self.cameras else ()
    if self.active_view < len(things) and things[self.active_view].type == "CAMERA":
        scenes.through(context, things[self.active_view])


def _finest(self) -> int:
    """The finest level that there is; without levels there is no limit yet."""
    return max((item.number for item in self.levels), default=2**31 - 1)


def _single_changed(self, context) -> None:
    if self.single_level > _finest(self):
        self.single_level = _finest(self)
    _changed(self, context)


def _start_changed(self, context) -> None:
    if self.level_start > _finest(self):
        self.level_start = _finest(self)
    if self.level_end < self.level_start:
        self.level_end = self.level_start
    _changed(self, context)


def _end_changed(self, context) -> None:
    if self.level_end > _finest(self):
        self.level_end = _finest(self)
    if self.level_start > self.level_end:
        self.level_start = self.level_end
    _changed(self, context)


def _eye_changed(self, context) -> None:
    from . import selection

    selection.update_inputs(self.id_data)


def _whose_eye_changed(self, context) -> None:
    from . import selection

    if self.eye == "VIEW" and not self.freeze:  # until a viewport says where it is
        selection.hold(self.id_data, selection.eye_place(self.id_data, context.scene), self.focal_px)
    selection.update_inputs(self.id_data)
    _changed(self, context)


def _freeze_changed(self, context) -> None:
    from . import selection

    if self.freeze and self.eye != "VIEW":  # focal_px is still the moving eye's
        selection.hold(self.id_data, selection.eye_place(self.id_data, context.scene), self.focal_px)
    selection.update_inputs(self.id_data)
    _changed(self, context)


def _can_be_eye(self, thing: bpy.types.Object) -> bool:
    return not thing.lodgs.is_root


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
    exact_s_min: bpy.props.StringProperty(options={"HIDDEN"})  # Blender's floats are shorter than the files'
    s_min: bpy.props.FloatProperty(
        name="Smallest Detail",
        description="Smallest size of a splat that training allowed at this level, in the scene's own units",
        precision=5,
        update=_changed,
        options=set(),
    )

    @property
    def has_s_min(self) -> bool:
        """Whether the level has a smallest detail, and so a place in the choice by distance."""
        return bool(self.exact_s_min)

    @property
    def exists(self) -> bool:
        """False once an artist has deleted the level's object, which the list still remembers."""
        return self.object is not None and bool(self.object.users_collection)


class SplatScene(bpy.types.PropertyGroup):
    """A splat scene, kept on its scene root: the empty that all its objects are children of.

    Children keep COLMAP coordinates; the root's transform stands it upright, scales and places it.
    """

    is_root: bpy.props.BoolProperty(options={"HIDDEN"})
    scene_folder: bpy.props.StringProperty(
        name="Scene", description="Folder of the COLMAP scene", subtype="DIR_PATH"
    )
    method: bpy.props.StringProperty(
        name="Method", description="Name of the method that made the levels; empty for a plain splat file"
    )
    meta: bpy.props.StringProperty(
        name="Facts", description="Further facts of the bundle, as JSON", options={"HIDDEN"}
    )
    cumulative: bpy.props.BoolProperty(
        name="Cumulative",
        description="Each level only holds what it adds to the coarser ones",
        update=_changed,
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
    level_start: bpy.props.IntProperty(
        name="Coarsest",
        description="Level that is shown farthest away; 1 is the coarsest of all",
        default=1,
        min=1,
        update=_start_changed,
    )
    level_end: bpy.props.IntProperty(
        name="Finest",
        description="Level that is shown nearest to the eye",
        default=1,
        min=1,
        update=_end_changed,
    )
    gamma: bpy.props.FloatProperty(
        name="Screen Size",
        description="γ: a finer level takes over where the smallest detail of the coarser one would cover "
        "this many pixels. Smaller is finer",
        default=1.0,
        min=0.01,
        soft_min=0.1,
        soft_max=10.0,
        subtype="PIXEL",
        update=_changed,
    )
    level_offset: bpy.props.FloatProperty(
        name="Level Offset",
        description="Levels finer (above 0) or coarser (below 0) than the distance asks for",
        default=0.0,
        min=-16.0,
        max=16.0,
        soft_min=-4.0,
        soft_max=4.0,
        update=_changed,
    )
    d_max: bpy.props.FloatProperty(
        name="Farthest",
        description="Distance from which on the coarsest level alone is shown, in the scene's own units; "
        "0 where levels are not those of an octree",
        update=_changed,
        options=set(),
    )
    d_max_focal: bpy.props.FloatProperty(
        name="Farthest at Focal Length",
        description="Focal length in pixels of a camera to which that distance belongs",
        default=1.0,
        subtype="PIXEL",
        update=_changed,
        options=set(),
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
                "scene camera for them",
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
                "Which level is where: violet (coarse), blue, teal, yellow, red and on",
            ),
            (
                "BANDS",
                "Bands",
                "Which level is wanted at which distance from the eye, in the same colours",
            ),
        ],
        options=set(),
    )

    training: bpy.props.PointerProperty(type=TrainingSettings)

    @property
    def by_distance(self) -> bool:
        """Whether the levels say at which distances they are to be shown."""
        return self.d_max > 0 or any(item.has_s_min for item in self.levels)


class ViewportSettings(bpy.types.PropertyGroup):
    """How 3D viewports draw splats, on the Blender scene (``Scene.lodgs_viewport``)."""

    splats: bpy.props.BoolProperty(
        name="Gaussian Splats",
        description="Draw splats as the photographs show them, not as points. Wireframe shading has none",
        default=True,
        update=_changed,
        options=set(),
    )
    budget: bpy.props.IntProperty(
        name="At Most",
        description="Most splats that a viewport draws. Where there are more, coarser levels stand in for "
        "the finest, and of a single level the most visible splats are drawn",
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


class View(bpy.types.PropertyGroup):
    """What an imported camera knows of its photograph, on its data (``Camera.lodgs``); all 0 on others."""

    width: bpy.props.IntProperty(name="Width", description="Width of the photograph", subtype="PIXEL")
    height: bpy.props.IntProperty(name="Height", description="Height of the photograph", subtype="PIXEL")
    fx: bpy.props.FloatProperty(name="Focal Length X", description="In pixels", subtype="PIXEL")
    fy: bpy.props.FloatProperty(name="Focal Length Y", description="In pixels", subtype="PIXEL")
    photograph: bpy.props.StringProperty(
        name="Photograph", description="File of the photograph", subtype="FILE_PATH"
    )
    distorted: bpy.props.BoolProperty(
        name="Distorted", description="The lens bends lines in the photograph, which the camera does not show"
    )
    psnr: bpy.props.FloatProperty(
        name="PSNR",
        description="How alike the splats and the photograph were when last measured, in dB; 0 before",
    )


def _ellipsoids_changed(self, context) -> None:
    from . import scenes

    if self.ellipsoids:
        scenes.offer_ellipsoids(self.id_data)
    _changed(self, context)


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
    draws_ellipsoids: bpy.props.BoolProperty(
        description="Whether renders of this scene show ellipsoids: LODGS draws true splats instead",
        get=lambda self: self.ellipsoids and self.id_data.render.engine != "LODGS",
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


CLASSES = (View, ViewportSettings, TrainingSettings, SplatLevel, SplatScene, RenderSettings)


def register() -> None:
    """Attach the groups to Blender's objects, cameras and scenes."""
    bpy.types.Object.lodgs = bpy.props.PointerProperty(type=SplatScene)
    bpy.types.Camera.lodgs = bpy.props.PointerProperty(type=View)
    bpy.types.Scene.lodgs_render = bpy.props.PointerProperty(type=RenderSettings)
    bpy.types.Scene.lodgs_viewport = bpy.props.PointerProperty(type=ViewportSettings)


def unregister() -> None:
    """Detach them again."""
    del bpy.types.Scene.lodgs_render
    del bpy.types.Scene.lodgs_viewport
    del bpy.types.Camera.lodgs
    del bpy.types.Object.lodgs
