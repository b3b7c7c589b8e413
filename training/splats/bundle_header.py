"""Header lines of a bundle and the entries of a folder's manifest, which share one form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..documents import parse_json, quote
from ..errors import LodgsError
from .dialects import MAX_COORDINATE
from .georeference import Georeference
from .levels import MAX_READ_LEVELS, META_SHAPES, NO_SPLATS, Bundle, Level
from .ply import Columns, Element

FORMAT_VERSION = 2
INCONSISTENCIES = (ValueError, KeyError, TypeError, AttributeError)
"""Exceptions that incomplete or inconsistent descriptions raise."""
_TAG = "lodsplat "
# Some viewers search the whole header for these words, so no comment may contain one.
_FORBIDDEN = ("packed_", "f_rest_", "end_header", "element chunk")
_MAX_FACT = 1e30

Kind = TypeVar("Kind")


def json_default(value: np.ndarray | np.generic):
    """Convert a numpy scalar or array for ``json.dumps(default=...)``."""
    return value.tolist()


def format_comment(values: dict) -> str:
    """Format a JSON object as a header comment of LODGS."""
    text = json.dumps(values, separators=(",", ":"), default=json_default, allow_nan=False)
    for word in _FORBIDDEN:  # such words only occur inside JSON strings, where an escape means the same
        text = text.replace(word, f"{word[:-1]}\\u{ord(word[-1]):04x}")
    return _TAG + text


def bundle_line(bundle: Bundle, **additions) -> dict:
    """Return the entry about the bundle, with additional keys."""
    return {
        "v": FORMAT_VERSION, "method": bundle.method, "rule": bundle.rule, "facts": bundle.facts,
        "controls": bundle.controls, "cumulative": bundle.cumulative,
        "sh": bundle.levels[0].sh_degree, **additions,
    }  # fmt: skip


def level_line(lod: int, level: Level) -> dict:
    """Return the entry about a level; ``lod`` 0 is the finest."""
    line = {"level": level.number, "lod": lod, "count": len(level.rows)}
    return line | {"facts": level.facts} if level.facts else line


def table_lines(bundle: Bundle) -> list[dict]:
    """Return the entries about the tables."""
    return [{"table": name, "element": f"lod_{name}"} for name in bundle.tables]


def table_elements(bundle: Bundle) -> list[Element]:
    """Return the PLY elements of the tables."""
    return [Element.from_columns(f"lod_{name}", columns) for name, columns in bundle.tables.items()]


def pop_tables(lines: list[dict], elements: dict[str, np.ndarray]) -> dict[str, Columns]:
    """Remove the listed tables from the elements of a file and return them.

    Raises:
        ValueError, KeyError, TypeError: the lines contradict the elements.
    """
    tables = {}
    for line in lines:
        name = check_type(line["table"], str, "table")
        if line["element"] != f"lod_{name}":
            raise ValueError(f"the table {quote(name)} is in another element")
        rows = elements.pop(line["element"])
        tables[name] = {column: np.array(rows[column]) for column in rows.dtype.names or ()}
    return tables


def parse_comments(comments: list[str], path: str | Path) -> tuple[Bundle | None, list[dict]]:
    """Parse the comments of a PLY.

    Returns:
        The bundle without splats, or None for a PLY of another program; and the lines after the first.

    Raises:
        LodgsError: the comments are not valid, inconsistent or from a newer version.
    """
    texts = [comment[len(_TAG) :] for comment in comments if comment.startswith(_TAG)]
    if not texts:
        return None, []
    try:
        head, *lines = [parse_json(text, f"A comment of {path}") for text in texts]
        meta = next((line["meta"] for line in lines if "meta" in line), {})
        return parse_bundle(head, [line for line in lines if "level" in line], meta, path), lines
    except INCONSISTENCIES as error:
        raise inconsistency_error(path, error) from error


def parse_bundle(head: dict, lines: list[dict], meta: dict, path: str | Path) -> Bundle:
    """Parse the entries of a header or a manifest to a bundle without splats.

    Args:
        head: entry about the bundle.
        lines: entries about the levels.
        meta: the bundle's meta.

    Raises:
        LodgsError: the bundle is from a newer version.
        ValueError, KeyError, TypeError, AttributeError: an entry is incomplete or inconsistent.
    """
    version = _check_count(head["v"], "v")
    if version > FORMAT_VERSION:
        raise LodgsError(
            f"Cannot read {path}: it is a bundle of the newer version {version}.", "Update LODGS to read it."
        )
    if version < FORMAT_VERSION:
        raise ValueError(f"version {version} is not supported")
    check_meta(meta)
    if not 1 <= len(check_type(lines, list, "levels")) <= MAX_READ_LEVELS:
        raise ValueError(f"{len(lines)} levels")
    for line in lines:
        _check_count(line["count"], "count")
        if not 1 <= _check_count(line["level"], "level") < 2**15:
            raise ValueError(f"{line['level']} is not a level number")
    controls = check_type(head["controls"], dict, "controls")
    # some exports from Blender hold check boxes as true and false
    controls = {name: int(value) if isinstance(value, bool) else value for name, value in controls.items()}
    levels = [Level(line["level"], NO_SPLATS, _check_numbers(line.get("facts", {}))) for line in lines]
    levels.sort(key=lambda level: level.number)
    if len({level.number for level in levels}) < len(levels):
        raise ValueError("a level appears twice")
    return Bundle(
        check_type(head["method"], str, "method"),
        levels,
        check_type(head["rule"], str, "rule"),
        _check_numbers(head["facts"]),
        _check_numbers(controls),
        check_type(head["cumulative"], bool, "cumulative"),
        meta,
    )


def inconsistency_error(path: str | Path, error: Exception) -> LodgsError:
    """Return the error for a file whose description of its levels is inconsistent."""
    return LodgsError(
        f"Cannot read {path}: its description of the levels is inconsistent "
        f"({type(error).__name__}: {str(error)[:300]}).",
        "Export it again; another program may have changed it.",
    )


def check_type(value: Kind, kind: type[Kind], name: str) -> Kind:
    """Return the value, or raise TypeError if it has another type."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} = {quote(value)} is not a {kind.__name__}")
    return value


def check_meta(meta: dict) -> None:
    """Raise one of :data:`INCONSISTENCIES` if an entry of meta has an invalid value."""
    check_type(meta, dict, "meta")
    for name, shape in META_SHAPES.items():
        if name in meta:
            values = np.asarray(meta[name])
            is_numeric = values.shape == shape and values.dtype.kind in "if"
            if not is_numeric or (np.abs(values) > MAX_COORDINATE).any():
                raise ValueError(f"{name} does not have {shape} numbers")
    check_type(meta.get("antialias", False), bool, "antialias")
    if "georeference" in meta:
        Georeference.from_json(meta["georeference"])


def _check_count(value: int, name: str) -> int:
    """Return the value, or raise ValueError if it is not an integer of at least 0."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{name} = {quote(value)} is not a count")
    return value


def _check_numbers(values: dict) -> dict[str, float]:
    """Return a copy of facts, or raise ValueError or TypeError if a value is no single-precision number."""
    for name, value in check_type(values, dict, "facts").items():
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > _MAX_FACT:
            raise ValueError(f"{name} = {quote(value)} is not a number up to {_MAX_FACT:g}")
    return dict(values)
