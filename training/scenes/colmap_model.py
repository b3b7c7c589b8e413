"""Files of a COLMAP model: cameras, poses and points, binary or text. numpy only.

File formats: https://colmap.github.io/format.html. Rigs and frames of newer COLMAP versions are ignored,
because images.bin and images.txt also hold each view's own pose. Time is linear in the file size; memory is
at most five times the file size, or ten times for text.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..documents import open_file
from ..errors import LodgsError, printable

DAMAGED_REMEDY = "Copy the model again, or rewrite it with COLMAP's model_converter."

_MAX_SIDE = 1 << 31
"""Exclusive limit of an image's width and height."""


@dataclass(frozen=True)
class _Lens:
    """A COLMAP camera model; its parameters are focal length(s), cx, cy, then the distortion."""

    name: str
    parameters: int
    focals: int
    perspective: bool = True  # a pinhole if the distortion is zero; a fisheye is never one


# Indexed by COLMAP's model id (colmap/src/colmap/sensor/models.h).
LENSES = dict(
    enumerate(
        [
            _Lens("SIMPLE_PINHOLE", 3, 1),
            _Lens("PINHOLE", 4, 2),
            _Lens("SIMPLE_RADIAL", 4, 1),
            _Lens("RADIAL", 5, 1),
            _Lens("OPENCV", 8, 2),
            _Lens("OPENCV_FISHEYE", 8, 2, perspective=False),
            _Lens("FULL_OPENCV", 12, 2),
            _Lens("FOV", 5, 2),
            _Lens("SIMPLE_RADIAL_FISHEYE", 4, 1, perspective=False),
            _Lens("RADIAL_FISHEYE", 5, 1, perspective=False),
            _Lens("THIN_PRISM_FISHEYE", 12, 2, perspective=False),
            _Lens("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, perspective=False),
            _Lens("SIMPLE_DIVISION", 4, 1),
            _Lens("DIVISION", 5, 2),
            _Lens("SIMPLE_FISHEYE", 3, 1, perspective=False),
            _Lens("FISHEYE", 4, 2, perspective=False),
            _Lens("EUCM", 6, 2),
            _Lens("EQUIRECTANGULAR", 2, 0, perspective=False),
        ]
    )
)
_LENS_BY_NAME = {lens.name: lens for lens in LENSES.values()}


@dataclass(frozen=True)
class Intrinsics:
    """One record of cameras.bin or cameras.txt.

    Attributes:
        width, height: size in pixels of the photos that COLMAP used.
        parameters: in COLMAP's order for the lens; finite, focal lengths > 0.
    """

    lens: _Lens
    width: int
    height: int
    parameters: np.ndarray

    @property
    def distorted(self) -> bool:
        """True unless the lens is a pinhole."""
        distortion = self.parameters[self.lens.focals + 2 :]
        if self.lens.name == "EUCM":  # alpha, beta: a pinhole if alpha = 0, for any beta
            distortion = distortion[:1]
        return not self.lens.perspective or bool(np.any(np.abs(distortion) > 1e-8))  # COLMAP's tolerance

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Pinhole part of the lens: fx, fy, cx, cy."""
        fx, fy = self.parameters[0], self.parameters[self.lens.focals - 1]
        cx, cy = self.parameters[self.lens.focals : self.lens.focals + 2]
        return float(fx), float(fy), float(cx), float(cy)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the lens for photos of another size."""
        if (width, height) == (self.width, self.height):
            return self
        focals, parameters = self.lens.focals, self.parameters.copy()
        scale_x, scale_y = width / self.width, height / self.height
        parameters[:focals] *= (scale_x,) if focals == 1 else (scale_x, scale_y)
        parameters[focals : focals + 2] *= scale_x, scale_y
        return Intrinsics(self.lens, width, height, parameters)


@dataclass(frozen=True)
class Pose:
    """One record of images.bin or images.txt, without its 2D points.

    Attributes:
        name: file name, decoded like file system names: bytes that are not UTF-8 become surrogates.
        world_to_camera: (4, 4) float64 rigid transform.
    """

    name: str
    camera_id: int
    world_to_camera: np.ndarray


def model_suffix(folder: Path) -> str:
    """Return the suffix of a folder's model files, ".bin" (preferred) or ".txt", or "" without a model."""
    for suffix in (".bin", ".txt"):
        if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file():
            return suffix
    return ""


def count_images(model: Path) -> int:
    """Return the number of registered images of a model; 0 if it cannot be read."""
    suffix = model_suffix(model)
    path = model / f"images{suffix}"
    try:
        if suffix == ".bin":
            with open_file(path) as file:
                return struct.unpack("<Q", file.read(8))[0]
        return len(read_poses(model))
    except (OSError, struct.error, LodgsError):
        return 0


def read_cameras(model: Path) -> dict[int, Intrinsics]:
    """Read the cameras of a model by COLMAP's id.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    return _read(model, "cameras", {".bin": _parse_cameras_bin, ".txt": _parse_cameras_txt})


def read_poses(model: Path) -> list[Pose]:
    """Read the registered images of a model, in the file's order.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    return _read(model, "images", {".bin": _parse_images_bin, ".txt": _parse_images_txt})


def read_observations(model: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the ids (O,) int64 of the points that the named images observe, by image name.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    parsers = {
        ".bin": partial(_parse_observations_bin, names=names),
        ".txt": partial(_parse_observations_txt, names=names),
    }
    return _read(model, "images", parsers)


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read positions (P, 3) float32, possibly not finite, colours (P, 3) uint8 and ids (P,) int64.

    A model without a points file has no points.

    Raises:
        LodgsError: the file is damaged.
    """
    if not (model / f"points3D{model_suffix(model)}").is_file():
        return _NO_POINTS
    return _read(model, "points3D", {".bin": _parse_points_bin, ".txt": _parse_points_txt})


def _read(model: Path, name: str, parsers: dict) -> Any:
    """Parse a model file with the parser of its suffix.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    suffix = model_suffix(model)
    path = model / f"{name}{suffix}"
    with open_file(path) as file:
        try:
            data = file.read()
        except OSError as error:
            raise LodgsError(f"Cannot read {path}: {error.strerror}.", "Check the folder.") from error
    try:
        return parsers[suffix](data.removeprefix(_UTF8_MARK) if suffix == ".txt" else data)
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise LodgsError(
            f"Cannot read {path}: the file is damaged or truncated ({error}).", DAMAGED_REMEDY
        ) from error


def _parse_cameras_bin(data: bytes) -> dict[int, Intrinsics]:
    (count,) = struct.unpack_from("<Q", data)
    offset = 8
    cameras = {}
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, offset)
        lens = LENSES.get(model_id)
        if lens is None:
            raise ValueError(f"camera model {model_id} is unknown")
        parameters = np.frombuffer(data, "<f8", lens.parameters, offset + 24)
        offset += 24 + 8 * lens.parameters
        cameras[camera_id] = _intrinsics(lens, width, height, parameters)
    return cameras


def _parse_cameras_txt(data: bytes) -> dict[int, Intrinsics]:
    cameras = {}
    for line in _content_lines(data):
        camera_id, model_name, width, height, *parameters = line.split()
        lens = _LENS_BY_NAME.get(model_name)
        if lens is None:
            raise ValueError(f"camera model {model_name} is unknown")
        cameras[int(camera_id)] = _intrinsics(lens, int(width), int(height), np.array(parameters, float))
    _check_count(len(cameras), data, "cameras")
    return cameras


def _intrinsics(lens: _Lens, width: int, height: int, parameters: np.ndarray) -> Intrinsics:
    if len(parameters) != lens.parameters:
        raise ValueError(f"{lens.name} has {lens.parameters} parameters, not {len(parameters)}")
    valid_size = 1 <= width < _MAX_SIDE and 1 <= height < _MAX_SIDE
    if not valid_size or not np.isfinite(parameters).all() or (parameters[: lens.focals] <= 0).any():
        raise ValueError("a camera has an invalid size, focal length or parameter")
    return Intrinsics(lens, width, height, parameters)


def make_intrinsics(name: str, width: int, height: int, parameters: np.ndarray) -> Intrinsics:
    """Return intrinsics for the name of a COLMAP camera model.

    Raises:
        ValueError: the size, a focal length or a parameter is invalid.
        KeyError: the name is unknown.
    """
    return _intrinsics(_LENS_BY_NAME[name], width, height, parameters)


def _parse_images_bin(data: bytes) -> list[Pose]:
    (count,) = struct.unpack_from("<Q", data)
    offset = 8
    poses = []
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, offset)
        end = data.index(b"\0", offset + 64)
        name = data[offset + 64 : end]
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * points2d
        if offset > len(data):
            raise ValueError(f"the file ends inside image {len(poses) + 1} of {count}")
        poses.append(_pose(name, camera_id, pose))
    return poses


def _parse_images_txt(data: bytes) -> list[Pose]:
    """Parse two lines per image; the second line, its 2D points, may be empty and is skipped."""
    poses = []
    lines = iter(data.split(b"\n"))
    for line in lines:
        line = line.strip()
        if not line or line.startswith(b"#"):
            continue
        # The name is the rest of the line: it may contain spaces.
        _, *pose, camera_id, name = line.split(maxsplit=9)
        next(lines, None)
        poses.append(_pose(name, int(camera_id), [float(number) for number in pose]))
    _check_count(len(poses), data, "images")
    return poses


def _parse_observations_bin(data: bytes, names: Collection[str]) -> dict[str, np.ndarray]:
    (count,) = struct.unpack_from("<Q", data)
    offset = 8
    point_ids = {}
    for _ in range(count):
        end = data.index(b"\0", offset + 64)
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        if (name := _decode_name(data[offset + 64 : end])) in names:
            point_ids[name] = _valid_ids(np.frombuffer(data, POINT2D, points2d, end + 9)["point"])
        offset = end + 9 + 24 * points2d
    return point_ids


def _parse_observations_txt(data: bytes, names: Collection[str]) -> dict[str, np.ndarray]:
    point_ids = {}
    lines = iter(data.split(b"\n"))
    for line in lines:
        line = line.strip()
        if not line or line.startswith(b"#"):
            continue
        points2d = next(lines, b"")
        if (name := _decode_name(line.split(maxsplit=9)[9])) in names:
            point_ids[name] = _valid_ids(np.array(points2d.split()[2::3], np.int64))
    return point_ids


def _valid_ids(ids: np.ndarray) -> np.ndarray:
    """Drop the id -1 of 2D points without a 3D point."""
    return ids[ids >= 0]


def _decode_name(name: bytes) -> str:
    """Return the name in the form of ``Camera.name``."""
    return name.decode("utf-8", "surrogateescape").replace("\\", "/")


def _pose(name: bytes, camera_id: int, pose: list[float]) -> Pose:
    """Return a pose from a quaternion (w, x, y, z) and a translation, both world to camera."""
    quaternion = np.array(pose[:4])
    text = name.decode("utf-8", "surrogateescape")
    if not (np.isfinite(pose).all() and quaternion.any()):
        raise ValueError(f"image {printable(text)} has no valid pose")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation_matrix(quaternion)
    world_to_camera[:3, 3] = pose[4:]
    return Pose(text, camera_id, world_to_camera)


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion wxyz (4,) of any length > 0."""
    # Scaling by a power of two is exact and keeps the squares from overflowing.
    quaternion = np.ldexp(quaternion, -np.frexp(np.abs(quaternion).max())[1])
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


# A packed record of points3D.bin, followed by `track` pairs of 4-byte integers.
POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_TRACK_OFFSET = 43
_BLOCK = 1 << 17
_NO_POINTS = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64)
_UTF8_MARK = b"\xef\xbb\xbf"  # Windows programs write it at the start of UTF-8 files


def _parse_points_bin(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    (count,) = struct.unpack_from("<Q", data)
    body = np.frombuffer(data, np.uint8, offset=8)
    starts = _point_starts(body)
    if len(starts) != count:
        raise ValueError(f"it has {len(starts)} points instead of {count}")
    if not count:
        return _NO_POINTS
    records = np.lib.stride_tricks.sliding_window_view(body, POINT.itemsize)[starts].view(POINT)[:, 0]
    return _to_float32(records["xyz"]), records["rgb"].copy(), records["id"].astype(np.int64)


def _point_starts(body: np.ndarray) -> np.ndarray:
    """Return the offsets of the records of points3D.bin, computed block by block."""
    offsets = [np.zeros(0, np.int64)]
    offset = 0
    count = 0
    while offset < len(body):
        starts, end = _record_chain(body[offset : offset + _BLOCK])
        count += len(starts)
        if not len(starts) or offset + end > len(body):
            raise ValueError(f"the file ends inside point {max(count, 1)}")
        offsets.append(starts + offset)
        offset += end
    return np.concatenate(offsets)


def _record_chain(block: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the offsets of the consecutive records from the block's first byte, and the end of the last one.

    Records have variable lengths, so sequential parsing would take one Python step per point. Instead, use
    that the five upper bytes of the 8-byte track length are zero (tracks shorter than 2^24 views): treat
    every offset with these zeros as a candidate record, then follow the chain from the first record in
    doubling strides of 1, 2, 4, ... records.
    """
    zero = block == 0
    run = zero[:-1] & zero[1:]
    run = run[:-2] & run[2:]
    run = run[:-1] & zero[4 : len(run) + 3]
    starts = np.flatnonzero(run[_TRACK_OFFSET + 3 :])
    low, middle, high = (block[starts + _TRACK_OFFSET + byte].astype(np.int64) for byte in range(3))
    ends = starts + POINT.itemsize + 8 * (low + (middle << 8) + (high << 16))
    end_of_chain = len(starts)
    number = np.full(len(block), end_of_chain)
    number[starts] = np.arange(end_of_chain)
    successor = np.full(end_of_chain + 1, end_of_chain)
    inside = ends < len(block)
    successor[:-1][inside] = number[ends[inside]]
    chain = number[:1]
    while chain[-1] < end_of_chain:
        chain = np.concatenate([chain, successor[chain]])
        successor = successor[successor]
    chain = chain[chain < end_of_chain]
    return starts[chain], int(ends[chain[-1]]) if len(chain) else 0


def _parse_points_txt(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lines = _content_lines(data)
    _check_count(len(lines), data, "points")
    if not lines:
        return _NO_POINTS
    table = np.loadtxt(lines, usecols=range(7), ndmin=2)
    colors = np.nan_to_num(table[:, 4:]).clip(0, 255).astype(np.uint8)
    return _to_float32(table[:, 1:4]), colors, np.nan_to_num(table[:, 0]).astype(np.int64)


def _to_float32(positions: np.ndarray) -> np.ndarray:
    """Convert to float32; values above its range become infinite."""
    with np.errstate(over="ignore"):
        return positions.astype(np.float32)


def _content_lines(data: bytes) -> list[str]:
    """Return the stripped lines without blank lines and comments."""
    lines = (line.strip() for line in data.decode("utf-8", "surrogateescape").split("\n"))
    return [line for line in lines if line and not line.startswith("#")]


def _check_count(count: int, data: bytes, kind: str) -> None:
    """Raise ValueError if a truncated file has fewer records than COLMAP's comment in its header states."""
    for line in data[:1000].split(b"\n"):
        key, _, value = line.partition(b":")
        if key.strip() == f"# Number of {kind}".encode():
            expected = int(value.split(b",")[0])
            if count < expected:
                raise ValueError(f"it has {count} {kind} instead of {expected}")
