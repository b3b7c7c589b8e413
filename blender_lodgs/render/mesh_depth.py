"""Depth of the meshes, rendered with Cycles, as holdout for splats behind them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from .. import compat
from ..data.cameras import scene_camera
from ..data.paths import relative_path
from ..data.viewpoints import SOLID, is_renderable
from . import compositing, engine
from .written_images import require_complete_image


def render_mesh_depth(scene: bpy.types.Scene, frames: Iterable[int]) -> Iterator[Path]:
    """Render the depth of a scene's meshes with Cycles, so that meshes occlude splats.

    Each frame is a multilayer EXR file with one ray through each pixel centre, where splats are evaluated
    too. After the last frame, the files become the holdout of the scene.

    Args:
        scene: scene with meshes and a camera.
        frames: frame numbers.

    Yields:
        The written file of each frame (:func:`depth_file_pattern`).

    Raises:
        LodgsError: the scene has no camera, no meshes or several views, a file cannot be written, or Cycles
            is disabled.
    """
    scene_camera(scene)
    compositing.require_cycles(scene)
    if scene.render.use_multiview:
        raise LodgsError(
            "Cannot render mesh depth: the scene has a stereo or multi-view render.",
            "Use Combine with Meshes, or disable Stereoscopy.",
        )
    pattern = depth_file_pattern(scene)
    meshes = bpy.data.scenes.new(f"{scene.name} Depth")
    try:
        compositing.copy_settings(scene, meshes, catchers=False)
        if not any(map(_has_depth, meshes.view_layers[0].objects)):
            raise LodgsError(
                f"Cannot render mesh depth: the scene '{scene.name}' has no meshes.",
                "Add a mesh outside the collections of the splats.",
            )
        _set_depth_only(meshes)
        for frame in frames:
            path = engine.frame_path(str(pattern), scene, frame)
            # as an animation, because a still of an inactive scene shows another frame
            meshes.frame_start = meshes.frame_end = frame
            meshes.render.filepath = str(path.parent / pattern.name)
            bpy.ops.render.render(scene=meshes.name, animation=True)
            require_complete_image(path)
            yield path
    except RuntimeError as error:
        raise LodgsError(
            f"Cannot render the depth of the meshes: {error}", "Save the .blend file in another folder."
        ) from error
    finally:
        bpy.data.scenes.remove(meshes)
    scene.lodgs_render.holdout = relative_path(str(pattern))
    if scene.lodgs_render.meshes is not None:
        compositing.combine_with_meshes(scene)


def _has_depth(obj: bpy.types.Object) -> bool:
    """Return whether an object has depth: outside splat scenes, or one of the user below a root."""
    has_surfaces = obj.type in SOLID - {"POINTCLOUD"} or obj.instance_type == "COLLECTION"
    return is_renderable(obj) or (has_surfaces and not obj.hide_render)


def depth_file_pattern(scene: bpy.types.Scene) -> Path:
    """Return the path of the depth files with #### for the frame number.

    The folder is next to the .blend file, or a private temporary folder if the file is not saved.
    """
    name = f"{bpy.path.clean_name(scene.name)}_####.exr"
    if bpy.data.filepath:
        return Path(bpy.path.abspath("//")) / f"{Path(bpy.data.filepath).stem}_depth" / name
    return Path(bpy.app.tempdir or _temporary_folder()) / "depth" / name


@cache
def _temporary_folder() -> str:
    """Create a temporary folder for this process, in case Blender has none."""
    return tempfile.mkdtemp(prefix="lodgs-")


def _set_depth_only(scene: bpy.types.Scene) -> None:
    """Set a scene up to render depth with one ray per pixel to multilayer EXR files."""
    render, settings = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    compat.set_multilayer_exr(render.image_settings)
    for layer in scene.view_layers:
        layer.use_pass_z, layer.use_pass_combined = True, False
    settings.samples, settings.max_bounces = 1, 0
    settings.use_denoising = settings.use_adaptive_sampling = False
    settings.pixel_filter_type, settings.filter_width = compositing.CENTER_FILTER
