"""Conversion of Blender cameras to trainer cameras: pinholes in pixels, OpenCV axes."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from .placement import matrix_of


def scene_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """Return the active camera object of a scene.

    Raises:
        LodgsError: The scene has no camera.
    """
    if scene.camera is None:
        raise LodgsError(
            "Cannot render: the scene has no camera.", "Add a camera, or look through one of the views."
        )
    return scene.camera


def view_of(
    obj: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
) -> tuple[Camera, float]:
    """Convert a camera object to a camera in Blender's world.

    The object's scale is ignored, as in Blender.

    Returns:
        The camera for an image of this size, and its clip start.

    Raises:
        LodgsError: The object is not a perspective camera.
    """
    camera = obj.data
    if obj.type != "CAMERA" or camera.type != "PERSP":
        kind = "not a camera" if obj.type != "CAMERA" else camera.type.lower()
        raise LodgsError(
            f"Cannot render with LODGS: '{obj.name}' is {kind}, but a perspective camera is needed.",
            "Set its lens type to Perspective.",
        )
    render = depsgraph.scene.render
    p = obj.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    return Camera(
        name=obj.name,
        width=width,
        height=height,
        fx=p[0][0] * width / 2,
        fy=p[1][1] * height / 2,
        cx=(1 - p[0][2]) * width / 2,
        cy=(1 + p[1][2]) * height / 2,
        world_to_camera=_world_to_camera(obj),
    ), camera.clip_start


def _world_to_camera(obj: bpy.types.Object) -> np.ndarray:
    """Return the (4, 4) float64 inverse of an object's pose without scale, in OpenCV axes.

    Blender's cameras look along -z with y up.
    """
    pose = np.array(obj.matrix_world, np.float64)
    axes = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
    # Blender's float32 axes are orthogonal to about 1e-7 only; make them so in float64.
    u, _, vh = np.linalg.svd(axes * (1.0, -1.0, -1.0))
    rotation = (u @ vh).T
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ pose[:3, 3]
    return matrix


def view_from(
    root: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    obj: bpy.types.Object | None = None,
) -> tuple[Camera, float]:
    """Convert a camera object to a camera in the coordinates of a splat scene's files.

    Args:
        obj: Camera object; None for the active camera of the scene.

    Returns:
        The camera and its clip start, in units of the files.

    Raises:
        LodgsError: The scene has no camera, or the root is scaled differently along its axes.
    """
    obj = obj or scene_camera(depsgraph.scene)
    camera, near = view_of(obj.evaluated_get(depsgraph), depsgraph, width, height)
    local, unit = camera.in_object_space(matrix_of(root, depsgraph))
    return local, near / unit
