"""Animated cameras: along a scene's photos, and around the scene."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.scenes.camera_path import smooth_path
from ...training.scenes.cameras import pick_evenly
from .objects import all_or_nothing
from .photographs import central_bounds, views
from .placement import axes_of

MAX_KEYS = 100
"""Maximum number of keyframes of a path; views are selected evenly."""
ELEVATION = math.radians(20)
"""Elevation of a turntable's camera above the center of the scene."""


@all_or_nothing()
def add_path(context: bpy.types.Context, root: bpy.types.Object) -> bpy.types.Object:
    """Create a camera that moves along a scene's views, in the order of their names, over the frame range.

    The path is smooth and has constant speed. The camera is a child of the scene's axes and becomes the
    active camera.

    Raises:
        LodgsError: there are fewer than two views, or all are at one position.
    """
    cameras = pick_evenly(views(root), MAX_KEYS)
    if len(cameras) < 2:
        raise LodgsError(
            f"Cannot make a camera path: '{root.name}' has {len(cameras)} camera(s), but two are needed.",
            "Import a COLMAP folder.",
        )
    positions = [view.matrix_basis.to_translation()[:] for view in cameras]
    rotations = [view.matrix_basis.to_quaternion()[:] for view in cameras]
    data = cameras[0].data.copy()
    data.background_images.clear()
    data.lodgs.photograph = ""
    camera = bpy.data.objects.new(f"{root.name} path", data)
    root.users_collection[0].objects.link(camera)
    camera.parent, camera.rotation_mode = axes_of(root), "QUATERNION"
    camera.lodgs.flight_of = root
    begin, end = context.scene.frame_start, context.scene.frame_end
    for position, rotation, time in zip(*smooth_path(np.array(positions), np.array(rotations)), strict=True):
        camera.location, camera.rotation_quaternion = position, rotation
        for name in ("location", "rotation_quaternion"):
            camera.keyframe_insert(name, frame=begin + float(time) * (end - begin))
    camera.update_tag(refresh={"TIME"})  # inserting keyframes left the camera at the last one
    context.scene.camera = camera
    return camera


@all_or_nothing()
def add_turntable(context: bpy.types.Context, root: bpy.types.Object) -> bpy.types.Object:
    """Create a camera that circles the central part of a scene once in the frame range, as a seamless loop.

    The camera is a child of an empty at the center and becomes the active camera.

    Raises:
        LodgsError: the scene has neither splats nor points.
    """
    bounds = central_bounds(root)
    if bounds is None:
        raise LodgsError(
            f"Cannot make a turntable: '{root.name}' has neither splats nor points.",
            "Import or train splats first.",
        )
    (middle, size), scene = bounds, context.scene
    pivot = bpy.data.objects.new(f"{root.name} turntable", None)
    data = bpy.data.cameras.new(f"{root.name} turntable camera")
    camera = bpy.data.objects.new(data.name, data)
    for obj in (pivot, camera):
        scene.collection.objects.link(obj)
        obj.lodgs.flight_of = root
    width, height = (getattr(scene.render, f"resolution_{axis}") for axis in "xy")
    tangent = data.sensor_width / 2 / data.lens * min(1.0, width / height, height / width)
    distance = size / 2 / math.sin(math.atan(tangent))
    data.clip_start, data.clip_end = distance / 1000, 100 * distance
    data.dof.focus_distance = distance
    pivot.location, pivot.empty_display_size = middle, size / 10
    camera.parent = pivot
    camera.matrix_basis = Matrix.Rotation(math.pi / 2 - ELEVATION, 4, "X") @ Matrix.Translation(
        (0, 0, distance)
    )
    for frame, angle in ((scene.frame_start, 0.0), (scene.frame_end + 1, 2 * math.pi)):
        pivot.rotation_euler.z = angle
        pivot.keyframe_insert("rotation_euler", index=2, frame=frame)
    (strip,) = pivot.animation_data.action.layers[0].strips
    for curve in strip.channelbags[0].fcurves:
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    scene.camera = camera
    return camera
