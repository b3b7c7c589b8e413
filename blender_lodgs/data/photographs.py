"""Views of a splat scene: camera objects at the poses of its photos."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...training.errors import LodgsError
from ...training.lod.crop import crop_mask
from ...training.scenes import overview
from ...training.scenes.cameras import Camera
from ...training.scenes.colmap import Scene
from ...training.splats.dialects import Warn, ignore
from ..attributes import HIDDEN, read_attribute
from . import crops, metadata
from .objects import root_of
from .placement import axes_of, matrix_in_world

SENSOR = 36.0
"""Longer side of imported cameras' sensors in millimetres, as on a full-frame camera."""


class View(Protocol):
    """Size and focal lengths of a view: a ``Camera``, or the data of an imported camera object."""

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
    """Create a camera object of a view in COLMAP's world, not yet in a collection.

    Args:
        extent: extent of the scene in scene units; sets the display size of the object.
        near: depth where splats begin in training and evaluation, in scene units.
        photograph: show the view's photo behind it.
        distorted: the photo has lens distortion.
    """
    data = bpy.data.cameras.new(camera.name)
    _fit(data, camera, distorted)
    data.display_size = extent / 20
    data.clip_start, data.clip_end = near, extent * 1000
    if photograph and camera.image is not None:
        background = data.background_images.new()
        background.image = bpy.data.images.load(str(camera.image), check_existing=True)
        background.alpha = 1.0
        background.frame_method = "STRETCH"
        data.show_background_images = True
    obj = bpy.data.objects.new(camera.name, data)
    obj.matrix_basis = Matrix((np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])).tolist())
    return obj


def show_undistorted(
    context: bpy.types.Context, root: bpy.types.Object, names: Sequence[str], scene: Scene
) -> None:
    """Replace the photos of a scene's views by undistorted ones, and adjust the cameras.

    Args:
        names: names of all views of the model, in order.
        scene: undistorted scene; see ``undistort.undistort_scene``.
    """
    undistorted = {camera.name: camera for camera in scene.cameras}
    for view in views(root):
        settings = view.data.lodgs
        camera = (
            undistorted.get(names[settings.model_index]) if 0 <= settings.model_index < len(names) else None
        )
        if camera is None or not settings.distorted:
            continue
        _fit(view.data, camera, distorted=False)
        for background in view.data.background_images:
            old_image = background.image
            background.image = bpy.data.images.load(str(camera.image), check_existing=True)
            if old_image is not None and not old_image.users:
                bpy.data.images.remove(old_image)
        if context.scene.camera == view:
            match_render(context.scene, camera, context.scene.render.resolution_percentage)


def _fit(data: bpy.types.Camera, camera: Camera, distorted: bool) -> None:
    """Set lens, sensor and shift of a camera to those of a view."""
    long = max(camera.width, camera.height)
    wide = camera.width >= camera.height
    data.sensor_fit = "HORIZONTAL" if wide else "VERTICAL"
    data.sensor_width, data.sensor_height = SENSOR * camera.width / long, SENSOR * camera.height / long
    data.lens = (camera.fx if wide else camera.fy) * SENSOR / long
    # Blender's shift moves the frame, as a fraction of the fitted side, against the principal point.
    pixel = camera.fy / camera.fx
    data.shift_x = (camera.width / 2 - camera.cx) / long * (1 if wide else pixel)
    data.shift_y = (camera.cy - camera.height / 2) / long / (pixel if wide else 1)
    view = data.lodgs
    view.width, view.height, view.fx, view.fy = camera.width, camera.height, camera.fx, camera.fy
    view.photograph, view.mask = (str(file) if file else "" for file in (camera.image, camera.mask))
    view.distorted = distorted


def camera_of(view: bpy.types.Object) -> Camera:
    """Return the view of a camera object from :func:`new_camera`, to the precision of Blender's float32."""
    data, settings = view.data, view.data.lodgs
    long, wide, pixel = (
        max(settings.width, settings.height),
        settings.width >= settings.height,
        settings.fy / settings.fx,
    )
    pose = np.array(view.matrix_basis, np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return Camera(
        view.name, settings.width, settings.height, settings.fx, settings.fy,
        settings.width / 2 - data.shift_x * long / (1 if wide else pixel),
        settings.height / 2 + data.shift_y * long * (pixel if wide else 1),
        np.linalg.inv(pose),
    )  # fmt: skip


def views(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the existing camera objects of a scene, sorted by name.

    Its collection also has those of copies of the scene.
    """
    objects, axes = root.lodgs.cameras.objects if root.lodgs.cameras else (), axes_of(root)
    cameras = [obj for obj in objects if obj.type == "CAMERA"]
    own = [obj for obj in cameras if obj.parent == axes or root_of(obj) in (None, root)]
    return sorted(own, key=lambda obj: obj.name)


def views_with_photo(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the views with a photo; those of imported splat files have none."""
    return [view for view in views(root) if view.data.lodgs.photograph]


def held_out(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the held-out views of the scene's run, if recorded."""
    return [view for view in views(root) if is_held_out(root, view)]


def is_held_out(root: bpy.types.Object, view: bpy.types.Object) -> bool:
    """Return True if the scene's run held out a view; False if that is not recorded."""
    settings = view.data.lodgs
    if settings.is_property_set("held_out"):
        return settings.held_out
    match metadata.meta_of(root).get("held_out"):
        case [*rests, int(every)] if every > 0:
            return settings.model_index % every in rests
    return False


def look_through(context: bpy.types.Context, root: bpy.types.Object, step: int = 0) -> bpy.types.Object:
    """Make one of the views the active camera and set the render size.

    Args:
        step: number of views to advance by name from the active camera; 0 takes the active object if it is a
            view.

    Returns:
        The camera object.

    Raises:
        LodgsError: the scene has no cameras.
    """
    cameras = views(root)
    if not cameras:
        raise LodgsError(
            f"Cannot look through a view: '{root.name}' has no cameras.", "Import a COLMAP folder."
        )
    current = context.scene.camera
    if step == 0 and context.active_object in cameras:
        current = context.active_object
    index = cameras.index(current) if current in cameras else min(-step, 0)
    return use_view(context, cameras[(index + step) % len(cameras)])


def look_at_scene(context: bpy.types.Context, root: bpy.types.Object, warn: Warn = ignore) -> None:
    """Show a splat scene in the window's viewports and extend their clip range to its sky.

    The viewports take the pose of the photos if it is known; otherwise they keep their direction and frame
    the scene. In a file that only has the objects of Blender's startup file, they are moved to a hidden
    collection; its camera only if the scene has photos, the first of which becomes the active camera.

    Args:
        warn: function that receives a sentence for each mesh that is hidden because it blocks the view from
            the photos.
    """
    _put_startup_objects_away(context, root)
    viewpoint = photo_viewpoint(root)
    for obj in _blocking_meshes(context, *viewpoint) if viewpoint is not None else ():
        obj.hide_set(True)
        warn(f"Hid '{obj.name}', which blocks the view of the splats. Press Alt+H to show it.")
    if viewpoint is None:
        frame_scene(context, root)
        return
    position, target = viewpoint
    for region in _viewports(context, root):
        region.view_rotation = (position - target).to_track_quat("Z", "Y")
        region.view_location, region.view_distance = target, (position - target).length


def _put_startup_objects_away(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Move the objects of an unchanged startup file to a hidden collection; see :func:`look_at_scene`.

    The file may be saved: users save it first, because runs are written next to it.
    """
    names = {obj.name for obj in bpy.data.objects if root_of(obj) is None}
    if names != {"Camera", "Cube", "Light"}:
        return
    unused = [bpy.data.objects[name] for name in ("Cube", "Light", "Camera")]
    if not _is_startup_cube(unused[0]):
        return
    if photos := views(root):
        use_view(context, photos[0])
    else:
        unused.pop()
    collection = bpy.data.collections.new("Startup Objects")
    context.scene.collection.children.link(collection)
    for obj in unused:
        for previous in obj.users_collection:
            previous.objects.unlink(obj)
        collection.objects.link(obj)
    collection.hide_viewport = collection.hide_render = True


def _is_startup_cube(obj: bpy.types.Object) -> bool:
    if obj.type != "MESH" or obj.modifiers or obj.matrix_world != Matrix():
        return False
    corners = np.array([vertex.co for vertex in obj.data.vertices[:9]])
    return corners.shape == (8, 3) and bool((np.abs(corners) == 1).all())


def frame_scene(context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Frame most of a splat scene in the window's viewports without rotating them; outliers are ignored."""
    if (bounds := central_bounds(root)) is not None:
        for region in _viewports(context, root):
            region.view_location, size = bounds
            region.view_distance = 1.5 * size


def _viewports(context: bpy.types.Context, root: bpy.types.Object) -> list[bpy.types.RegionView3D]:
    """Return the window's viewports, set to free perspective and a clip range that covers a splat scene."""
    regions, reach = [], _reach(root)
    for area in context.screen.areas if context.screen is not None else ():
        if area.type == "VIEW_3D":
            space = area.spaces.active
            space.clip_end = max(space.clip_end, reach)
            space.region_3d.view_perspective = "PERSP"
            regions.append(space.region_3d)
    return regions


def _blocking_meshes(context: bpy.types.Context, position: Vector, target: Vector) -> list[bpy.types.Object]:
    """Return the visible meshes whose bounding box intersects the segment from a position to a target."""
    blocking = []
    for obj in context.view_layer.objects:
        if obj.type == "MESH" and obj.visible_get():
            to_local = obj.matrix_world.inverted_safe()
            start, end = np.array(to_local @ position), np.array(to_local @ target)
            corners, direction = np.array(obj.bound_box), end - start
            direction[direction == 0] = 1e-30
            entry, exit = np.sort(
                [(corners.min(0) - start) / direction, (corners.max(0) - start) / direction], axis=0
            )
            if max(entry.max(), 0) <= min(exit.min(), 1):
                blocking.append(obj)
    return blocking


def photo_viewpoint(root: bpy.types.Object) -> tuple[Vector, Vector] | None:
    """Return a camera position and its target, in Blender's world.

    They come from the bundle, or from the most central view and the median depth of the points. None without
    both.
    """
    meta = metadata.meta_of(root)
    if "view" in meta:
        position, target = (matrix_in_world(root) @ Vector(point) for point in meta["view"])
        return position, target
    poses, points = np.array([view.matrix_basis for view in views(root)]), _positions(root.lodgs.points)
    if not len(poses) or not len(points):
        return None
    positions = poses[:, :3, 3]
    pose = poses[np.linalg.norm(positions - positions.mean(0), axis=1).argmin()]
    position, direction = pose[:3, 3], -pose[:3, 2]
    depths = (points - position) @ direction
    depth = np.median(depths[depths > 0]) if (depths > 0).any() else 1.0
    return matrix_in_world(root) @ Vector(position), matrix_in_world(root) @ Vector(
        position + depth * direction
    )


def central_bounds(root: bpy.types.Object) -> tuple[Vector, float] | None:
    """Return center and diagonal of a box around most of a scene, in Blender's world.

    The box encloses nine tenths of the remaining finest level along each axis, or of the points, without
    far background and outliers. None if the scene has neither.
    """
    points = _central_points(root)
    if not len(points):
        return None
    points = points[:: max(len(points) // 100_000, 1)].astype(np.float64)
    low, high = np.percentile(points[overview.is_near(points)], (5, 95), axis=0)
    size = float(np.linalg.norm(high - low)) * max(matrix_in_world(root).to_scale())
    return matrix_in_world(root) @ Vector((low + high) / 2), size


def _reach(root: bpy.types.Object) -> float:
    """Return the clip distance for viewports: the extent of all splats, up to a hundred times
    :func:`central_bounds`.

    0 without splats.
    """
    bounds = central_bounds(root)
    if bounds is None:
        return 0.0
    across = float(np.linalg.norm(np.ptp(_central_points(root), axis=0))) * max(
        matrix_in_world(root).to_scale()
    )
    return min(across, 100 * bounds[1])


def _central_points(root: bpy.types.Object) -> np.ndarray:
    """Return positions (N, 3) of the finest level or of the points, in the scene's coordinates.

    Cropped and hidden splats are excluded unless none would remain.
    """
    levels = [item.object for item in root.lodgs.existing_levels]
    if not levels:
        return _positions(root.lodgs.points)
    points, hidden = _positions(levels[-1]), read_attribute(levels[-1].data, HIDDEN)
    remaining = crop_mask(crops.evaluated_crops(root, bpy.context.evaluated_depsgraph_get()), points)
    if hidden is not None:
        remaining &= ~hidden.astype(bool)
    return points[remaining] if remaining.any() else points


def _positions(obj: bpy.types.Object | None) -> np.ndarray:
    """Return the positions (N, 3) of an object's points, in its local space."""
    values = None if obj is None else read_attribute(obj.data, "position")
    return np.zeros((0, 3), np.float32) if values is None else values


def use_view(context: bpy.types.Context, view: bpy.types.Object) -> bpy.types.Object:
    """Make a view the active camera and set the render size.

    Returns:
        The view.
    """
    context.scene.camera = view
    if view.data.lodgs.width:
        match_render(context.scene, view.data.lodgs, context.scene.render.resolution_percentage)
    root = root_of(view)
    if root is not None and root.lodgs.cameras is not None:
        row = root.lodgs.cameras.objects.find(view.name)
        if row >= 0 and row != root.lodgs.active_view:  # keep the list of views in sync
            root.lodgs.active_view = row
    return view


def match_render(scene: bpy.types.Scene, view: View, percentage: int = 100) -> None:
    """Set the render size and pixel aspect to those of a view."""
    render = scene.render
    render.resolution_x, render.resolution_y = view.width, view.height
    render.resolution_percentage = percentage
    render.pixel_aspect_x = max(1.0, view.fy / view.fx)
    render.pixel_aspect_y = max(1.0, view.fx / view.fy)
