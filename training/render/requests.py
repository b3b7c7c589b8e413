"""Requests to the renderer (``serve``): parsing and checks."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from ..documents import parse_json
from ..editing.look import LOOK_SETTINGS, Look, Looks
from ..errors import LodgsError
from ..lod.crop import SHAPES, Crop
from ..lod.query import LodQuery
from ..lod.rule import NO_RULE, Rule, fact_names, find_rule
from ..scenes.cameras import MAX_COORDINATE, Camera, camera_from_dict, check_render_size
from .lens import MAX_ANGLE, MAX_SAMPLES, PROJECTIONS, SHARP, Aperture, LensProjection

MAX_BACKGROUND = 1e6
"""Maximum component of a background colour."""
MAX_SPLATS = 1 << 30
"""Maximum number of splats of a set."""
MAX_LEVEL_NUMBER = 1 << 15
MAX_NUMBER = 1e30
"""Maximum magnitude of a rule's arguments, which fit in single precision."""
MAX_COLUMNS = 32
"""Maximum number of columns of a table or a set."""
MAX_ROWS = 4096
"""Maximum number of rows of a table."""
MAX_CROPS = 256
MAX_KEYS = 64
"""Maximum number of times at which a frame gives moving cameras and sets."""
MAX_BLADES = 256

_NAME = re.compile(r"[\w-][\w.-]{0,99}", re.ASCII)


@dataclass(frozen=True)
class CancelRequest:
    """A request to cancel a frame."""

    frame: int


@dataclass(frozen=True)
class SetRequest:
    """A set of splats in a file or a paged bundle, see ``scene.Instance``.

    Attributes:
        file: file name in the folder of arrays; "" for a paged bundle.
        count: number of splats.
        matrix, level, antialias, looks, motion: see ``scene.Instance``.
        columns: names of the extra columns in the file.
        query: rule and arguments that weight the splats in addition to the file's weights, or None.
        paged: path of a bundle from which only the splats that the query selects are read; or None.
    """

    file: str
    count: int
    matrix: np.ndarray
    level: int
    antialias: bool = False
    columns: tuple[str, ...] = ()
    query: LodQuery | None = None
    paged: Path | None = None
    looks: Looks = ()
    motion: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class FrameRequest:
    """A request for an image: the arguments of ``blur.draw_blurred``, and those below.

    Attributes:
        frame: number of the frame.
        out: name of the file for the planes in the folder of arrays.
        photograph: photo to compare with, or None.
        mask: image that excludes black pixels from the comparison, or None.
        holdout: EXR with depths of meshes, or None.
        samples, aperture, cameras: see ``blur.Blur``.
    """

    frame: int
    out: str
    camera: Camera
    near: float
    background: tuple[float, float, float] | None
    depth: bool
    levels: bool
    window: tuple[int, int, int, int] | None
    photograph: Path | None
    mask: Path | None
    holdout: Path | None
    sets: list[SetRequest]
    projection: LensProjection = SHARP
    samples: int = 1
    aperture: Aperture | None = None
    cameras: tuple[Camera, ...] = ()

    @property
    def is_one_view(self) -> bool:
        """True if the image is a single pinhole view, without blur or panorama."""
        moves = self.cameras or any(item.motion for item in self.sets)
        return self.projection == SHARP and self.aperture is None and not moves


def frame_number(values: dict) -> int | None:
    """Return the frame number of a request, or None."""
    frame = values.get("frame")
    return frame if _is_integer(frame) else None


def parse_line(line: bytes) -> dict:
    """Parse the JSON object of a request.

    Raises:
        LodgsError: the line is not a JSON object, or exceeds a limit of ``documents``.
    """
    return parse_json(line, "A request")


def parse_request(values: dict) -> FrameRequest | CancelRequest:
    """Check a request and convert it.

    Raises:
        LodgsError: a value is missing or invalid.
    """
    if "cancel" in values:
        return CancelRequest(_integer(values, "cancel"))
    frame = _integer(values, "frame")
    camera, near = camera_from_dict(_typed(values, "camera", dict))
    window = _window(values, camera)
    check_render_size(*(window[2:] if window else (camera.width, camera.height)))
    photo, background = _path(values, "photograph"), None
    if photo and window:
        raise _invalid("photograph", "given together with a window")
    if values.get("background") is not None:
        red, green, blue = _numbers(values, "background", 3, MAX_BACKGROUND)
        background = red, green, blue
    return FrameRequest(
        frame=frame,
        out=_name(values, "out"),
        camera=camera,
        near=near,
        background=background,
        depth=bool(values.get("depth")),
        levels=bool(values.get("levels")),
        window=window,
        photograph=photo,
        mask=_path(values, "mask"),
        holdout=_path(values, "holdout"),
        sets=[_set(item) for item in _typed(values, "sets", list)],
        projection=_projection(values),
        samples=_integer({"samples": 1} | values, "samples", 1, MAX_SAMPLES),
        aperture=_aperture(values),
        cameras=_cameras(values),
    )


def _keys(values: dict, key: str) -> list:
    """Return the values of the times at which something moves; none for something at rest."""
    items = _typed({key: []} | values, key, list)
    if len(items) > MAX_KEYS:
        raise _invalid(key, f"{len(items)} items")
    return items


def _cameras(values: dict) -> tuple[Camera, ...]:
    items = [_typed({"cameras": item}, "cameras", dict) for item in _keys(values, "cameras")]
    return tuple(camera_from_dict(item)[0] for item in items)


def _projection(values: dict) -> LensProjection:
    item = _typed({"projection": SHARP.as_dict()} | values, "projection", dict)
    (distance,) = _numbers({"distance": [item.get("distance")]}, "distance", 1, MAX_COORDINATE)
    west, east = _numbers({"longitude": _pair(item, "longitude")}, "longitude", 2, MAX_ANGLE)
    south, north = _numbers({"latitude": _pair(item, "latitude")}, "latitude", 2, MAX_ANGLE)
    if item.get("kind") not in PROJECTIONS or not (distance > 0 and west < east and south < north):
        raise _invalid("projection", item)
    return LensProjection(item["kind"], distance, (west, east), (south, north))


def _pair(values: dict, key: str) -> list:
    return list(values[key]) if isinstance(values.get(key), list | tuple) else []


def _aperture(values: dict) -> Aperture | None:
    if values.get("aperture") is None:
        return None
    item = _typed(values, "aperture", dict)
    names = "radius", "focus", "rotation", "ratio"
    numbers = _numbers({"aperture": [item.get(name) for name in names]}, "aperture", 4, MAX_COORDINATE)
    radius, focus, rotation, ratio = numbers
    if not (radius >= 0 and focus > 0 and ratio > 0):
        raise _invalid("aperture", item)
    return Aperture(radius, focus, _integer(item, "blades", 0, MAX_BLADES), rotation, ratio)


def _set(values: Any) -> SetRequest:
    if not isinstance(values, dict):
        raise _invalid("sets", values)
    paged = _path(values, "paged")
    query = _query(_typed(values, "query", dict)) if values.get("query") is not None else None
    if paged is not None and (query is None or query.resolved_rule.paged_file is None):
        raise _invalid("query", "given with a paged file")
    return SetRequest(
        file="" if paged else _name(values, "file"),
        count=0 if paged else _integer(values, "count", 0, MAX_SPLATS),
        matrix=_matrix(values),
        level=0 if paged else _integer(values, "level", 0, MAX_LEVEL_NUMBER),
        antialias=bool(values.get("antialias")),
        columns=_columns(values),
        query=query,
        paged=paged,
        looks=_looks(values),
        motion=tuple(_matrix({"matrix": item}) for item in _keys(values, "motion")),
    )


def _matrix(values: dict) -> np.ndarray:
    matrix = np.array(_typed(values, "matrix", list), object)
    if matrix.shape != (4, 4):
        raise _invalid("matrix", values["matrix"])
    matrix = np.reshape(_numbers({"matrix": matrix.ravel().tolist()}, "matrix", 16, MAX_COORDINATE), (4, 4))
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise _invalid("matrix", values["matrix"])
    return matrix


def _columns(values: dict) -> tuple[str, ...]:
    columns = _typed({"columns": []} | values, "columns", list)
    names = tuple(_name({"columns": column}, "columns") for column in columns)
    if len(names) > MAX_COLUMNS or len(set(names)) < len(names):
        raise _invalid("columns", columns)
    return names


def _query(values: dict) -> LodQuery:
    name = _typed(values, "rule", str)
    rule = find_rule(name) if name else NO_RULE
    if rule is None:
        raise _invalid("rule", name)
    x, y, z = _numbers(values, "position", 3, MAX_COORDINATE)
    (focal_px,) = _numbers({"focal_px": [values.get("focal_px")]}, "focal_px", 1, MAX_NUMBER)
    controls = _named_numbers(values, "values", [control.name for control in rule.controls])
    for control in rule.controls:  # limits are rounded to single precision, as Blender's sliders do
        if not np.float32(control.low) <= np.float32(controls[control.name]) <= np.float32(control.high):
            raise _invalid(control.name, controls[control.name])
    facts = _named_numbers(values, "facts", fact_names(rule) if name else [])
    return LodQuery(
        rule.name, (x, y, z), focal_px, tuple(facts.items()), tuple(controls.items()), _tables(values, rule),
        _crops(values),
    )  # fmt: skip


def _crops(values: dict) -> tuple[Crop, ...] | None:
    if values.get("crops") is None:
        return None
    return tuple(map(_crop, _short_list(values, "crops")))


def _short_list(values: dict, key: str) -> list:
    items = _typed(values, key, list)
    if len(items) > MAX_CROPS:
        raise _invalid(key, f"{len(items)} items")
    return items


def _crop(values: Any) -> Crop:
    if not isinstance(values, dict) or values.get("shape") not in SHAPES:
        raise _invalid("crops", values)
    rows = _typed(values, "to_local", list)
    if len(rows) != 3:
        raise _invalid("to_local", rows)
    a, b, c = (_numbers({"to_local": row}, "to_local", 4, MAX_NUMBER) for row in rows)
    return Crop(values["shape"], tuple(map(tuple, (a, b, c))), bool(values.get("outside")))


def _looks(values: dict) -> Looks:
    looks = []
    for item in _short_list({"looks": []} | values, "looks"):
        if not isinstance(item, dict):
            raise _invalid("looks", item)
        look = dict(_typed(item, "look", dict))
        red, green, blue = _numbers(look, "tint", 3, MAX_NUMBER)
        del look["tint"]
        numbers = _named_numbers({"look": look}, "look", [name for name in LOOK_SETTINGS if name != "tint"])
        crop = None if item.get("crop") is None else _crop(item["crop"])
        looks.append((crop, Look(tint=(red, green, blue), **numbers)))
    return tuple(looks)


def _tables(values: dict, rule: Rule) -> tuple:
    """Return the tables in the form of ``LodQuery``; all must belong to the rule."""
    tables = []
    for name, table in _typed({"tables": {}} | values, "tables", dict).items():
        if name not in rule.tables or not isinstance(table, dict) or len(table) > MAX_COLUMNS:
            raise _invalid("tables", name)
        lengths = {len(_typed(table, column, list)) for column in table}
        if len(lengths) > 1 or max(lengths, default=0) > MAX_ROWS:
            raise _invalid(name, f"columns of {sorted(lengths)} rows")
        rows = {column: _numbers(table, column, len(table[column]), MAX_NUMBER) for column in table}
        tables.append((name, tuple((column, "<f8", np.array(row).tobytes()) for column, row in rows.items())))
    return tuple(tables)


def _named_numbers(values: dict, key: str, names: list[str]) -> dict[str, float]:
    """Return the numbers of an object with exactly these names, in their order."""
    items = _typed(values, key, dict)
    if items.keys() != set(names):
        raise _invalid(key, sorted(items))
    numbers = _numbers({key: [items[name] for name in names]}, key, len(names), MAX_NUMBER)
    return dict(zip(names, numbers, strict=True))


def _window(values: dict, camera: Camera) -> tuple[int, int, int, int] | None:
    if not values.get("window"):
        return None
    window = _typed(values, "window", list)
    if len(window) != 4 or not all(_is_integer(value) for value in window):
        raise _invalid("window", window)
    left, top, width, height = window
    if not (0 <= left < left + width <= camera.width and 0 <= top < top + height <= camera.height):
        raise _invalid("window", window)
    return left, top, width, height


def _numbers(values: dict, key: str, count: int, maximum: float) -> list[float]:
    numbers = _typed(values, key, list)
    is_valid = len(numbers) == count and all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= maximum
        for value in numbers
    )
    if not is_valid:
        raise _invalid(key, numbers)
    return [float(value) for value in numbers]


def _integer(values: dict, key: str, minimum: int = -(1 << 62), maximum: int = 1 << 62) -> int:
    value = values.get(key)
    if not (_is_integer(value) and minimum <= value <= maximum):
        raise _invalid(key, value)
    return int(value)


def _is_integer(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _name(values: dict, key: str) -> str:
    """Return a plain file name, which cannot lead to another folder."""
    name = _typed(values, key, str)
    if not _NAME.fullmatch(name):
        raise _invalid(key, name)
    return name


def _path(values: dict, key: str) -> Path | None:
    return Path(_typed(values, key, str)) if values.get(key) is not None else None


def _typed(values: dict, key: str, kind: type) -> Any:
    value = values.get(key)
    if not isinstance(value, kind):
        raise _invalid(key, value)
    return value


def _invalid(key: str, value: Any) -> LodgsError:
    text = "nothing" if value is None else repr(value)
    text = text if len(text) < 100 else f"{text[:100]}..."
    return LodgsError(
        f'Cannot read the request: "{key}" cannot be {text}.',
        "Use an extension and a trainer of the same version.",
    )
