"""Agisoft Metashape's cameras as XML (Export Cameras, Agisoft XML), next to the photos.

Format: Metashape's manual, appendix "Camera models". A frame camera has x' = x (1 + K1 r^2 + ...) +
P1 (r^2 + 2 x^2) + 2 P2 x y and u = w / 2 + cx + x' f + x' B1 + y' B2, so P1 is OpenCV's p2 and P2 its p1. A
fisheye's x has the length of its angle to the axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ...documents import DECIMAL_COMMAS, has_decimal_commas, open_text
from ...errors import LodgsError
from ...files import is_file
from ...splats.georeference import ECEF, Georeference, is_on_earth
from ..lenses import Intrinsics
from .exported import (
    ExportedScene,
    ExportedView,
    PhotoFinder,
    colmap_lens,
    find_image,
    get_number,
    invert_pose,
    parse_array,
    parse_xml,
    visible_files,
)

NAME = "Metashape XML"
MAX_SKEW = 0.5
"""Maximum b2 in pixels that is ignored; larger values are an error."""
_HEAD_BYTES = 4096
_COMPONENT = "component_id"
_LOCAL = "LOCAL_CS", "ENGCRS", "Local"
"""First words of WKT for coordinates without a place on Earth."""
_FISHEYES = "fisheye", "equidistant_fisheye"
"""Camera types of Metashape 1 and 2 whose x' is the angle; that of an equisolid fisheye is not."""
_IMAGES = "images", "photos", "Images", "."


def find(folder: Path) -> Path | None:
    """Return the first XML file with the elements of a Metashape document."""
    try:
        files = visible_files(folder)
    except OSError:
        return None
    for path in (path for path in files if path.suffix.lower() == ".xml"):
        try:
            with open_text(path) as file:
                if b"<document" in (head := file.read(_HEAD_BYTES)) and b"<chunk" in head:
                    return path
        except LodgsError:
            continue
    return None


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views of the chunk with most aligned cameras, in metres if known.

    The axes are those of the chunk's largest component. Other components, which Metashape aligned separately,
    are included if their transform is known. The file has no points. The chunk's transform into geocentric
    coordinates, if it is georeferenced, is the georeference, because splats need small coordinates.

    Raises:
        LodgsError: the file is damaged.
    """
    chunks = parse_xml(path, "Metashape").findall("chunk")
    if not chunks:
        raise LodgsError(f"Cannot read {path}: it has no chunk.", "Export the cameras again.")
    counts = [len(chunk.findall("cameras//transform")) for chunk in chunks]
    others = sum(counts) - max(counts)
    warnings = [f"Skipped {others:,} cameras in other chunks of {path}."] if others else []
    chunk = _Chunk(chunks[counts.index(max(counts))], path.parent, folder)
    views, excluded = [], []
    for camera in chunk.cameras:
        try:
            views.append(chunk.view(camera))
        except LodgsError as error:
            excluded.append((camera.get("label", ""), error.what))
    return ExportedScene(views, excluded=excluded, warnings=warnings, georeference=chunk.georeference)


class _Chunk:
    """A chunk with its lenses, and the transforms of its components.

    Args:
        folder: folder of the XML file.
        search: folder with photos.

    Attributes:
        cameras: cameras with a label.
        georeference: place of the views on Earth, None if the chunk has none.
    """

    def __init__(self, chunk: Element, folder: Path, search: Path) -> None:
        self.cameras = [camera for camera in chunk.iter("camera") if camera.get("label") is not None]
        self._by_id = {camera.get("id", ""): camera for camera in chunk.iter("camera")}
        self._sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
        self._lenses = {name: _lens_or_error(sensor) for name, sensor in self._sensors.items()}
        self._files = _LabelFinder(folder, chunk, search)
        self._transforms = {
            part.get("id", ""): _parse_transform(part) for part in chunk.iterfind("components/component")
        }
        aligned = [
            camera.get(_COMPONENT, "") for camera in self.cameras if camera.find("transform") is not None
        ]
        largest = max(aligned, key=aligned.count, default="")
        base = self._transforms.get(largest)
        if base is None:
            transform = _parse_transform(chunk)
            base = self._transforms[largest] = np.eye(4) if transform is None else transform
        self._base, self._scale = base, np.cbrt(np.linalg.det(base[:3, :3]))
        system = (chunk.findtext("reference") or "").strip()
        self.georeference = None
        if system and not system.startswith(_LOCAL) and is_on_earth(base[:3, 3]):
            self.georeference = Georeference(ECEF, base @ np.diag([1 / self._scale] * 3 + [1.0]))

    def view(self, camera: Element) -> ExportedView:
        """Return the view of a camera, in the axes of the largest component and in metres if known.

        Raises:
            LodgsError: the camera is disabled or not aligned, or has no supported lens; the reason is a
                clause.
        """
        if camera.get("enabled") in ("0", "false"):
            raise LodgsError("it is disabled in Metashape.")
        local, aligned_camera = _rig_pose(camera, self._by_id, self._sensors)
        transform = self._transforms.get(aligned_camera.get(_COMPONENT, ""))
        if transform is None:
            raise LodgsError("Metashape did not align it with the largest group of photos.")
        lens = self._lenses.get(camera.get("sensor_id", ""))
        if not isinstance(lens, Intrinsics):
            raise lens or LodgsError("it has no lens.")
        pose = np.linalg.solve(self._base, transform @ local)
        pose[:3, 3] *= self._scale
        return ExportedView(self._files.find(camera), lens, invert_pose(pose))


def _lens_or_error(sensor: Element) -> Intrinsics | LodgsError:
    """Return the lens of a sensor, or the reason why it cannot be used."""
    try:
        return _parse_lens(sensor)
    except LodgsError as error:
        return error


def _parse_lens(sensor: Element) -> Intrinsics:
    """Return the adjusted calibration, which follows the initial one if both exist."""
    kind = sensor.get("type", "frame")
    if kind not in ("frame", *_FISHEYES):
        raise LodgsError(f"camera type {kind} is not supported.")
    calibrations = [entry for entry in sensor.iterfind("calibration") if entry.find("f") is not None]
    if not calibrations:
        raise LodgsError("its lens has no calibration.")
    adjusted = [entry for entry in calibrations if entry.get("class") == "adjusted"]
    calibration = (adjusted or calibrations)[-1]
    resolution = calibration.find("resolution")
    size = dict((resolution if resolution is not None else sensor).items())
    values: dict[str, float] = {}
    try:
        values = {entry.tag: float(entry.text or "") for entry in calibration if entry.tag != "resolution"}
        width, height = float(size.get("width", 0)), float(size.get("height", 0))
    except ValueError as error:
        if has_decimal_commas(str(error)):
            raise LodgsError(f"{DECIMAL_COMMAS}.") from error
        raise LodgsError("its calibration has a value that is not a number.") from error
    fisheye = kind in _FISHEYES
    remedy = "has no equivalent among COLMAP's lenses: fix it to 0 in Metashape."
    unsupported = ("p3", "p4") if fisheye else ("k4", "p3", "p4")
    if name := next((name for name in unsupported if values.get(name)), ""):
        raise LodgsError(f"its {name} {remedy}")
    if abs(values.get("b2", 0.0)) > MAX_SKEW:
        raise LodgsError(f"its b2 {remedy}")
    focal = get_number(values, "f")
    return colmap_lens(
        width, height, (focal + values.get("b1", 0.0), focal),
        (width / 2 + values.get("cx", 0.0), height / 2 + values.get("cy", 0.0)),
        tuple(values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")),
        (values.get("p2", 0.0), values.get("p1", 0.0)), fisheye,
    )  # fmt: skip


def _rig_pose(
    camera: Element, cameras: Mapping[str, Element], sensors: Mapping[str, Element]
) -> tuple[np.ndarray, Element]:
    """Return a camera's pose (4, 4) in its component, and the camera whose transform states it.

    A camera of a rig without a transform has the pose of its master, times the offset of its own sensor in
    the frame of the master's sensor (Metashape's Sensor.location and Sensor.rotation, in the chunk's units).

    Raises:
        LodgsError: if neither the camera nor a master is aligned, or an offset is missing or invalid.
    """
    offset = np.eye(4)
    for _ in range(len(cameras) + 1):
        if (text := camera.findtext("transform")) is not None:
            return parse_array(text.split(), 4, 4) @ offset, camera
        master = cameras.get(camera.get("master_id", ""))
        if master is None or master is camera:
            break
        own, other = (sensors.get(entry.get("sensor_id", "")) for entry in (camera, master))
        # The rig's reference sensor may differ from the sensor of the reference camera.
        offset = np.linalg.solve(_sensor_offset(other), _sensor_offset(own)) @ offset
        camera = master
    raise LodgsError("Metashape did not align it.")


def _sensor_offset(sensor: Element | None) -> np.ndarray:
    """Return the pose (4, 4) of a sensor in the frame of its rig; the identity for a master."""
    offset = np.eye(4)
    part = sensor if sensor is None or sensor.find("rig") is None else sensor.find("rig")
    if part is None:
        return offset
    rotation, location = (part.findtext(name, "").split() for name in ("rotation", "location"))
    if sensor is not None and sensor.get("master_id") is not None and not (rotation or location):
        raise LodgsError("its sensor has no position in its rig.")
    if rotation:  # older versions write empty elements
        offset[:3, :3] = parse_array(rotation, 3, 3)
    if location:
        offset[:3, 3] = parse_array(location, 3)
    invert_pose(offset)
    return offset


def _parse_transform(part: Element) -> np.ndarray | None:
    """Return the transform of a chunk or component to the world, (4, 4) with scale; None if unknown."""
    element = part.find("transform")
    if element is None:
        return None
    transform = np.eye(4)
    try:
        scale = float(element.findtext("scale") or 1.0)
        rotation = parse_array((element.findtext("rotation") or "1 0 0 0 1 0 0 0 1").split(), 3, 3)
        transform[:3, :3] = scale * rotation
        transform[:3, 3] = parse_array((element.findtext("translation") or "0 0 0").split(), 3)
        invert_pose(transform)
    except (LodgsError, ValueError):
        return None
    return transform


class _LabelFinder:
    """Finder of photos by camera label, in the usual folders next to the export or anywhere in another one.

    Args:
        folder: folder of the export.
        search: the other folder.
    """

    def __init__(self, folder: Path, chunk: Element, search: Path) -> None:
        self._folder = folder
        self._groups = {
            camera: group.get("label", "") for group in chunk.iter("group") for camera in group.iter("camera")
        }
        self._photos = PhotoFinder((), [folder], search)

    def find(self, camera: Element) -> Path:
        """Return a camera's photo, or the expected path if there is no photo.

        Raises:
            LodgsError: several photos match.
        """
        label = camera.get("label", "")
        for name in _IMAGES:
            path = find_image(self._folder / name, label)
            if is_file(path):
                return path
        # Metashape names groups after their folders.
        return (
            self._photos.locate(f"{self._groups.get(camera, '')}/{label}") or self._folder / "images" / label
        )
