"""The render engine LODGS: F12 and animations of splats, drawn by the trainer's rasterizer.

Pixels equal those of ``python -m training render``. Meshes are not drawn: they are another engine's picture,
which the compositor joins with this one by depth.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ...training.editing.paint import COLUMNS as PAINT
from ...training.editing.paint import painted
from ...training.errors import LodgsError
from ...training.lod.rule import every_column
from ...training.splats.gaussians import Splats
from .. import attributes
from ..data import changes, objects, roots, selection, shown
from ..data.cameras import scene_camera, view_of
from . import renderer

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
            drawn = _draw(depsgraph, *size, window, self._on_progress)
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

    def _on_progress(self, fraction: float, text: str) -> bool:
        self.update_progress(fraction)
        self.update_stats("", text)
        return not self.test_break()


def frame(
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    window: tuple[int, int, int, int],
    on_progress: renderer.OnProgress = lambda fraction, text: True,
) -> renderer.Frame | None:
    """The splats that a depsgraph shows, as its scene's camera sees them in a picture of this size.

    Args:
        window: left, bottom, width and height of the part that is drawn.
        on_progress: see ``renderer.OnProgress``.

    Returns:
        The picture with the passes that the view layer wants; None where it was ended.

    Raises:
        LodgsError: there is no trainer, or the camera cannot be rendered through, or the depth that holds
            out is missing, or the renderer failed.
    """
    scene, layer = depsgraph.scene, depsgraph.view_layer
    camera, near = view_of(scene_camera(scene).evaluated_get(depsgraph), depsgraph, width, height)
    left, bottom, across, up = window
    settings = scene.lodgs_render
    return renderer.frame(
        placed_splats(depsgraph),
        camera,
        near,
        on_progress,
        background=None if scene.render.film_transparent else tuple(settings.background),
        depth=layer.use_pass_z,
        levels=settings.use_pass_levels,
        window=(left, height - bottom - up, across, up),
        holdout=holdout_file(scene, scene.frame_current),
    )


_draw = frame
"""What renders of this engine are drawn by."""


@contextmanager
def drawn_by(draw: Callable[..., renderer.Frame | None]) -> Iterator[None]:
    """Has renders drawn by another function of the same arguments as :func:`frame`, in the block."""
    global _draw
    before, _draw = _draw, draw
    try:
        yield
    finally:
        _draw = before


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


def placed_splats(depsgraph: bpy.types.Depsgraph) -> list[renderer.PlacedSplats | renderer.PlacedTree]:
    """What a depsgraph shows of splats, in the form that files have: so its pixels are those of the files.

    What only a rule chooses from is all of an object's splats, with the choice. Else it is what modifiers
    leave.
    """
    found = []
    for instance in shown.without_coarser(shown.splat_instances(depsgraph)):
        evaluated, matrix, level = instance.evaluated, instance.matrix_world, instance.level
        place, empty = (matrix, level, instance.antialias), not len(evaluated.data.points)
        if instance.source is not None and (choice := shown.choice_of_picture(instance, depsgraph)):
            tree = instance.source.path, matrix, instance.antialias, choice, instance.looks
            found.append(renderer.PlacedTree(*tree))
            continue
        if not _chosen_by_rule(instance, depsgraph):
            if not empty:
                read = partial(_splats_of, evaluated.data)
                uid = instance.object.session_uid
                found.append(renderer.PlacedSplats(uid, read, *place, looks=instance.looks))
            continue
        own = instance.object.data
        read = partial(_splats_of, own.evaluated_get(depsgraph), every_column())
        version = *changes.version(own), *changes.paint(own)
        choice = selection.choice(evaluated, depsgraph)
        found.append(
            renderer.PlacedSplats(own.session_uid, read, *place, version, choice, empty, instance.looks)
        )
    return found


def _chosen_by_rule(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether an instance shows its object's own splats, chosen by nothing but a rule.

    Of objects that no viewport shows, Blender does not tell when they change.
    """
    return (
        selection.only_chosen(instance.evaluated, depsgraph)
        and attributes.WEIGHT not in instance.object.data.attributes
        and instance.object.visible_get(view_layer=depsgraph.view_layer)
    )


def _splats_of(cloud: bpy.types.PointCloud, columns: Iterable[str] = ()) -> tuple[Splats, np.ndarray | None]:
    """The splats of a point cloud as painted, with what it has of some columns, and their weights."""
    splats = objects.splats_of(cloud)
    if splats is None:  # modifiers have taken their attributes away
        nothing = np.zeros((0, 4), np.float32)
        return Splats(nothing[:, :3], nothing, nothing[:, :3], nothing[:, 0], np.zeros((0, 1, 3))), None
    for name in (*columns, *PAINT):
        values = attributes.read_attribute(cloud, name)
        if values is not None and values.ndim == 1:
            splats.extras[name] = values
    return painted(splats), attributes.read_attribute(cloud, attributes.WEIGHT)


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
    return sorted({item.number for root in roots.roots(scene) for item in root.lodgs.levels})


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
