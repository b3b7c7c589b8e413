"""Pinhole cameras in OpenCV axes (x right, y down, z forward). numpy only."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..documents import read_json
from ..errors import LodgsError
from ..files import atomic_write

MAX_SIDE = 32768
"""Maximum width and height of a rendered image, in pixels."""
MAX_PIXELS = 1 << 27
"""Maximum number of pixels of a rendered image or tile; a 16k frame has fewer."""
MAX_COORDINATE = 1e12
"""Maximum absolute coordinate in any unit: float32 can hold the squares of such lengths."""
_ROUNDING = 1e-6
"""Pixels that a product of floats may lack to a whole number."""
_FOCAL_RANGE = 1e-3, 1e6
"""Minimum and maximum focal length, as a multiple of the longer image side."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera of one view.

    Attributes:
        name: image path relative to the scene's image folder, with forward slashes.
        width: image width in pixels.
        height: image height in pixels.
        fx: horizontal focal length in pixels.
        fy: vertical focal length in pixels.
        cx: principal point in pixels, from the left; pixel centres lie at +0.5, as in COLMAP.
        cy: principal point in pixels, from the top.
        world_to_camera: (4, 4) float64 rigid transform, OpenCV axes, COLMAP world.
        image: path of the photo, or None.
        mask: path of a mask with the photo's aspect ratio, black in ignored areas, or None.
        depth: path of a depth map with the photo's aspect ratio, see ``depths.read_depth_map``, or None.
        turns: clockwise quarter turns that make the photo upright, see ``images.quarter_turns``.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    image: Path | None = None
    mask: Path | None = None
    depth: Path | None = None
    turns: int = 0

    @property
    def center(self) -> np.ndarray:
        """Camera position in world coordinates, (3,) float64."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    @property
    def flaw(self) -> str:
        """Reason why the camera is invalid, as a clause without a period; "" for a valid camera."""
        pose = self.world_to_camera
        side = max(self.width, self.height)
        if not (np.isfinite(pose).all() and np.abs(pose).max() <= MAX_COORDINATE):
            return f"its pose has a number above the limit of {MAX_COORDINATE:g}"
        rotation = pose[:3, :3]
        orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        if not orthonormal or np.linalg.det(rotation) <= 0 or not np.allclose(pose[3], (0, 0, 0, 1)):
            return "its pose is not a rotation and translation"
        shortest, longest = (factor * side for factor in _FOCAL_RANGE)
        if not (shortest <= self.fx <= longest and shortest <= self.fy <= longest):
            return f"its focal length of {self.fx:g}, {self.fy:g} pixels is impossible for an image of {side}"
        if not (abs(self.cx) <= longest and abs(self.cy) <= longest):
            return f"its principal point at {self.cx:g}, {self.cy:g} is impossible for an image of {side}"
        return ""

    @property
    def focal(self) -> float:
        """Shorter focal length in pixels, used to select levels of detail."""
        return float(min(self.fx, self.fy))

    def view_space(self, points: np.ndarray) -> np.ndarray:
        """Transform world points (P, 3) to camera axes, (P, 3) float64."""
        return points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (P, 3) onto the image with COLMAP's PINHOLE model.

        Returns:
            Pixels (P, 2) float64, x right and y down from the image's corner, undefined for depths <= 0; and
            depths (P,) along the camera's z axis, in world units.
        """
        x, y, z = self.view_space(points).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=1), z

    def unproject(self, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """Return the world points (P, 3) at pixels (P, 2) and depths (P,) > 0. Inverse of :meth:`project`."""
        rays = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        local = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
        return (local - self.world_to_camera[:3, 3]) @ self.world_to_camera[:3, :3]

    def sees(self, points: np.ndarray, near: float = 0.0, margin: float = 0.0) -> np.ndarray:
        """Return a mask (P,) of the world points (P, 3) that project into the image.

        Args:
            near: minimum depth in world units, exclusive.
            margin: enlarge the image by this fraction of its size on each side.
        """
        (u, v), depth = (columns.T for columns in self.project(points))
        margin_x, margin_y = margin * self.width, margin * self.height
        inside = (
            (u >= -margin_x) & (u < self.width + margin_x) & (v >= -margin_y) & (v < self.height + margin_y)
        )
        return inside & (depth > near)

    def moved(self, offset: np.ndarray) -> Camera:
        """Return the camera in a world whose coordinates are larger by an offset (3,) float64."""
        if not np.any(offset):
            return self
        pose = self.world_to_camera.copy()
        left, _, right = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right  # a rotation in float32 would move a far camera by its rounding
        pose[:3, 3] -= pose[:3, :3] @ offset
        return replace(self, world_to_camera=pose)

    def resized(self, width: int, height: int) -> Camera:
        """Return the view at another resolution, with scaled intrinsics."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height,
            fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy,
        )  # fmt: skip

    def turned(self, turns: int) -> Camera:
        """Return an upright view in the axes of its stored photo, 1 to 3 clockwise turns from upright."""
        axes = np.eye(4)
        if turns == 2:
            axes[:2, :2] *= -1
            pose = axes @ self.world_to_camera
            return replace(self, cx=self.width - self.cx, cy=self.height - self.cy, world_to_camera=pose)
        axes[:2, :2] = ((0, 1), (-1, 0)) if turns == 1 else ((0, -1), (1, 0))
        cx, cy = (self.cy, self.width - self.cx) if turns == 1 else (self.height - self.cy, self.cx)
        return replace(
            self, width=self.height, height=self.width, fx=self.fy, fy=self.fx, cx=cx, cy=cy,
            world_to_camera=axes @ self.world_to_camera,
        )  # fmt: skip

    def scaled(self, share: float) -> Camera:
        """Return the view with image sides multiplied by ``share`` and rounded down to whole pixels."""
        width, height = (int(side * share + _ROUNDING) for side in (self.width, self.height))
        return self.resized(max(width, 1), max(height, 1))

    def widened(self, share: float) -> Camera:
        """Return the camera with an image enlarged on each side by a fraction of its size."""
        margin_x, margin_y = round(share * self.width), round(share * self.height)
        return replace(
            self, width=self.width + 2 * margin_x, height=self.height + 2 * margin_y,
            cx=self.cx + margin_x, cy=self.cy + margin_y, image=None, mask=None, depth=None,
        )  # fmt: skip

    def in_object_space(self, matrix: np.ndarray) -> tuple[Camera, float]:
        """Return the camera in an object's coordinates; the image stays the same.

        Args:
            matrix: (4, 4) object-to-world transform: rotation, uniform positive scale, translation.

        Returns:
            The camera, and the number of world units per object unit.
        """
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        pose = self.world_to_camera @ matrix
        pose[:3] /= scale
        return replace(self, world_to_camera=pose), scale


def look_at(
    position: np.ndarray, target: np.ndarray, up: np.ndarray | tuple[float, float, float]
) -> np.ndarray:
    """Return world_to_camera (4, 4), OpenCV axes, of a camera at a position (3,) that looks at a target (3,).

    Args:
        up: (3,) world direction that is up in the image. If the camera looks along it, the roll is arbitrary.
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


T = TypeVar("T")


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Return 1.1 x the largest distance of a camera from the mean camera position, as 3DGS does.

    The result is 0 if all cameras share one position.
    """
    centers = np.array([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def pick_evenly(items: Sequence[T], limit: int) -> list[T]:
    """Return at most ``limit`` evenly spaced items, including the first and the last."""
    indices = np.linspace(0, len(items) - 1, min(limit, len(items)))
    return [items[index] for index in indices.round().astype(int)]


def write_camera(path: Path, camera: Camera, near: float) -> None:
    """Write a camera and its near depth as JSON.

    Camera files have the coordinates of the original scene: add the splats' local origin (``Camera.moved``).

    Raises:
        LodgsError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(camera_to_dict(camera, near), indent=1) + "\n", encoding="utf-8")


def camera_to_dict(camera: Camera, near: float) -> dict:
    """Return a camera as JSON values. :func:`camera_from_dict` restores it bit by bit."""
    names = ("name", "width", "height", "fx", "fy", "cx", "cy")
    values = {name: getattr(camera, name) for name in names}
    return {**values, "world_to_camera": camera.world_to_camera.tolist(), "near": near}


def read_camera(path: Path) -> tuple[Camera, float]:
    """Read a camera file with the keys of :func:`camera_to_dict`.

    Returns:
        The camera and its near depth.

    Raises:
        LodgsError: the file cannot be read or contains no valid camera.
    """
    values = read_json(path, f"The camera {path}")
    try:
        return camera_from_dict(values)
    except LodgsError as error:
        reason = error.what[:1].lower() + error.what[1:]
        raise LodgsError(f"Cannot read camera {path}: {reason}", error.remedy) from error


def read_camera_folder(folder: Path) -> tuple[list[Camera], float]:
    """Read the camera files (*.json) of a folder.

    Returns:
        The cameras, sorted and named by file name, and their smallest near depth.

    Raises:
        LodgsError: the folder has fewer than two files, or a file cannot be read.
    """
    files = sorted(folder.glob("*.json"))
    if len(files) < 2:
        raise LodgsError(
            f"Cannot read cameras from {folder}: found {len(files)} camera files (*.json), need at least 2.",
            "Choose another folder.",
        )
    cameras, near_depths = zip(*map(read_camera, files), strict=True)
    named = [replace(camera, name=file.stem) for camera, file in zip(cameras, files, strict=True)]
    return named, min(near_depths)


def camera_from_dict(values: dict) -> tuple[Camera, float]:
    """Return the camera and the near depth (default 0.01) of the JSON values of :func:`camera_to_dict`.

    Raises:
        LodgsError: a key is missing or invalid.
    """
    remedy = "Give width, height, fx, fy, cx, cy and world_to_camera (4x4, OpenCV axes)."
    try:
        camera = Camera(
            name=str(values.get("name", "")),
            width=int(values["width"]), height=int(values["height"]),
            fx=float(values["fx"]), fy=float(values["fy"]),
            cx=float(values["cx"]), cy=float(values["cy"]),
            world_to_camera=np.array(values["world_to_camera"], np.float64),
        )  # fmt: skip
        near = float(values.get("near", 0.01))
    except KeyError as error:
        raise LodgsError(f"The camera has no {error}.", remedy) from error
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
        raise LodgsError(f"The camera is invalid: {str(error)[:200]}.", remedy) from error
    if camera.world_to_camera.shape != (4, 4):
        raise LodgsError("The camera is invalid: world_to_camera is not a 4x4 matrix.", remedy)
    if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
        raise LodgsError(
            f"The camera is invalid: its image has {camera.width}x{camera.height} pixels.",
            f"Choose 1 to {MAX_SIDE} pixels per side.",
        )
    if flaw := camera.flaw:
        raise LodgsError(f"The camera is invalid: {flaw}.", remedy)
    if not 0 <= near <= MAX_COORDINATE:
        raise LodgsError(
            f"The camera is invalid: its near depth is {near:g}.",
            f"Choose a value from 0 to {MAX_COORDINATE:g}.",
        )
    return camera, near


def check_render_size(width: int, height: int) -> None:
    """Raise LodgsError if an image of this size exceeds the limits for rendering."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise LodgsError(
            f"Cannot render an image of {width}x{height} pixels.",
            f"Choose 1 to {MAX_SIDE} pixels per side and at most {MAX_PIXELS:,} pixels in total.",
        )
