"""Agisoft Metashape's cameras as XML (Export Cameras, Agisoft XML), photographs beside it.

Facts: Metashape's manual, appendix "Camera models": a frame camera's x' = x (1 + K1 r^2 + ...) +
P1 (r^2 + 2 x^2) + 2 P2 x y, u = w / 2 + cx + x' f + x' B1 + y' B2; so P1 is OpenCV's p2 and P2 its p1. A
fisheye's x is as long as its angle to the axis.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ...documents import open_file
from ...errors import LodgsError
from ..colmap import MASKS
from ..colmap_model import Intrinsics
from ..images import IMAGE_SUFFIXES
from .exported import (
    ExportedScene,
    ExportedView,
    colmap_lens,
    find_image,
    get_number,
    invert_pose,
    parse_array,
)

NAME = "Metashape XML"
MOST_BYTES = 1 << 26
"""Of a file that is read."""
_BEGIN = 4096
_COMPONENT = "component_id"
_IMAGES = "images", "photos", "Images", "."


def find(folder: Path) -> Path | None:
    """The first XML file that says that it is a Metashape document."""
    for path in sorted(folder.glob("*.xml")):
        try:
            with open_file(path) as file:
                if b"<document" in (begin := file.read(_BEGIN)) and b"<chunk" in begin:
                    return path
        except LodgsError:
            continue
    return None


def read(path: Path) -> ExportedScene:
    """Views of the first chunk, in the axes of its largest component, in metres where these are known.

    Other components, which Metashape has aligned by themselves, come along where it knows their place. The
    file tells of no points. The place of the chunk on earth is left out: splats need small numbers.

    Raises:
        LodgsError: the file is damaged.
    """
    chunk = _parsed(path).find("chunk")
    if chunk is None:
        raise LodgsError(f"{path} has no chunk.", "Export the cameras again.")
    lenses: dict[str, Intrinsics | LodgsError] = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        try:
            lenses[sensor.get("id", "")] = _lens(sensor)
        except LodgsError as error:
            lenses[sensor.get("id", "")] = error
    cameras = [camera for camera in chunk.iter("camera") if camera.get("label") is not None]
    aligned = [camera.get(_COMPONENT, "") for camera in cameras if camera.find("transform") is not None]
    largest = max(aligned, key=aligned.count, default="")
    places = {part.get("id", ""): _place(part) for part in chunk.iterfind("components/component")}
    place = places.get(largest)
    if place is None:
        place = places[largest] = np.eye(4) if (whole := _place(chunk)) is None else whole
    scale = np.cbrt(np.linalg.det(place[:3, :3]))
    files = _Files(path.parent, chunk)
    views, left_out = [], []
    for camera in cameras:
        label, transform = camera.get("label", ""), camera.findtext("transform")
        try:
            if camera.get("enabled") in ("0", "false"):
                raise LodgsError("it is disabled in Metashape.")
            if transform is None:
                raise LodgsError("it was not aligned.")
            its = places.get(camera.get(_COMPONENT, ""))
            if its is None:
                raise LodgsError("Metashape has not aligned it together with most of the others.")
            lens = lenses.get(camera.get("sensor_id", ""))
            if not isinstance(lens, Intrinsics):
                raise lens or LodgsError("it has no lens.")
            pose = np.linalg.solve(place, its @ parse_array(transform.split(), 4, 4))
            pose[:3, 3] *= scale
            views.append(ExportedView(files.find(camera), lens, invert_pose(pose)))
        except LodgsError as error:
            left_out.append((label, error.what))
    return ExportedScene(views, left_out=left_out)


def _parsed(path: Path) -> Element:
    with open_file(path) as file:
        data = file.read(MOST_BYTES + 1)
    try:
        if len(data) > MOST_BYTES or b"<!DOCTYPE" in data or b"<!ENTITY" in data:
            raise ValueError("it is too large, or defines entities")
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise LodgsError(f"{path} is no XML of Metashape ({error}).", "Export the cameras again.") from error


def _lens(sensor: Element) -> Intrinsics:
    """What Metashape has found, which stands last where it was given one before."""
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise LodgsError(f"its camera type {kind} is none that is known here.")
    found = [each for each in sensor.iterfind("calibration") if each.find("f") is not None]
    if not found:
        raise LodgsError("its lens has no calibration.")
    calibration = found[-1]
    resolution = calibration.find("resolution")
    size = dict((resolution if resolution is not None else sensor).items())
    told: dict[str, float] = {}
    try:
        told = {each.tag: float(each.text or "") for each in calibration if each.tag != "resolution"}
        width, height = float(size.get("width", 0)), float(size.get("height", 0))
    except ValueError as error:
        raise LodgsError("its calibration has something that is no number.") from error
    fisheye = kind == "fisheye"
    if told.get("k4") and not fisheye:
        raise LodgsError("its k4 is of a lens that COLMAP does not have; fix it at 0 in Metashape.")
    if abs(told.get("b2", 0.0)) > 0.5:
        raise LodgsError("its b2 is of a lens that COLMAP does not have; fix it at 0 in Metashape.")
    focal = get_number(told, "f")
    return colmap_lens(
        width, height, (focal + told.get("b1", 0.0), focal),
        (width / 2 + told.get("cx", 0.0), height / 2 + told.get("cy", 0.0)),
        tuple(told.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")),
        (told.get("p2", 0.0), told.get("p1", 0.0)), fisheye,
    )  # fmt: skip


def _place(part: Element) -> np.ndarray | None:
    """A chunk's or component's axes in the world, (4, 4): rotation, scale, translation; None: not known."""
    told = part.find("transform")
    if told is None:
        return None
    place = np.eye(4)
    try:
        scale = float(told.findtext("scale") or 1.0)
        place[:3, :3] = scale * parse_array((told.findtext("rotation") or "1 0 0 0 1 0 0 0 1").split(), 3, 3)
        place[:3, 3] = parse_array((told.findtext("translation") or "0 0 0").split(), 3)
        invert_pose(place)
    except (LodgsError, ValueError):
        return None
    return place


class _Files:
    """Photographs by what cameras are called: in the folder, or wherever they lie below it."""

    def __init__(self, folder: Path, chunk: Element) -> None:
        self._folder = folder
        self._groups = {
            camera: group.get("label", "") for group in chunk.iter("group") for camera in group.iter("camera")
        }
        self._below: dict[str, list[Path]] | None = None

    def find(self, camera: Element) -> Path:
        """A camera's photograph; where there is none, the place where it should be.

        Raises:
            LodgsError: there are several.
        """
        label = camera.get("label", "")
        places = [find_image(self._folder / name, label) for name in _IMAGES]
        for place in places:
            if place.is_file():
                return place
        if self._below is None:
            self._below = {}
            for file in sorted(self._folder.rglob("*")):
                if file.suffix.lower() in IMAGE_SUFFIXES and not file.is_relative_to(self._folder / MASKS):
                    for name in (file.name, file.stem):
                        self._below.setdefault(name, []).append(file)
        found = self._below.get(label, [])
        if len(found) > 1:  # groups are called as the folders that they were made of
            group = self._groups.get(camera)
            found = [file for file in found if file.parent.name == group] or found
        if len(found) > 1:
            raise LodgsError(f"several photographs are called so, such as {found[0]} and {found[1]}.")
        return found[0] if found else places[0]
