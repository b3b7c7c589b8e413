"""The views of a splat scene in Blender: camera objects that stand where its photographs were taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...training.errors import LodgsError
from ...training.lod.crop import crop_mask
from ...training.scenes.cameras import Camera
from ...training.scenes.colmap import Scene
from ...training.splats.dialects import Warn, ignore
from ..attributes import HIDDEN, read_attribute
from . import crops, selection
from .objects import root_of
from .placement import in_parent

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
    _fit(data, camera, distorted)
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


def show_undistorted(
    context: bpy.types.Context, root: bpy.types.Object, names: Sequence[str], scene: Scene
) -> None:
    """Gives a scene's views the photographs without their lens's distortion, and cameras that fit these.

    Args:
        names: of all views of the model, in order.
        scene: see ``undistort.undistorted``.
    """
    found = {camera.name: camera for camera in scene.cameras}
    for view in views(root):
        facts = view.data.lodgs
        camera = found.get(names[facts.place]) if 0 <= facts.place < len(names) else None
        if camera is None or not facts.distorted:
            continue
        _fit(view.data, camera, distorted=False)
        for picture in view.data.background_images:
            before = picture.image
            picture.image = bpy.data.images.load(str(camera.image), check_existing=True)
            if before is not None and not before.users:
                bpy.data.images.remove(before)
        if context.scene.camera == view:
            match_render(context.scene, camera, context.scene.render.resolution_percentage)


def _fit(data: bpy.types.Camera, camera: Camera, distorted: bool) -> None:
    """Has a camera see what a view's photograph shows."""
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
    view.photograph, view.mask = (str(file) if file else "" for file in (camera.image, camera.mask))
    view.distorted = distorted


def camera_of(view: bpy.types.Object) -> Camera:
    """The view that :func:`new_camera` has made a camera object of, as far as Blender's float32 hold it."""
    data, own = view.data, view.data.lodgs
    long, wide, pixel = max(own.width, own.height), own.width >= own.height, own.fy / own.fx
    pose = np.array(view.matrix_basis, np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return Camera(
        view.name, own.width, own.height, own.fx, own.fy,
        own.width / 2 - data.shift_x * long / (1 if wide else pixel),
        own.height / 2 + data.shift_y * long * (pixel if wide else 1),
        np.linalg.inv(pose),
    )  # fmt: skip


def views(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The camera objects of a scene that are still there, by name."""
    cameras = root.lodgs.cameras
    found = [obj for obj in cameras.objects if obj.type == "CAMERA"] if cameras else []
    return sorted(found, key=lambda obj: obj.name)


def photographed(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The views that have a photograph: those of an imported file of splats have none."""
    return [view for view in views(root) if view.data.lodgs.photograph]


def held_out(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The views that the run of the scene's levels did not train on, as far as it says so."""
    return [view for view in views(root) if is_held_out(root, view)]


def is_held_out(root: bpy.types.Object, view: bpy.types.Object) -> bool:
    """Whether the run of the scene's levels did not train on a view; False where it does not say so."""
    facts = view.data.lodgs
    if facts.is_property_set("held_out"):
        return facts.held_out
    match selection.read_json(root.lodgs.meta).get("held_out"):
        case [*rests, int(every)] if every > 0:
            return facts.place % every in rests
    return False


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


def look_at_scene(context: bpy.types.Context, root: bpy.types.Object, warn: Warn = ignore) -> None:
    """Turns the window's viewports to a splat scene, to orbit there: as it was photographed, where that is
    known, else from where they look already, with most of it in sight. They see as far as its sky.

    Args:
        warn: told of meshes that stand between where it was photographed from and what was seen there, such
            as a new file's cube: they are hidden, or there would be nothing else to see.
    """
    photographed = photographed_from(root)
    for obj in _in_the_way(context, *photographed) if photographed is not None else ():
        obj.hide_set(True)
        warn(f"'{obj.name}' stands before the cameras and is hidden; Alt+H shows it.")
    if photographed is None:
        frame(context, root)
        return
    eye, target = photographed
    for looks in _viewports(context, root):
        looks.view_rotation = (eye - target).to_track_quat("Z", "Y")
        looks.view_location, looks.view_distance = target, (eye - target).length


def frame(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Has most of what is left of a splat scene in sight of the window's viewports, from the side that they
    look from: far outliers do not count."""
    if (bounds := bounds_of_most(root)) is not None:
        for looks in _viewports(context, root):
            looks.view_location, size = bounds
            looks.view_distance = 1.5 * size


def _viewports(context: bpy.types.Context, root: bpy.types.Object) -> list[bpy.types.RegionView3D]:
    """The window's viewports, out of cameras, and with all of a splat scene before their far end."""
    found, reach = [], _reach(root)
    for area in context.screen.areas if context.screen is not None else ():
        if area.type == "VIEW_3D":
            space = area.spaces.active
            space.clip_end = max(space.clip_end, reach)
            space.region_3d.view_perspective = "PERSP"
            found.append(space.region_3d)
    return found


def _in_the_way(context: bpy.types.Context, eye: Vector, target: Vector) -> list[bpy.types.Object]:
    """The meshes that can be seen, through whose box the way from an eye to a target leads."""
    found = []
    for obj in context.view_layer.objects:
        if obj.type == "MESH" and obj.visible_get():
            to_local = obj.matrix_world.inverted_safe()
            begin, end = np.array(to_local @ eye), np.array(to_local @ target)
            corners, way = np.array(obj.bound_box), end - begin
            way[way == 0] = 1e-30
            enters, leaves = np.sort([(corners.min(0) - begin) / way, (corners.max(0) - begin) / way], axis=0)
            if max(enters.max(), 0) <= min(leaves.min(), 1):
                found.append(obj)
    return found


def photographed_from(root: bpy.types.Object) -> tuple[Vector, Vector] | None:
    """An eye and what it looks at, in the root's parent: what a bundle records, or else of the view in the
    middle of all views, at the median depth of the points. None where neither is there."""
    meta = selection.read_json(root.lodgs.meta)
    if "view" in meta:
        eye, target = (in_parent(root) @ Vector(place) for place in meta["view"])
        return eye, target
    poses, places = np.array([view.matrix_basis for view in views(root)]), _positions(root.lodgs.points)
    if not len(poses) or not len(places):
        return None
    eyes = poses[:, :3, 3]
    pose = poses[np.linalg.norm(eyes - eyes.mean(0), axis=1).argmin()]
    eye, ahead = pose[:3, 3], -pose[:3, 2]
    depths = (places - eye) @ ahead
    depth = np.median(depths[depths > 0]) if (depths > 0).any() else 1.0
    return in_parent(root) @ Vector(eye), in_parent(root) @ Vector(eye + depth * ahead)


def bounds_of_most(root: bpy.types.Object) -> tuple[Vector, float] | None:
    """Middle and diagonal, in the root's parent, of a box around nine tenths of what is left of the finest
    level along each axis, or of the points without splats: far outliers, which both always have, are not
    in it. None without either."""
    places = _most_places(root)
    if not len(places):
        return None
    low, high = np.percentile(places, (5, 95), axis=0)
    size = float(np.linalg.norm(high - low)) * max(in_parent(root).to_scale())
    return in_parent(root) @ Vector((low + high) / 2), size


def _reach(root: bpy.types.Object) -> float:
    """How far a viewport has to see: across all splats of the finest level, or a hundred times most of them
    where some are lost in space; 0 without splats."""
    bounds = bounds_of_most(root)
    if bounds is None:
        return 0.0
    across = float(np.linalg.norm(np.ptp(_most_places(root), axis=0))) * max(in_parent(root).to_scale())
    return min(across, 100 * bounds[1])


def _most_places(root: bpy.types.Object) -> np.ndarray:
    """(N, 3) places of the finest level, or without levels of the points, in the scene's own space; those
    that crops and hiding leave, if they leave some."""
    levels = [item.object for item in root.lodgs.levels if item.exists]
    if not levels:
        return _positions(root.lodgs.points)
    places, hidden = _positions(levels[-1]), read_attribute(levels[-1].data, HIDDEN)
    left = crop_mask(crops.as_objects_stand(root, bpy.context.evaluated_depsgraph_get()), places)
    if hidden is not None:
        left &= ~hidden.astype(bool)
    return places[left] if left.any() else places


def _positions(obj: bpy.types.Object | None) -> np.ndarray:
    """(N, 3) places of an object's points, in its own space."""
    found = None if obj is None else read_attribute(obj.data, "position")
    return np.zeros((0, 3), np.float32) if found is None else found


def through(context: bpy.types.Context, view: bpy.types.Object) -> bpy.types.Object:
    """Makes a view the scene's camera, and gives the render its size. Returns the view."""
    context.scene.camera = view
    if view.data.lodgs.width:
        match_render(context.scene, view.data.lodgs, context.scene.render.resolution_percentage)
    root = root_of(view)
    if root is not None and root.lodgs.cameras is not None:
        line = root.lodgs.cameras.objects.find(view.name)
        if line >= 0 and line != root.lodgs.active_view:  # the list of views goes along
            root.lodgs.active_view = line
    return view


def match_render(scene: bpy.types.Scene, view: View, percentage: int = 100) -> None:
    """Gives the render the size and the pixel shape of a view."""
    render = scene.render
    render.resolution_x, render.resolution_y = view.width, view.height
    render.resolution_percentage = percentage
    render.pixel_aspect_x = max(1.0, view.fy / view.fx)
    render.pixel_aspect_y = max(1.0, view.fx / view.fy)
