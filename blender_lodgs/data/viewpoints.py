"""From where splats without photographs, or a Blender scene, are looked at, so that there are photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.runs.job import VIEW_WIDTHS, VIEWS, Job
from ...training.scenes.cameras import Camera
from ...training.scenes.viewpoints import (
    DOMES,
    NEAR_SHARE,
    OPAQUE,
    aerial_views,
    dome_views_around,
    opaque_means,
    views_along,
    walk_views,
)
from ...training.splats.gaussians import Splats
from .. import attributes
from . import changes
from .cameras import scene_camera, view_from, view_of
from .objects import root_of
from .placement import matrix_of

SAMPLE = 100_000
"""About so many splats say where a dome will be, before there is one."""

UP, LOWEST = (0.0, 0.0, 1.0), 0.0
"""What is up in a Blender scene, and the sine of the elevation at which a dome begins there: things stand on
the ground."""
CLIP_START = 0.1
"""Of cameras along a curve in a Blender scene, in its units: as Blender gives to new cameras; a quarter of
how far they are apart where that is less."""
_SOLID = {"MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "POINTCLOUD", "CURVES"}

Shot = bpy.types.Object | int | tuple[Camera, float]
"""From where a picture of a Blender scene is rendered: a camera of it, the frame in which its camera looks,
or a view that is placed in its world, with its near depth."""

_kept: dict[str, tuple[tuple, Any]] = {}
"""What viewports ask for at every redraw, with what it depends on: the last of each kind."""


def _is_curve(settings: bpy.types.PropertyGroup, obj: bpy.types.Object) -> bool:
    return obj.type == "CURVE"


class ViewsSettings:
    """Settings of views for rendering training images, of splats or of a Blender scene."""

    views_from: bpy.props.EnumProperty(
        name="Views From",
        description="Placement of the cameras that render training images",
        items=[
            (
                "DOME",
                "All Around",
                "Dome of cameras around the splats or the selected objects, for an object seen from outside",
            ),
            (
                "GRID",
                "Above",
                "Grid of cameras above the splats or the selected objects that look down and to four sides, "
                "as a drone does, for terrain and towns",
            ),
            ("CAMERAS", "Cameras", "All cameras of the Blender scene"),
            ("ANIMATION", "Animation", "Scene camera at frames spread evenly over the frame range"),
            ("CURVE", "Along Curve", "Cameras along a curve that look ahead, to both sides and back in turn"),
        ],
    )
    views: bpy.props.IntProperty(
        name="Views", description="Number of views", default=Job.views, min=VIEWS[0], max=VIEWS[1]
    )
    show_views: bpy.props.BoolProperty(
        name="Show Views",
        description="Show the views in the viewport",
        default=False,
        options=set(),
    )
    view_width: bpy.props.IntProperty(
        name="View Width",
        description="Width of the rendered images. Training scales them by Image Scale",
        default=Job.view_width,
        min=VIEW_WIDTHS[0],
        max=VIEW_WIDTHS[1],
        subtype="PIXEL",
    )
    height: bpy.props.FloatProperty(
        name="Height",
        description="Height of the views above the top of the subject. 0 uses twice their spacing",
        default=0.0,
        min=0.0,
        soft_max=1000.0,
        subtype="DISTANCE",
    )
    curve: bpy.props.PointerProperty(
        name="Curve",
        description="Curve for the cameras to follow, at eye level",
        type=bpy.types.Object,
        poll=_is_curve,
    )


def alone(root: bpy.types.Object) -> bool:
    """Return True if a splat scene has splats but no photos."""
    return not root.lodgs.scene_folder and any(item.exists for item in root.lodgs.levels)


def count(settings: bpy.types.PropertyGroup) -> int:
    """Return the number of views of the settings."""
    return len(_cameras(bpy.context.scene)) if settings.views_from == "CAMERAS" else settings.views


def placed(context: bpy.types.Context, root: bpy.types.Object, splats: Splats) -> list[tuple[Camera, float]]:
    """The views that a root's settings ask for, in its splats' coordinates, each with its near depth.

    None of a dome, which the trainer places.

    Args:
        splats: the root's finest level.

    Raises:
        LodgsError: there are no two cameras, no curve, or one that leads nowhere; or the root is stretched.
    """
    settings = root.lodgs.training
    width, height = size(context.scene, settings)
    match settings.views_from:
        case "CAMERAS":
            cameras = _enough(_cameras(context.scene))
            depsgraph = context.evaluated_depsgraph_get()
            return [view_from(root, depsgraph, width, height, camera) for camera in cameras]
        case "ANIMATION":
            frames = _frames(context.scene, settings.views)
            return _animated(context, frames, lambda depsgraph: view_from(root, depsgraph, width, height))
        case "CURVE":
            into = np.linalg.inv(matrix_of(root))
            way = _way(settings.curve) @ into[:3, :3].T + into[:3, 3]
            views, near = walk_views(splats, way, into[:3, 2], settings.views, width, height)
            return [(view, near) for view in views]
        case "GRID":
            views, near = _above(root, opaque_means(splats), settings, width, height)
            return [(view, near) for view in views]
    return []


def of_scene(context: bpy.types.Context, width: int, height: int) -> list[Shot]:
    """From where the settings of a Blender scene (``Scene.lodgs_capture``) have it captured.

    Raises:
        LodgsError: there are no two cameras, no curve, or one that leads nowhere; the camera stands still; a
            camera is no perspective one; or nothing is there to look at.
    """
    scene, settings = context.scene, context.scene.lodgs_capture
    match settings.views_from:
        case "CAMERAS":
            cameras = _enough([obj for obj in _cameras(scene) if root_of(obj) is None])
            _seen(context, cameras, width, height)
            return list(cameras)
        case "ANIMATION":
            frames = _frames(scene, settings.views)
            _seen(context, [frames[0], frames[len(frames) // 2], frames[-1]], width, height)
            return list(frames)
    views, near = placed_in_scene(context, width, height)
    return [(view, near) for view in views]


def seen_from(context: bpy.types.Context, width: int, height: int) -> list[tuple[Camera, float]]:
    """What will be seen in each of the shots of :func:`of_scene`, in Blender's world, and its near depth.

    Raises:
        LodgsError: as there.
    """
    return _seen(context, of_scene(context, width, height), width, height)


def _seen(
    context: bpy.types.Context, shots: Sequence[Shot], width: int, height: int
) -> list[tuple[Camera, float]]:
    def see(depsgraph: bpy.types.Depsgraph, camera: bpy.types.Object) -> tuple[Camera, float]:
        return view_of(camera.evaluated_get(depsgraph), depsgraph, width, height)

    scene, frames = context.scene, [shot for shot in shots if isinstance(shot, int)]
    if frames:
        return _animated(context, frames, lambda depsgraph: see(depsgraph, scene_camera(scene)))
    depsgraph = context.evaluated_depsgraph_get()
    return [shot if isinstance(shot, tuple) else see(depsgraph, shot) for shot in shots]


def placed_in_scene(
    context: bpy.types.Context, width: int = 3, height: int = 2
) -> tuple[list[Camera], float]:
    """The views that are placed in a Blender scene, and their near depth: all around or above what is
    selected, or all of it, or along a curve. None where its own cameras are taken.

    Raises:
        LodgsError: there is nothing to look at, or no way to walk.
    """
    settings = context.scene.lodgs_capture
    match settings.views_from:
        case "DOME":
            return dome_views_around(_corners(context), settings.views, width, height, UP, LOWEST)
        case "GRID":
            return aerial_views(_corners(context), settings.views, width, height, settings.height)
        case "CURVE":
            way = _way(settings.curve)
            apart = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) / settings.views
            views = views_along(way, np.array(UP), settings.views, width, height)
            return views, min(CLIP_START, apart / 4)
    return [], 0.0


def count_of_scene(scene: bpy.types.Scene) -> int:
    """How many views the settings of a Blender scene ask for."""
    match scene.lodgs_capture.views_from:
        case "CAMERAS":
            return sum(root_of(obj) is None for obj in _cameras(scene))
        case "ANIMATION":
            return len(_frames(scene, scene.lodgs_capture.views))
    return scene.lodgs_capture.views


def chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """What is selected of a Blender scene, of that which views can be placed around."""
    return [
        obj
        for obj in context.view_layer.objects
        if obj.select_get()
        and root_of(obj) is None
        and not obj.hide_render
        and (obj.type in _SOLID or obj.instance_type == "COLLECTION")
    ]


def _corners(context: bpy.types.Context) -> np.ndarray:
    """Corners (8 N, 3) of the boxes of what is selected of a Blender scene, or of all that renders of it.

    Raises:
        LodgsError: there is nothing.
    """
    depsgraph = context.evaluated_depsgraph_get()
    seen = [obj for obj in context.view_layer.objects if root_of(obj) is None]
    corners = list(_boxes(chosen(context), depsgraph)) or list(_boxes(seen, depsgraph))
    if not corners:
        raise LodgsError(
            "The Blender scene holds nothing to look at.", "Add something, or choose other views."
        )
    return np.concatenate(corners)


def _boxes(
    objects: Iterable[bpy.types.Object], depsgraph: bpy.types.Depsgraph, placed: Matrix | None = None
) -> Iterator[np.ndarray]:
    """Corners (8, 3) of each of some objects that render, and of what collections' instances show.

    Args:
        placed: how they are moved as a whole.
    """
    for obj in objects:
        if obj.hide_render:
            continue
        shown = obj.evaluated_get(depsgraph)
        matrix = placed @ shown.matrix_world if placed else shown.matrix_world
        if obj.type in _SOLID:
            turned = np.array(matrix)
            yield np.array(shown.bound_box, np.float64) @ turned[:3, :3].T + turned[:3, 3]
        if obj.instance_type == "COLLECTION" and obj.instance_collection is not None:
            collection = obj.instance_collection
            moved = matrix @ Matrix.Translation(-collection.instance_offset)
            yield from _boxes(collection.all_objects, depsgraph, moved)


def placed_of(root: bpy.types.Object) -> list[Camera]:
    """The views that training will place around or above a root's splats, or along a curve, in their world.

    Raises:
        LodgsError: there is no opaque splat to look at, or no way to walk.
    """
    settings = root.lodgs.training
    match settings.views_from:
        case "DOME":
            return dome_of(root)[0]
        case "GRID":
            key = *_cloud_of(root)[1:], settings.views, settings.height, matrix_of(root).tobytes()
            return _keep("above", key, lambda: _above(root, _sample_of(root), settings)[0])
        case "CURVE":
            into = np.linalg.inv(matrix_of(root))
            way = _way(settings.curve) @ into[:3, :3].T + into[:3, 3]
            return views_along(way, into[:3, 2], settings.views, 3, 2)
    return []


def dome_of(root: bpy.types.Object) -> tuple[list[Camera], tuple[float, float]]:
    """The dome that training will place around a root's splats, up to the few that it looks at more closely,
    and how far its two shells are away from their middle; kept until something changes.

    Raises:
        LodgsError: there is no opaque splat to look at.
    """
    count = root.lodgs.training.views
    views, near = _keep(
        "dome", (*_cloud_of(root)[1:], count), lambda: dome_views_around(_sample_of(root), count)
    )
    return views, (DOMES[0] * near / NEAR_SHARE, DOMES[1] * near / NEAR_SHARE)


def _cloud_of(root: bpy.types.Object) -> tuple[bpy.types.PointCloud, int, changes.Version]:
    """The finest splats of a root, and what is another one for others, or after they have changed."""
    cloud = [item for item in root.lodgs.levels if item.exists][-1].object.data
    return cloud, cloud.session_uid, changes.version(cloud)


def _sample_of(root: bpy.types.Object) -> np.ndarray:
    """Where some of a root's opaque splats are, (N, 3) float64, in their coordinates."""
    cloud = _cloud_of(root)[0]
    step = max(len(cloud.points) // SAMPLE, 1)
    means, base = (attributes.view_attribute(cloud, name) for name in ("position", attributes.BASE))
    if means is None or base is None:  # as Blender has no points
        return np.zeros((0, 3))
    return means[base[:, 3] > OPAQUE][::step].astype(np.float64)


def _above(
    root: bpy.types.Object, places: np.ndarray, settings: Any, width: int = 3, height: int = 2
) -> tuple[list[Camera], float]:
    """Views above places (N, 3) of a root, by Blender's up, and their near depth: in the root's own world."""
    matrix = matrix_of(root)
    views, near = aerial_views(
        places @ matrix[:3, :3].T + matrix[:3, 3], settings.views, width, height, settings.height
    )
    inside, units = zip(*[view.in_object_space(matrix) for view in views], strict=True)
    return list(inside), near / units[0]


def _keep(kind: str, key: tuple, make: Callable[[], Any]) -> Any:
    """What was made of a kind last, made anew where what it depends on is another."""
    if kind not in _kept or _kept[kind][0] != key:
        _kept[kind] = key, make()
    return _kept[kind][1]


def size(scene: bpy.types.Scene, settings: bpy.types.PropertyGroup) -> tuple[int, int]:
    """Width and height of the pictures in pixels: of the shape that renders have."""
    render = scene.render
    return settings.view_width, max(round(settings.view_width * render.resolution_y / render.resolution_x), 1)


def _cameras(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    return sorted((obj for obj in scene.objects if obj.type == "CAMERA"), key=lambda obj: obj.name)


def _enough(cameras: list[bpy.types.Object]) -> list[bpy.types.Object]:
    if len(cameras) < VIEWS[0]:
        raise LodgsError(
            f"The Blender scene has {len(cameras)} camera(s), and training takes two views or more.",
            "Add cameras, or choose other views.",
        )
    return cameras


def _frames(scene: bpy.types.Scene, count: int) -> list[int]:
    """So many frames, evenly chosen from the scene's range, or all that it has."""
    frames = np.linspace(scene.frame_start, scene.frame_end, count).round().astype(int)
    return np.unique(frames).tolist()


def _animated(
    context: bpy.types.Context,
    frames: Sequence[int],
    see: Callable[[bpy.types.Depsgraph], tuple[Camera, float]],
) -> list[tuple[Camera, float]]:
    """What the scene's camera sees in some frames, as ``see`` has it in each."""
    scene, frame, part = context.scene, context.scene.frame_current, context.scene.frame_subframe
    found = []
    try:
        for each in frames:
            scene.frame_set(each)
            found.append(see(context.evaluated_depsgraph_get()))
    finally:
        scene.frame_set(frame, subframe=part)
    if not np.ptp([view.world_to_camera for view, _ in found], axis=0).any():
        raise LodgsError(
            f"The camera '{scene_camera(scene).name}' does not move in the frames of the scene.",
            "Animate it, or choose other views.",
        )
    return found


def _way(curve: bpy.types.Object | None) -> np.ndarray:
    """The corners (P, 3) of a curve in Blender's world, as fine as it is drawn.

    Raises:
        LodgsError: there is none, or it has not one spline.
    """
    if curve is None:
        raise LodgsError("No curve is chosen to walk along.", "Choose one, or other views.")
    if len(curve.data.splines) != 1:
        raise LodgsError(
            f"The curve '{curve.name}' has {len(curve.data.splines)} splines, and a walk takes one.",
            "Choose another curve, or join its splines.",
        )
    corners = _keep("way", (curve.data.session_uid, changes.version(curve.data)), lambda: _drawn(curve))
    matrix = np.array(curve.matrix_world, np.float64)
    return corners @ matrix[:3, :3].T + matrix[:3, 3]


def _drawn(curve: bpy.types.Object) -> np.ndarray:
    """The corners (P, 3) of a curve in its own space, without what makes a pipe of it."""
    plain = bpy.data.objects.new(curve.name, curve.data.copy())
    try:
        plain.data.bevel_depth = plain.data.extrude = 0
        plain.data.bevel_object = plain.data.taper_object = None
        corners = np.array([vertex.co for vertex in plain.to_mesh().vertices], np.float64).reshape(-1, 3)
    finally:
        bpy.data.curves.remove(plain.data)
    return np.concatenate([corners, corners[:1]]) if curve.data.splines[0].use_cyclic_u else corners
