"""Conversion of Blender cameras to trainer cameras: pinholes in pixels, OpenCV axes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...training.errors import LodgsError
from ...training.render.lens import (
    EQUIRECTANGULAR,
    MAX_ANGLE,
    ORTHOGRAPHIC,
    SHARP,
    Aperture,
    LensProjection,
)
from ...training.runs.job import MIN_VIEWS
from ...training.scenes.cameras import Camera
from .objects import root_of
from .placement import matrix_of, require_finite, world_matrix

ORTHOGONAL = 1e-5
"""Maximum stretch of a camera's axes without scale that counts as rounding: 0.01 pixels of 1,000."""


class UnsupportedCameraError(LodgsError):
    """A camera that LODGS cannot use."""


def scene_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """Return the active camera object of a scene.

    Raises:
        LodgsError: the scene has no camera, or another object as its camera.
    """
    remedy = "Add a camera, or look through one of the views."
    if scene.camera is None:
        raise LodgsError("Cannot render: the scene has no camera.", remedy)
    if scene.camera.type != "CAMERA":
        raise LodgsError(f"Cannot render: the scene's camera '{scene.camera.name}' is not a camera.", remedy)
    return scene.camera


def enabled_cameras(scene: bpy.types.Scene, root: bpy.types.Object | None = None) -> list[bpy.types.Object]:
    """Return the cameras of a scene that are enabled in renders, in the order of their names.

    Args:
        root: root of a splat scene, to exclude cameras of other ones.
    """
    cameras = [
        obj
        for obj in scene.objects
        if obj.type == "CAMERA" and not obj.hide_render and (root is None or root_of(obj) in (None, root))
    ]
    rendered = {obj for layer in scene.view_layers for obj in _rendered_objects(layer.layer_collection)}
    return sorted(rendered.intersection(cameras), key=lambda obj: obj.name)


def _rendered_objects(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.Object]:
    """Yield the objects of a collection and those below it, without disabled and excluded collections."""
    if not layer.collection.hide_render:
        yield from () if layer.exclude else layer.collection.objects
        for child in layer.children:
            yield from _rendered_objects(child)


@dataclass(frozen=True)
class RenderView:
    """A camera object in one image of a render. Stereo renders have one for each eye.

    Attributes:
        obj: evaluated camera object.
        matrix: matrix from the camera to Blender's world. Its scale is ignored, as in Blender.
        shift_x: horizontal shift of the lens.
    """

    obj: bpy.types.Object
    matrix: Matrix
    shift_x: float

    @classmethod
    def of(cls, obj: bpy.types.Object) -> RenderView:
        """Return the view of an evaluated camera object."""
        return cls(obj, world_matrix(obj), obj.data.shift_x)

    @property
    def world_to_camera(self) -> Matrix:
        """The inverse of the matrix with normalised columns, as Cycles and viewports use it.

        Raises:
            UnsupportedCameraError: the camera has no size.
        """
        _require_size(self.obj, np.array(self.matrix, np.float64))
        return self.matrix.normalized().inverted()

    def projection(self, depsgraph: bpy.types.Depsgraph, width: int, height: int) -> Matrix:
        """Return the matrix from the camera to clip space for an image of this size."""
        render, camera = depsgraph.scene.render, self.obj.data
        projection = self.obj.calc_matrix_camera(
            depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
        )
        shift = (self.shift_x - camera.shift_x) * projection[0][0]
        if camera.type == "PERSP":
            sensor = camera.sensor_height if camera.sensor_fit == "VERTICAL" else camera.sensor_width
            projection[0][2] += shift * sensor / camera.lens
        elif camera.type == "ORTHO":
            projection[0][3] -= shift * camera.ortho_scale
        return projection

    def pinhole(
        self, depsgraph: bpy.types.Depsgraph, width: int, height: int
    ) -> tuple[Camera, np.ndarray | None]:
        """Convert the view to a camera in Blender's world for an image of this size.

        Returns:
            The camera, and the (4, 4) float64 transform of the world under which the camera shows this view:
            a shear or a mirroring, if the scale of parents or of the camera has this effect. None otherwise.

        Raises:
            UnsupportedCameraError: the object is not a perspective camera, or has no size.
        """
        _require_perspective(self.obj)
        camera, deformation, _ = self.lens_camera(depsgraph, width, height)
        return camera, deformation

    def lens_camera(
        self, depsgraph: bpy.types.Depsgraph, width: int, height: int
    ) -> tuple[Camera, np.ndarray | None, LensProjection]:
        """Convert the view to a camera and a projection, and the transform of :meth:`pinhole`.

        Raises:
            UnsupportedCameraError: the object is no camera, has no size, or has another lens.
        """
        if problem := unsupported_lens(self.obj):
            raise UnsupportedCameraError(
                f"Cannot render with LODGS: '{self.obj.name}' is {problem}.",
                "Set its lens type to Perspective, Orthographic, or Panoramic with the type Equirectangular.",
            )
        world_to_camera, deformation = _split_pose(self.obj, np.array(self.matrix, np.float64))
        data, side, projection = self.obj.data, float(max(width, height)), SHARP
        fx, fy, cx, cy = side, side, width / 2, height / 2
        if data.type == "PANO":
            longitude, latitude = (
                (data.longitude_min, data.longitude_max),
                (data.latitude_min, data.latitude_max),
            )
            projection = LensProjection(EQUIRECTANGULAR, longitude=longitude, latitude=latitude)
        else:
            p = self.projection(depsgraph, width, height)
            fx, fy = p[0][0] * width / 2, p[1][1] * height / 2
            column, sign = (3, 1) if data.type == "ORTHO" else (2, -1)
            cx, cy = (1 + sign * p[0][column]) * width / 2, (1 - sign * p[1][column]) * height / 2
            if data.type == "ORTHO":  # pixels per world unit, times the distance
                projection = LensProjection(ORTHOGRAPHIC, distance=side / fx)
                fx, fy = side, fy * side / fx
        return Camera(self.obj.name, width, height, fx, fy, cx, cy, world_to_camera), deformation, projection


def unsupported_lens(obj: bpy.types.Object) -> str:
    """Return the lens of a camera object that LODGS cannot render, as a noun or an adjective, or ""."""
    if obj.type != "CAMERA":
        return "not a camera"
    if obj.data.type == "PANO" and obj.data.panorama_type != "EQUIRECTANGULAR":
        return f"a panoramic camera of the type {obj.data.panorama_type.replace('_', ' ').title()}"
    if obj.data.type == "PANO" and not (
        -MAX_ANGLE <= obj.data.longitude_min < obj.data.longitude_max <= MAX_ANGLE
        and obj.data.latitude_min < obj.data.latitude_max
    ):
        return "a panoramic camera with an empty, inverted or too large range of angles"
    return "" if obj.data.type in ("PERSP", "ORTHO", "PANO") else f"a {obj.data.type.lower()} camera"


def aperture_of(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Aperture | None:
    """Return the aperture of an evaluated camera object as Cycles uses it, or None without depth of field.

    The aperture of an orthographic camera has a diameter of 1/f-stop units. Panoramas have none.
    """
    data, dof = obj.data, obj.data.dof
    if not dof.use_dof or data.type == "PANO":
        return None
    diameter = (1.0 if data.type == "ORTHO" else data.lens / 1000) / max(dof.aperture_fstop, 1e-5)
    focus = dof.focus_distance
    if dof.focus_object is not None:
        matrix = obj.matrix_world.normalized()
        axis = matrix.to_3x3() @ Vector((0, 0, 1))
        target = dof.focus_object.evaluated_get(depsgraph).matrix_world
        bone = dof.focus_object.pose and dof.focus_object.pose.bones.get(dof.focus_subtarget)
        position = (target @ bone.matrix if bone else target).translation
        focus = abs(axis.dot(matrix.translation - position))
    return Aperture(
        diameter / 2, max(focus, 1e-5), dof.aperture_blades, dof.aperture_rotation, dof.aperture_ratio
    )


def require_flat_stereo(scene: bpy.types.Scene, obj: bpy.types.Object) -> None:
    """Raise UnsupportedCameraError if each direction of a camera's image has eyes of its own."""
    is_stereo = scene.render.use_multiview and scene.render.views_format == "STEREO_3D"
    if is_stereo and obj.data.type != "ORTHO" and obj.data.stereo.use_spherical_stereo:
        raise UnsupportedCameraError(
            f"Cannot render with LODGS: camera '{obj.name}' has Spherical Stereo.",
            "Clear Spherical Stereo in its settings (Stereoscopy).",
        )


def _require_perspective(obj: bpy.types.Object) -> None:
    """Raise UnsupportedCameraError if an object is not a perspective camera."""
    if obj.type != "CAMERA" or obj.data.type != "PERSP":
        kind = "not a camera" if obj.type != "CAMERA" else obj.data.type.lower()
        raise UnsupportedCameraError(
            f"Cannot render with LODGS: '{obj.name}' is {kind}, but a perspective camera is needed.",
            "Set its lens type to Perspective.",
        )


def view_of(
    obj: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
) -> tuple[Camera, float]:
    """Convert an evaluated camera object to a camera in Blender's world.

    The object's scale is ignored, as in Blender.

    Returns:
        The camera for an image of this size, and its clip start.

    Raises:
        UnsupportedCameraError: the object is no perspective camera, has no size, or is sheared or mirrored.
    """
    camera, deformation = RenderView.of(obj).pinhole(depsgraph, width, height)
    if deformation is not None:
        effect = "mirrors" if np.linalg.det(deformation[:3, :3]) < 0 else "shears"
        raise UnsupportedCameraError(
            f"Cannot use camera '{obj.name}': its scale or that of a parent {effect} its image.",
            "Apply the scale of the camera and its parents (Object > Apply > Scale).",
        )
    return camera, obj.data.clip_start


def _require_size(obj: bpy.types.Object, matrix: np.ndarray) -> None:
    """Raise LodgsError if a camera's matrix (4, 4) is not finite or its axes are in one plane."""
    require_finite(obj, matrix)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if lengths.min() == 0 or np.linalg.cond(matrix[:3, :3] / lengths) > 1e5:
        raise UnsupportedCameraError(
            f"Cannot render with LODGS: the scale of camera '{obj.name}' or of a parent is 0.",
            "Give them a scale above 0 along all axes.",
        )


def _split_pose(obj: bpy.types.Object, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Split the matrix (4, 4) of a camera, without scale, into a rigid pose and a deformation.

    Blender's cameras look along -z with y up.

    Returns:
        (4, 4) float64 ``world_to_camera``, OpenCV axes, and the transform of :meth:`RenderView.pinhole`.
    """
    _require_size(obj, matrix)
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    axes *= 1.0, -1.0, -1.0
    # Blender's float32 axes are orthogonal to about 1e-7 only; make them so in float64.
    u, scales, vh = np.linalg.svd(axes)
    rotation = (u @ vh).T
    is_mirrored = np.linalg.det(rotation) < 0
    if is_mirrored:
        rotation[0] *= -1
    pose = _to_origin(rotation, matrix[:3, 3])
    if not is_mirrored and np.abs(scales - 1).max() < ORTHOGONAL:
        return pose, None
    return pose, np.linalg.inv(pose) @ _to_origin(np.linalg.inv(axes), matrix[:3, 3])


def _to_origin(linear: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the (4, 4) matrix that maps a position to the origin with a linear part (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = -linear @ position
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
        obj: camera object; None for the active camera of the scene.

    Returns:
        The camera and its clip start, in units of the files.

    Raises:
        LodgsError: the scene has no camera, or the root is scaled differently along its axes.
    """
    obj = obj or scene_camera(depsgraph.scene)
    camera, near = view_of(obj.evaluated_get(depsgraph), depsgraph, width, height)
    local, unit = camera.in_object_space(matrix_of(root, depsgraph))
    return local, near / unit


def supported_views(
    shots: Iterable[bpy.types.Object | int],
    view_of_shot: Callable[[Any], tuple[Camera, float]],
    warn: Callable[[str], object],
) -> list[tuple[Any, tuple[Camera, float]]]:
    """Return the shots with supported cameras and their views, and warn of other shots.

    Args:
        shots: camera objects, or frames of the scene's camera.
        view_of_shot: function that returns the view and the clip start of a shot.
        warn: function called with one sentence for each camera that is left out.

    Raises:
        UnsupportedCameraError: fewer than two views remain.
    """
    views, problems = [], {}
    for shot in shots:
        try:
            views.append((shot, view_of_shot(shot)))
        except UnsupportedCameraError as error:
            problems.setdefault(str(error), (error, []))[1].append(shot)
    for error, skipped in problems.values():
        if len(views) < MIN_VIEWS:
            raise error
        frames = ", ".join(str(shot) for shot in skipped if isinstance(shot, int))
        warn(f"{error.what} {f'Frames {frames} are' if frames else 'It is'} left out. {error.remedy}")
    return views


def views_of_cameras(
    context: bpy.types.Context,
    cameras: Iterable[bpy.types.Object],
    view_in: Callable[[bpy.types.Depsgraph, bpy.types.Object], tuple[Camera, float]],
    warn: Callable[[str], object],
) -> list[tuple[Any, tuple[Camera, float]]]:
    """Return :func:`supported_views` of camera objects, also of cameras that are hidden in viewports.

    Args:
        view_in: function that returns the view and the clip start of a camera in an evaluated depsgraph.
    """
    scene, active = context.scene, context.scene.camera

    def view_of_camera(camera: bpy.types.Object) -> tuple[Camera, float]:
        if not camera.visible_get():
            scene.camera = camera  # the only hidden camera that Blender evaluates
        return view_in(context.evaluated_depsgraph_get(), camera)

    try:
        return supported_views(cameras, view_of_camera, warn)
    finally:
        scene.camera = active
