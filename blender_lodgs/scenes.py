"""Splat scenes in Blender: a root, a collection, and in it cameras, points and levels.

The scene root is an empty; ``root.lodgs`` holds what belongs to the scene (see ``properties.SplatScene``).
Everything else is its child in COLMAP coordinates. These functions are what operators call and what scripts
may call.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import numpy as np
from mathutils import Matrix

from ..training.errors import LodgsError
from ..training.lod.selection import complete
from ..training.scenes.cameras import Camera
from ..training.scenes.colmap import Scene, read_scene
from ..training.scenes.orientation import up_rotation
from ..training.splats.bundle import Bundle, Facts, Level, read_bundle, read_folder
from ..training.splats.gaussians import Splats
from . import objects, selection
from .nodes import ellipsoids

if TYPE_CHECKING:
    from .properties import View

SENSOR = 36.0
"""Longer side of every imported camera's sensor in millimetres: lenses read as on a full-frame camera."""


def roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The splat scenes' roots in a Blender scene."""
    return [thing for thing in scene.objects if thing.lodgs.is_root]


def active_root(context: bpy.types.Context) -> bpy.types.Object | None:
    """The splat scene that is meant: the active object's, else the only one there is."""
    thing = context.active_object
    while thing is not None:
        if thing.lodgs.is_root:
            return thing
        thing = thing.parent
    there = roots(context.scene)
    return there[0] if len(there) == 1 else None


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
        folder: the scene's folder, or that of a model in it.
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
    scene = read_scene(Path(folder), Path(model) if model else None, Path(images) if images else None)
    for message in scene.warnings:
        warn(message)
    if scene.distorted:
        warn(
            f"{len(scene.distorted)} of {len(scene.cameras)} views have lens distortion: their photographs "
            "fit the points only roughly here. Training undistorts them."
        )
    with _new_scene(context, scene.folder.name) as root:
        if upright:
            root.rotation_mode = "QUATERNION"
            root.rotation_quaternion = Matrix(up_rotation(scene.cameras).tolist()).to_quaternion()
        centers = np.array([camera.center for camera in scene.cameras])
        root.lodgs.scene_folder = str(scene.folder)
        if model:
            root.lodgs.training.model = str(scene.model)
        if images:
            root.lodgs.training.images = str(scene.images_folder)
        root.lodgs.camera_center = centers.mean(axis=0)
        extent = _extent(scene)
        root.empty_display_size = extent / 4

        cameras = bpy.data.collections.new(f"{root.name} cameras")
        _collection(root).children.link(cameras)
        root.lodgs.cameras = cameras
        for camera in scene.cameras:
            thing = _new_camera(camera, extent, photographs)
            thing.data.lodgs.distorted = camera.name in scene.distorted
            thing.parent = root
            cameras.objects.link(thing)
            if context.scene.camera is None:
                context.scene.camera = thing
                match_render(context.scene, camera)
        if len(scene.points):
            points = objects.new_points(
                f"{root.name} points", scene.points, scene.point_colors, radius=extent / 400
            )
            points.parent = root
            _collection(root).objects.link(points)
            root.lodgs.points = points
    return root


def import_splats(context: bpy.types.Context, path: Path | str, *, upright: bool = True) -> bpy.types.Object:
    """A bundle, a folder of levels, or any 3DGS PLY as a single level, as a new splat scene.

    Args:
        upright: turn the root as the bundle says, or without that so that -y, which is up in most splat
            files, is up; otherwise leave the axes.

    Returns:
        The scene root.

    Raises:
        LodgsError: the file cannot be read. Nothing is left behind in that case.
    """
    path = Path(path)
    bundle = read_folder(path) if path.is_dir() else read_bundle(path)
    with _new_scene(context, path.stem) as root:
        if upright:
            rows = bundle.meta.get("up_rotation", ((1, 0, 0), (0, 0, 1), (0, -1, 0)))
            root.rotation_euler = Matrix(rows).to_euler()
        for level in bundle.levels:
            _put_level(root, level)
        set_bundle_facts(root, bundle)
        root.lodgs.gamma = bundle.meta.get("gamma", root.lodgs.gamma)
        root.lodgs.level_end = root.lodgs.single_level = bundle.levels[-1].number
        root.lodgs.level_start = bundle.levels[0].number
    return root


def set_bundle_facts(root: bpy.types.Object, facts: Bundle | Facts) -> None:
    """Takes over what a bundle says beside its levels. Levels whose objects are gone leave the list."""
    root.lodgs.method = facts.method
    root.lodgs.cumulative = facts.cumulative
    root.lodgs.meta = json.dumps(facts.meta)
    root.lodgs.d_max = facts.meta.get("d_max", 0.0) if facts.cumulative else 0.0
    root.lodgs.d_max_focal = facts.meta.get("focal_px", 1.0)
    if "camera_center" in facts.meta:
        root.lodgs.camera_center = facts.meta["camera_center"]
    _levels_changed(root)


def set_level(root: bpy.types.Object, level: Level) -> bpy.types.Object:
    """Adds a level to a splat scene, or replaces the one of its number; a new finest one is shown.

    COLMAP's points are hidden when the first level arrives.

    Returns:
        The level's object.
    """
    first = not root.lodgs.levels
    thing = _put_level(root, level)
    _levels_changed(root)
    if level.number == root.lodgs.levels[-1].number:
        root.lodgs.level_end = root.lodgs.single_level = level.number
        root.lodgs.active_level = len(root.lodgs.levels) - 1
    if first and root.lodgs.points:  # the splats stand where the points were
        root.lodgs.points.hide_viewport = root.lodgs.points.hide_render = True
    return thing


def remove_finer_levels(root: bpy.types.Object) -> None:
    """Removes all levels but the coarsest, whose object the coarsest of the next set takes over."""
    for item in root.lodgs.levels:
        if item.exists and item.number > 1:
            cloud = item.object.data
            bpy.data.objects.remove(item.object)
            if not cloud.users:
                bpy.data.pointclouds.remove(cloud)
    _levels_changed(root)


def read_levels(root: bpy.types.Object) -> Bundle:
    """The levels of a splat scene with all that artists have changed in them, in the splats' own world.

    The objects' transforms and modifiers are not applied.

    Raises:
        LodgsError: there are none.
    """
    levels = [
        Level(
            item.number, objects.read_splats(item.object), float(item.exact_s_min) if item.has_s_min else None
        )
        for item in root.lodgs.levels
        if item.exists
    ]
    if not levels:
        raise LodgsError(f"{root.name} has no levels yet.", "Train it or import splats first.")
    meta = json.loads(root.lodgs.meta) if root.lodgs.meta else {}
    return Bundle(root.lodgs.method, levels, meta, root.lodgs.cumulative)


def read_level(root: bpy.types.Object, number: int) -> Splats:
    """One level with all that artists have changed in it; where levels add up, with all coarser ones.

    Raises:
        LodgsError: there is no such level.
    """
    bundle = read_levels(root)
    for level in bundle.levels:
        if level.number == number:
            return complete(bundle, level)
    raise LodgsError(f"{root.name} has no level {number}.", "Choose one from the list of levels.")


def shown_splats(context: bpy.types.Context, root: bpy.types.Object) -> Splats:
    """The splats that the detail settings, and artists' own modifiers, leave visible in the view layer.

    Columns that not every visible level has are left out.

    Raises:
        LodgsError: nothing is visible, or the levels have spherical harmonics of different degrees.
    """
    depsgraph = context.evaluated_depsgraph_get()
    parts = [
        objects.read_splats(item.object, depsgraph) for item in root.lodgs.levels if _visible(context, item)
    ]
    if not any(len(part) for part in parts):
        raise LodgsError(f"No splats of {root.name} are shown.", "Look at the detail settings.")
    if len({part.sh_degree for part in parts}) > 1:
        raise LodgsError(
            f"The levels of {root.name} have spherical harmonics of different degrees.", "Export one level."
        )
    shared = [name for name in parts[0].extras if all(name in part.extras for part in parts)]
    arrays = ("means", "quats", "log_scales", "opacity_logits", "sh")
    return Splats(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays},
        extras={name: np.concatenate([part.extras[name] for part in parts]) for name in shared},
    )


def count_shown(context: bpy.types.Context, root: bpy.types.Object) -> tuple[int, int]:
    """How many splats are visible as of the last evaluation, and how many there are in all levels."""
    depsgraph, shown, everything = context.view_layer.depsgraph, 0, 0
    for item in root.lodgs.levels:
        if item.exists:
            everything += len(item.object.data.points)
            if depsgraph is not None and _visible(context, item):
                shown += len(item.object.evaluated_get(depsgraph).data.points)
    return shown, everything


def show_only(root: bpy.types.Object, number: int) -> None:
    """Shows one level everywhere; where levels add up, with all coarser ones."""
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", number
    for item in root.lodgs.levels:
        if item.number == number or (root.lodgs.cumulative and item.number < number):
            item.show = True


def offer_ellipsoids(scene: bpy.types.Scene) -> None:
    """Gives every level of a scene's splats the modifier that makes ellipsoids where they are wanted."""
    for root in roots(scene):
        for item in root.lodgs.levels:
            if item.exists:
                ellipsoids.attach(item.object)
    cycles = getattr(scene, "cycles", None)
    for limit in ("transparent_max_bounces", "min_transparent_bounces") if cycles else ():
        setattr(cycles, limit, max(getattr(cycles, limit), ellipsoids.BOUNCES))


def views(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The camera objects of a COLMAP scene that are still there, by name."""
    cameras = root.lodgs.cameras
    found = [thing for thing in cameras.objects if thing.type == "CAMERA"] if cameras else []
    return sorted(found, key=lambda thing: thing.name)


def look_through(context: bpy.types.Context, root: bpy.types.Object, step: int = 0) -> bpy.types.Object:
    """Makes one of the views the scene's camera, and gives the render its size.

    Args:
        step: how many views to go on by name from the scene's camera; 0 takes the active object, where that
            is a view.

    Returns:
        The camera object.

    Raises:
        LodgsError: the scene has no cameras.
    """
    there = views(root)
    if not there:
        raise LodgsError(f"'{root.name}' has no cameras.", "Import a COLMAP folder.")
    current = context.scene.camera
    if step == 0 and context.active_object in there:
        current = context.active_object
    index = there.index(current) if current in there else min(-step, 0)
    return through(context, there[(index + step) % len(there)])


def through(context: bpy.types.Context, view: bpy.types.Object) -> bpy.types.Object:
    """Makes a view the scene's camera, and gives the render its size. Returns the view."""
    context.scene.camera = view
    if view.data.lodgs.width:
        match_render(context.scene, view.data.lodgs)
    for root in roots(context.scene):
        line = root.lodgs.cameras.objects.find(view.name) if root.lodgs.cameras else -1
        if line >= 0 and line != root.lodgs.active_view:  # the list of views goes along
            root.lodgs.active_view = line
    return view


def match_render(scene: bpy.types.Scene, camera: Camera | View) -> None:
    """Gives the render the size and the pixel shape of a view."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = camera.width, camera.height, 100
    render.pixel_aspect_x = max(1.0, camera.fy / camera.fx)
    render.pixel_aspect_y = max(1.0, camera.fx / camera.fy)


@contextmanager
def _new_scene(context: bpy.types.Context, name: str) -> Iterator[bpy.types.Object]:
    """A new root in a new collection; both, and all in them, vanish again if the block fails."""
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    scene, camera = context.scene, context.scene.camera
    images = set(bpy.data.images)
    collection = bpy.data.collections.new(name)
    root = bpy.data.objects.new(name, None)
    root.lodgs.is_root = True
    collection.objects.link(root)
    scene.collection.children.link(collection)
    try:
        yield root
    except BaseException:
        scene.camera = camera
        bpy.data.batch_remove(list(set(bpy.data.images) - images))
        for part in [*collection.children_recursive, collection]:
            for thing in list(part.objects):
                data = thing.data
                bpy.data.objects.remove(thing)
                if data is not None:
                    bpy.data.batch_remove([data])
            bpy.data.collections.remove(part)
        raise
    for thing in context.selected_objects:
        thing.select_set(False)
    context.view_layer.objects.active = root
    root.select_set(True)


def _visible(context: bpy.types.Context, item) -> bool:
    return item.exists and item.object.visible_get(view_layer=context.view_layer)


def _collection(root: bpy.types.Object) -> bpy.types.Collection:
    return root.users_collection[0]


def _extent(scene: Scene) -> float:
    """The scene's size, for what must be neither too small nor too large to see."""
    try:
        return scene.extent()
    except LodgsError:  # one place to stand, and no points: nothing tells the size
        return 1.0


def _new_camera(camera: Camera, extent: float, photograph: bool) -> bpy.types.Object:
    """A view as a camera object, in no collection yet, placed in COLMAP's world."""
    data = bpy.data.cameras.new(camera.name)
    long = max(camera.width, camera.height)
    wide = camera.width >= camera.height
    data.sensor_fit = "HORIZONTAL" if wide else "VERTICAL"
    data.sensor_width, data.sensor_height = SENSOR * camera.width / long, SENSOR * camera.height / long
    data.lens = (camera.fx if wide else camera.fy) * SENSOR / long
    # Blender's shift moves the frame, in parts of the fitted side; the principal point moves the other way.
    pixel = camera.fy / camera.fx
    data.shift_x = (camera.width / 2 - camera.cx) / long * (1 if wide else pixel)
    data.shift_y = (camera.cy - camera.height / 2) / long / (pixel if wide else 1)
    view = data.lodgs
    view.width, view.height, view.fx, view.fy = camera.width, camera.height, camera.fx, camera.fy
    view.photograph = str(camera.image) if camera.image else ""
    data.display_size = extent / 20
    data.clip_start, data.clip_end = extent / 1000, extent * 1000
    if photograph and camera.image is not None:
        picture = data.background_images.new()
        picture.image = bpy.data.images.load(str(camera.image), check_existing=True)
        picture.alpha = 1.0
        picture.frame_method = "STRETCH"
        data.show_background_images = True
    thing = bpy.data.objects.new(camera.name, data)
    thing.matrix_basis = Matrix((np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])).tolist())
    return thing


def _put_level(root: bpy.types.Object, level: Level) -> bpy.types.Object:
    """The level's object in the scene and its entry in the list, without what depends on the whole list."""
    settings = root.lodgs
    fresh = objects.new_splats(f"{root.name} level {level.number}", level.splats)
    item = next((entry for entry in settings.levels if entry.number == level.number), None)
    if item is None:
        item = settings.levels.add()
        item.number = level.number
        position = sum(entry.number < level.number for entry in settings.levels)
        settings.levels.move(len(settings.levels) - 1, position)
        item = settings.levels[position]
    elif item.exists:
        # The object stays, with all that artists have hung on it; only its splats change.
        old, thing = item.object.data, item.object
        thing.data, thing.color = fresh.data, fresh.color
        bpy.data.objects.remove(fresh)
        name = old.name
        bpy.data.pointclouds.remove(old)
        thing.data.name = name
        fresh = thing
    if fresh.parent is None:
        fresh.parent = root
        _collection(root).objects.link(fresh)
    item.object = fresh
    item.exact_s_min = "" if level.s_min is None else repr(float(level.s_min))
    item.s_min = level.s_min or 0.0
    return fresh


def _levels_changed(root: bpy.types.Object) -> None:
    """Drops levels whose objects are gone, keeps the settings within the rest, and renews the drivers."""
    settings = root.lodgs
    for index in reversed(range(len(settings.levels))):
        if not settings.levels[index].exists:
            settings.levels.remove(index)
    if settings.levels:
        finest = settings.levels[-1].number
        settings.level_end = min(settings.level_end, finest)
        settings.single_level = min(settings.single_level, finest)
    settings.active_level = min(settings.active_level, len(settings.levels) - 1)
    selection.attach(root)
    for scene in root.users_scene:
        if scene.lodgs_render.ellipsoids:
            offer_ellipsoids(scene)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Follows artists: a deleted level leaves no gap in the distances, a new material is shown."""
    if depsgraph.id_type_updated("COLLECTION"):
        for root in roots(scene):
            if not all(item.exists for item in root.lodgs.levels):
                _levels_changed(root)
    if any(update.is_updated_geometry for update in depsgraph.updates):
        for root in roots(scene):
            selection.update_inputs(root)


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_on_update)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_on_update)
