"""JSON and TOML of anybody's making: the one place where such text is read, and what it may hold.

Whoever reads a job, a camera, a manifest, a header's comment, an event or a request reads it here, and has
then a dict of plain values: nothing nests deeper than `DEEPEST`, every number is finite, every text can be
written again. Time and memory grow with the text's length, of which there is a most.
"""

from __future__ import annotations

import json
import math
import re
import reprlib
import tomllib
from pathlib import Path
from typing import IO, Any

from .errors import LodgsError, printable
from .files import open_regular

MAX_JSON_BYTES = 1 << 20
"""Most bytes of one JSON text: a file, or a line where each is an object. All of ours have a few thousand."""
MAX_TOML_BYTES = 1 << 14
"""Most bytes of one TOML text. Its parser's time grows with the square of a dotted key's length."""
MAX_NESTING = 16
"""How deep objects and lists may lie in each other; ours need six."""
MAX_INTEGER = 2**63 - 1
"""Largest whole number, as 64 bits hold it."""

_NO_TEXT = re.compile("[\0\ud800-\udfff]")
_QUOTES = reprlib.Repr()
_QUOTES.maxstring = _QUOTES.maxother = 200


def open_file(path: str | Path, what: str = "") -> IO[bytes]:
    """Open a regular file for reading; a pipe or a device, which may have no end, is not opened.

    Args:
        what: what a message calls it; "" for its path.

    Raises:
        LodgsError: there is no such file, it is not a file, or it may not be read.
    """
    try:
        return open_regular(path)
    except OSError as error:
        reason = error.strerror or str(error)
    except ValueError:  # a NUL or half a surrogate pair
        reason = "its name is no name of a file"
    raise LodgsError(
        f"{what or printable(path)} could not be read: {reason}.", "Check the path and its rights."
    )


def quote(value: Any) -> str:
    """A value as a message can quote it: its begin where it is long, and nothing in it that is no text."""
    return printable(_QUOTES.repr(value))


def read_json(path: str | Path, what: str = "", most: int = MAX_JSON_BYTES) -> dict:
    """The object in a JSON file; ``what`` as for `open_file`, ``most`` as for `json_object`.

    Raises:
        LodgsError: the file cannot be read, or as `json_object`.
    """
    what = what or printable(path)
    return parse_json(_read(path, what, most), what, most)


def read_toml(path: str | Path, what: str = "") -> dict:
    """The table in a TOML file; ``what`` as for `open_file`.

    Raises:
        LodgsError: the file cannot be read, is no TOML, or breaks a bound of this module.
    """
    what = what or printable(path)
    try:
        table = tomllib.loads(_text(_read(path, what, MAX_TOML_BYTES), MAX_TOML_BYTES))
        _check(table, MAX_NESTING)
    except (ValueError, RecursionError) as error:
        raise _not_valid(what, error) from error
    return table


def parse_json(text: str | bytes, what: str, most: int = MAX_JSON_BYTES) -> dict:
    """The JSON object that a text is.

    Args:
        text: UTF-8 where it is bytes.
        what: what a message calls it, such as "The camera view.json".
        most: bytes that it may have.

    Raises:
        LodgsError: it is no JSON, no object, or breaks a bound of this module.
    """
    try:
        values = json.loads(_text(text, most), parse_int=_whole)
        if not isinstance(values, dict):
            raise ValueError("it is no object")
        _check(values, MAX_NESTING)
    except (ValueError, RecursionError) as error:
        raise _not_valid(what, error) from error
    return values


def _read(path: str | Path, what: str, most: int) -> bytes:
    with open_file(path, what) as file:
        try:
            return file.read(most + 1)
        except OSError as error:
            raise LodgsError(f"{what} could not be read: {error.strerror}.") from error


def _text(text: str | bytes, most: int) -> str:
    if len(text) > most:
        raise ValueError(f"it is longer than {most:,} bytes")
    return text.decode("utf-8-sig") if isinstance(text, bytes) else text


def _check(value: Any, room: int, key: str = "a value") -> None:
    """ValueError unless a value is one of those that this module lets in, at most so many levels deep.

    Args:
        key: the nearest one that the value stands under.
    """
    match value:
        case dict() | list() if room == 0:
            raise ValueError(f"it nests deeper than {MAX_NESTING} levels")
        case dict():
            for name, inside in value.items():
                _check(name, room - 1, "a key")
                _check(inside, room - 1, name)
        case list():
            for inside in value:
                _check(inside, room - 1, key)
        case float() if not math.isfinite(value):
            raise ValueError(f"{key[:200]} = {value} is not a finite number")
        case int() if abs(value) > MAX_INTEGER:
            raise ValueError(f"{key[:200]} has too many digits")
        case str() if _NO_TEXT.search(value):
            raise ValueError(f"{key[:200]} holds characters that are none")
        case None | bool() | int() | float() | str():
            pass
        case _:  # TOML's dates and times
            raise ValueError(f"{key[:200]} is a {type(value).__name__}")


def _whole(digits: str) -> int:
    if len(digits) > 20:
        raise ValueError("a number in it has too many digits")
    return int(digits)


def _not_valid(what: str, error: Exception) -> LodgsError:
    reason = "it nests too deep" if isinstance(error, RecursionError) else str(error)
    return LodgsError(f"{what} is not valid: {reason}.", "Correct that and try again.")
