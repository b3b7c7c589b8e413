"""Import of COLMAP scenes and splat files as new splat scenes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import bpy
from mathutils import Matrix

from ...training.lod.selection import unknown_rule_error
from ...training.lod.tree.paging import TreeFile, is_tree, read_budgeted
from ...training.methods import METHODS
from ...training.scenes.cameras import Camera, camera_extent
from ...training.scenes.colmap import read_scene
from ...training.scenes.formats import ensure_colmap_scene
from ...training.scenes.undistort import cached_undistorted_scene
from ...training.scenes.view_tables import read_view_tables
from ...training.splats.bundle import read_bundle, read_header
from ...training.splats.formats import STREAMED_FILE, is_plain_ply, open_as_ply
from ...training.splats.level_folder import read_folder
from ...training.splats.levels import Bundle
from . import objects, scenes, streams
from .photographs import match_render, new_camera, views
from .placement import axes_of, new_axes
from .roots import collection_of

ABOUT = "About these splats"
"""The name of the text that tells of LODGS where it is not installed."""


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
    """A COLMAP scene as a new splat scene: cameras, their photographs and the coloured points.

    Where the Blender scene has no camera, the first view becomes its camera and gives the render its size.

    Args:
        folder: the scene's folder, or that of a model in it; or another program's export, which is then made
            a COLMAP scene (``formats.colmap_scene``).
        model: folder of the model; by default the largest one. Training takes the same one.
        images: folder of the photographs; by default found beside the model. Training takes the same one.
        upright: turn the root so that the cameras' mean up direction is +z; otherwise leave COLMAP's axes.
        photographs: show each camera's photograph behind its view.
        warn: receives one sentence for each thing that was left out or is odd.

    Returns:
        The scene root.

    Raises:
        LodgsError: the folder holds no scene that can be read. Nothing is left behind in that case.
    """
    manager = context.window_manager
    manager.progress_begin(0, 1)  # at the mouse pointer
    try:
        model, images = (Path(path) if path else None for path in (model, images))
        folder = Path(folder) if model else ensure_colmap_scene(Path(folder), warn)
        scene = read_scene(folder, model, images, manager.progress_update)
    finally:
        manager.progress_end()
    for message in scene.warnings:
        warn(message)
    straight = cached_undistorted_scene(scene)
    shown = {camera.name: camera for camera in straight.cameras} if straight else {}
    extent = scene.extent(default=1.0)
    near = scene.near(default=extent / 1000)
    with new_scene(context, scene.folder.name) as root:
        axes = axes_of(root)
        if upright:
            axes.rotation_quaternion = Matrix(scene.up_rotation().tolist()).to_quaternion()
        root.empty_display_size = extent / 4
        root.lodgs.scene_folder = str(scene.folder)
        root.lodgs.camera_center = scene.center
        root.lodgs.training.median_depth = scene.median_depth(default=0.0)
        root.lodgs.training.model = str(scene.model) if model else ""
        root.lodgs.training.images = str(scene.images_folder) if images else ""

        seen = [shown.get(camera.name, camera) for camera in scene.cameras]
        distorted = set(scene.distorted) - shown.keys()
        _add_views(context, root, seen, extent, near, photographs, distorted, scene.names)
        if len(scene.points):
            points = objects.new_points(
                f"{root.name} points", scene.points, scene.point_colors, radius=extent / 400
            )
            points.parent = axes
            collection_of(root).objects.link(points)
            root.lodgs.points = points
    return root


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
    """Gives a scene a camera object for each view; see :func:`new_camera`.

    Args:
        names: of all views of the model, in order; none: there are no others.
    """
    root.lodgs.cameras = bpy.data.collections.new(f"{root.name} cameras")
    collection_of(root).children.link(root.lodgs.cameras)
    place_of = {name: place for place, name in enumerate(names or [camera.name for camera in cameras])}
    for camera in cameras:
        view = new_camera(camera, extent, near, photograph=photographs, distorted=camera.name in distorted)
        view.parent, view.data.lodgs.place = axes_of(root), place_of[camera.name]
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
    """A bundle, a folder of levels, or any 3DGS PLY as a single level, as a new splat scene.

    Args:
        budget: see :func:`read_splats_file`.
        upright: turn the scene as the bundle says, or without that so that -y, which is up in most splat
            files, is up; otherwise leave the axes.
        warn: receives a sentence for each thing that is shown otherwise than the file's maker shows it.

    Returns:
        The scene root.

    Raises:
        LodgsError: the file cannot be read, or what it says is not possible. Nothing is left behind then.
    """
    pieces = place_splats(context, read_splats_file(path, budget), upright, warn)
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            return end.value


@dataclass(frozen=True)
class SplatsFile:
    """What a file of splats holds.

    Attributes:
        bundle: its levels; the coarsest splats of a tree that stays in its file.
        total: splats of such a tree; 0 where all are in the bundle.
        budget: most splats of such a tree in memory.
        warnings: a sentence for each thing that is shown otherwise than the file's maker shows it.
    """

    path: Path
    bundle: Bundle
    total: int
    budget: int
    warnings: list[str]


def read_splats_file(path: Path | str, budget: int = 0) -> SplatsFile:
    """What :func:`place_splats` places: a bundle, a folder of levels, or any other file of splats (see
    ``training.splats.formats``) as a single level.

    Nothing of Blender is touched, so that a thread may do it.

    Args:
        budget: most splats of a tree of splats in memory; 0: all. Of a larger one the coarsest are imported,
            which stand for the others; where LODGS itself draws, others are read from the file as the eye
            comes near (``streams``).

    Raises:
        LodgsError: the file cannot be read.
    """
    path, warnings, total = Path(path), [], 0
    if path.name == STREAMED_FILE:
        path = path.resolve().parent
    if budget and not path.is_dir() and is_plain_ply(path) and is_tree(read_header(path)):
        total = TreeFile(path).total
        bundle, _ = read_budgeted(path, budget if total <= budget else streams.held_of(budget))
        here = sum(len(level.splats) for level in bundle.levels)
        if here < total:
            warnings.append(
                f"{here:,} of {total:,} splats are here: coarser ones stand for the others, which are read "
                f"from {path.name} where viewports and renders of LODGS need them."
            )
        total = total if here < total else 0
    else:
        with open_as_ply(path) as there:
            bundle = (read_folder if there.is_dir() else read_bundle)(there, warnings.append)
    return SplatsFile(path, bundle, total, budget, warnings)


def place_splats(
    context: bpy.types.Context, file: SplatsFile, upright: bool, warn: Callable[[str], object]
) -> Generator[None, None, bpy.types.Object]:
    """Makes a new splat scene of what a file holds, level by level, and yields between two; see
    :func:`import_splats`. Ended early, it leaves nothing behind."""
    for message in file.warnings:
        warn(message)
    bundle, made = file.bundle, []
    cameras, near, unseen = read_view_tables(bundle.tables)
    try:
        for level in bundle.levels:
            made.append(objects.new_splats(f"{file.path.stem} {level.number}", level.splats))
            yield
        with new_scene(context, file.path.stem.removesuffix(".compressed")) as root:
            if upright:
                axes_of(root).rotation_quaternion = Matrix(bundle.up_rotation.tolist()).to_quaternion()
            _fill(root, file, made)
            if cameras:
                _add_views(context, root, cameras, camera_extent(cameras) or 1.0, near)
                for facts in (view.data.lodgs for view in views(root)):
                    facts.held_out = cameras[facts.place].name in unseen
            root.lodgs.training.method = next(
                info.name for info in METHODS.values() if info.suggested_for_base
            )
    except BaseException:
        bpy.data.batch_remove([obj.data for obj in made])  # which takes the objects along
        raise
    if bundle.rule and not root.lodgs.by_distance:
        warn(" ".join(unknown_rule_error(bundle.rule)))
    return root


def refill(root: bpy.types.Object, file: SplatsFile) -> None:
    """Gives a splat scene what a file holds, in place of the levels that it has."""
    scenes.make_room(root, file.bundle.levels[-1].number)
    _fill(root, file, [None] * len(file.bundle.levels))


def _fill(root: bpy.types.Object, file: SplatsFile, made: Sequence[bpy.types.Object | None]) -> None:
    """Puts a file's levels, of which there may be objects, and all that it says of them into a scene."""
    for level, obj in zip(file.bundle.levels, made, strict=True):
        scenes.put_level(root, level, obj)
    scenes.set_bundle_facts(root, file.bundle)
    scenes.set_tables(root, file.bundle.tables)
    root.lodgs.single_level = file.bundle.levels[-1].number
    if file.total:
        streams.begin(root, file.path, file.budget, file.total)
        root.lodgs.eye = "VIEW"  # so that what is looked at comes


@contextmanager
def new_scene(context: bpy.types.Context, name: str) -> Iterator[bpy.types.Object]:
    """A new root in a new collection; both, and all in them, vanish again if the block fails."""
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
    """Leaves a text in the file for whoever opens it without LODGS, and sees points."""
    if ABOUT not in bpy.data.texts:
        bpy.data.texts.new(ABOUT).write(
            "The point clouds in this file are Gaussian splats. Without the extension LODGS, Blender shows "
            "the finest level of each scene as points.\n\nWith it they are drawn as splats, in viewports and "
            "in renders, with detail by distance, and can be cleaned, placed and exported: Edit, "
            "Preferences, Get Extensions, Install from Disk. Nothing is lost without it.\n"
        )
