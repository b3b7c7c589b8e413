"""Agisoft Metashape's cameras as XML (Export Cameras, Agisoft XML), photographs beside it.

Facts: Metashape's manual, appendix "Camera models": a frame camera's x' = x (1 + K1 r^2 + ...) +
P1 (r^2 + 2 x^2) + 2 P2 x y, u = w / 2 + cx + x' f + x' B1 + y' B2; so P1 is OpenCV's p2 and P2 its p1.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ...documents import open_file
from ...errors import LodgsError
from ..model import Intrinsics
from .views import Exported, View, find_image, lens_of, number, numbers, world_to_camera

NAME = "Metashape XML"
MOST_BYTES = 1 << 26
"""Of a file that is read."""
_BEGIN = 4096
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


def read(path: Path) -> Exported:
    """Views of the first chunk, in its own axes, in its unit where it has one.

    The file tells of no points. The place of the chunk on earth is left out: splats need small numbers.

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
    scale = _scale(chunk)
    views, left_out = [], []
    for camera in chunk.iter("camera"):
        label, transform = camera.get("label", ""), camera.findtext("transform")
        if camera.get("label") is None:
            continue
        try:
            if transform is None:
                raise LodgsError("it was not aligned.")
            lens = lenses.get(camera.get("sensor_id", ""))
            if not isinstance(lens, Intrinsics):
                raise lens or LodgsError("it has no lens.")
            pose = numbers(transform.split(), 4, 4)
            pose[:3, 3] *= scale
            views.append(View(_image(path.parent, label), lens, world_to_camera(pose)))
        except LodgsError as error:
            left_out.append((label, error.what))
    return Exported(views, left_out=left_out)


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
    if kind not in ("frame", "fisheye_none"):
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
    if told.get("k4"):
        raise LodgsError("its k4 is of a lens that COLMAP does not have; fix it at 0 in Metashape.")
    if abs(told.get("b2", 0.0)) > 0.5:
        raise LodgsError("its b2 is of a lens that COLMAP does not have; fix it at 0 in Metashape.")
    focal = number(told, "f")
    return lens_of(
        width, height, (focal + told.get("b1", 0.0), focal),
        (width / 2 + told.get("cx", 0.0), height / 2 + told.get("cy", 0.0)),
        tuple(told.get(name, 0.0) for name in ("k1", "k2", "k3")), (told.get("p2", 0.0), told.get("p1", 0.0)),
    )  # fmt: skip


def _scale(chunk: Element) -> float:
    """Of a chunk's length how many metres it is; 1 where that is not known."""
    try:
        scale = float(chunk.findtext("transform/scale") or 1.0)
    except ValueError:
        return 1.0
    return scale if np.isfinite(scale) and scale > 0 else 1.0


def _image(folder: Path, label: str) -> Path:
    places = [find_image(folder / name, label) for name in _IMAGES]
    return next((place for place in places if place.is_file()), places[0])
