"""Import of COLMAP scenes and splat files as new splat scenes."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event

import bpy
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.lod.on_disk import open_paged
from ...training.lod.rule import resolve_rule
from ...training.lod.selection import unknown_rule_error
from ...training.methods import METHODS
from ...training.scenes import overview
from ...training.scenes.cameras import Camera, camera_extent
from ...training.scenes.colmap import Scene, read_scene
from ...training.scenes.formats import ensure_colmap_scene, scene_of_model
from ...training.scenes.triangulate import cached_points
from ...training.scenes.undistort import cached_undistorted_scene
from ...training.scenes.view_tables import read_view_tables
from ...training.splats.bundle import read_bundle, read_header
from ...training.splats.formats import MAIN_FILES, Convert, is_plain_ply, open_as_ply
from ...training.splats.level_folder import read_folder
from ...training.splats.levels import Bundle
from ..nodes.camera_choices import VIEWPORT
from . import objects, scenes, streams, viewpoints
from .paths import stored_path
from .photographs import match_render, new_camera, views
from .placement import axes_of, new_axes
from .roots import collection_of

ABOUT = "About these splats"
"""Name of the text that explains splat scenes to users without LODGS."""


def import_colmap(
    context: bpy.types.Context,
    folder: Path | str,
    *,
    model: Path | str | None = None,
    images: Path | str | None = None,
    upright: bool = True,
    photographs: bool = True,
    warn: Callable[[str], object] = print,
) -> bpy.types.Object:
    """Import a COLMAP scene as a new splat scene with cameras, photos and coloured points.

    If the Blender scene has no camera, the first view becomes its camera and sets the render size.

    Args:
        folder: folder of the scene or of a model in it, or another program's export, which is converted
            (``formats.ensure_colmap_scene``).
        model: folder of the model; by default the largest one. Training uses the same one.
        images: folder of the photos; by default the one next to the model. Training uses the same one.
        upright: rotate the scene so that the cameras' mean up direction is +z; otherwise keep COLMAP's axes.
        photographs: show the photo of each view behind it.
        warn: function that receives a sentence for each omission or irregularity.

    Returns:
        The scene root.

    Raises:
        LodgsError: the folder has no readable scene. The file is unchanged in that case.
    """
    model, images = (Path(path) if path else None for path in (model, images))
    scene = _read_photo_scene(context, Path(folder), model, images, warn)
    undistorted = cached_undistorted_scene(scene)
    undistorted_cameras = {camera.name: camera for camera in undistorted.cameras} if undistorted else {}
    extent = scene.extent(default=1.0)
    near = scene.near(default=extent / 1000)
    with new_scene(context, scene_of_model(scene.folder).name) as root:
        axes = axes_of(root)
        if upright:
            axes.rotation_quaternion = Matrix(scene.up_rotation().tolist()).to_quaternion()
        root.empty_display_size = extent / 4
        root.lodgs.scene_folder = str(scene.folder)
        root.lodgs.camera_center = scene.center
        if scene.origin.any():
            root.lodgs.meta = json.dumps({"origin": scene.origin.tolist()})
        root.lodgs.training.median_depth = scene.median_depth(default=0.0)
        root.lodgs.training.model = str(scene.model) if model else ""
        root.lodgs.training.images = str(scene.images_folder) if images else ""

        cameras = [undistorted_cameras.get(camera.name, camera) for camera in scene.cameras]
        distorted = set(scene.distorted) - undistorted_cameras.keys()
        _add_views(context, root, cameras, extent, near, photographs, distorted, scene.names)
        if len(scene.points):
            _add_points(root, scene, radius=extent / 400)
    return root


def _read_photo_scene(
    context: bpy.types.Context,
    folder: Path,
    model: Path | None,
    images: Path | None,
    warn: Callable[[str], object],
) -> Scene:
    """Read a COLMAP scene or an export with progress at the mouse pointer; see :func:`import_colmap`."""
    manager = context.window_manager
    manager.progress_begin(0, 1)
    try:
        if model is None:
            folder = ensure_colmap_scene(folder, warn)
        scene = cached_points(read_scene(folder, model, images, manager.progress_update))
    finally:
        manager.progress_end()
    for message in scene.warnings:
        warn(message)
    return scene


def _add_points(root: bpy.types.Object, scene: Scene, radius: float) -> None:
    """Add the coloured points of a COLMAP scene to a root."""
    points = objects.new_points(f"{root.name} points", scene.points, scene.point_colors, radius=radius)
    points.parent = axes_of(root)
    collection_of(root).objects.link(points)
    root.lodgs.points = points


def _add_views(
    context: bpy.types.Context,
    root: bpy.types.Object,
    cameras: Sequence[Camera],
    extent: float,
    near: float,
    photographs: bool = False,
    distorted: Collection[str] = (),
    names: Sequence[str] = (),
) -> None:
    """Add a camera object to a scene for each view; see :func:`new_camera`.

    Args:
        names: names of all views of the model, in order; if empty, those of ``cameras``.
    """
    root.lodgs.cameras = bpy.data.collections.new(f"{root.name} cameras")
    collection_of(root).children.link(root.lodgs.cameras)
    index_of = {name: index for index, name in enumerate(names or [camera.name for camera in cameras])}
    for camera in cameras:
        view = new_camera(camera, extent, near, photograph=photographs, distorted=camera.name in distorted)
        view.parent, view.data.lodgs.model_index = axes_of(root), index_of[camera.name]
        root.lodgs.cameras.objects.link(view)
    if context.scene.camera is None and cameras:
        context.scene.camera = root.lodgs.cameras.objects[0]
        match_render(context.scene, cameras[0], context.scene.render.resolution_percentage)


def import_splats(
    context: bpy.types.Context,
    path: Path | str,
    *,
    upright: bool = True,
    budget: int = 0,
    warn: Callable[[str], object] = print,
) -> bpy.types.Object:
    """Import a bundle, a folder of levels, or a 3DGS PLY as a single level, as a new splat scene.

    Args:
        budget: see :func:`read_splats_file`.
        upright: rotate the scene as the bundle records, or so that -y is up, as in most splat files;
            otherwise keep the axes.
        warn: function that receives a sentence for each difference from the display of the original program.

    Returns:
        The scene root.

    Raises:
        LodgsError: the file cannot be read or has invalid values. The file is unchanged in that case.
    """
    steps = place_splats(context, splats_reader(path, budget)(), upright, warn)
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            return stop.value


@dataclass(frozen=True)
class SplatsFile:
    """Contents of a splat file.

    Attributes:
        bundle: levels; for splats that stay in their file, the coarsest ones.
        total: number of splats in such a file; 0 if the bundle has all splats.
        budget: maximum number of splats of such a file in memory.
        warnings: sentences about differences from the display of the original program.
        stamp: version of the file, see :func:`file_stamp`.
    """

    path: Path
    bundle: Bundle
    total: int
    budget: int
    warnings: list[str]
    stamp: str


def file_stamp(path: Path) -> str:
    """Return a text that changes with the size or time of a file, or of a folder's files; empty if none."""
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        stats = [file.stat() for file in files]
    except OSError:
        return ""
    return f"{sum(stat.st_size for stat in stats)} {max((stat.st_mtime_ns for stat in stats), default=0)}"


def make_converter(stop: Event | None) -> Convert | None:
    """Return the conversion of files that Blender cannot read; ``runs.conversion`` replaces this function."""


def splats_reader(path: Path | str, budget: int = 0, stop: Event | None = None) -> Callable[[], SplatsFile]:
    """Return :func:`read_splats_file` for a file and this computer's trainer; it may run in a thread.

    Args:
        stop: event that stops the trainer.
    """
    return partial(read_splats_file, path, budget, make_converter(stop))


def read_splats_file(path: Path | str, budget: int = 0, convert: Convert | None = None) -> SplatsFile:
    """Read a bundle, a folder of levels, or another splat file (``training.splats.formats``) as a single
    level.

    Does not access Blender's data and may run in a thread.

    Args:
        budget: maximum number of splats of a paged file in memory; 0 for all. Of a larger one, only the
            coarsest splats are read; LODGS streams finer ones as the camera approaches (``streams``).
        convert: function for files that Blender cannot read.

    Raises:
        LodgsError: the file cannot be read.
    """
    path, warnings, total = Path(path), [], 0
    if path.name in MAIN_FILES:
        path = path.resolve().parent
    stamp = file_stamp(path)  # before reading, so that a later change is noticed
    if budget and not path.is_dir() and is_plain_ply(path) and _is_paged(path):
        paged = open_paged(path)
        total = paged.total
        bundle = paged.top(budget if total <= budget else streams.resident_count(budget))
        count = sum(len(level.splats) for level in bundle.levels)
        if count < total:
            warnings.append(
                f"Imported the coarsest {count:,} of {total:,} splats. Viewports and renders of LODGS "
                f"stream finer ones from {path.name}."
            )
        total = total if count < total else 0
    else:
        with open_as_ply(path, convert) as file:
            bundle = (read_folder if file.is_dir() else read_bundle)(file, warnings.append)
        if not bundle.method and not bundle.on_disk:  # another program's file
            overview.complete_meta(bundle)
            warnings += overview.describe_clutter(bundle.levels[-1].splats)
    if not any(len(level.rows) for level in bundle.levels):
        raise LodgsError(f"Cannot import {path}: it has no splats that can be drawn.", "Export it again.")
    return SplatsFile(path, bundle, total, budget, warnings, stamp)


def _is_paged(path: Path) -> bool:
    return resolve_rule(read_header(path).rule).paged_file is not None


def place_splats(
    context: bpy.types.Context, file: SplatsFile, upright: bool, warn: Callable[[str], object]
) -> Generator[None, None, bpy.types.Object]:
    """Create a new splat scene from a file's contents; yields after each level.

    See :func:`import_splats`. If the generator is closed early, the file is unchanged.
    """
    for message in file.warnings:
        warn(message)
    bundle, level_objects = file.bundle, []
    cameras, near, held_out = read_view_tables(bundle.tables)
    try:
        for level in bundle.levels:
            level_objects.append(objects.new_splats(f"{file.path.stem} {level.number}", level.splats))
            yield
        with new_scene(context, file.path.stem.removesuffix(".compressed")) as root:
            if upright:
                axes_of(root).rotation_quaternion = Matrix(bundle.up_rotation.tolist()).to_quaternion()
            _fill(root, file, level_objects)
            set_source(root, file)
            if cameras:
                _add_views(context, root, cameras, camera_extent(cameras) or 1.0, near)
                for settings in (view.data.lodgs for view in views(root)):
                    settings.held_out = cameras[settings.model_index].name in held_out
            _choose_views(context, root)
            root.lodgs.training.method = next(
                info.name for info in METHODS.values() if info.suggested_for_base
            )
    except BaseException:
        bpy.data.batch_remove([obj.data for obj in level_objects])  # also removes the objects
        raise
    if bundle.rule and not root.lodgs.by_distance:
        warn(" ".join(unknown_rule_error(bundle.rule)))
    return root


def _choose_views(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Let trainings use the artist's views: cameras, else a selected curve, else an animated scene camera."""
    settings, camera = root.lodgs.training, context.scene.camera
    animation = camera.animation_data if camera is not None else None
    curve = next((obj for obj in context.selected_objects if obj.type == "CURVE"), None)
    if viewpoints.has_cameras(context.scene, root):
        settings.views_from = "CAMERAS"
    elif curve is not None:
        settings.views_from, settings.curve = "CURVE", curve
    elif animation is not None and animation.action is not None:
        settings.views_from = "ANIMATION"


def refill(root: bpy.types.Object, file: SplatsFile) -> None:
    """Replace the levels of a splat scene by those of a file."""
    scenes.prepare_refill(root, [level.number for level in file.bundle.levels])
    _fill(root, file, [None] * len(file.bundle.levels))


def set_source(root: bpy.types.Object, file: SplatsFile) -> None:
    """Store the file that a scene was read from."""
    source = root.lodgs.source
    source.file, source.file_version = stored_path(file.path), file.stamp
    source.count = sum(len(level.splats) for level in file.bundle.levels)


def _fill(root: bpy.types.Object, file: SplatsFile, level_objects: Sequence[bpy.types.Object | None]) -> None:
    """Add a file's levels and metadata to a scene.

    Args:
        level_objects: object of each level, or None to create one.
    """
    for level, obj in zip(file.bundle.levels, level_objects, strict=True):
        scenes.put_level(root, level, obj)
    scenes.set_bundle_facts(root, file.bundle)
    scenes.set_tables(root, file.bundle.tables)
    root.lodgs.single_level = file.bundle.levels[-1].number
    if file.total:
        streams.start_streaming(root, file.path, file.budget, file.total)
        root.lodgs.camera_choice = VIEWPORT.identifier  # stream for the viewport


@contextmanager
def new_scene(context: bpy.types.Context, name: str) -> Iterator[bpy.types.Object]:
    """Create a root in a new collection; both are removed with their contents if the block fails."""
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    with objects.all_or_nothing():
        collection = bpy.data.collections.new(name)
        root = bpy.data.objects.new(name, None)
        root.lodgs.is_root = True
        collection.objects.link(root)
        context.scene.collection.children.link(collection)
        new_axes(root)
        _write_note()
        yield root
    for obj in context.selected_objects:
        obj.select_set(False)
    context.view_layer.objects.active = root
    root.select_set(True)


def _write_note() -> None:
    """Add a text to the file for users without LODGS."""
    if ABOUT not in bpy.data.texts:
        bpy.data.texts.new(ABOUT).write(
            "The point clouds in this file are Gaussian splats. Without the extension LODGS, Blender shows "
            "the finest level of each scene as points.\n\nLODGS draws them as splats in viewports and "
            "renders, with detail by distance, and can clean, place and export them. To install it: Edit, "
            "Preferences, Get Extensions, Install from Disk. The file keeps all data without it.\n"
        )
