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
"""Pixels on the longest side of an image that is drawn."""
MAX_PIXELS = 1 << 27
"""Pixels of a picture, or of the window of one, that is drawn: a 16k frame has fewer."""
MAX_COORDINATE = 1e12
"""No coordinate is larger, in any unit: float32 holds the squares of such lengths."""
_FOCALS = 1e-3, 1e6
"""Focal lengths that there are, in the longer side of their image."""


@dataclass(frozen=True)
class Camera:
    """One undistorted view.

    Attributes:
        name: image name relative to the scene's image folder, with forward slashes.
        width, height: image size in pixels.
        fx, fy, cx, cy: intrinsics in pixels; pixel centres lie at +0.5, as in COLMAP.
        world_to_camera: (4, 4) float64, rigid, OpenCV axes, COLMAP world.
        image: path of the photograph, or None where there is none.
        mask: path of a picture of the same proportions that is black where the photograph does not count.
        depth: path of a depth map of the same proportions, see ``depths.read_map``.
        turns: quarter turns clockwise that stand the photograph upright, see ``images.quarter_turns``.
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
        """The eye in world coordinates, (3,) float64."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    @property
    def flaw(self) -> str:
        """Why there can be no such camera, as what follows "its"; "" where there can."""
        pose, side = self.world_to_camera, max(self.width, self.height)
        if not (np.isfinite(pose).all() and np.abs(pose).max() <= MAX_COORDINATE):
            return f"pose has a number beyond {MAX_COORDINATE:g}"
        rotation = pose[:3, :3]
        turns = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
        if not turns or not np.allclose(pose[3], (0, 0, 0, 1)):
            return "pose is no rotation and translation"
        shortest, longest = (times * side for times in _FOCALS)
        if not (shortest <= self.fx <= longest and shortest <= self.fy <= longest):
            return f"focal length of {self.fx:g}, {self.fy:g} pixels is impossible for an image of {side}"
        if not (abs(self.cx) <= longest and abs(self.cy) <= longest):
            return f"principal point at {self.cx:g}, {self.cy:g} is impossible for an image of {side}"
        return ""

    @property
    def focal(self) -> float:
        """The shorter focal length in pixels: the one that levels of detail are chosen by."""
        return float(min(self.fx, self.fy))

    def view_space(self, points: np.ndarray) -> np.ndarray:
        """World points (P, 3) in the camera's axes, (P, 3) float64."""
        return points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where world points (P, 3) are in the image, as COLMAP's PINHOLE model has it.

        Returns:
            (P, 2) float64 pixels, x to the right and y down from the image's corner, without meaning where
            the depth is not above 0; and depths (P,) along the camera's z axis, in world units.
        """
        x, y, z = self.view_space(points).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=1), z

    def unproject(self, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """World points (P, 3) at pixels (P, 2) and depths (P,) above 0: the inverse of :meth:`project`."""
        rays = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        local = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
        return (local - self.world_to_camera[:3, 3]) @ self.world_to_camera[:3, :3]

    def sees(self, points: np.ndarray, near: float = 0.0, margin: float = 0.0) -> np.ndarray:
        """Which world points (P, 3) are in the image, (P,) bool.

        Args:
            near: only what lies deeper than this, in world units.
            margin: widen the image by this share of its size on every side.
        """
        (u, v), depth = (columns.T for columns in self.project(points))
        across, down = margin * self.width, margin * self.height
        inside = (u >= -across) & (u < self.width + across) & (v >= -down) & (v < self.height + down)
        return inside & (depth > near)

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another pixel grid; intrinsics scale with it."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height,
            fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy,
        )  # fmt: skip

    def scaled(self, share: float) -> Camera:
        """The same view, its image this share of the size, in whole pixels."""
        return self.resized(max(int(self.width * share), 1), max(int(self.height * share), 1))

    def widened(self, share: float) -> Camera:
        """The same eye with a larger image: on every side by a share of its size, in whole pixels."""
        across, down = round(share * self.width), round(share * self.height)
        return replace(
            self, width=self.width + 2 * across, height=self.height + 2 * down,
            cx=self.cx + across, cy=self.cy + down, image=None, mask=None, depth=None,
        )  # fmt: skip

    def in_object_space(self, matrix: np.ndarray) -> tuple[Camera, float]:
        """This view of a world as seen from inside an object in it: pixels stay the same.

        Args:
            matrix: (4, 4) from the object to the world: rotation, one scale above 0, translation.

        Returns:
            The camera in the object's coordinates, and how many units of the world one of its units is.
        """
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        pose = self.world_to_camera @ matrix
        pose[:3] /= scale
        return replace(self, world_to_camera=pose), scale


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """world_to_camera (4, 4), OpenCV axes, of an eye (3,) that looks at a point (3,) of the world.

    Args:
        up: (3,) what is up in the picture; where the eye looks along it, anything level is to the right.
    """
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(ahead, right), ahead
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


T = TypeVar("T")


def camera_extent(cameras: Sequence[Camera]) -> float:
    """1.1 x the largest distance of a camera from the cameras' mean, as 3DGS has it; 0 where all stand in one
    place."""
    centers = np.array([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def pick_evenly(cameras: Sequence[T], most: int) -> list[T]:
    """At most so many of the cameras (or of anything), evenly chosen, the first and the last among them."""
    chosen = np.linspace(0, len(cameras) - 1, min(most, len(cameras)))
    return [cameras[place] for place in chosen.round().astype(int)]


def write_camera(path: Path, camera: Camera, near: float) -> None:
    """Writes a view as JSON: its fields, and the depth at which drawing begins.

    Raises:
        LodgsError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(camera_to_dict(camera, near), indent=1) + "\n", encoding="utf-8")


def camera_to_dict(camera: Camera, near: float) -> dict:
    """A view as JSON knows it; :func:`camera_from_dict` is the inverse, to the bit."""
    names = ("name", "width", "height", "fx", "fy", "cx", "cy")
    values = {name: getattr(camera, name) for name in names}
    return {**values, "world_to_camera": camera.world_to_camera.tolist(), "near": near}


def read_camera(path: Path) -> tuple[Camera, float]:
    """A view that :func:`write_camera` wrote, or anybody in the same words, and its near depth.

    Raises:
        LodgsError: the file cannot be read, or describes no camera.
    """
    values = read_json(path, f"The camera {path}")
    try:
        return camera_from_dict(values)
    except LodgsError as error:
        raise LodgsError(f"{path}: {error.what}", error.remedy) from error


def read_camera_folder(folder: Path) -> tuple[list[Camera], float]:
    """The views of a folder of camera files, by name, and the depth at which drawing begins in all of them.

    Raises:
        LodgsError: there are not two, or one cannot be read.
    """
    files = sorted(folder.glob("*.json"))
    if len(files) < 2:
        raise LodgsError(f"{folder} holds no two camera files (*.json).", "Choose another folder.")
    cameras, nears = zip(*map(read_camera, files), strict=True)
    named = [replace(camera, name=file.stem) for camera, file in zip(cameras, files, strict=True)]
    return named, min(nears)


def camera_from_dict(values: dict) -> tuple[Camera, float]:
    """A view and its near depth (0.01 where it is missing), of ``camera_as_dict``'s keys.

    Raises:
        LodgsError: a key is missing or impossible.
    """
    remedy = "A camera has width, height, fx, fy, cx, cy and world_to_camera (4x4, OpenCV axes)."
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
        raise LodgsError(f"The camera lacks {error}.", remedy) from error
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
        raise LodgsError(f"The camera is not valid: {str(error)[:200]}.", remedy) from error
    if camera.world_to_camera.shape != (4, 4):
        raise LodgsError("The camera's world_to_camera is no 4x4 matrix of numbers.", remedy)
    if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
        raise LodgsError(
            f"The camera's image of {camera.width}x{camera.height} pixels cannot be drawn.",
            f"Choose from 1 to {MAX_SIDE} pixels a side.",
        )
    if flaw := camera.flaw:
        raise LodgsError(f"The camera's {flaw}.", remedy)
    if not 0 <= near <= MAX_COORDINATE:
        raise LodgsError(f"The camera's near depth of {near:g} is impossible.", "Give 0 or more.")
    return camera, near


def check_render_size(width: int, height: int) -> None:
    """Raises LodgsError where a picture of so many pixels is not drawn."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise LodgsError(
            f"A picture of {width}x{height} pixels is not drawn.",
            f"Choose at most {MAX_SIDE} pixels a side, and {MAX_PIXELS:,} in all.",
        )
