"""Exported views, and helpers to parse other programs' files."""

from __future__ import annotations

import json
import os
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ...documents import DECIMAL_COMMAS, decode_text, has_decimal_commas, parse_json, read_bytes
from ...errors import LodgsError, printable
from ...files import is_file
from ...splats.georeference import Georeference
from ..cameras import Camera
from ..colmap import DEPTH_SUFFIXES
from ..image_files import NO_PHOTOS, UNREADABLE_SUFFIXES, walk_files
from ..images import IMAGE_SUFFIXES
from ..lenses import Intrinsics, make_intrinsics

MAX_BYTES = 1 << 26
"""Maximum size of a JSON or XML file; 5,000 views take about 4 million bytes."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Conversion between OpenCV's camera axes and OpenGL's (x right, y up, looking along -z)."""
_SUFFIXES = *IMAGE_SUFFIXES, ".exr", *(suffix.upper() for suffix in IMAGE_SUFFIXES), ".EXR"
_OTHER_SUFFIXES = *UNREADABLE_SUFFIXES, *(suffix.upper() for suffix in UNREADABLE_SUFFIXES)
_NO_POINTS = np.zeros((0, 3))
_MAX_PARTS = 64
"""Maximum number of folders in an exported name; further leading ones are dropped."""


@dataclass(frozen=True)
class ExportedView:
    """A photo and its camera.

    Attributes:
        image: image file; it may not exist.
        lens: lens for photos of its size; its size is 0 if the program does not export it.
        world_to_camera: (4, 4), OpenCV axes.
        mask: mask that is black in ignored areas, or None.
        depth: depth map in the scene's unit, see ``depths.read_depth_map``, or None.
    """

    image: Path
    lens: Intrinsics
    world_to_camera: np.ndarray
    mask: Path | None = None
    depth: Path | None = None

    @property
    def has_depth(self) -> bool:
        """True if the depth map exists in a supported format."""
        return self.depth is not None and self.depth.suffix.lower() in DEPTH_SUFFIXES and is_file(self.depth)

    def sized(self, width: int, height: int) -> ExportedView:
        """Return the view with the lens scaled to photos of the given size."""
        return replace(self, lens=self.lens.resized(width, height))

    def turned(self, turns: int) -> ExportedView:
        """Return the view for a photo that only its EXIF data turns upright, see ``Camera.turned``."""
        pose = self.camera("").turned(turns).world_to_camera
        return replace(self, lens=self.lens.turned(turns), world_to_camera=pose)

    def camera(self, name: str) -> Camera:
        """Return the pinhole part of the camera."""
        lens = self.lens
        return Camera(name, lens.width, lens.height, *lens.pinhole, self.world_to_camera, self.image)


@dataclass(frozen=True)
class ExportedScene:
    """Content of an export.

    Attributes:
        views: views, whose files may not exist.
        points: (P, 3) in the views' world, possibly empty.
        colors: (P, 3) uint8.
        excluded: (name, sentence) for each unusable view.
        warnings: further sentences.
        georeference: place of the views' world on Earth, or None.
    """

    views: list[ExportedView]
    points: np.ndarray = field(default_factory=lambda: _NO_POINTS)
    colors: np.ndarray = field(default_factory=lambda: _NO_POINTS.astype(np.uint8))
    excluded: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    georeference: Georeference | None = None


def read_document(path: Path) -> dict:
    """Read a JSON file with thousands of views in any encoding, see ``parse_json``."""
    data = read_bytes(path, MAX_BYTES)
    return parse_json(decode_text(data), printable(path), MAX_BYTES, finite=False)


def parse_xml(path: Path, program: str) -> Element:
    """Return the root of an XML file in any encoding.

    Raises:
        LodgsError: the file is damaged, too large, or defines entities.
    """
    try:
        data = read_bytes(path, MAX_BYTES)
        encoding = json.detect_encoding(data)
        text = data.decode(encoding, "replace")
        if len(data) > MAX_BYTES or any(mark in text for mark in ("<!DOCTYPE", "<!ENTITY", "\0")):
            raise ValueError(f"it exceeds {MAX_BYTES:,} bytes, defines entities, or is not text")
        return ElementTree.fromstring(data if encoding == "utf-8" else text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise LodgsError(
            f"Cannot read {path}: it is not an XML file of {program} ({error}).", "Export the cameras again."
        ) from error


def get_number(values: Mapping[str, Any], name: str, default: float | None = None) -> float:
    """Return a number by name, which may be written as a text.

    Raises:
        LodgsError: there is no finite number, and neither null nor nothing with a default.
    """
    value = values.get(name)
    value = default if value is None else value
    if isinstance(value, str):
        if has_decimal_commas(value):
            raise LodgsError(f"{DECIMAL_COMMAS}, such as {name} = {value[:20]}.")
        with suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise LodgsError(f"it has no number '{name}'.")
    return float(value)


def parse_array(value: Any, *shape: int, finite: bool = True) -> np.ndarray:
    """Return nested or flat lists of numbers as an array of the given shape.

    Args:
        finite: reject infinite numbers, NaN and null; otherwise null is NaN.

    Raises:
        LodgsError: the value has another shape, or contains anything but such numbers.
    """
    try:
        array = np.array(value, np.float64)
        if finite and not np.isfinite(array).all():
            raise ValueError
        return array.reshape(shape)
    except (TypeError, ValueError) as error:
        if has_decimal_commas(str(error)):
            raise LodgsError(f"{DECIMAL_COMMAS}.") from error
        size = "x".join("N" if side < 0 else str(side) for side in shape)
        raise LodgsError(f"it has a value that is not {size} finite numbers.") from error


def parse_camera_matrix(value: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera matrix of 3x3 or 4x4 numbers, nested or flat, by rows or by columns.

    Raises:
        LodgsError: the value is not such a matrix.
    """
    numbers = parse_array(value, -1)
    if len(numbers) not in (9, 16):
        raise LodgsError("its camera matrix is not 3x3 or 4x4 numbers.")
    matrix = numbers.reshape(int(len(numbers) ** 0.5), -1)[:3, :3]
    if matrix[2, 0] and not matrix[0, 2]:  # stored by columns, as ARKit does
        matrix = matrix.T
    if not (np.array_equal(matrix[2], [0, 0, 1]) and matrix[1, 0] == 0 and abs(matrix[0, 1]) < 0.01):
        raise LodgsError("its camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1].")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def colmap_lens(
    width: float, height: float, focal: tuple[float, float], center: tuple[float, float],
    radial: tuple[float, ...] = (), tangential: tuple[float, float] = (0.0, 0.0), fisheye: bool = False,
) -> Intrinsics:  # fmt: skip
    """Return the simplest COLMAP lens with the given distortion.

    Args:
        radial: OpenCV's k1, k2, k3, k4, ...: the first three are a polynomial, and k4 to k6 the denominator
            of the rational model. For a fisheye, k1 to k4 are a polynomial.
        tangential: OpenCV's p1, p2; for a fisheye, the same terms of its angles.

    Raises:
        LodgsError: a parameter is invalid.
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
    """Return world_to_camera (4, 4) in OpenCV axes for a pose (3, 4) or (4, 4); its scale is dropped.

    Args:
        opengl: True for a pose in OpenGL's camera axes.

    Raises:
        LodgsError: the pose is not a rotation and translation.
    """
    pose = np.eye(4)
    if len(camera_to_world) < 3:
        raise LodgsError("its pose is not a matrix of 3 or 4 rows.")
    if len(camera_to_world) == 4 and camera_to_world[3, :3].any():  # stored by columns, as ARKit does
        if camera_to_world[:3, 3].any():
            raise LodgsError("its pose is not a rotation and translation.")
        camera_to_world = camera_to_world.T
    pose[:3] = camera_to_world[:3]
    left, stretch, right = np.linalg.svd(pose[:3, :3])
    if not (stretch[2] > 0 and stretch[0] < 1.02 * stretch[2] and np.linalg.det(left @ right) > 0):
        raise LodgsError("its pose is not a rotation and translation.")
    pose[:3, :3] = left @ right
    return np.linalg.inv(pose @ OPENGL if opengl else pose)


def find_image(folder: Path, name: str) -> Path:
    """Find a photo by an exported name.

    The name may lack its suffix, have another one, start with another computer's path, be a URL, have
    another Unicode form, or have spaces around it.

    Returns:
        A file in the folder or below it, or the expected path if there is no such file.
    """
    forms = (unicodedata.normalize(form, name) for form in ("NFC", "NFD"))
    path = re.sub(r"[?#].*", "", name) if "://" in name else name
    spellings = name, unquote(path), name.strip(), *forms
    for spelling in dict.fromkeys(spellings):
        for candidate in _candidates(folder, spelling):
            stem = candidate.stem if _has_photo_suffix(candidate) else candidate.name
            start = str(candidate)[: -len(candidate.name)] + stem if candidate.name else str(candidate)
            paths = [start + suffix for suffix in _SUFFIXES]
            # A readable copy precedes the original in a format that LODGS does not read.
            originals = [start + suffix for suffix in _OTHER_SUFFIXES]
            own = str(candidate)
            for path in (*[own][: candidate.suffix in _SUFFIXES], *paths, own, *originals):
                if is_file(path):
                    return Path(path)
    return _candidates(folder, name)[0]


def _has_photo_suffix(path: Path) -> bool:
    return path.suffix in _SUFFIXES or path.suffix.lower() in UNREADABLE_SUFFIXES


def _candidates(folder: Path, name: str) -> list[Path]:
    """Return the paths of a name below a folder, with all of its parts and with fewer leading ones."""
    parts = [
        part
        for part in name.replace("\\", "/").split("/")
        if part not in ("", ".", "..") and not Path(part).drive
    ][-_MAX_PARTS:]
    return [folder.joinpath(*parts[start:]) for start in range(len(parts))] or [folder]


def find_file(folder: Path, *names: str) -> Path | None:
    """Return the first of the named files that exists in a folder, in any case, or None."""
    try:
        entries = {entry.casefold(): entry for entry in sorted(os.listdir(folder), reverse=True)}
    except OSError:
        return None
    candidates = [folder / name for name in names]
    candidates += [folder / entries[name.casefold()] for name in names if name.casefold() in entries]
    return next((path for path in candidates if is_file(path)), None)


def visible_files(folder: Path) -> list[Path]:
    """Return the sorted files of a folder without hidden ones, such as those that macOS adds to archives."""
    return sorted(path for path in folder.iterdir() if path.name[0] != "." and is_file(path))


def finite_points(
    path: Path, points: np.ndarray, colors: np.ndarray, warnings: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (P, 3) with a finite position and their colours, and warn about the others."""
    valid = np.isfinite(points).all(axis=1)
    if not valid.all():
        warnings.append(f"Skipped {np.sum(~valid):,} points of {path}: their position is not finite.")
    return points[valid], colors[valid]


class PhotoFinder:
    """Finder of photos below a folder by the last parts of their exported names.

    Args:
        names: exported names of all photos. A photo at the exported place of one is no match for another.
        roots: folders that the names are relative to, the preferred one first.
        folder: folder that is searched for other photos, with its subfolders.
    """

    def __init__(self, names: Iterable[str], roots: Sequence[Path], folder: Path) -> None:
        self._folder = folder
        self._names = names
        self._roots = roots
        self._by_stem: dict[str, list[Path]] | None = None
        self._moved: list[tuple[Path, Path]] = []
        self._expected_paths: dict[str, Path] = {}
        self._exact_paths: dict[str, Path] | None = None

    def find(self, name: str) -> Path:
        """Return a photo at its exported place, else the only photo below the folder with its name.

        The result is the expected path if there is no such photo.

        Raises:
            LodgsError: if several photos match.
        """
        expected = self._expected(name)
        if is_file(expected) or (path := self.locate(name)) is None:
            return expected
        self._moved.append((expected, path))
        return path

    def _expected(self, name: str) -> Path:
        """Return the photo at its exported place, or that place in the preferred folder."""
        if name not in self._expected_paths:
            exact = self._exact()
            places = [exact[name]] if name in exact else [find_image(root, name) for root in self._roots]
            others = set() if name in exact else set(exact.values())
            expected = next((path for path in places if is_file(path) and path not in others), None)
            self._expected_paths[name] = expected or _candidates(self._roots[0], name)[0]
        return self._expected_paths[name]

    def _exact(self) -> dict[str, Path]:
        """Return the photos by those of the names that need no other suffix or spelling."""
        if self._exact_paths is None:
            self._exact_paths = {}
            for name in self._names:
                paths = (path for root in self._roots for path in _candidates(root, name))
                path = next((path for path in paths if path.suffix in _SUFFIXES and is_file(path)), None)
                if path is not None:
                    self._exact_paths[name] = path
        return self._exact_paths

    def locate(self, name: str) -> Path | None:
        """Return the photo below the folder that has most of the name's last parts, or None.

        Raises:
            LodgsError: if several photos match. ``what`` continues a sentence such as "Skipped <name>:".
        """
        if self._by_stem is None:
            self._by_stem = {}
            claimed = set(map(self._expected, self._names))
            for path in walk_files(self._folder, NO_PHOTOS):
                if path.suffix in _SUFFIXES and path not in claimed:
                    self._by_stem.setdefault(_fold(path.stem), []).append(path)
        parts = _fold(name.replace("\\", "/")).split("/")
        stem = Path(parts[-1]).stem if _has_photo_suffix(Path(parts[-1])) else parts[-1]
        matches = self._by_stem.get(stem, [])
        ranks = [_shared_parts(parts, path) for path in matches]
        matches = [path for path, rank in zip(matches, ranks, strict=True) if rank == max(ranks)]
        if len(matches) > 1:
            raise LodgsError(f"several photos have this name, such as {matches[0]} and {matches[1]}.")
        return matches[0] if matches else None

    def warnings(self) -> list[str]:
        """Return a sentence about the photos found in another place than the export states."""
        if not self._moved:
            return []
        expected, path = self._moved[0]
        return [f"Found {len(self._moved):,} photos in another place, such as {path} instead of {expected}."]


def _shared_parts(parts: list[str], path: Path) -> tuple[int, bool]:
    """Return the number of equal parent folders at the end of two paths, and True for equal file names."""
    count = 0
    for part, folder in zip(reversed(parts[:-1]), reversed(path.parts[:-1]), strict=False):
        if part != _fold(folder):
            break
        count += 1
    return count, parts[-1] == _fold(path.name)


def _fold(name: str) -> str:
    """Return a name for comparison in one Unicode form and without case."""
    return unicodedata.normalize("NFC", name).casefold()
