"""What other programs ask ``serve`` for: the one place where a request is read and checked."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from ..documents import parse_json
from ..editing.look import RANGES, Look
from ..errors import LodgsError
from ..lod.crop import SHAPES, Crop
from ..lod.query import LodQuery
from ..lod.rule import NO_RULE, Rule, fact_names, find_rule
from ..lod.rules.cut import RULE as CUT
from ..scenes.cameras import MAX_COORDINATE, Camera, camera_from_dict, check_render_size

MAX_BACKGROUND = 1e6
"""No colour of a background is larger."""
MAX_SPLATS = 1 << 30
"""Splats of one set."""
MAX_LEVEL_NUMBER = 1 << 15
MAX_NUMBER = 1e30
"""Of numbers that a rule is told: single precision holds them."""
MAX_COLUMNS, MAX_ROWS = 32, 4096
"""Of a table, and columns of a set."""
MAX_CROPS = 256

_NAME = re.compile(r"[\w-][\w.-]{0,99}", re.ASCII)


@dataclass(frozen=True)
class CancelRequest:
    """Do not draw a frame, or stop drawing it."""

    frame: int


@dataclass(frozen=True)
class SetRequest:
    """A set of splats in a file, and where it stands; see ``scene.Instance``.

    Attributes:
        file: a name in the folder of arrays.
        looks: what is made of its colours and opacities, and where; see ``scene.Instance``.
        tree: a bundle of the rule ``cut`` somewhere else, of which the choice's cut is read instead, with its
            levels; or None.
        count: of its splats.
        antialias: see ``scene.Instance``.
        columns: names of the further columns that the file has.
        choice: by what its splats are weighted, on top of the file's weights; None: by these alone.
    """

    file: str
    count: int
    matrix: np.ndarray
    level: int
    antialias: bool = False
    columns: tuple[str, ...] = ()
    choice: LodQuery | None = None
    tree: Path | None = None
    looks: tuple[tuple[Crop | None, Look], ...] = ()


@dataclass(frozen=True)
class FrameRequest:
    """A picture that is asked for: the arguments of ``scene.draw``, and

    Attributes:
        frame: its number.
        out: the file for its planes, a name in the folder of arrays.
        photograph: to compare with, or None.
        mask: black where the photograph does not count, or None.
        holdout: EXR of meshes' depths, or None.
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


def frame_number(values: dict) -> int | None:
    """The number of the frame that a request is about, if it has one."""
    frame = values.get("frame")
    return frame if _is_whole(frame) else None


def parse_line(line: bytes) -> dict:
    """A request as it came.

    Raises:
        LodgsError: it is no JSON object, or breaks a bound of ``documents``.
    """
    return parse_json(line, "A request")


def parse_request(values: dict) -> FrameRequest | CancelRequest:
    """A request, checked.

    Raises:
        LodgsError: it lacks something, or something in it is impossible.
    """
    if "cancel" in values:
        return CancelRequest(_whole(values, "cancel"))
    frame = _whole(values, "frame")
    camera, near = camera_from_dict(_of_kind(values, "camera", dict))
    window = _window(values, camera)
    check_render_size(*(window[2:] if window else (camera.width, camera.height)))
    photograph, background = _path(values, "photograph"), None
    if photograph and window:
        raise _refused("photograph", "given beside a window")
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
        photograph=photograph,
        mask=_path(values, "mask"),
        holdout=_path(values, "holdout"),
        sets=[_named_set(one) for one in _of_kind(values, "sets", list)],
    )


def _named_set(values: Any) -> SetRequest:
    if not isinstance(values, dict):
        raise _refused("sets", values)
    matrix = np.array(_of_kind(values, "matrix", list), object)
    if matrix.shape != (4, 4):
        raise _refused("matrix", values["matrix"])
    matrix = np.reshape(_numbers({"matrix": matrix.ravel().tolist()}, "matrix", 16, MAX_COORDINATE), (4, 4))
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise _refused("matrix", values["matrix"])
    tree = _path(values, "tree")
    choice = _choice(_of_kind(values, "choice", dict)) if values.get("choice") is not None else None
    if tree is not None and (choice is None or choice.rule != CUT.name):
        raise _refused("choice", "given with a tree")
    return SetRequest(
        file="" if tree else _name(values, "file"),
        count=0 if tree else _whole(values, "count", 0, MAX_SPLATS),
        matrix=matrix,
        level=0 if tree else _whole(values, "level", 0, MAX_LEVEL_NUMBER),
        antialias=bool(values.get("antialias")),
        columns=_columns(values),
        choice=choice,
        tree=tree,
        looks=_looks(values),
    )


def _columns(values: dict) -> tuple[str, ...]:
    given = _of_kind({"columns": []} | values, "columns", list)
    names = tuple(_name({"columns": name}, "columns") for name in given)
    if len(names) > MAX_COLUMNS or len(set(names)) < len(names):
        raise _refused("columns", given)
    return names


def _choice(values: dict) -> LodQuery:
    name = _of_kind(values, "rule", str)
    rule = find_rule(name) if name else NO_RULE
    if rule is None:
        raise _refused("rule", name)
    x, y, z = _numbers(values, "eye", 3, MAX_COORDINATE)
    (focal_px,) = _numbers({"focal_px": [values.get("focal_px")]}, "focal_px", 1, MAX_NUMBER)
    controls = _by_name(values, "values", [control.name for control in rule.controls])
    for control in rule.controls:  # the ends of a slider, as single precision has them, are possible
        if not np.float32(control.low) <= np.float32(controls[control.name]) <= np.float32(control.high):
            raise _refused(control.name, controls[control.name])
    facts = _by_name(values, "facts", fact_names(rule) if name else [])
    return LodQuery(
        rule.name, (x, y, z), focal_px, tuple(facts.items()), tuple(controls.items()), _tables(values, rule),
        _crops(values),
    )  # fmt: skip


def _crops(values: dict) -> tuple[Crop, ...] | None:
    if values.get("crops") is None:
        return None
    return tuple(map(_crop, _some(values, "crops")))


def _some(values: dict, key: str) -> list:
    given = _of_kind(values, key, list)
    if len(given) > MAX_CROPS:
        raise _refused(key, f"{len(given)} of them")
    return given


def _crop(crop: Any) -> Crop:
    if not isinstance(crop, dict) or crop.get("shape") not in SHAPES:
        raise _refused("crops", crop)
    rows = _of_kind(crop, "to_own", list)
    if len(rows) != 3:
        raise _refused("to_own", rows)
    a, b, c = (_numbers({"to_own": row}, "to_own", 4, MAX_NUMBER) for row in rows)
    return Crop(crop["shape"], tuple(map(tuple, (a, b, c))), bool(crop.get("outside")))


def _looks(values: dict) -> tuple[tuple[Crop | None, Look], ...]:
    found = []
    for one in _some({"looks": []} | values, "looks"):
        if not isinstance(one, dict):
            raise _refused("looks", one)
        look = dict(_of_kind(one, "look", dict))
        red, green, blue = _numbers(look, "tint", 3, MAX_NUMBER)
        del look["tint"]
        parts = _by_name({"look": look}, "look", [name for name in RANGES if name != "tint"])
        crop = None if one.get("crop") is None else _crop(one["crop"])
        found.append((crop, Look(tint=(red, green, blue), **parts)))
    return tuple(found)


def _tables(values: dict, rule: Rule) -> tuple:
    """Tables as ``LodQuery`` has them; those that the rule knows, if any."""
    found = []
    for name, table in _of_kind({"tables": {}} | values, "tables", dict).items():
        if name not in rule.tables or not isinstance(table, dict) or len(table) > MAX_COLUMNS:
            raise _refused("tables", name)
        lengths = {len(_of_kind(table, column, list)) for column in table}
        if len(lengths) > 1 or max(lengths, default=0) > MAX_ROWS:
            raise _refused(name, "of such columns")
        rows = {column: _numbers(table, column, len(table[column]), MAX_NUMBER) for column in table}
        found.append((name, tuple((column, "<f8", np.array(row).tobytes()) for column, row in rows.items())))
    return tuple(found)


def _by_name(values: dict, key: str, names: list[str]) -> dict[str, float]:
    """An object of numbers with just these names, in their order."""
    given = _of_kind(values, key, dict)
    if given.keys() != set(names):
        raise _refused(key, sorted(given))
    numbers = _numbers({key: [given[name] for name in names]}, key, len(names), MAX_NUMBER)
    return dict(zip(names, numbers, strict=True))


def _window(values: dict, camera: Camera) -> tuple[int, int, int, int] | None:
    if not values.get("window"):
        return None
    given = _of_kind(values, "window", list)
    if len(given) != 4 or not all(_is_whole(value) for value in given):
        raise _refused("window", given)
    left, top, width, height = given
    if not (0 <= left < left + width <= camera.width and 0 <= top < top + height <= camera.height):
        raise _refused("window", given)
    return left, top, width, height


def _numbers(values: dict, key: str, count: int, largest: float) -> list[float]:
    given = _of_kind(values, key, list)
    fine = len(given) == count and all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest
        for value in given
    )
    if not fine:
        raise _refused(key, given)
    return [float(value) for value in given]


def _whole(values: dict, key: str, least: int = -(1 << 62), most: int = 1 << 62) -> int:
    value = values.get(key)
    if not (_is_whole(value) and least <= value <= most):
        raise _refused(key, value)
    return int(value)


def _is_whole(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _name(values: dict, key: str) -> str:
    """A file's plain name: one that leads nowhere else."""
    name = _of_kind(values, key, str)
    if not _NAME.fullmatch(name):
        raise _refused(key, name)
    return name


def _path(values: dict, key: str) -> Path | None:
    return Path(_of_kind(values, key, str)) if values.get(key) is not None else None


def _of_kind(values: dict, key: str, kind: type) -> Any:
    value = values.get(key)
    if not isinstance(value, kind):
        raise _refused(key, value)
    return value


def _refused(key: str, value: Any) -> LodgsError:
    text = "nothing" if value is None else repr(value)
    text = text if len(text) < 100 else f"{text[:100]}..."
    return LodgsError(f'A request is not valid: "{key}" cannot be {text}.')
