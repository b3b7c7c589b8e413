"""The render engine LODGS: F12 and animations of splats, drawn by the trainer's rasterizer.

Pixels equal those of ``python -m training render``. Meshes are not drawn: they are another engine's picture,
which the compositor joins with this one by depth.
"""

from __future__ import annotations

import re
from pathlib import Path

import bpy
import numpy as np

from ..training.errors import LodgsError
from . import objects, renderer, scenes, shown
from .cameras import view_of

ID = "LODGS"
LEVEL, LEVEL_MASK, DEPTH, COMBINED = "Level", "Level {}", "Depth", "Combined"


class LodgsEngine(bpy.types.RenderEngine):
    bl_idname = ID
    bl_label = "LODGS"
    bl_use_postprocess = True
    bl_use_preview = False
    bl_use_eevee_viewport = True  # materials and lights of meshes; splats are drawn over it
    bl_use_spherical_stereo = False

    def update_render_passes(self, scene=None, renderlayer=None):
        self.register_pass(scene, renderlayer, COMBINED, 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, DEPTH, 1, "Z", "VALUE")
        if scene.lodgs_render.use_pass_levels:
            self.register_pass(scene, renderlayer, LEVEL, 1, "X", "VALUE")
            for number in levels_in(scene):
                self.register_pass(scene, renderlayer, LEVEL_MASK.format(number), 1, "X", "VALUE")

    def render(self, depsgraph):
        size = self.resolution_x, self.resolution_y
        window = border(depsgraph.scene.render, *size)
        try:
            drawn = frame(depsgraph, *size, window, self._wanted)
        except LodgsError as error:
            self.error_set(str(error))
            self.report({"ERROR"}, str(error))  # without it a black picture would be written
            return
        if drawn is None or self.test_break():
            return
        planes = drawn.planes
        _, _, width, height = window
        result = self.begin_result(0, 0, width, height, layer=depsgraph.view_layer.name)
        for target in result.layers[0].passes:
            names = [f"{target.name}.{channel}" for channel in target.channel_id]
            if all(name in planes for name in names):
                pixels = np.stack([planes[name][::-1] for name in names], axis=2)  # Blender's begin below
                target.rect.foreach_set(np.ascontiguousarray(pixels).reshape(-1))
        self.end_result(result)

    def _wanted(self, share: float, text: str) -> bool:
        self.update_progress(share)
        self.update_stats("", text)
        return not self.test_break()


def frame(
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    window: tuple[int, int, int, int],
    wanted: renderer.Wanted = lambda share, text: True,
) -> renderer.Frame | None:
    """The splats that a depsgraph shows, as its scene's camera sees them in a picture of this size.

    Args:
        window: left, bottom, width and height of the part that is drawn.
        wanted: told how far it is; False ends it.

    Returns:
        The picture with the passes that the view layer wants; None where it was ended.

    Raises:
        LodgsError: there is no trainer, or the camera cannot be rendered through, or the depth that holds
            out is missing, or the renderer failed.
    """
    scene, layer = depsgraph.scene, depsgraph.view_layer
    if scene.camera is None:
        raise LodgsError("The scene has no camera.", "Add one, or look through one of the views.")
    camera, near = view_of(scene.camera.evaluated_get(depsgraph), depsgraph, width, height)
    left, bottom, across, up = window
    settings = scene.lodgs_render
    return renderer.frame(
        splat_sets(depsgraph),
        camera,
        near,
        wanted,
        background=None if scene.render.film_transparent else tuple(settings.background),
        depth=layer.use_pass_z,
        levels=settings.use_pass_levels,
        window=(left, height - bottom - up, across, up),
        holdout=holdout_file(scene, scene.frame_current),
    )


def holdout_file(scene: bpy.types.Scene, frame: int) -> Path | None:
    """The file with the depth of the meshes in a frame; None where nothing is to be held out.

    Raises:
        LodgsError: it does not exist.
    """
    if not scene.lodgs_render.holdout:
        return None
    path = at_frame(scene.lodgs_render.holdout, scene.original, frame)
    if not path.is_file():
        raise LodgsError(
            f"The depth of the meshes in frame {frame} is missing: {path}.",
            "Press Render Mesh Depth (for all frames, the button beside it), or clear Hold Out.",
        )
    return path


def at_frame(pattern: str, scene: bpy.types.Scene, frame: int) -> Path:
    """A path with the frame's number in the place of the last # characters of its name, as Blender counts."""
    path = Path(bpy.path.abspath(pattern, library=scene.library))

    def number(found: re.Match) -> str:
        return "-" * (frame < 0) + str(abs(frame)).zfill(len(found[0]))

    return path.with_name(re.sub(r"#+(?=[^#]*$)", number, path.name))


def splat_sets(depsgraph: bpy.types.Depsgraph) -> list[renderer.Set]:
    """What a depsgraph shows of splats, in the form that files have: so its pixels are those of the files."""
    found, known = [], {}
    for one in shown.splat_sets(depsgraph):
        key = one.object.session_uid
        if key not in known:
            cloud = one.evaluated.data
            known[key] = objects.splats_of(cloud), objects.read_attribute(cloud, objects.WEIGHT)
        splats, weights = known[key]
        if splats is not None and len(splats):
            found.append(renderer.Set(key, splats, weights, one.matrix_world, one.level))
    return found


def coded(linear: np.ndarray) -> np.ndarray:
    """Display-coded (sRGB) values of linear light from 0 on, float32."""
    curve = 1.055 * linear ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve).astype(np.float32)


def size(render: bpy.types.RenderSettings) -> tuple[int, int]:
    """Width and height of the whole picture in pixels, in Blender's arithmetic."""
    percent = render.resolution_percentage
    return max(render.resolution_x * percent // 100, 1), max(render.resolution_y * percent // 100, 1)


def border(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int]:
    """Left, bottom, width and height of the part of the picture that is rendered, in Blender's arithmetic."""
    if not render.use_border:
        return 0, 0, width, height
    x = [int(np.float32(at) * np.float32(width)) for at in (render.border_min_x, render.border_max_x)]
    y = [int(np.float32(at) * np.float32(height)) for at in (render.border_min_y, render.border_max_y)]
    return x[0], y[0], x[1] - x[0], y[1] - y[0]


def levels_in(scene: bpy.types.Scene) -> list[int]:
    """Numbers of the levels of all splat scenes in a scene."""
    return sorted({item.number for root in scenes.roots(scene) for item in root.lodgs.levels})


def use(scene: bpy.types.Scene) -> None:
    """Makes LODGS the scene's engine, and its colours those of the photographs."""
    scene.render.engine = ID
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


CLASSES = (LodgsEngine,)

_NOT_OURS = ("freestyle", "simplify", "gpencil")
"""Parts of the names of Blender's panels that would promise too much."""


def _shared_panels():
    """Blender's own panels that make sense for any engine: output, colour management, cameras, ..."""
    return [
        panel
        for panel in bpy.types.Panel.__subclasses__()
        if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ())
        and not any(part in panel.__name__ for part in _NOT_OURS)
    ]


def register() -> None:
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.add(ID)


def unregister() -> None:
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.discard(ID)
