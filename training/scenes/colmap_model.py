"""The files of a COLMAP model: cameras, poses and points, binary or text, of anybody's making. numpy only.

File formats: https://colmap.github.io/format.html. rigs and frames of newer COLMAP versions are not needed:
images.bin and images.txt hold each view's own pose there too. Time grows with the bytes of a file; memory is
at most five times as much, and for text ten times.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ..documents import open_file
from ..errors import LodgsError, printable
from ..splats.similarity import Similarity

DAMAGED_REMEDY = "Copy the model again, or write it anew with COLMAP's model_converter."

_LARGEST_SIDE = 1 << 31
"""No image is so wide or high."""


@dataclass(frozen=True)
class _Lens:
    """A COLMAP camera model: its parameters are focal length(s), cx, cy, then those of the distortion."""

    name: str
    parameters: int
    focals: int
    perspective: bool = True  # a pinhole when the distortion is zero; fisheyes never are


# By COLMAP's model id (colmap/src/colmap/sensor/models.h).
_LENSES = dict(
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
_LENS_BY_NAME = {lens.name: lens for lens in _LENSES.values()}


@dataclass(frozen=True)
class Intrinsics:
    """One record of cameras.bin or cameras.txt.

    Attributes:
        width, height: in pixels, of the photographs that COLMAP has seen.
        parameters: as COLMAP orders them for the lens; finite, focal lengths above 0.
    """

    lens: _Lens
    width: int
    height: int
    parameters: np.ndarray

    @property
    def distorted(self) -> bool:
        """Whether this is no pinhole."""
        distortion = self.parameters[self.lens.focals + 2 :]
        if self.lens.name == "EUCM":  # alpha, beta: a pinhole at alpha = 0, whatever beta
            distortion = distortion[:1]
        return not self.lens.perspective or bool(np.any(np.abs(distortion) > 1e-8))  # as COLMAP has it

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        fx, fy = self.parameters[0], self.parameters[self.lens.focals - 1]
        cx, cy = self.parameters[self.lens.focals : self.lens.focals + 2]
        return float(fx), float(fy), float(cx), float(cy)


@dataclass(frozen=True)
class Pose:
    """One record of images.bin or images.txt, without its 2D points.

    Attributes:
        name: as the file system's names are decoded: what is not UTF-8 in it stands as surrogates.
        world_to_camera: (4, 4) float64, rigid.
    """

    name: str
    camera_id: int
    world_to_camera: np.ndarray


def model_suffix(folder: Path) -> str:
    """The form in which a folder holds a model, ".bin" before ".txt", or an empty string."""
    for suffix in (".bin", ".txt"):
        if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file():
            return suffix
    return ""


def count_images(model: Path) -> int:
    """How many images a model says or has; 0 where that cannot be read."""
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
    """The cameras of a model by COLMAP's id.

    Raises:
        LodgsError: there is no such file, or it is damaged. So do the others here.
    """
    return _read(model, "cameras", {".bin": _cameras_bin, ".txt": _cameras_txt})


def read_poses(model: Path) -> list[Pose]:
    """The registered images of a model, in the file's order."""
    return _read(model, "images", {".bin": _images_bin, ".txt": _images_txt})


def read_observations(model: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """The ids (O,) int64 of the points that some images observe, by the images' names."""
    return _read(
        model, "images", {".bin": partial(_seen_bin, names=names), ".txt": partial(_seen_txt, names=names)}
    )


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points of a model: positions (P, 3) float32, finite or not, colours (P, 3) uint8, ids (P,) int64.

    A model without a file of them has none.
    """
    if not (model / f"points3D{model_suffix(model)}").is_file():
        return _NO_POINTS
    return _read(model, "points3D", {".bin": _points_bin, ".txt": _points_txt})


def _read(model: Path, name: str, parsers: dict):
    """Parse a file of a model, or say that it is damaged."""
    suffix = model_suffix(model)
    path = model / f"{name}{suffix}"
    with open_file(path) as file:
        try:
            data = file.read()
        except OSError as error:
            raise LodgsError(f"{path} cannot be read: {error.strerror}.", "Check the folder.") from error
    try:
        return parsers[suffix](data.removeprefix(_MARK) if suffix == ".txt" else data)
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise LodgsError(f"{path} is damaged or cut short ({error}).", DAMAGED_REMEDY) from error


def _cameras_bin(data: bytes) -> dict[int, Intrinsics]:
    (count,), at, cameras = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, at)
        lens = _LENSES.get(model_id)
        if lens is None:
            raise ValueError(f"camera model {model_id} is unknown")
        parameters = np.frombuffer(data, "<f8", lens.parameters, at + 24)
        at += 24 + 8 * lens.parameters
        cameras[camera_id] = _intrinsics(lens, width, height, parameters)
    return cameras


def _cameras_txt(data: bytes) -> dict[int, Intrinsics]:
    cameras = {}
    for line in _lines(data):
        camera_id, model_name, width, height, *parameters = line.split()
        lens = _LENS_BY_NAME.get(model_name)
        if lens is None:
            raise ValueError(f"camera model {model_name} is unknown")
        cameras[int(camera_id)] = _intrinsics(lens, int(width), int(height), np.array(parameters, float))
    _expect(len(cameras), data, "cameras")
    return cameras


def _intrinsics(lens: _Lens, width: int, height: int, parameters: np.ndarray) -> Intrinsics:
    if len(parameters) != lens.parameters:
        raise ValueError(f"{lens.name} has {lens.parameters} parameters, not {len(parameters)}")
    sized = 1 <= width < _LARGEST_SIDE and 1 <= height < _LARGEST_SIDE
    if not sized or not np.isfinite(parameters).all() or (parameters[: lens.focals] <= 0).any():
        raise ValueError("a camera has no size or focal length")
    return Intrinsics(lens, width, height, parameters)


def make_intrinsics(name: str, width: int, height: int, parameters: np.ndarray) -> Intrinsics:
    """A record by the name of its lens.

    Raises:
        ValueError: there is no such lens, or it has no size or focal length.
    """
    return _intrinsics(_LENS_BY_NAME[name], width, height, parameters)


def write_model(
    model: Path,
    lenses: Sequence[Intrinsics],
    poses: Sequence[tuple[str, np.ndarray]],
    points: np.ndarray,
    colors: np.ndarray,
) -> None:
    """Writes a binary model without tracks; pycolmap, which writes these too, is not where Blender is.

    Args:
        model: its folder, new.
        lenses: of each view.
        poses: name and world_to_camera (4, 4) of each view.
        points: (P, 3).
        colors: (P, 3) uint8.

    Raises:
        OSError: it cannot be written.
    """
    model.mkdir(parents=True)
    numbers: dict[bytes, int] = {}
    images = []
    for place, (lens, (name, pose)) in enumerate(zip(lenses, poses, strict=True), 1):
        model_id = next(number for number, each in _LENSES.items() if each is lens.lens)
        camera = (
            struct.pack("<iQQ", model_id, lens.width, lens.height) + lens.parameters.astype("<f8").tobytes()
        )
        number = numbers.setdefault(camera, len(numbers) + 1)
        values = *Similarity(pose[:3, :3], 1.0, pose[:3, 3]).quat, *pose[:3, 3]
        text = name.encode("utf-8", "surrogateescape")
        images.append(struct.pack("<i7di", place, *values, number) + text + b"\0" + struct.pack("<Q", 0))
    cameras = [struct.pack("<i", number) + camera for camera, number in numbers.items()]
    rows = np.zeros(len(points), _POINT)
    rows["id"], rows["xyz"], rows["rgb"] = np.arange(1, len(points) + 1), points, colors
    for file, count, parts in (
        ("cameras.bin", len(cameras), cameras),
        ("images.bin", len(images), images),
        ("points3D.bin", len(rows), [rows.tobytes()]),
    ):
        (model / file).write_bytes(struct.pack("<Q", count) + b"".join(parts))


def _images_bin(data: bytes) -> list[Pose]:
    (count,), at, poses = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end]
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points2d
        if at > len(data):
            raise ValueError(f"it ends within image {len(poses) + 1} of {count}")
        poses.append(_pose(name, camera_id, pose))
    return poses


def _images_txt(data: bytes) -> list[Pose]:
    """Two lines an image, the second (its 2D points, possibly none) passed over."""
    poses, lines = [], iter(data.split(b"\n"))
    for line in lines:
        line = line.strip()
        if not line or line.startswith(b"#"):
            continue
        # NAME is everything after the ninth field: it may hold spaces.
        _, *pose, camera_id, name = line.split(maxsplit=9)
        next(lines, None)
        poses.append(_pose(name, int(camera_id), [float(number) for number in pose]))
    _expect(len(poses), data, "images")
    return poses


def _seen_bin(data: bytes, names: Collection[str]) -> dict[str, np.ndarray]:
    (count,), at, seen = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        end = data.index(b"\0", at + 64)
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        if (name := _name(data[at + 64 : end])) in names:
            seen[name] = _observed(np.frombuffer(data, _POINT2D, points2d, end + 9)["point"])
        at = end + 9 + 24 * points2d
    return seen


def _seen_txt(data: bytes, names: Collection[str]) -> dict[str, np.ndarray]:
    seen, lines = {}, iter(data.split(b"\n"))
    for line in lines:
        line = line.strip()
        if not line or line.startswith(b"#"):
            continue
        points2d = next(lines, b"")
        if (name := _name(line.split(maxsplit=9)[9])) in names:
            seen[name] = _observed(np.array(points2d.split()[2::3], np.int64))
    return seen


def _observed(ids: np.ndarray) -> np.ndarray:
    """Without the 2D points that are no point's, of which the id is -1."""
    return ids[ids >= 0]


def _name(name: bytes) -> str:
    """As `Camera.name` has it."""
    return name.decode("utf-8", "surrogateescape").replace("\\", "/")


def _pose(name: bytes, camera_id: int, pose: list[float]) -> Pose:
    """Rotation from a unit quaternion (w, x, y, z) and translation, both world to camera."""
    quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
    text = name.decode("utf-8", "surrogateescape")
    if not (np.isfinite(pose).all() and quaternion.any()):
        raise ValueError(f"image {printable(text)} has no pose")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation_matrix(quaternion), translation
    return Pose(text, camera_id, world_to_camera)


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) of a quaternion wxyz (4,) of any length above 0."""
    # by a power of two, which rounds nothing, so that no square overflows
    quaternion = np.ldexp(quaternion, -np.frexp(np.abs(quaternion).max())[1])
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


# A record of points3D.bin, packed; `track` pairs of 4-byte integers follow it.
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_TRACK_AT = 43
_BLOCK = 1 << 17
_NO_POINTS = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64)
_MARK = b"\xef\xbb\xbf"  # Windows' programs begin UTF-8 with it


def _points_bin(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    (count,) = struct.unpack_from("<Q", data)
    body = np.frombuffer(data, np.uint8, offset=8)
    starts = _point_starts(body)
    if len(starts) != count:
        raise ValueError(f"it should hold {count} points")
    if not count:
        return _NO_POINTS
    records = np.lib.stride_tricks.sliding_window_view(body, _POINT.itemsize)[starts].view(_POINT)[:, 0]
    return _float32(records["xyz"]), records["rgb"].copy(), records["id"].astype(np.int64)


def _point_starts(body: np.ndarray) -> np.ndarray:
    """Where the records of points3D.bin begin, block by block of the file."""
    found, at, count = [np.zeros(0, np.int64)], 0, 0
    while at < len(body):
        starts, end = _chain(body[at : at + _BLOCK])
        count += len(starts)
        if not len(starts) or at + end > len(body):
            raise ValueError(f"it ends within point {max(count, 1)}")
        found.append(starts + at)
        at += end
    return np.concatenate(found)


def _chain(block: np.ndarray) -> tuple[np.ndarray, int]:
    """Where the records begin that follow each other from the block's first byte on, and where the last ends.

    Each record tells its own length, so that a straight reading would take one step of Python a point.
    Instead: a track length is a small number in 8 bytes, so a record can only begin where the right five
    bytes are zero (tracks below 2^24 views). All of these places are taken for records, and the chain from
    the first is followed in strides that double: 1, 2, 4, ... records.
    """
    zero = block == 0
    run = zero[:-1] & zero[1:]
    run = run[:-2] & run[2:]
    run = run[:-1] & zero[4 : len(run) + 3]
    starts = np.flatnonzero(run[_TRACK_AT + 3 :])
    low, middle, high = (block[starts + _TRACK_AT + byte].astype(np.int64) for byte in range(3))
    ends = starts + _POINT.itemsize + 8 * (low + (middle << 8) + (high << 16))
    none = len(starts)
    number = np.full(len(block), none)
    number[starts] = np.arange(none)
    following = np.full(none + 1, none)
    inside = ends < len(block)
    following[:-1][inside] = number[ends[inside]]
    chain = number[:1]
    while chain[-1] < none:
        chain = np.concatenate([chain, following[chain]])
        following = following[following]
    chain = chain[chain < none]
    return starts[chain], int(ends[chain[-1]]) if len(chain) else 0


def _points_txt(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lines = _lines(data)
    _expect(len(lines), data, "points")
    if not lines:
        return _NO_POINTS
    table = np.loadtxt(lines, usecols=range(7), ndmin=2)
    colors = np.nan_to_num(table[:, 4:]).clip(0, 255).astype(np.uint8)
    return _float32(table[:, 1:4]), colors, np.nan_to_num(table[:, 0]).astype(np.int64)


def _float32(positions: np.ndarray) -> np.ndarray:
    """Infinite where they are too large for it."""
    with np.errstate(over="ignore"):
        return positions.astype(np.float32)


def _lines(data: bytes) -> list[str]:
    """Lines that are neither blank nor comments."""
    lines = (line.strip() for line in data.decode("utf-8", "surrogateescape").split("\n"))
    return [line for line in lines if line and not line.startswith("#")]


def _expect(count: int, data: bytes, what: str) -> None:
    """COLMAP writes the number of records as a comment: fewer of them means that the file was cut."""
    for line in data[:1000].split(b"\n"):
        before, _, after = line.partition(b":")
        if before.strip() == f"# Number of {what}".encode():
            expected = int(after.split(b",")[0])
            if count < expected:
                raise ValueError(f"it should hold {expected} {what} and holds {count}")
