"""The render engine LODGS: stills and animations of splats, rendered by the trainer's rasterizer.

Pixels equal those of ``python -m training render``. Meshes are not rendered: another engine renders them, and
the compositor combines both images by depth.
"""

from __future__ import annotations

import math
import re
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np

from ...training.editing.paint import COLUMNS as PAINT
from ...training.editing.paint import apply_paint
from ...training.errors import LodgsError, is_out_of_memory
from ...training.lod.rule import all_rule_columns
from ...training.render.lens import LensProjection
from ...training.scenes.cameras import Camera, camera_to_dict
from ...training.splats.gaussians import Splats
from .. import attributes, compat
from ..data import changes, objects, roots, selection, shown
from ..data.cameras import RenderView, aperture_of, require_flat_stereo, scene_camera, unsupported_lens
from ..data.paths import absolute_path
from ..nodes import display
from . import renderer, written_images

ID = "LODGS"
MAX_KEYS = 63
"""Maximum number of evaluations of motion per frame."""
LEVEL, LEVEL_MASK, DEPTH, COMBINED = "Level", "Level {}", "Depth", "Combined"


class LodgsEngine(bpy.types.RenderEngine):
    bl_idname = ID
    bl_label = "LODGS"
    bl_use_postprocess = True
    bl_use_preview = False
    bl_use_eevee_viewport = True  # for meshes; splats are drawn on top
    bl_use_spherical_stereo = False

    def update_render_passes(self, scene=None, renderlayer=None):
        self.register_pass(scene, renderlayer, COMBINED, 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, DEPTH, 1, "Z", "VALUE")
        if scene.lodgs_render.use_pass_levels:
            self.register_pass(scene, renderlayer, LEVEL, 1, "X", "VALUE")
            for number in level_numbers(scene):
                self.register_pass(scene, renderlayer, LEVEL_MASK.format(number), 1, "X", "VALUE")

    def render(self, depsgraph):
        try:
            written_images.raise_problem()
            self._render_views(depsgraph)
        except Exception as error:
            message = str(error)
            if not isinstance(error, LodgsError):
                traceback.print_exc()
                message = _unexpected(depsgraph.scene.frame_current, error)
            self.error_set(message)
            self.report({"ERROR"}, message)  # otherwise Blender would write a black image

    def _render_views(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Render the image of each eye or camera in a stereo or multi-view render, else one image."""
        size = self.resolution_x, self.resolution_y
        window = render_border(depsgraph.scene.render, *size)
        names = self._view_names(depsgraph)
        keys = self._motion_keys(depsgraph, names)
        last_text = ""
        for index, name in enumerate(names):
            view = self._view(depsgraph, name)

            def on_progress(fraction: float, text: str, done: int = index) -> bool:
                nonlocal last_text
                self.update_progress((done + fraction) / len(names))
                if text != last_text:  # background renders print a line for each update
                    self.update_stats("", text)
                    last_text = text
                return not self.test_break()

            motion = [key.of_view(name) for key in keys]
            frame = _render_function(depsgraph, *size, window, on_progress, view, motion)
            if frame is None or self.test_break():
                return
            _, _, width, height = window
            result = self.begin_result(0, 0, width, height, layer=depsgraph.view_layer.name, view=name)
            _write_passes(result.layers[0].passes, frame.planes)
            self.end_result(result)

    def _view_names(self, depsgraph: bpy.types.Depsgraph) -> list[str]:
        """Return the names of the views of a stereo or multi-view render, or [""]."""
        if not depsgraph.scene.render.use_multiview:
            return [""]
        result = self.begin_result(0, 0, 1, 1, layer=depsgraph.view_layer.name)
        names = [view.name for view in result.views]
        self.end_result(result, cancel=True)
        return names or [""]

    def _motion_keys(self, depsgraph: bpy.types.Depsgraph, names: list[str]) -> list[_MotionKey]:
        """Return the placement of cameras and splats at equal intervals of the shutter time."""
        now, keys = _frame(depsgraph.scene), []
        for time in shutter_times(depsgraph.scene):
            self._set_time(time)
            cameras = {
                name: self._view(depsgraph, name).lens_camera(depsgraph, self.resolution_x, self.resolution_y)
                for name in names
            }
            keys.append(_MotionKey(cameras, _matrices(depsgraph)))
        if keys:
            self._set_time(now)
        return keys

    def _set_time(self, time: float) -> None:
        frame = math.floor(time)
        self.frame_set(frame, time - frame)

    def _view(self, depsgraph: bpy.types.Depsgraph, name: str) -> RenderView:
        """Return the camera of an eye or of a view of a multi-view render."""
        camera = scene_camera(depsgraph.scene).evaluated_get(depsgraph)
        if not name:
            return RenderView.of(camera)
        self.active_view_set(name)
        camera = self.camera_override or camera
        require_flat_stereo(depsgraph.scene, camera)
        return RenderView(camera, self.camera_model_matrix(camera), self.camera_shift_x(camera))


def _write_passes(passes: Iterable[bpy.types.RenderPass], planes: dict[str, np.ndarray]) -> None:
    """Copy the planes of a frame into the passes of a render layer that have planes."""
    for target in passes:
        names = [f"{target.name}.{channel}" for channel in target.channel_id]
        if all(name in planes for name in names):
            pixels = np.stack([planes[name][::-1] for name in names], axis=2)  # rows from the bottom
            target.rect.foreach_set(np.ascontiguousarray(pixels).reshape(-1))


def _unexpected(frame: int, error: Exception) -> str:
    """Return the message about an error in LODGS itself."""
    if is_out_of_memory(error):
        return f"Cannot render frame {frame}: not enough memory. Close other files and programs."
    reason = f"unexpected {type(error).__name__} ({error})"
    return f"Cannot render frame {frame}: {reason}. Report it with the text in Blender's system console."


class MotionKey(NamedTuple):
    """Placement of a camera and of splats at one time.

    Attributes:
        camera: camera in Blender's world.
        deformation: see ``RenderView.pinhole``.
        matrices: matrices of splat instances, by object and number among its instances.
    """

    camera: Camera
    deformation: np.ndarray | None
    matrices: dict[tuple[int, int], np.ndarray]


class _MotionKey(NamedTuple):
    """Like :class:`MotionKey`, with the cameras of all views of a stereo or multi-view render."""

    cameras: dict[str, tuple[Camera, np.ndarray | None, LensProjection]]
    matrices: dict[tuple[int, int], np.ndarray]

    def of_view(self, name: str) -> MotionKey:
        camera, deformation, _ = self.cameras[name]
        return MotionKey(camera, deformation, self.matrices)


def shutter_times(scene: bpy.types.Scene) -> list[float]:
    """Return the frames, with fractions, at which a scene's motion is evaluated; none without motion blur.

    With the setting *Steps* of EEVEE's motion blur, the motion is straight between 2 * steps + 1 times.
    """
    render = scene.render
    if not render.use_motion_blur or not render.motion_blur_shutter:
        return []
    start = {"START": 0.0, "CENTER": -0.5, "END": -1.0}[render.motion_blur_position]
    count = min(2 * scene.eevee.motion_blur_steps + 1, MAX_KEYS)
    first = _frame(scene) + start * render.motion_blur_shutter
    return list(np.linspace(first, first + render.motion_blur_shutter, count))


def _frame(scene: bpy.types.Scene) -> float:
    """Return the current frame with its fraction, before time remapping, as ``frame_set`` takes it."""
    return scene.frame_current + scene.frame_subframe


def _matrices(depsgraph: bpy.types.Depsgraph) -> dict[tuple[int, int], np.ndarray]:
    """Return the matrices of the splat instances of :func:`placed_splats`."""
    instances = shown.drop_streamed_levels(shown.splat_instances(depsgraph))
    return dict(zip(_identities(instances), (item.matrix_world for item in instances), strict=True))


def _identities(instances: Iterable[shown.SplatInstance]) -> Iterator[tuple[int, int]]:
    """Yield the object of each instance, and the number of its earlier instances."""
    counts = Counter()
    for instance in instances:
        uid = instance.object.session_uid
        yield uid, counts[uid]
        counts[uid] += 1


def render_frame(
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    window: tuple[int, int, int, int],
    on_progress: renderer.OnProgress = lambda fraction, text: True,
    view: RenderView | None = None,
    motion: Sequence[MotionKey] = (),
) -> renderer.RenderedFrame | None:
    """Render the splats of a depsgraph from a camera, as Cycles does.

    Splats are selected and adjusted as at the time of the frame; only their placement changes while the
    shutter is open.

    Args:
        depsgraph: evaluated depsgraph.
        width: width of the full image in pixels.
        height: height of the full image in pixels.
        window: left, bottom, width and height of the rendered part in pixels.
        on_progress: see ``renderer.OnProgress``.
        view: camera, or None for the scene's camera.
        motion: placement of camera and splats at equal intervals of the shutter time.

    Returns:
        The frame with the passes of the view layer, or None if it was cancelled.

    Raises:
        LodgsError: the trainer is missing, the camera type is not supported, a holdout file is missing, or
            the renderer failed.
    """
    scene = depsgraph.scene
    layer = depsgraph.view_layer
    view = view or RenderView.of(scene_camera(scene).evaluated_get(depsgraph))
    camera, deformation, projection = view.lens_camera(depsgraph, width, height)
    aperture = aperture_of(view.obj, depsgraph)
    splats = placed_splats(depsgraph, motion)
    if deformation is not None:
        splats = [replace(item, matrix=deformation @ item.matrix) for item in splats]
    cameras = tuple(key.camera for key in motion)
    if all(camera_to_dict(key, 0) == camera_to_dict(camera, 0) for key in cameras):
        cameras = ()
    lens = renderer.FrameLens(projection, aperture, cameras, scene.lodgs_render.samples)
    left, bottom, window_width, window_height = window
    settings = scene.lodgs_render
    frame_view = renderer.FrameView(
        camera,
        view.obj.data.clip_start,
        background=None if scene.render.film_transparent else tuple(settings.background),
        depth=layer.use_pass_z,
        levels=settings.use_pass_levels,
        window=(left, height - bottom - window_height, window_width, window_height),
        holdout=holdout_file(scene, scene.frame_current),
        lens=lens,
    )
    return renderer.draw_frame(splats, frame_view, on_progress)


_render_function = render_frame
"""Function that renders the frames of the engine."""


@contextmanager
def use_renderer(function: Callable[..., renderer.RenderedFrame | None]) -> Iterator[None]:
    """Render with another function within the block. Its arguments are those of :func:`render_frame`."""
    global _render_function
    previous = _render_function
    _render_function = function
    try:
        yield
    finally:
        _render_function = previous


def holdout_file(scene: bpy.types.Scene, frame: int) -> Path | None:
    """Return the file with the mesh depth of a frame, or None if the scene has no mesh holdout.

    Raises:
        LodgsError: the file does not exist.
    """
    if not scene.lodgs_render.holdout:
        return None
    if scene.render.use_multiview:
        raise LodgsError(
            "Cannot hold out meshes in a stereo or multi-view render: depth files have one view.",
            "Clear Hold Out, and use Combine with Meshes.",
        )
    if problem := holdout_problem(scene):
        raise LodgsError(f"Cannot hold out meshes: {problem}.", "Clear Hold Out, or disable the setting.")
    path = frame_path(scene.lodgs_render.holdout, scene.original, frame)
    if not path.is_file():
        raise LodgsError(
            f"Cannot hold out meshes: the depth file of frame {frame} is missing: {path}.",
            "Press Render Mesh Depth (for all frames, the button next to it), or clear Hold Out.",
        )
    return path


def holdout_problem(scene: bpy.types.Scene) -> str:
    """Return why meshes cannot be held out, as a clause: their depth is sharp and planar. "" if they can."""
    if scene.camera and scene.camera.type == "CAMERA" and scene.camera.data.type == "PANO":
        return "the camera is panoramic"
    return "depth of field or motion blur is enabled" if is_blurred(scene) else ""


def is_blurred(scene: bpy.types.Scene) -> bool:
    """Return whether a scene renders with depth of field or motion blur."""
    camera = scene.camera
    focuses = camera and camera.type == "CAMERA" and camera.data.type != "PANO" and camera.data.dof.use_dof
    return bool(focuses or scene.render.use_motion_blur)


def limitations(scene: bpy.types.Scene) -> list[str]:
    """Return sentences about settings of the camera and the scene that renders refuse or ignore."""
    texts, camera, settings = [], scene.camera, scene.lodgs_render
    if camera is None:
        return ["The scene has no camera."]
    if problem := unsupported_lens(camera):
        texts.append(f"'{camera.name}' is {problem}, which LODGS cannot render.")
    elif camera.data.type == "PANO":
        if camera.data.dof.use_dof:
            texts.append("Panoramas have no depth of field.")
        texts.append("Viewport Quality renders no panoramas.")
    if is_blurred(scene):
        texts.append("Viewport Quality renders without blur.")
    if settings.holdout and (problem := holdout_problem(scene)):
        texts.append(f"Hold Out does not work: {problem}.")
    elif settings.meshes is not None and is_blurred(scene):
        texts.append("The depths of blurred images are sharp, so meshes and splats combine with hard edges.")
    return texts


def frame_path(pattern: str, scene: bpy.types.Scene, frame: int) -> Path:
    """Replace the last # characters of a file name by the frame number, as Blender does."""
    path = absolute_path(pattern, library=scene.library)
    if not path.name:
        raise LodgsError(f"Cannot use the depth files {pattern}: it is a folder.", "Choose a file.")

    def number(match: re.Match) -> str:
        return "-" * (frame < 0) + str(abs(frame)).zfill(len(match[0]))

    return path.with_name(re.sub(r"#+(?=[^#]*$)", number, path.name))


def placed_splats(
    depsgraph: bpy.types.Depsgraph, motion: Sequence[MotionKey] = ()
) -> list[renderer.PlacedSplats | renderer.PlacedFile]:
    """Return the visible splats of a depsgraph in the form of splat files, so that both render equally.

    For an object whose splats are selected only by a rule, all its splats are returned with the arguments of
    the rule. Other objects give the splats that remain after their modifiers.
    """
    placed: list[renderer.PlacedSplats | renderer.PlacedFile] = []
    instances = shown.drop_streamed_levels(shown.splat_instances(depsgraph))
    for identity, instance in zip(_identities(instances), instances, strict=True):
        evaluated, matrix, level = instance.evaluated, instance.matrix_world, instance.level
        placement = (matrix, level, instance.antialias)
        options = {"looks": instance.looks, "motion": _motion_of(identity, matrix, motion)}
        is_empty = not display.point_count(evaluated.data)
        if instance.source is not None and (query := shown.camera_query(instance, depsgraph)):
            file = instance.source.path, matrix, instance.antialias, query
            placed.append(renderer.PlacedFile(*file, **options))
            continue
        if not _is_selected_by_rule(instance, depsgraph):
            if not is_empty:
                read = partial(_read_splats, evaluated.data)
                uid = instance.object.session_uid
                placed.append(renderer.PlacedSplats(uid, read, *placement, **options))
            continue
        cloud = instance.object.data
        read = partial(_read_splats, cloud.evaluated_get(depsgraph), all_rule_columns())
        version = *changes.version(cloud), *changes.paint_version(cloud)
        query = shown.rule_query(instance, depsgraph)
        is_empty &= np.array_equal(matrix, np.array(evaluated.matrix_world))  # instances have other levels
        placed.append(
            renderer.PlacedSplats(cloud.session_uid, read, *placement, version, query, is_empty, **options)
        )
    return placed


def _motion_of(
    identity: tuple[int, int], matrix: np.ndarray, motion: Sequence[MotionKey]
) -> tuple[np.ndarray, ...]:
    """Return the matrices of an instance while the shutter is open; none if it does not move in the image."""
    if not all(identity in key.matrices for key in motion):
        return ()  # created while the shutter is open
    matrices = tuple(
        key.matrices[identity] if key.deformation is None else key.deformation @ key.matrices[identity]
        for key in motion
    )
    return () if all(np.array_equal(key, matrix) for key in matrices) else matrices


def _is_selected_by_rule(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return True if an instance shows the splats of its object, selected by a rule alone.

    Objects that are hidden in the viewport and objects of scenes that no window shows do not count, because
    Blender does not report their changes.
    """
    shown_scenes = {bpy.context.scene, *(window.scene for window in bpy.context.window_manager.windows)}
    return display.is_reduced(instance.evaluated.data) or (
        depsgraph.scene.original in shown_scenes
        and selection.only_lodgs_modifiers(instance.evaluated, depsgraph)
        and attributes.WEIGHT not in instance.object.data.attributes
        and instance.object.visible_get(view_layer=depsgraph.view_layer)
    )


def _read_splats(
    cloud: bpy.types.PointCloud, columns: Iterable[str] = ()
) -> tuple[Splats, np.ndarray | None]:
    """Read the painted splats of a point cloud with optional columns, and their weights."""
    splats = objects.splats_of(cloud)
    if splats is None:  # a modifier has removed the attributes
        empty = np.zeros((0, 4), np.float32)
        return Splats(empty[:, :3], empty, empty[:, :3], empty[:, 0], np.zeros((0, 1, 3))), None
    for name in (*columns, *PAINT):
        values = attributes.read_attribute(cloud, name)
        if values is not None and values.ndim == 1:
            splats.extras[name] = values
    return apply_paint(splats), attributes.read_attribute(cloud, attributes.WEIGHT)


def render_size(render: bpy.types.RenderSettings) -> tuple[int, int]:
    """Return the width and height of the full image in pixels, rounded as in Blender."""
    percent = render.resolution_percentage
    return max(render.resolution_x * percent // 100, 1), max(render.resolution_y * percent // 100, 1)


def render_border(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int]:
    """Return left, bottom, width and height of the rendered region in pixels, rounded as in Blender."""
    if not render.use_border:
        return 0, 0, width, height
    x = [int(np.float32(edge) * np.float32(width)) for edge in (render.border_min_x, render.border_max_x)]
    y = [int(np.float32(edge) * np.float32(height)) for edge in (render.border_min_y, render.border_max_y)]
    return x[0], y[0], x[1] - x[0], y[1] - y[0]


def level_numbers(scene: bpy.types.Scene) -> list[int]:
    """Return the sorted level numbers of all splat scenes in a Blender scene, also in instances."""
    return sorted({item.number for root in roots.all_roots(scene) for item in root.lodgs.levels})


def use(scene: bpy.types.Scene) -> None:
    """Set the LODGS engine and a view transform that shows colours as in the photos."""
    scene.render.engine = ID
    compat.use_standard_view(scene.view_settings)
    scene.view_settings.look = "None"


CLASSES = (LodgsEngine,)

_UNSUPPORTED = ("freestyle", "simplify", "gpencil")
"""Parts of the names of Blender panels whose settings LODGS ignores."""


def _shared_panels() -> list[type[bpy.types.Panel]]:
    """Return Blender's panels that suit every engine: output, colour management, cameras and others."""
    return [
        panel
        for panel in bpy.types.Panel.__subclasses__()
        if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ())
        and not any(part in panel.__name__ for part in _UNSUPPORTED)
    ]


def register() -> None:
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.add(ID)


def unregister() -> None:
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.discard(ID)
