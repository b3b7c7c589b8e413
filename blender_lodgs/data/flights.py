"""Cameras that move by themselves: along a scene's photographs, and around it."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.scenes.camera_path import smooth_path
from ...training.scenes.cameras import pick_evenly
from .objects import all_or_nothing
from .photographs import bounds_of_most, views
from .placement import axes_of

MOST_KEYS = 100
"""Keyframes of a path, of views evenly chosen."""
ABOVE = math.radians(20)
"""How high a turntable's camera stands over the middle of the scene."""


@all_or_nothing()
def path(context: bpy.types.Context, root: bpy.types.Object) -> bpy.types.Object:
    """A camera that goes along a scene's views by name, smoothed, as fast everywhere, in the scene's frames.

    It hangs on the scene's axes, and becomes the scene's camera.

    Raises:
        LodgsError: there are no two views, or all are at one place.
    """
    found = pick_evenly(views(root), MOST_KEYS)
    if len(found) < 2:
        raise LodgsError(
            f"'{root.name}' has {len(found)} camera(s), and a path takes two.", "Import a COLMAP folder."
        )
    places = [view.matrix_basis.to_translation()[:] for view in found]
    turns = [view.matrix_basis.to_quaternion()[:] for view in found]
    data = found[0].data.copy()
    data.background_images.clear()
    data.lodgs.photograph = ""
    camera = bpy.data.objects.new(f"{root.name} path", data)
    root.users_collection[0].objects.link(camera)
    camera.parent, camera.rotation_mode = axes_of(root), "QUATERNION"
    camera.lodgs.flight_of = root
    begin, end = context.scene.frame_start, context.scene.frame_end
    for place, turn, time in zip(*smooth_path(np.array(places), np.array(turns)), strict=True):
        camera.location, camera.rotation_quaternion = place, turn
        for name in ("location", "rotation_quaternion"):
            camera.keyframe_insert(name, frame=begin + float(time) * (end - begin))
    camera.update_tag(refresh={"TIME"})  # setting keys has left it at the last
    context.scene.camera = camera
    return camera


@all_or_nothing()
def turntable(context: bpy.types.Context, root: bpy.types.Object) -> bpy.types.Object:
    """A camera that goes once around most of a scene in the scene's frames, evenly, so that they can be
    repeated. It hangs on an empty in the middle, and becomes the scene's camera.

    Raises:
        LodgsError: the scene has neither splats nor points.
    """
    bounds = bounds_of_most(root)
    if bounds is None:
        raise LodgsError(f"'{root.name}' has nothing to turn around.", "Import splats, or train some.")
    (middle, size), scene = bounds, context.scene
    pivot = bpy.data.objects.new(f"{root.name} turntable", None)
    data = bpy.data.cameras.new(f"{root.name} turntable camera")
    camera = bpy.data.objects.new(data.name, data)
    for obj in (pivot, camera):
        scene.collection.objects.link(obj)
        obj.lodgs.flight_of = root
    wide, high = (getattr(scene.render, f"resolution_{axis}") for axis in "xy")
    tangent = data.sensor_width / 2 / data.lens * min(1.0, wide / high, high / wide)
    away = size / 2 / math.sin(math.atan(tangent))
    data.clip_start, data.clip_end = away / 1000, 100 * away
    pivot.location, pivot.empty_display_size = middle, size / 10
    camera.parent = pivot
    camera.matrix_basis = Matrix.Rotation(math.pi / 2 - ABOVE, 4, "X") @ Matrix.Translation((0, 0, away))
    for frame, turn in ((scene.frame_start, 0.0), (scene.frame_end + 1, 2 * math.pi)):
        pivot.rotation_euler.z = turn
        pivot.keyframe_insert("rotation_euler", index=2, frame=frame)
    (strip,) = pivot.animation_data.action.layers[0].strips
    for curve in strip.channelbags[0].fcurves:
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    scene.camera = camera
    return camera
