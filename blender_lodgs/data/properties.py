"""Properties that LODGS stores on cameras, crops and Blender scenes, and registration of all properties."""

from __future__ import annotations

import bpy

from ...training.optimize.memory import free_memory
from ...training.render.lens import MAX_SAMPLES
from .. import compat
from .property_callbacks import look_up, tag_owner
from .scene_properties import CONTROLS, SplatLevel, SplatScene, SplatSource, SplatStream, SplatTable
from .training_settings import PARAMETERS, TrainingCell, TrainingSettings
from .view_settings import ViewsSettings

_redraw = look_up("redraw")
_ellipsoids_changed = look_up("ellipsoids")


def _is_native(self) -> bool:
    return compat.NATIVE_SPLATS is not None and self.splats and self.drawn_by == "BLENDER"


def _hides_blender(self) -> bool:
    return self.splats if compat.NATIVE_SPLATS is None else not _is_native(self)


def _hides_points(self) -> bool:
    return self.splats and not _is_native(self) and not self.all_points and draws_viewports


draws_viewports = not bpy.app.background and bpy.app.version >= (5, 0)
"""False if Blender has no windows: scripts then read complete points after evaluation. Blender 4.5 does not
know the bounds of clouds that Python made."""

BYTES_PER_SPLAT = 8 << 10
"""Free memory for each splat of the default budget; a viewport with Blender's own data needs about 1 kB."""


def default_budget() -> int:
    """Return the default splat budget for the free memory of this computer, in steps of 500,000."""
    return min(max(free_memory() // BYTES_PER_SPLAT // 500_000 * 500_000, 1_000_000), 8_000_000)


class ViewportSettings(bpy.types.PropertyGroup):
    """Drawing of splats in 3D viewports, on the Blender scene (``Scene.lodgs_viewport``)."""

    splats: bpy.props.BoolProperty(
        name="Gaussian Splats",
        description="Draw Gaussian splats instead of points. Wireframe shading always shows points",
        default=True,
        update=tag_owner,
        options=set(),
    )
    drawn_by: bpy.props.EnumProperty(
        name="Drawn By",
        description="Choose whether LODGS or Blender draws splats in 3D viewports",
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
        update=tag_owner,
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
    hides_points: bpy.props.BoolProperty(
        description="Viewports reduce splat objects to their bounds, because LODGS draws the splats",
        get=_hides_points,
        options={"HIDDEN"},
    )
    all_points: bpy.props.BoolProperty(
        description="Viewports evaluate all points of splat objects, as for wireframes",
        update=tag_owner,
        options={"HIDDEN", "SKIP_SAVE"},
    )
    budget: bpy.props.IntProperty(
        name="Splat Budget",
        description="Maximum number of splats that a viewport draws. Beyond it, coarser levels replace finer "
        "ones. Lower it if the viewport is slow",
        default=default_budget(),
        min=1000,
        max=16_000_000,
        step=10_000,
        options=set(),
    )
    moving: bpy.props.FloatProperty(
        name="While Moving",
        description="Resolution of splats while a slow view moves. Lower it for smoother navigation",
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
        description="Folder for the images and the COLMAP model; empty for lodgs_capture next to the .blend "
        "file",
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
        name="Photo",
        description="Image file of the photo",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    mask: bpy.props.StringProperty(
        name="Mask",
        description="Image that is black where training ignores the photo. Empty for none",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    distorted: bpy.props.BoolProperty(
        name="Distorted", description="The photo has lens distortion, which the camera does not show"
    )
    model_index: bpy.props.IntProperty(
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
            ("INSIDE", "Keep Inside", "Keep splats inside this crop or inside another one of this kind"),
            ("OUTSIDE", "Cut Out", "Remove splats inside this crop"),
            ("ALL", "Keep All", "Keep all splats; the crop only has a look of its own"),
        ],
        update=tag_owner,
    )
    use: bpy.props.BoolProperty(name="Use", description="Enable the crop", default=True, update=tag_owner)


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
        description="Render splats as soft ellipsoids in Cycles and EEVEE, for shadows and reflections. "
        "Suits up to some hundred thousand splats",
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
        description="OpenEXR files with the Depth pass of the meshes, to leave out the splats behind them; "
        "#### is the frame number",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    is_for_meshes: bpy.props.BoolProperty(
        description="This scene renders the meshes for another scene", options={"HIDDEN"}
    )
    hides_splats: bpy.props.BoolProperty(
        description="Renders of this scene show no splats, not even indirectly",
        get=lambda self: self.is_for_meshes and not self.ellipsoids,
        options={"HIDDEN"},
    )
    shadows: bpy.props.BoolProperty(
        name="Splat Shadows",
        description="Let splats shadow and light the meshes: Cycles draws them as ellipsoids that the camera "
        "does not see. Suits up to some hundred thousand splats",
        update=look_up("shadows"),
    )
    samples: bpy.props.IntProperty(
        name="Samples",
        description="Number of images that depth of field and motion blur average. Raise it if blurred edges "
        "show copies",
        default=64,
        min=1,
        max=MAX_SAMPLES,
        soft_max=1024,
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
        description="Settings that Combine with Meshes changed and Remove Meshes restores, as JSON",
        options={"HIDDEN"},
    )


CLASSES = (
    ViewSettings, ViewportSettings, *PARAMETERS.values(), TrainingCell, TrainingSettings, SplatLevel,
    SplatTable, SplatStream, SplatSource, *CONTROLS.values(), SplatScene, CropSettings, BrushSettings,
    RenderSettings, CaptureSettings,
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
