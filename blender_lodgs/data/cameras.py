"""Blender's cameras as the trainer sees them: pinholes in pixels, OpenCV axes."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from .placement import matrix_of


def scene_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """The camera object that a scene is rendered through.

    Raises:
        LodgsError: there is none.
    """
    if scene.camera is None:
        raise LodgsError("The scene has no camera.", "Add one, or look through one of the views.")
    return scene.camera


def view_of(
    obj: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
) -> tuple[Camera, float]:
    """What a camera object sees in a render of this size, and the depth at which it begins to see.

    Blender ignores a camera's scale, and so does this. The world is Blender's.

    Raises:
        LodgsError: the camera is no perspective one.
    """
    camera = obj.data
    if obj.type != "CAMERA" or camera.type != "PERSP":
        kind = "no camera" if obj.type != "CAMERA" else f"{camera.type.lower()}"
        raise LodgsError(
            f"LODGS renders through perspective cameras, and '{obj.name}' is {kind}.",
            "Change its lens type to Perspective.",
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
    """(4, 4) float64 of an object's pose without its scale; Blender's cameras look along -z with y up."""
    pose = np.array(obj.matrix_world, np.float64)
    axes = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
    # orthogonal to the last bit of float64, where Blender's float32 are so to about 1e-7
    left, _, right = np.linalg.svd(axes * (1.0, -1.0, -1.0))
    rotation = (left @ right).T
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, -rotation @ pose[:3, 3]
    return found


def view_from(
    root: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    obj: bpy.types.Object | None = None,
) -> tuple[Camera, float]:
    """What a camera sees, in the coordinates of a splat scene, which are those of its files.

    Args:
        obj: a camera; None for the one that the scene is rendered through.

    Raises:
        LodgsError: there is no camera to render through, or the root is stretched.
    """
    obj = obj or scene_camera(depsgraph.scene)
    camera, near = view_of(obj.evaluated_get(depsgraph), depsgraph, width, height)
    inside, unit = camera.in_object_space(matrix_of(root, depsgraph))
    return inside, near / unit
