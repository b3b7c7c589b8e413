"""A Blender scene as a COLMAP scene: pictures and depths by its own engine, exact cameras, a model of them.

What is rendered lies in a folder as ``training.scenes.rendered_views`` has it, view by view, whole or not at all:
the same call goes on where one stopped, and several may work on ranges of the views at a time. This happens
in a Blender of its own, in background (``blender --command lodgs capture``), because it changes the scene.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.files import atomic_write
from ...training.scenes.cameras import Camera, check_render_size, read_camera, write_camera
from ...training.scenes.images import image_size
from ...training.scenes.rendered_views import CAMERAS, DEPTHS, IMAGES
from .. import compat, extension
from ..data import photographs, roots, viewpoints
from ..data.cameras import scene_camera, view_of
from ..runs import environment, processes
from .engine import LodgsEngine

Tell = Callable[[int, int], object]
"""Is told before each view that is rendered which one it is, from 1 on, and of how many."""
CLEAN = 256
"""Samples of a pixel from which on Cycles leaves little noise without a denoiser."""


def render_views(
    context: bpy.types.Context,
    folder: Path,
    width: int,
    height: int,
    only: tuple[int, int] | None = None,
    tell: Tell = lambda number, count: None,
) -> int:
    """Renders the views that the scene's settings (``Scene.lodgs_capture``) ask for, where they are missing.

    Blur, borders, the sequencer and what compositors write into files are switched off, splat scenes are left
    out; all else is as the scene has it. The scene is not to be used on.

    Args:
        only: first and last view, from 1 on, of those to render; there need not be so many.

    Returns:
        How many views the settings ask for.

    Raises:
        LodgsError: as ``viewpoints.of_scene``; the folder holds other views, or cannot be written.
    """
    check_render_size(width, height)
    _check(context.scene)
    shots = viewpoints.of_scene(context, width, height)
    names = [f"view_{number:04d}" for number in range(1, len(shots) + 1)]
    there = {file.stem for file in (folder / CAMERAS).glob("*.json")}
    if there - set(names):
        raise _others(folder)
    if not there and any((folder / kind).exists() for kind in ("sparse", CAMERAS, IMAGES, DEPTHS)):
        raise LodgsError(f"{folder} holds another scene.", "Choose another folder.")
    _prepare(context.scene, width, height)
    first, last = only or (1, len(shots))
    for number in range(first, min(last, len(shots)) + 1):
        name = names[number - 1]
        camera, near = _look(context, shots[number - 1], width, height)
        file = folder / CAMERAS / f"{name}.json"
        if file.exists():
            if not _same(camera, read_camera(file)[0]):
                raise _others(folder)
            continue
        tell(number, len(shots))
        if bpy.ops.render.render() != {"FINISHED"}:
            raise LodgsError(f"View {number} was not rendered to its end.", "Do it again: it goes on there.")
        _save(context.scene, folder, name, (width, height))
        write_camera(file, camera, near)  # the last: where it is, the view is whole
    return len(shots)


def noise(scene: bpy.types.Scene) -> str | None:
    """What to know of the noise of a scene's renders, which splats learn; None where there is little."""
    if scene.render.engine != "CYCLES" or scene.cycles.samples >= CLEAN:
        return None
    count = scene.cycles.samples
    left = f"{count} {'sample leaves' if count == 1 else 'samples leave'} noise, and splats learn it"
    if not scene.cycles.use_denoising:
        return f"Without a denoiser {left}. Switch on Denoise in Render > Sampling, or take {CLEAN} samples."
    if not compat.DENOISES and scene.cycles.denoiser != "OPTIX":
        return f"This Blender has no denoiser: {left}. Take blender.org's Blender, or {CLEAN} samples."
    return None


def write_model(folder: Path) -> str:
    """Has the trainer make the COLMAP model of all views that were rendered; returns what it says of it.

    Raises:
        LodgsError: there is no trainer, or the views make no model.
    """
    done = subprocess.run(
        [str(environment.trainer_python()), "-m", "training", "model", str(folder)],
        cwd=extension.FOLDER, env=processes.environment(), stdin=subprocess.DEVNULL, capture_output=True,
        text=True, encoding="utf-8", errors="replace", check=False,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )  # fmt: skip
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["The trainer has ended without a word."])[-1]
        raise LodgsError(last.removeprefix("error: "))
    return done.stdout.strip()


def _check(scene: bpy.types.Scene) -> None:
    if scene.render.engine == LodgsEngine.bl_idname:
        raise LodgsError("LODGS renders splats and nothing else.", "Choose Cycles, EEVEE or Workbench.")
    if not any(layer.use for layer in scene.view_layers):
        raise LodgsError(
            "No view layer of the scene is rendered.",
            "Switch one on in the View Layer tab: Use for Rendering.",
        )


def _others(folder: Path) -> LodgsError:
    return LodgsError(
        f"{folder} holds other views than these.",
        "Choose another folder, or the settings that it began with.",
    )


def _same(camera: Camera, before: Camera) -> bool:
    """Whether two views are one, but for what other processors make of the same numbers."""
    fields = "width", "height", "fx", "fy", "cx", "cy"
    return np.allclose(
        [getattr(camera, name) for name in fields], [getattr(before, name) for name in fields], rtol=1e-5
    ) and np.allclose(camera.world_to_camera, before.world_to_camera, rtol=1e-5, atol=1e-5)


def _prepare(scene: bpy.types.Scene, width: int, height: int) -> None:
    """Has a scene render sharp stills of one size, with depth, and nothing of what else renders do."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.use_border = render.use_multiview = render.use_sequencer = render.use_motion_blur = False
    render.use_stamp = False
    render.use_persistent_data = True
    used = [layer for layer in scene.view_layers if layer.use]
    for layer in used:
        layer.use_pass_z = True
        # a picture that nobody composes is the first one's, and depths are to be of what it shows
        layer.use = layer == used[0] or compat.composites(scene)
    trees = [getattr(scene, "node_tree", None), *bpy.data.node_groups]
    for tree in filter(None, trees):
        for node in tree.nodes:
            if node.bl_idname == "CompositorNodeOutputFile":
                node.mute = True
    for root in roots.roots(scene):
        for obj in root.children_recursive:
            obj.driver_remove("hide_render")  # by which a level is shown alone
            obj.hide_render = True


def _look(context: bpy.types.Context, shot: viewpoints.Shot, width: int, height: int) -> tuple[Camera, float]:
    """Makes the scene's camera what a shot says; what it sees, in the world, and its near depth."""
    scene = context.scene
    if isinstance(shot, int):
        scene.frame_set(shot)
    else:
        for marker in scene.timeline_markers:  # which would choose another
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
    """Writes what was rendered last: all its layers, and the picture as the display shows it."""
    settings, result = scene.render.image_settings, bpy.data.images["Render Result"]
    settings.color_management = "FOLLOW_SCENE"
    for kind, ending in ((DEPTHS, "exr"), (IMAGES, "png")):
        if kind == DEPTHS:
            compat.multilayer_exr(settings)
            settings.exr_codec = "ZIP"
        else:
            compat.png(settings, alpha=scene.render.film_transparent)
        file = folder / kind / f"{name}.{ending}"
        with atomic_write(file) as temporary:
            try:
                result.save_render(str(temporary), scene=scene)
                whole = image_size(temporary) == size
            except RuntimeError:  # which Blender raises without saying why
                whole = False
            if not whole:
                also = ", or connect the compositor's output" if compat.composites(scene) else ""
                raise LodgsError(f"{file} is not whole.", f"Free some space there{also}, then do it again.")
