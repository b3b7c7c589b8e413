"""A view as other programs tell it, and what their files have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...documents import read_json
from ...errors import LodgsError
from ..cameras import Camera
from ..colmap import DEPTH_SUFFIXES
from ..colmap_model import Intrinsics, make_intrinsics
from ..images import IMAGE_SUFFIXES

MAX_JSON_BYTES = 1 << 26
"""Bytes of a JSON file that is read: of 5,000 views it has some 4 million."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's camera axes to OpenGL's (x right, y up, looking along -z), or back."""
_ENDINGS = *IMAGE_SUFFIXES, ".exr", *(suffix.upper() for suffix in IMAGE_SUFFIXES), ".EXR"
_NO_POINTS = np.zeros((0, 3))


@dataclass(frozen=True)
class ExportedView:
    """A photograph and the camera that took it.

    Attributes:
        image: the file.
        lens: as COLMAP has it, for photographs of its size; of no size (0) where the program does not tell.
        world_to_camera: (4, 4), OpenCV axes.
        mask: black where the photograph does not count; None: there is none.
        depth: a depth map, as ``depths.read_map`` reads it in the scene's unit; None: there is none.
    """

    image: Path
    lens: Intrinsics
    world_to_camera: np.ndarray
    mask: Path | None = None
    depth: Path | None = None

    @property
    def has_depth(self) -> bool:
        """Whether there is a depth map of a kind that is read."""
        return self.depth is not None and self.depth.suffix.lower() in DEPTH_SUFFIXES and self.depth.is_file()

    def sized(self, width: int, height: int) -> ExportedView:
        """The same with the lens for photographs of that size; focal lengths scale with it."""
        lens, count = self.lens, self.lens.lens.focals
        if (width, height) == (lens.width, lens.height):
            return self
        parameters, across, down = lens.parameters.copy(), width / lens.width, height / lens.height
        parameters[:count] *= (across,) if count == 1 else (across, down)
        parameters[count : count + 2] *= across, down
        return replace(self, lens=make_intrinsics(lens.lens.name, width, height, parameters))

    def camera(self, name: str) -> Camera:
        """Its pinhole part."""
        lens = self.lens
        return Camera(name, lens.width, lens.height, *lens.pinhole, self.world_to_camera, self.image)


@dataclass(frozen=True)
class ExportedScene:
    """What a program has exported.

    Attributes:
        views: with files that may not be there.
        points: (P, 3), possibly none; in the views' world.
        colors: (P, 3) uint8.
        left_out: names of what cannot be used, and a sentence of each.
        warnings: other sentences.
    """

    views: list[ExportedView]
    points: np.ndarray = field(default_factory=lambda: _NO_POINTS)
    colors: np.ndarray = field(default_factory=lambda: _NO_POINTS.astype(np.uint8))
    left_out: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def read_document(path: Path) -> dict:
    """As ``read_json``, of a file that tells of thousands of views."""
    return read_json(path, max_bytes=MAX_JSON_BYTES)


def get_number(values: Mapping[str, Any], name: str, otherwise: float | None = None) -> float:
    """A number by name.

    Raises:
        LodgsError: there is none, and nothing instead.
    """
    value = values.get(name, otherwise)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise LodgsError(f"it has no number '{name}'.")
    return float(value)


def parse_array(value: Any, *shape: int) -> np.ndarray:
    """An array of that shape, in lists or flat.

    Raises:
        LodgsError: it is something else.
    """
    try:
        found = np.array(value, np.float64)
        if not np.isfinite(found).all():
            raise ValueError
        return found.reshape(shape)
    except (TypeError, ValueError) as error:
        size = "x".join(map(str, shape))
        raise LodgsError(f"where {size} numbers are expected it has something else.") from error


def colmap_lens(
    width: float, height: float, focal: tuple[float, float], center: tuple[float, float],
    radial: tuple[float, ...] = (), tangential: tuple[float, float] = (0.0, 0.0), fisheye: bool = False,
) -> Intrinsics:  # fmt: skip
    """A lens as COLMAP has it, the simplest that is enough.

    Args:
        radial: OpenCV's k1, k2, k3, k4, ...: the first three are polynomial; k4 to k6 the rational model's
            denominator, or k1 to k4 the fisheye's polynomial.
        tangential: OpenCV's p1, p2; of a fisheye what they are of its angles.

    Raises:
        LodgsError: there is no such lens.
    """
    k = [*radial, *[0.0] * 6][: max(6, len(radial))]
    if fisheye and any(tangential):
        name, distortion = "THIN_PRISM_FISHEYE", [*k[:2], *tangential, *k[2:4], 0.0, 0.0]
    elif fisheye:
        name, distortion = "OPENCV_FISHEYE", k[:4]
    elif any(k[2:]):
        name, distortion = "FULL_OPENCV", [*k[:2], *tangential, *k[2:6]]
    elif any(k) or any(tangential):
        name, distortion = "OPENCV", [*k[:2], *tangential]
    else:
        name, distortion = "PINHOLE", []
    try:
        return make_intrinsics(name, int(width), int(height), np.array([*focal, *center, *distortion]))
    except (ValueError, OverflowError) as error:
        raise LodgsError(f"{error}.") from error


def invert_pose(camera_to_world: np.ndarray, opengl: bool = False) -> np.ndarray:
    """(4, 4) in OpenCV axes, of (3, 4) or (4, 4); a scale of the axes is left out.

    Raises:
        LodgsError: it is no rotation and translation.
    """
    pose = np.eye(4)
    if len(camera_to_world) < 3:
        raise LodgsError("its pose is no matrix of 3 or 4 rows.")
    pose[:3] = camera_to_world[:3]
    left, stretch, right = np.linalg.svd(pose[:3, :3])
    if not (stretch[2] > 0 and stretch[0] < 1.02 * stretch[2] and np.linalg.det(left @ right) > 0):
        raise LodgsError("its pose is no rotation and translation.")
    pose[:3, :3] = left @ right
    return np.linalg.inv(pose @ OPENGL if opengl else pose)


def find_image(folder: Path, name: str) -> Path:
    """A photograph by the name that a program gives it: with or without an ending or with another one,
    perhaps of another computer's folder.

    Returns:
        A file in the folder or below; where there is none, the place where it should be.
    """
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    there = [folder.joinpath(*parts[start:]) for start in range(len(parts))] or [folder]
    for place in there:
        bare = place.stem if place.suffix in _ENDINGS else place.name
        for each in (place, *(place.with_name(bare + ending) for ending in _ENDINGS)):
            if each.is_file():
                return each
    return there[0]
