"""Files of a COLMAP model: cameras, poses and points, binary or text. numpy only.

File formats: https://colmap.github.io/format.html. Rigs and frames of newer COLMAP versions are ignored,
because images.bin and images.txt also hold each view's own pose. Time is linear in the file size. Binary
files are mapped and text is read by lines, so memory depends on valid records, not on the file size.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path, PureWindowsPath
from typing import IO, Any

import numpy as np

from ..documents import damage_error, open_file, open_lines, read_lines
from ..errors import LodgsError, printable
from ..files import is_file
from ..splats.quats import rotation_matrices
from .lenses import LENS_BY_NAME, LENSES, MAX_LENS_ID, Intrinsics, UnknownLens, intrinsics_of

DAMAGED_REMEDY = "Copy the model again, or rewrite it with COLMAP's model_converter."

_Cameras = tuple[dict[int, Intrinsics], dict[int, Exception]]
"""Valid cameras, and the flaws of invalid ones, by COLMAP's id."""
_MAX_NAME = 1 << 16
_MAX_LINE = 1 << 26  # bytes of a million 2D points


@dataclass(frozen=True)
class Pose:
    """One record of images.bin or images.txt, without its 2D points.

    Attributes:
        name: file name, from UTF-8 or Windows-1252. Other bytes become surrogates. A path that leaves the
            image folder is reduced to its last part.
        world_to_camera: (4, 4) float64 rigid transform; NaN if the record has no valid one.
    """

    name: str
    camera_id: int
    world_to_camera: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """Camera position, (3,) float64."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


def model_suffix(folder: Path) -> str:
    """Return the suffix of a folder's model files, ".bin" (preferred) or ".txt", or "" without a model."""
    for suffix in (".bin", ".txt"):
        if is_file(folder / f"cameras{suffix}") and is_file(folder / f"images{suffix}"):
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


def read_cameras(
    model: Path, used: Collection[int] | None = None, warn: Callable[[str], object] = str
) -> dict[int, Intrinsics]:
    """Read the valid cameras of a model by COLMAP's id.

    Args:
        used: ids of the cameras of images. Default: all.
        warn: called with a sentence about invalid cameras that no image uses.

    Raises:
        LodgsError: the file is missing or damaged, or a used camera is invalid.
    """
    cameras, flaws = _read(model, "cameras", {".bin": _parse_cameras_bin, ".txt": _parse_cameras_txt})
    path = model / f"cameras{model_suffix(model)}"
    for camera_id, error in flaws.items():
        if used is None or camera_id in used:
            raise _model_error(path, error)
    if flaws:
        error = next(iter(flaws.values()))
        warn(f"Skipped {len(flaws):,} cameras of {path} that no image uses: {error}.")
    return cameras


def read_poses(model: Path) -> list[Pose]:
    """Read the registered images of a model, in the file's order.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    return _read(model, "images", {".bin": _parse_images_bin, ".txt": _parse_images_txt})


def read_observations(model: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the pixels and ids of the points that the named images observe, by image name.

    Returns:
        Records (O,) of type ``POINT2D``.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    parsers = {
        ".bin": partial(_parse_observations_bin, names=names),
        ".txt": partial(_parse_observations_txt, names=names),
    }
    return _read(model, "images", parsers)


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read positions (P, 3) float64, possibly not finite, colours (P, 3) uint8 and ids (P,) int64.

    A model without a points file has no points.

    Raises:
        LodgsError: the file is damaged.
    """
    parsers = {".bin": _parse_points_bin, ".txt": _parse_points_txt}
    for suffix in sorted(parsers, key=lambda suffix: suffix != model_suffix(model)):
        for name in "points3D", "points3d":
            if is_file(model / f"{name}{suffix}"):  # some programs write points of the other kind
                return _read(model, name, parsers, suffix)
    return _NO_POINTS


def _read(model: Path, name: str, parsers: dict, suffix: str = "") -> Any:
    """Parse a model file with the parser of its suffix, by default that of the model.

    Raises:
        LodgsError: the file is missing or damaged.
    """
    suffix = suffix or model_suffix(model)
    path = model / f"{name}{suffix}"
    try:
        if suffix == ".txt":
            with open_lines(path) as file:
                return parsers[suffix](file)
        with open_file(path) as file:
            if not os.fstat(file.fileno()).st_size:
                raise ValueError("it is empty")
            return parsers[suffix](mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise LodgsError(f"Cannot read {path}: {error.strerror}.", "Check the folder.") from error
    except (ValueError, IndexError, KeyError, OverflowError, struct.error) as error:
        raise _model_error(path, error) from error


def _model_error(path: Path, error: Exception) -> LodgsError:
    """Return the error for a model file that cannot be parsed."""
    if isinstance(error, UnknownLens):
        return LodgsError(
            f"Cannot read {path}: {error}.",
            "Undistort the photos in the program that wrote the model (colmap image_undistorter).",
        )
    return damage_error(path, error, DAMAGED_REMEDY)


def _parse_cameras_bin(data: mmap.mmap) -> _Cameras:
    count = _record_count(data, 48)
    offset = 8
    cameras, flaws = {}, {}
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, offset)
        lens = LENSES.get(model_id)
        if lens is None:  # its number of parameters is unknown, too
            is_plausible = 0 <= model_id < MAX_LENS_ID
            raise (UnknownLens if is_plausible else ValueError)(
                f"camera {camera_id} has the unknown lens model {model_id}"
            )
        parameters = np.frombuffer(data, "<f8", lens.parameters, offset + 24).copy()
        offset += 24 + 8 * lens.parameters
        try:
            cameras[camera_id] = intrinsics_of(lens, width, height, parameters)
        except ValueError as error:
            flaws[camera_id] = ValueError(f"camera {camera_id}: {error}")
    return cameras, flaws


def _parse_cameras_txt(file: IO[bytes]) -> _Cameras:
    cameras, flaws = {}, {}
    for line in _content_lines(file):
        camera_id, model_name, width, height, *parameters = line.split()
        number = int(camera_id)
        try:
            if (lens := LENS_BY_NAME.get(model_name.upper())) is None:
                raise UnknownLens(f"camera {number} has the unknown lens model {model_name[:40]}")
            size = _side(width), _side(height)
            cameras[number] = intrinsics_of(lens, *size, np.array(parameters, float))
        except UnknownLens as error:
            flaws[number] = error
        except (ValueError, OverflowError) as error:
            flaws[number] = ValueError(f"camera {number}: {error}")
    _check_count(len(cameras.keys() | flaws.keys()), file, "cameras")
    return cameras, flaws


def _side(text: str) -> int:
    """Return a side in pixels, which other programs may write with a decimal point."""
    number = float(text)
    if not number.is_integer():
        raise ValueError(f"invalid size {text[:20]}")
    return int(number)


def _parse_images_bin(data: mmap.mmap) -> list[Pose]:
    count = _record_count(data, 73)
    offset = 8
    poses = []
    for _ in range(count):
        _require_size(data)
        _, *pose, camera_id = struct.unpack_from("<i7di", data, offset)
        end = _name_end(data, offset + 64)
        name = data[offset + 64 : end]
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * points2d
        if offset > len(data):
            raise ValueError(f"the file ends inside image {len(poses) + 1} of {count}")
        poses.append(_pose(name, camera_id, pose))
    return poses


def _parse_images_txt(file: IO[bytes]) -> list[Pose]:
    """Parse the lines of the images; the lines of their 2D points are skipped."""
    poses = []
    for line, _ in _image_lines(file):
        # The name is the rest of the line: it may contain spaces.
        _, *pose, camera_id, name = line.split(maxsplit=9)
        poses.append(_pose(_unquoted(name), int(camera_id), [float(number) for number in pose]))
    _check_count(len(poses), file, "images")
    return poses


def _image_lines(file: IO[bytes]) -> Iterator[tuple[bytes, bytes]]:
    """Yield the line of each image of images.txt and the line of its 2D points, which may be missing.

    COLMAP writes a second line for each image, possibly empty. Files from other sources omit it or have
    further blank lines.

    Raises:
        ValueError: a line is neither.
    """
    image = b""
    for number, line in enumerate(_lines(file), 1):
        line = line.strip()
        if not line or line.startswith(b"#"):
            continue
        if _is_points_line(line):
            if not image:
                raise ValueError(f"line {number} is not an image")
            yield image, line
            image = b""
            continue
        if len(line.split(maxsplit=9)) < 10:
            shortened = printable(line[:60].decode("utf-8", "replace"))
            raise ValueError(f"line {number} is not an image of 10 values: {shortened}")
        if image:
            yield image, b""
        image = line
    if image:
        yield image, b""


def _unquoted(name: bytes) -> bytes:
    """Return a name without the quotes that some programs write around names with spaces."""
    return name[1:-1] if len(name) > 2 and name[:1] == name[-1:] == b'"' else name


def _is_points_line(line: bytes) -> bool:
    """Return True for numbers in groups of x, y and a point's id, which is an integer."""
    tokens = line.split()
    ids = b"".join(tokens[2::3]).replace(b"-", b"")
    return len(tokens) % 3 == 0 and ids.isdigit() and not b"".join(tokens).translate(None, _NUMERIC)


def _parse_observations_bin(data: mmap.mmap, names: Collection[str]) -> dict[str, np.ndarray]:
    count = _record_count(data, 73)
    offset = 8
    observations = {}
    for _ in range(count):
        _require_size(data)
        end = _name_end(data, offset + 64)
        (points2d,) = struct.unpack_from("<Q", data, end + 1)
        if (name := _decode_name(data[offset + 64 : end])) in names:
            records = np.frombuffer(data, POINT2D, points2d, end + 9)
            observations[name] = _with_points(records)
        offset = end + 9 + 24 * points2d
    return observations


def _parse_observations_txt(file: IO[bytes], names: Collection[str]) -> dict[str, np.ndarray]:
    observations = {}
    for line, points2d in _image_lines(file):
        if (name := _decode_name(_unquoted(line.split(maxsplit=9)[9]))) in names:
            tokens = points2d.split()
            records = np.empty(len(tokens) // 3, POINT2D)
            records["point"] = np.array(tokens[2::3], np.int64)
            for axis in range(2):
                records["xy"][:, axis] = np.array(tokens[axis::3], np.float64)
            observations[name] = _with_points(records)
    return observations


def _with_points(records: np.ndarray) -> np.ndarray:
    """Drop the 2D points without a 3D point, whose id is -1."""
    return records[np.asarray(records["point"]) >= 0]


def _record_count(data: mmap.mmap, min_bytes: int) -> int:
    """Return the declared number of records, of at least the given bytes each."""
    _require_size(data)
    (count,) = struct.unpack_from("<Q", data)
    if 8 + count * min_bytes > len(data):
        raise ValueError(f"it is too short for {count} records")
    return count


def _require_size(data: mmap.mmap) -> None:
    """Raise ValueError if a mapped file has become shorter: the system ends processes that read there."""
    if data.size() < len(data):
        raise ValueError("another program has truncated it")


def _name_end(data: mmap.mmap, begin: int) -> int:
    if (end := data.find(b"\0", begin, begin + _MAX_NAME)) < 0:
        raise ValueError("a name has no end")
    return end


def _decode_name(name: bytes) -> str:
    """Return the name in the form of ``Camera.name``."""
    return _decode(name).replace("\\", "/")


def _decode(name: bytes) -> str:
    """Decode a name as UTF-8, else as Windows-1252; other bytes become surrogates.

    Some programs write the path on their computer. Of paths that leave the image folder, only the last part
    remains. A letter and a colon without a slash are part of a file's name.
    """
    text = name.decode("utf-8", "surrogateescape")
    for encoding in "utf-8", "cp1252":
        with suppress(UnicodeDecodeError):
            text = name.decode(encoding)
            break
    path = PureWindowsPath(text)  # with the separators of all systems
    return (path.name if path.root or ".." in path.parts else "") or text


def _pose(name: bytes, camera_id: int, pose: list[float]) -> Pose:
    """Return a pose from a quaternion (w, x, y, z) and a translation, both world to camera."""
    quaternion = np.array(pose[:4])
    text = _decode(name)
    if not (np.isfinite(pose).all() and quaternion.any()):  # some programs write such poses of failed photos
        return Pose(text, camera_id, np.full((4, 4), np.nan))
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation_matrix(quaternion)
    world_to_camera[:3, 3] = pose[4:]
    return Pose(text, camera_id, world_to_camera)


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion wxyz (4,) of any length > 0."""
    # Scaling by a power of two is exact and keeps the squares from overflowing.
    quaternion = np.ldexp(quaternion, -np.frexp(np.abs(quaternion).max())[1])
    return rotation_matrices(quaternion / np.linalg.norm(quaternion))


# A packed record of points3D.bin, followed by `track` pairs of 4-byte integers.
POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_TRACK_OFFSET = 43
_BLOCK = 1 << 17
_NO_POINTS = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64)
_NUMERIC = b"0123456789.+-eEnaifNAIF"  # characters of numbers, including nan and inf


def _parse_points_bin(data: mmap.mmap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = _record_count(data, POINT.itemsize)
    body = np.frombuffer(data, np.uint8, offset=8)
    starts = _point_starts(body, count, lambda: _require_size(data))
    if len(starts) != count:
        raise ValueError(f"it has {len(starts)} points instead of {count}")
    if not count:
        return _NO_POINTS
    _require_size(data)
    records = np.lib.stride_tricks.sliding_window_view(body, POINT.itemsize)[starts].view(POINT)[:, 0]
    return records["xyz"].astype(np.float64), records["rgb"].copy(), records["id"].astype(np.int64)


def _point_starts(body: np.ndarray, expected: int, check: Callable[[], object] = lambda: None) -> np.ndarray:
    """Return the offsets of the records of points3D.bin, computed block by block; stop after too many.

    Args:
        check: called before a block is read.
    """
    offsets = [np.zeros(0, np.int64)]
    offset = 0
    count = 0
    while offset < len(body) and count <= expected:
        check()
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


def _parse_points_txt(file: IO[bytes]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parse lines of an id, a position, a colour and further values.

    Files made by hand may have lines without the id, and without colours.
    """
    lines = _content_lines(file)
    first = next(lines, "")
    columns = min(len(first.split()), 7)
    if 0 < columns < 3:
        raise ValueError(f"a point has {columns} instead of at least 3 values")
    table = np.loadtxt(chain([first], lines), usecols=range(columns), ndmin=2) if first else np.empty((0, 7))
    _check_count(len(table), file, "points")
    ids = np.nan_to_num(table[:, :1])
    start = int(table.shape[1] in (4, 7) and 2 * np.count_nonzero(ids == np.floor(ids)) >= len(ids))
    positions, colors = table[:, start : start + 3], np.nan_to_num(table[:, start + 3 : start + 6])
    if colors.shape[1] < 3 or (not start and colors.min(initial=0) < 0):  # negative values are normals
        colors = np.full(positions.shape, 128)
    elif colors.max(initial=0) <= 1 and (colors % 1).any():
        colors *= 255
    colors = colors.clip(0, 255).astype(np.uint8)
    with np.errstate(invalid="ignore"):  # ids that are not finite match no observation
        return positions, colors, ids[:, 0].astype(np.int64) if start else np.zeros(0, np.int64)


def _lines(file: IO[bytes]) -> Iterator[bytes]:
    return read_lines(file, _MAX_LINE)


def _content_lines(file: IO[bytes]) -> Iterator[str]:
    """Yield the stripped lines without blank lines and comments."""
    for line in _lines(file):
        text = line.decode("utf-8", "surrogateescape").strip()
        if text and not text.startswith("#"):
            yield text


def _check_count(count: int, file: IO[bytes], kind: str) -> None:
    """Raise ValueError if a truncated file has fewer records than COLMAP's comment in its header states."""
    file.seek(0)
    for line in file.read(1000).split(b"\n"):
        key, _, value = line.partition(b":")
        number = value.split(b",")[0].strip()
        if key.strip() == f"# Number of {kind}".encode() and number.isdigit() and count < int(number):
            raise ValueError(f"it has {count} {kind}, but its header states {number.decode()}")
