"""The photographs of a COLMAP scene in Blender: camera objects that stand where they were taken."""

from __future__ import annotations

from typing import Protocol

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from . import selection

SENSOR = 36.0
"""Longer side of every imported camera's sensor in millimetres: lenses read as on a full-frame camera."""


class View(Protocol):
    """What the render takes over of a view: of a ``Camera``, or of the data of an imported camera object."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...


def new_camera(
    camera: Camera, extent: float, near: float, *, photograph: bool, distorted: bool = False
) -> bpy.types.Object:
    """A view as a camera object that is in no collection yet, placed in COLMAP's world.

    Args:
        extent: the scene's, in its own units; sizes the object's display.
        near: depth from which on splats are trained and measured, in the same units.
        photograph: show the view's photograph behind it.
        distorted: the lens bends lines in the photograph.
    """
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
    view.distorted = distorted
    data.display_size = extent / 20
    data.clip_start, data.clip_end = near, extent * 1000
    if photograph and camera.image is not None:
        picture = data.background_images.new()
        picture.image = bpy.data.images.load(str(camera.image), check_existing=True)
        picture.alpha = 1.0
        picture.frame_method = "STRETCH"
        data.show_background_images = True
    obj = bpy.data.objects.new(camera.name, data)
    obj.matrix_basis = Matrix((np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])).tolist())
    return obj


def views(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The camera objects of a COLMAP scene that are still there, by name."""
    cameras = root.lodgs.cameras
    found = [obj for obj in cameras.objects if obj.type == "CAMERA"] if cameras else []
    return sorted(found, key=lambda obj: obj.name)


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
    cameras = views(root)
    if not cameras:
        raise LodgsError(f"'{root.name}' has no cameras.", "Import a COLMAP folder.")
    current = context.scene.camera
    if step == 0 and context.active_object in cameras:
        current = context.active_object
    index = cameras.index(current) if current in cameras else min(-step, 0)
    return through(context, cameras[(index + step) % len(cameras)])


def look_as_photographed(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Turns the window's viewports to where the splats of a bundle were photographed from, to orbit there.

    A file that does not say so leaves them as they are.
    """
    meta = selection.read_json(root.lodgs.meta)
    if context.screen is None or "view" not in meta:
        return
    eye, target = (root.matrix_basis @ Vector(place) for place in meta["view"])
    for area in context.screen.areas:
        if area.type == "VIEW_3D":
            looks = area.spaces.active.region_3d
            looks.view_perspective = "PERSP"
            looks.view_rotation = (eye - target).to_track_quat("Z", "Y")
            looks.view_location, looks.view_distance = target, (eye - target).length


def through(context: bpy.types.Context, view: bpy.types.Object) -> bpy.types.Object:
    """Makes a view the scene's camera, and gives the render its size. Returns the view."""
    context.scene.camera = view
    if view.data.lodgs.width:
        match_render(context.scene, view.data.lodgs)
    root = view.parent
    if root is not None and root.lodgs.cameras is not None:
        line = root.lodgs.cameras.objects.find(view.name)
        if line >= 0 and line != root.lodgs.active_view:  # the list of views goes along
            root.lodgs.active_view = line
    return view


def match_render(scene: bpy.types.Scene, view: View) -> None:
    """Gives the render the size and the pixel shape of a view."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = view.width, view.height, 100
    render.pixel_aspect_x = max(1.0, view.fy / view.fx)
    render.pixel_aspect_y = max(1.0, view.fx / view.fy)
