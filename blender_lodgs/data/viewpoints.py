"""From where splats without photographs are looked at, so that their own pictures can be the photographs."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.runs.job import VIEWS
from ...training.scenes.cameras import Camera
from ...training.scenes.viewpoints import DOMES, NEAR, OPAQUE, dome_around, walk
from ...training.splats.gaussians import Splats
from .. import attributes
from . import changes
from .cameras import scene_camera, view_from
from .placement import matrix_of

SAMPLE = 100_000
"""About so many splats say where a dome will be, before there is one."""

_domes: dict[tuple, tuple[list[Camera], tuple[float, float]]] = {}
"""The last one, by what it depends on."""


def alone(root: bpy.types.Object) -> bool:
    """Whether a splat scene has splats but no photographs."""
    return not root.lodgs.scene_folder and any(item.exists for item in root.lodgs.levels)


def count(settings: bpy.types.PropertyGroup) -> int:
    """How many views the settings ask for."""
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
            cameras = _cameras(context.scene)
            if len(cameras) < VIEWS[0]:
                raise LodgsError(
                    f"The Blender scene has {len(cameras)} camera(s), and training takes two views or more.",
                    "Add cameras, or choose other views.",
                )
            depsgraph = context.evaluated_depsgraph_get()
            return [view_from(root, depsgraph, width, height, camera) for camera in cameras]
        case "ANIMATION":
            return _animated(context, root, width, height)
        case "CURVE":
            if settings.curve is None:
                raise LodgsError("No curve is chosen to walk along.", "Choose one, or other views.")
            into = np.linalg.inv(matrix_of(root))
            way = _way(settings.curve) @ into[:3, :3].T + into[:3, 3]
            views, near = walk(splats, way, into[:3, 2], settings.views, width, height)
            return [(view, near) for view in views]
    return []


def dome_of(root: bpy.types.Object) -> tuple[list[Camera], tuple[float, float]]:
    """The dome that training will place around a root's splats, up to the few that it looks at more closely,
    and how far its two shells are away from their middle; kept until something changes.

    Raises:
        LodgsError: there is no opaque splat to look at.
    """
    cloud = [item for item in root.lodgs.levels if item.exists][-1].object.data
    key = cloud.session_uid, changes.version(cloud), root.lodgs.training.views
    if key not in _domes:
        step = max(len(cloud.points) // SAMPLE, 1)
        means, base = (attributes.view_attribute(cloud, name) for name in ("position", attributes.BASE))
        if means is None or base is None:  # as Blender has no points
            means, base = np.zeros((0, 3)), np.zeros((0, 4))
        views, near = dome_around(means[base[:, 3] > OPAQUE][::step].astype(np.float64), key[-1])
        _domes.clear()
        _domes[key] = views, (DOMES[0] * near / NEAR, DOMES[1] * near / NEAR)
    return _domes[key]


def size(scene: bpy.types.Scene, settings: bpy.types.PropertyGroup) -> tuple[int, int]:
    """Width and height of the pictures in pixels: of the shape that renders have."""
    render = scene.render
    return settings.view_width, max(round(settings.view_width * render.resolution_y / render.resolution_x), 1)


def _cameras(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    return sorted((obj for obj in scene.objects if obj.type == "CAMERA"), key=lambda obj: obj.name)


def _animated(
    context: bpy.types.Context, root: bpy.types.Object, width: int, height: int
) -> list[tuple[Camera, float]]:
    """What the scene's camera sees in frames that are evenly chosen from the scene's range."""
    scene, frame, part = context.scene, context.scene.frame_current, context.scene.frame_subframe
    frames = np.linspace(scene.frame_start, scene.frame_end, root.lodgs.training.views).round().astype(int)
    found = []
    try:
        for each in np.unique(frames).tolist():
            scene.frame_set(each)
            found.append(view_from(root, context.evaluated_depsgraph_get(), width, height))
    finally:
        scene.frame_set(frame, subframe=part)
    if not np.ptp([view.world_to_camera for view, _ in found], axis=0).any():
        raise LodgsError(
            f"The camera '{scene_camera(scene).name}' does not move in the frames of the scene.",
            "Animate it, or choose other views.",
        )
    return found


def _way(curve: bpy.types.Object) -> np.ndarray:
    """The corners (P, 3) of a curve in Blender's world, as fine as it is drawn.

    Raises:
        LodgsError: it has not one spline.
    """
    if len(curve.data.splines) != 1:
        raise LodgsError(
            f"The curve '{curve.name}' has {len(curve.data.splines)} splines, and a walk takes one.",
            "Choose another curve, or join its splines.",
        )
    plain = bpy.data.objects.new(curve.name, curve.data.copy())  # without what makes a pipe of it
    try:
        plain.data.bevel_depth = plain.data.extrude = 0
        plain.data.bevel_object = plain.data.taper_object = None
        corners = np.array([vertex.co for vertex in plain.to_mesh().vertices], np.float64).reshape(-1, 3)
    finally:
        bpy.data.curves.remove(plain.data)
    if curve.data.splines[0].use_cyclic_u:
        corners = np.concatenate([corners, corners[:1]])
    matrix = np.array(curve.matrix_world, np.float64)
    return corners @ matrix[:3, :3].T + matrix[:3, 3]
