"""Placement of views for training images of splats without photos, or of a Blender scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.runs.job import MIN_VIEWS
from ...training.scenes.cameras import Camera, pick_evenly
from ...training.scenes.viewpoints import (
    DOMES,
    NEAR_SHARE,
    OPAQUE,
    aerial_views,
    ball_of_corners,
    dome_views_around,
    opaque_means,
    surrounding_views,
    views_along,
    walk_views,
)
from ...training.splats.gaussians import Splats
from .. import attributes
from . import changes, visited
from .cameras import enabled_cameras, scene_camera, supported_views, view_from, view_of, views_of_cameras
from .objects import root_of
from .placement import matrix_of

SAMPLE = 100_000
"""Approximate number of splats for the preview of a dome."""
UP = (0.0, 0.0, 1.0)
"""Up axis of a Blender scene."""
MIN_ELEVATION = 0.0
"""Sine of a dome's lowest elevation: objects stand on the ground."""
CLIP_START = 0.1
"""Maximum clip start of cameras along a curve, as Blender's default; at most a quarter of their spacing."""
SOLID = {"MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "POINTCLOUD", "CURVES"}
"""Types of objects with surfaces or volumes."""

Shot = bpy.types.Object | int | tuple[Camera, float]
"""Camera of an image: a camera object, a frame of the active camera, or a placed view and its near depth."""
Warn = Callable[[str], object]
"""Function called with a sentence about the views."""

_cache: dict[str, tuple[tuple, Any]] = {}
"""Last key and value of each kind, for redraws of viewports."""


def _ignore(message: str) -> None:
    """Ignore a warning, in previews."""


def has_only_splats(root: bpy.types.Object) -> bool:
    """Return True if a splat scene has splats but no photos."""
    return not root.lodgs.scene_folder and bool(root.lodgs.existing_levels)


def view_count(settings: bpy.types.PropertyGroup) -> int:
    """Return the number of views of the settings."""
    if settings.views_from == "VISITED":
        return min(settings.views, visited.count(bpy.context.scene))
    if settings.views_from != "CAMERAS":
        return settings.views
    return _count(enabled_cameras(bpy.context.scene, settings.id_data))


def training_views(
    context: bpy.types.Context, root: bpy.types.Object, splats: Splats, warn: Warn = _ignore
) -> list[tuple[Camera, float]]:
    """Return the views of a root's settings in its splats' coordinates, each with its near depth.

    Empty for a dome, which the trainer places.

    Args:
        splats: finest level of the root.
        warn: function called with a sentence for each camera that is left out.

    Raises:
        LodgsError: there are fewer than two cameras, no curve or a curve of length 0; or the root is scaled
            differently along its axes.
    """
    settings = root.lodgs.training
    width, height = image_size(context.scene, settings)
    match settings.views_from:
        case "CAMERAS":
            cameras = _require_two(enabled_cameras(context.scene, root))
            views = views_of_cameras(
                context, cameras, lambda graph, camera: view_from(root, graph, width, height, camera), warn
            )
            return [view for _, view in views]
        case "ANIMATION":
            frames = _frames(context.scene, settings.views)
            views = _animated(
                context, frames, lambda depsgraph: view_from(root, depsgraph, width, height), warn
            )
            return [view for _, view in views]
        case "CURVE":
            world_to_root = np.linalg.inv(matrix_of(root))
            points = _curve_points(settings.curve) @ world_to_root[:3, :3].T + world_to_root[:3, 3]
            views, near = walk_views(splats, points, world_to_root[:3, 2], settings.views, width, height)
            return [(view, near) for view in views]
        case "GRID":
            views, near = _aerial_views(root, opaque_means(splats), settings, width, height)
            return [(view, near) for view in views]
        case "VISITED":
            visits, near = _visited_views(context.scene, settings.views, width, height)
            local_views, units = _in_root(visits, root)
            return [(view, near / units) for view in local_views]
    return []


def capture_shots(context: bpy.types.Context, width: int, height: int, warn: Warn = _ignore) -> list[Shot]:
    """Return the shots of a Blender scene according to its settings (``Scene.lodgs_capture``).

    Args:
        warn: function called with a sentence for each camera that is left out.

    Raises:
        LodgsError: there are fewer than two cameras that LODGS can use, no curve or a curve of length 0; the
            camera does not move; or the scene is empty.
    """
    return [shot for shot, _ in _shots_with_views(context, width, height, warn)]


def capture_views(context: bpy.types.Context, width: int, height: int) -> list[tuple[Camera, float]]:
    """Return the views and near depths of the shots of :func:`capture_shots`, in Blender's world.

    Raises:
        LodgsError: see :func:`capture_shots`.
    """
    return [view for _, view in _shots_with_views(context, width, height, _ignore)]


def _shots_with_views(
    context: bpy.types.Context, width: int, height: int, warn: Warn
) -> Sequence[tuple[Shot, tuple[Camera, float]]]:
    def evaluated_view(depsgraph: bpy.types.Depsgraph, camera: bpy.types.Object) -> tuple[Camera, float]:
        return view_of(camera.evaluated_get(depsgraph), depsgraph, width, height)

    scene, settings = context.scene, context.scene.lodgs_capture
    match settings.views_from:
        case "CAMERAS":
            cameras = _require_two([obj for obj in enabled_cameras(scene) if root_of(obj) is None])
            return views_of_cameras(context, cameras, evaluated_view, warn)
        case "ANIMATION":
            frames = _frames(scene, settings.views)
            return _animated(
                context, frames, lambda depsgraph: evaluated_view(depsgraph, scene_camera(scene)), warn
            )
    views, near = placed_capture_views(context, width, height)
    return [((view, near), (view, near)) for view in views]


def placed_capture_views(
    context: bpy.types.Context, width: int = 3, height: int = 2
) -> tuple[list[Camera], float]:
    """Return the placed views of a Blender scene and their near depth.

    They are around or above the selection or all objects, or along a curve. Empty if the scene's own cameras
    are used.

    Raises:
        LodgsError: there is no object or no curve.
    """
    settings = context.scene.lodgs_capture
    match settings.views_from:
        case "DOME":
            ball = ball_of_corners(_corners(context))
            return dome_views_around(ball, settings.views, width, height, UP, MIN_ELEVATION)
        case "GRID":
            return aerial_views(_corners(context), settings.views, width, height, settings.height)
        case "CURVE":
            points = _curve_points(settings.curve)
            spacing = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) / settings.views
            views = views_along(points, np.array(UP), settings.views, width, height)
            return views, min(CLIP_START, spacing / 4)
        case "VISITED":
            return _visited_views(context.scene, settings.views, width, height)
    return [], 0.0


def capture_view_count(scene: bpy.types.Scene) -> int:
    """Return the number of views of a Blender scene's capture settings."""
    match scene.lodgs_capture.views_from:
        case "CAMERAS":
            return _count(obj for obj in enabled_cameras(scene) if root_of(obj) is None)
        case "ANIMATION":
            return len(_frames(scene, scene.lodgs_capture.views))
        case "VISITED":
            return min(scene.lodgs_capture.views, visited.count(scene))
    return scene.lodgs_capture.views


def selected_subjects(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected objects of a Blender scene that views can be placed around."""
    return [
        obj
        for obj in context.view_layer.objects
        if obj.select_get() and not obj.hide_render and is_renderable(obj)
    ]


def is_renderable(obj: bpy.types.Object) -> bool:
    """Return whether an object outside splat scenes has surfaces or volumes, or instances a collection."""
    return root_of(obj) is None and (obj.type in SOLID or obj.instance_type == "COLLECTION")


def _corners(context: bpy.types.Context) -> np.ndarray:
    """Return the corners (8 N, 3) of the bounding boxes of the selection, or of all rendered objects.

    Raises:
        LodgsError: there are no objects.
    """
    depsgraph = context.evaluated_depsgraph_get()
    objects = [obj for obj in context.view_layer.objects if root_of(obj) is None]
    corners = list(_boxes(selected_subjects(context), depsgraph)) or list(_boxes(objects, depsgraph))
    if not corners:
        raise LodgsError(
            "Cannot place views: the Blender scene is empty.", "Add objects, or choose other views."
        )
    return np.concatenate(corners)


def _boxes(
    objects: Iterable[bpy.types.Object], depsgraph: bpy.types.Depsgraph, transform: Matrix | None = None
) -> Iterator[np.ndarray]:
    """Yield the bounding-box corners (8, 3) of each rendered object, also in collection instances.

    Args:
        transform: transform of the collection instance.
    """
    for obj in objects:
        if obj.hide_render:
            continue
        evaluated = obj.evaluated_get(depsgraph)
        matrix = transform @ evaluated.matrix_world if transform else evaluated.matrix_world
        if obj.type in SOLID:
            world = np.array(matrix)
            yield np.array(evaluated.bound_box, np.float64) @ world[:3, :3].T + world[:3, 3]
        if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
            collection = obj.instance_collection
            instance_matrix = matrix @ Matrix.Translation(-collection.instance_offset)
            yield from _boxes(collection.all_objects, depsgraph, instance_matrix)


def preview_views(root: bpy.types.Object) -> list[Camera]:
    """Return the views that training will place around or above a root's splats, or along a curve.

    They are in the splats' world.

    Raises:
        LodgsError: there are no opaque splats or no curve.
    """
    settings = root.lodgs.training
    match settings.views_from:
        case "DOME":
            return preview_dome(root)[0]
        case "GRID":
            key = *_finest_cloud(root)[1:], settings.views, settings.height, matrix_of(root).tobytes()
            return _cached("above", key, lambda: _aerial_views(root, _sample_positions(root), settings)[0])
        case "CURVE":
            world_to_root = np.linalg.inv(matrix_of(root))
            points = _curve_points(settings.curve) @ world_to_root[:3, :3].T + world_to_root[:3, 3]
            return views_along(points, world_to_root[:3, 2], settings.views, 3, 2)
        case "VISITED":
            return _in_root(_visited_views(bpy.context.scene, settings.views)[0], root)[0]
    return []


def preview_dome(root: bpy.types.Object) -> tuple[list[Camera], tuple[float, float]]:
    """Return the dome of a root's next training and the radii of its two shells; cached.

    The dome is computed from a sample of the splats.

    Raises:
        LodgsError: there are no opaque splats.
    """
    count = root.lodgs.training.views
    views, near = _cached(
        "dome", (*_finest_cloud(root)[1:], count), lambda: surrounding_views(_sample_positions(root), count)
    )
    return views, (DOMES[0] * near / NEAR_SHARE, DOMES[1] * near / NEAR_SHARE)


def _finest_cloud(root: bpy.types.Object) -> tuple[bpy.types.PointCloud, int, changes.Version]:
    """Return the finest point cloud of a root and two values that change with it and its points."""
    cloud = root.lodgs.existing_levels[-1].object.data
    return cloud, cloud.session_uid, changes.version(cloud)


def _sample_positions(root: bpy.types.Object) -> np.ndarray:
    """Return a sample of the root's opaque splats: positions (N, 3) float64."""
    cloud = _finest_cloud(root)[0]
    step = max(len(cloud.points) // SAMPLE, 1)
    means, base = (attributes.view_attribute(cloud, name) for name in ("position", attributes.BASE))
    if means is None or base is None:  # empty clouds have no attributes
        return np.zeros((0, 3))
    return means[base[:, 3] > OPAQUE][::step].astype(np.float64)


def _aerial_views(
    root: bpy.types.Object, points: np.ndarray, settings: Any, width: int = 3, height: int = 2
) -> tuple[list[Camera], float]:
    """Return views above points and their near depth, in the root's coordinates.

    The views are above the points in the direction of Blender's z axis.

    Args:
        points: (N, 3) in the root's coordinates.
    """
    matrix = matrix_of(root)
    views, near = aerial_views(
        points @ matrix[:3, :3].T + matrix[:3, 3], settings.views, width, height, settings.height
    )
    local_views, units = _in_root(views, root)
    return local_views, near / units


def _visited_views(
    scene: bpy.types.Scene, count: int, width: int = 3, height: int = 2
) -> tuple[list[Camera], float]:
    """Return up to ``count`` views where viewports rested, and their least near depth, in Blender's world.

    Raises:
        LodgsError: there are fewer than two.
    """
    visits = visited.visited_views(scene, width, height)
    if len(visits) < MIN_VIEWS:
        raise LodgsError(
            f"Cannot place views: viewports rested in {len(visits)} view(s), but two are needed.",
            "Look around in a viewport, or choose other views.",
        )
    views, nears = zip(*pick_evenly(visits, count), strict=True)
    return list(views), min(nears)


def _in_root(views: Iterable[Camera], root: bpy.types.Object) -> tuple[list[Camera], float]:
    """Return views of Blender's world in a root's coordinates, and the number of world units per unit."""
    local_views, units = zip(*[view.in_object_space(matrix_of(root)) for view in views], strict=True)
    return list(local_views), units[0]


def _cached(kind: str, key: tuple, create: Callable[[], Any]) -> Any:
    """Return the cached value of a kind; create it again if its key differs."""
    if kind not in _cache or _cache[kind][0] != key:
        _cache[kind] = key, create()
    return _cache[kind][1]


def image_size(scene: bpy.types.Scene, settings: bpy.types.PropertyGroup) -> tuple[int, int]:
    """Return width and height of the images in pixels, with the aspect ratio of renders."""
    render = scene.render
    return settings.view_width, max(round(settings.view_width * render.resolution_y / render.resolution_x), 1)


def _count(cameras: Iterable[bpy.types.Object]) -> int:
    """Return the number of perspective cameras."""
    return sum(camera.data.type == "PERSP" for camera in cameras)


def has_cameras(scene: bpy.types.Scene, root: bpy.types.Object) -> bool:
    """Return True if a scene has enough perspective cameras to train a root on their views."""
    return _count(enabled_cameras(scene, root)) >= MIN_VIEWS


def _require_two(cameras: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Return the cameras.

    Raises:
        LodgsError: there are fewer than two.
    """
    if len(cameras) < MIN_VIEWS:
        raise LodgsError(
            f"Cannot train: the Blender scene has {len(cameras)} camera(s), but two views are needed.",
            "Add cameras, or choose other views.",
        )
    return cameras


def _frames(scene: bpy.types.Scene, count: int) -> list[int]:
    """Return up to ``count`` frames, spread evenly over the scene's range."""
    frames = np.linspace(scene.frame_start, scene.frame_end, count).round().astype(int)
    return np.unique(frames).tolist()


def _animated(
    context: bpy.types.Context,
    frames: Sequence[int],
    view_in: Callable[[bpy.types.Depsgraph], tuple[Camera, float]],
    warn: Warn,
) -> list[tuple[int, tuple[Camera, float]]]:
    """Return frames of the scene with their views, as :func:`supported_views`.

    Args:
        view_in: returns the view in an evaluated depsgraph.

    Raises:
        LodgsError: the camera does not move, or cannot be used.
    """
    scene, frame, subframe = context.scene, context.scene.frame_current, context.scene.frame_subframe

    def view_at(number: int) -> tuple[Camera, float]:
        scene.frame_set(number)
        return view_in(context.evaluated_depsgraph_get())

    try:
        views = supported_views(frames, view_at, warn)
    finally:
        scene.frame_set(frame, subframe=subframe)
    if not np.ptp([view.world_to_camera for _, (view, _) in views], axis=0).any():
        raise LodgsError(
            f"Cannot place views: the camera '{scene_camera(scene).name}' does not move in the frame range.",
            "Animate the camera, or choose other views.",
        )
    return views


def _curve_points(curve: bpy.types.Object | None) -> np.ndarray:
    """Return the points (P, 3) of a curve in Blender's world, at display resolution.

    Raises:
        LodgsError: there is no curve, or it does not have one spline.
    """
    if curve is None or not curve.users_collection:  # the setting keeps a deleted curve
        raise LodgsError("Cannot place views: no curve is chosen.", "Choose a curve, or choose other views.")
    if len(curve.data.splines) != 1:
        raise LodgsError(
            f"Cannot place views: '{curve.name}' has {len(curve.data.splines)} splines instead of one.",
            "Choose another curve, or join its splines.",
        )
    corners = _cached(
        "curve", (curve.data.session_uid, changes.version(curve.data)), lambda: _tessellate(curve)
    )
    matrix = np.array(curve.matrix_world, np.float64)
    return corners @ matrix[:3, :3].T + matrix[:3, 3]


def _tessellate(curve: bpy.types.Object) -> np.ndarray:
    """Return the points (P, 3) of a curve in its local space, without bevel and extrusion."""
    copy = bpy.data.objects.new(curve.name, curve.data.copy())
    try:
        copy.data.bevel_depth = copy.data.extrude = 0
        copy.data.bevel_object = copy.data.taper_object = None
        corners = np.array([vertex.co for vertex in copy.to_mesh().vertices], np.float64).reshape(-1, 3)
    finally:
        bpy.data.curves.remove(copy.data)
    return np.concatenate([corners, corners[:1]]) if curve.data.splines[0].use_cyclic_u else corners
