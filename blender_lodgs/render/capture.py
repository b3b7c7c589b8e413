"""Capture of a Blender scene as a COLMAP scene: rendered images, depth maps, exact cameras and points.

The output folder has the layout of ``training.scenes.rendered_views``. Each view is written completely or not
at all, so a repeated call continues, and several processes may render different ranges of views. Captures
change the scene, so they run in a background Blender (``blender --command lodgs capture``).
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from ...training.errors import LodgsError, system_remedy
from ...training.files import atomic_write
from ...training.scenes.cameras import Camera, check_render_size, read_camera, write_camera
from ...training.scenes.rendered_views import CAMERAS, DEPTHS, IMAGES
from .. import compat, extension
from ..data import photographs, roots, viewpoints
from ..data.cameras import scene_camera, view_of
from ..data.original_place import original_place
from ..runs import environment, processes
from .engine import LodgsEngine
from .written_images import is_complete_image

ViewCallback = Callable[[int, int], object]
"""Function that is called before each view is rendered, with its number (from 1) and the number of views."""
LOW_NOISE_SAMPLES = 256
"""Samples per pixel from which Cycles needs no denoiser."""


def render_views(
    context: bpy.types.Context,
    folder: Path,
    width: int,
    height: int,
    only: tuple[int, int] | None = None,
    on_view: ViewCallback = lambda number, count: None,
    warn: viewpoints.Warn = print,
) -> int:
    """Render the missing views of a capture (``Scene.lodgs_capture``).

    Motion blur, depth of field, render borders, the sequencer and file output nodes are disabled, and splat
    scenes are hidden. The scene must not be used afterwards.

    Args:
        context: context with the scene to render.
        folder: output folder.
        width: width of the images in pixels.
        height: height of the images in pixels.
        only: numbers of the first and last view to render, from 1. The range may exceed the number of views.
        on_view: function called before each view.
        warn: function called with a sentence for each camera that is left out.

    Returns:
        Number of views of the capture.

    Raises:
        LodgsError: see ``viewpoints.capture_shots``, or the folder contains other views or is not writable.
    """
    check_render_size(width, height)
    _check(context.scene)
    shots = viewpoints.capture_shots(context, width, height, warn)
    names = [f"view_{number:04d}" for number in range(1, len(shots) + 1)]
    existing = {file.stem for file in (folder / CAMERAS).glob("*.json")}
    if existing - set(names):
        raise _different_views(folder)
    foreign = ("sparse",) if (folder / CAMERAS).is_dir() else ("sparse", CAMERAS, IMAGES, DEPTHS)
    if not existing and any((folder / kind).exists() for kind in foreign):
        raise LodgsError(f"Cannot capture to {folder}: it contains another scene.", "Choose another folder.")
    _mark(folder)
    _prepare(context.scene, width, height)
    place = original_place(context.scene, warn)
    first, last = only or (1, len(shots))
    for number in range(first, min(last, len(shots)) + 1):
        name = names[number - 1]
        camera, near = _set_camera(context, shots[number - 1], width, height)
        camera = place.local_camera(camera)
        file = folder / CAMERAS / f"{name}.json"
        if file.exists():
            if not _is_same_view(camera, read_camera(file)[0].moved(-place.origin)):
                raise _different_views(folder)
            continue
        on_view(number, len(shots))
        if bpy.ops.render.render() != {"FINISHED"}:
            raise LodgsError(
                f"Cannot capture view {number}: its render was cancelled.", "Start the capture again."
            )
        _save(context.scene, folder, name, (width, height))
        write_camera(file, camera.moved(place.origin), near)  # last, as it marks the view as complete
    return len(shots)


def _mark(folder: Path) -> None:
    """Create the cameras' folder, which marks a capture that ends before its first view is complete."""
    try:
        (folder / CAMERAS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(
            f"Cannot write {error.filename}: {error.strerror}.",
            system_remedy(error, "Choose another folder."),
        ) from error


def noise_warning(scene: bpy.types.Scene) -> str | None:
    """Return a warning if the renders of a scene are noisy, because splats learn noise. None otherwise."""
    if scene.render.engine != "CYCLES" or scene.cycles.samples >= LOW_NOISE_SAMPLES:
        return None
    count = scene.cycles.samples
    problem = f"{count} {'sample leaves' if count == 1 else 'samples leave'} noise, which splats learn"
    if not scene.cycles.use_denoising:
        return (
            f"Without a denoiser, {problem}. Enable Denoise in Render > Sampling, "
            f"or use {LOW_NOISE_SAMPLES} samples."
        )
    if not compat.HAS_DENOISER and scene.cycles.denoiser != "OPTIX":
        return (
            f"This Blender has no denoiser: {problem}. Use Blender from blender.org, "
            f"or {LOW_NOISE_SAMPLES} samples."
        )
    return None


def write_model(folder: Path) -> str:
    """Let the trainer write the COLMAP model of all rendered views. Return its output.

    Raises:
        LodgsError: the trainer is missing, or it cannot create the model.
    """
    process = subprocess.run(
        [str(environment.trainer_python()), "-m", "training", "model", str(folder)],
        cwd=extension.FOLDER, env=processes.environment(), stdin=subprocess.DEVNULL, capture_output=True,
        text=True, encoding="utf-8", errors="replace", check=False,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )  # fmt: skip
    if process.returncode:
        no_output = f"The trainer stopped with exit code {process.returncode}."
        last = (process.stderr.strip().splitlines() or [no_output])[-1]
        raise LodgsError(last.removeprefix("error: "))
    return process.stdout.strip()


def _check(scene: bpy.types.Scene) -> None:
    if scene.render.engine == LodgsEngine.bl_idname:
        raise LodgsError(
            "Cannot capture with the LODGS render engine: it renders only splats.",
            "Choose Cycles, EEVEE or Workbench.",
        )
    if not any(layer.use for layer in scene.view_layers):
        raise LodgsError(
            "Cannot capture the scene: none of its view layers is rendered.",
            "Enable Use for Rendering in the View Layer tab.",
        )


def _different_views(folder: Path) -> LodgsError:
    return LodgsError(
        f"Cannot capture to {folder}: it contains other views.",
        "Choose another folder, or restore the settings of the first capture.",
    )


def _is_same_view(camera: Camera, saved: Camera) -> bool:
    """Compare two cameras with a tolerance for the rounding of different processors."""
    fields = "width", "height", "fx", "fy", "cx", "cy"
    return np.allclose(
        [getattr(camera, name) for name in fields], [getattr(saved, name) for name in fields], rtol=1e-5
    ) and np.allclose(camera.world_to_camera, saved.world_to_camera, rtol=1e-5, atol=1e-5)


def _prepare(scene: bpy.types.Scene, width: int, height: int) -> None:
    """Set a scene up to render sharp stills of one size with depth, without other render effects."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.use_border = render.use_multiview = render.use_sequencer = render.use_motion_blur = False
    render.use_stamp = False
    render.use_persistent_data = True
    used = [layer for layer in scene.view_layers if layer.use]
    for layer in used:
        layer.use_pass_z = True
        # without a compositor, image and depth must come from the same layer: the first one
        layer.use = layer == used[0] or compat.uses_compositor(scene)
    trees = [getattr(scene, "node_tree", None), *bpy.data.node_groups]
    for tree in filter(None, trees):
        for node in tree.nodes:
            if node.bl_idname == "CompositorNodeOutputFile":
                node.mute = True
    for root in roots.all_roots(scene):
        for obj in root.children_recursive:
            obj.driver_remove("hide_render")  # the driver would show a level
            obj.hide_render = True


def _set_camera(
    context: bpy.types.Context, shot: viewpoints.Shot, width: int, height: int
) -> tuple[Camera, float]:
    """Set the scene's camera for a shot. Return its view in world space and its near clipping distance."""
    scene = context.scene
    if isinstance(shot, int):
        scene.frame_set(shot)
    else:
        for marker in scene.timeline_markers:  # markers would replace the camera
            marker.camera = None
        if isinstance(shot, tuple):
            view, near = shot
            scene.camera = photographs.new_camera(view, 100 * near, near, photograph=False)
            scene.collection.objects.link(scene.camera)
            photographs.match_render(scene, view)
        else:
            scene.camera = shot
    camera = scene_camera(scene)
    camera.data.dof.use_dof = False
    context.view_layer.update()
    depsgraph = context.evaluated_depsgraph_get()
    return view_of(camera.evaluated_get(depsgraph), depsgraph, width, height)


def _save(scene: bpy.types.Scene, folder: Path, name: str, size: tuple[int, int]) -> None:
    """Write the last render: all layers as EXR, and the display image as PNG."""
    settings, result = scene.render.image_settings, bpy.data.images["Render Result"]
    settings.color_management = "FOLLOW_SCENE"
    for kind, suffix in ((DEPTHS, "exr"), (IMAGES, "png")):
        if kind == DEPTHS:
            compat.set_multilayer_exr(settings)
            settings.exr_codec = "ZIP"
        else:
            compat.set_png(settings, alpha=scene.render.film_transparent)
        file = folder / kind / f"{name}.{suffix}"
        with atomic_write(file) as temporary:
            try:
                with compat.square_pixels(scene.render):
                    result.save_render(str(temporary), scene=scene)
                complete = is_complete_image(temporary, size)
            except RuntimeError:  # Blender gives no reason
                complete = False
            if not complete:
                hint = ", or connect the compositor's output" if compat.uses_compositor(scene) else ""
                raise LodgsError(
                    f"Cannot write {file}: the image is incomplete.",
                    f"Free some disk space{hint}, then start the capture again.",
                )
