"""Events of a run: JSON lines that the trainer writes, and the only reader for them.

A run folder may be damaged or come from an untrusted source. :func:`read_events` returns only well-formed
events: of a known kind, with every required value, finite numbers in range, printable texts, and paths
inside the run folder.
"""

from __future__ import annotations

import errno
import json
import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, Any

import numpy as np

from ..errors import ERROR_CAUSES, LodgsError
from ..files import name_errors, open_regular
from ..splats.georeference import Georeference
from ..splats.levels import MAX_LEVELS, META_SHAPES

PROTOCOL = 1
"""Version of the events; increased when a reader of older events would misread them."""

MAX_BYTES, MAX_LINE, MAX_EVENTS = 1 << 26, 1 << 18, 300_000
"""Limits of file size, line length and number of events; a month of training stays below them."""

PART_KINDS = ("coarse", "block", "seam")
"""Parts of a scene in cells: coarse levels of the full scene, a cell, the borders of a cell."""
PART_STATES = ("waiting", "running", "done", "cancelled", "failed")
"""Training states of a part."""

_MAX_TEXT, _MAX_NUMBER, _MAX_DEPTH = 10_000, 1e30, 8
_RESERVE = 1 << 16  # bytes


# -- reading ---------------------------------------------------------------------------------------------


def read_events(path: Path, since: int = 0) -> tuple[list[dict], int]:
    """Read complete lines after byte ``since``; return their events and the offset for the next call.

    An incomplete last line is left for the next call. Lines that are not events (from a killed trainer) and
    events of unknown kinds are skipped; so are malformed optional values. An event with a missing or
    malformed required value is replaced by a warning, once per kind.

    Raises:
        LodgsError: the file exceeds MAX_BYTES or MAX_EVENTS.
        OSError: the path is unreadable or not a file.
    """
    try:
        file = open_regular(path)
    except FileNotFoundError:
        return [], 0
    events: list[dict] = []
    malformed: set[str] = set()
    with file:
        size = os.fstat(file.fileno()).st_size
        offset = file.seek(since if 0 <= since <= size else 0)
        while line := file.readline(MAX_LINE):
            if line[-1:] != b"\n" and len(line) < MAX_LINE:
                break
            offset += len(line)
            if offset > MAX_BYTES or len(events) == MAX_EVENTS:
                raise LodgsError(
                    f"Cannot read {path}: it is too large for the events of a run.",
                    "Choose another run folder.",
                )
            record = _parse(line)
            if record is None:
                continue
            kind = record["event"]
            event = _well_formed(record)
            if event is None and kind not in malformed:
                malformed.add(kind)
                message = f"Ignored a '{kind}' event in an unknown format: its values are missing or invalid."
                event = {"event": "warning", "message": message}
            if event is not None:
                events.append(event)
    return events, offset


def _parse(line: bytes) -> dict | None:
    """Return a line's JSON object if it is an event of a known kind, else None."""
    if not line.startswith(b"{"):
        return None
    try:
        record = json.loads(line, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        return None
    kind = record.get("event")
    return record if isinstance(kind, str) and kind in _REQUIRED else None


def _reject_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _well_formed(record: dict) -> dict | None:
    """Drop malformed values from an event; return None if one of them is required."""
    valid = {name: value for name, value in record.items() if _VALUES.get(name, _is_plain)(value)}
    return valid if _REQUIRED[record["event"]] <= valid.keys() else None


def _is_text(value: object) -> bool:
    if not isinstance(value, str) or len(value) > _MAX_TEXT or "\0" in value:
        return False
    return not any("\ud800" <= character <= "\udfff" for character in value)


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and -_MAX_NUMBER <= value <= _MAX_NUMBER  # pyrefly: ignore[unsupported-operation]


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**31


def _is_level(value: object) -> bool:
    return type(value) is int and 1 <= value <= MAX_LEVELS


def _is_bool(value: object) -> bool:
    return isinstance(value, bool)


def _is_path(value: object) -> bool:
    """Return whether a value is a relative path without ``..``, on any platform."""
    if not isinstance(value, str) or not _is_text(value) or value in ("", ".") or ":" in value:
        return False
    return not any(
        path.is_absolute() or path.drive or path.root or ".." in path.parts
        for path in (PurePosixPath(value), PureWindowsPath(value))
    )


def _is_cause(value: object) -> bool:
    return isinstance(value, str) and value in ERROR_CAUSES


def _are_parts(value: object) -> bool:
    """Return whether a value is the list of part states of a ``progress`` event."""
    return isinstance(value, list) and all(
        isinstance(part, dict)
        and part.get("kind") in PART_KINDS
        and part.get("state") in PART_STATES
        and all(_is_count(part.get(name)) for name in ("block", "step", "of"))
        for part in value
    )


def _are_numbers(value: object) -> bool:
    if not isinstance(value, dict) or len(value) > 100:
        return False
    return all(_is_text(name) and _is_number(number) for name, number in value.items())


def _is_plain(value: object, depth: int = 0) -> bool:
    """Return whether a value is small, not deeply nested, printable and writable as JSON."""
    match value:
        case None | bool():
            return True
        case int() | float():
            return _is_number(value)
        case str():
            return _is_text(value)
        case list():
            return depth < _MAX_DEPTH and all(_is_plain(item, depth + 1) for item in value)
        case dict():
            return depth < _MAX_DEPTH and all(
                _is_text(name) and _is_plain(item, depth + 1) for name, item in value.items()
            )
    return False


def _is_meta(value: object) -> bool:
    if not isinstance(value, dict) or not _is_plain(value):
        return False
    try:
        Georeference.from_json(value.get("georeference", {"crs": "-"}))
    except ValueError:
        return False
    return all(_has_shape(value[name], shape) for name, shape in META_SHAPES.items() if name in value)


def _has_shape(value: object, shape: tuple[int, ...]) -> bool:
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        return False
    return array.shape == shape and array.dtype.kind in "if"


_REQUIRED: dict[str, set[str]] = {
    "hello": {"event"},
    "status": {"message"},
    "progress": {"level", "levels", "step", "of", "loss", "psnr", "splats", "steps_per_s", "eta_s"},
    "level": {"level", "path", "splats"},
    "warning": {"message"},
    "error": {"what"},
    "cancelled": {"event"},
    "done": {"event"},
}
"""Required values by kind of event."""

_VALUES: dict[str, Callable[[object], bool]] = {
    **dict.fromkeys(("event", "message", "what", "remedy", "method", "rule", "stage", "version"), _is_text),
    **dict.fromkeys(("level", "levels"), _is_level),
    **dict.fromkeys(("step", "of", "splats", "protocol", "pid", "drawn"), _is_count),
    **dict.fromkeys(
        ("time", "loss", "psnr", "steps_per_s", "eta_s", "train_psnr", "fitted_psnr"), _is_number
    ),
    **dict.fromkeys(("cumulative", "again", "more"), _is_bool),
    **dict.fromkeys(("facts", "scene_facts", "controls"), _are_numbers),
    **dict.fromkeys(("path", "bundle"), _is_path),
    "meta": _is_meta,
    "blocks": _are_parts,
    "cause": _is_cause,
}
"""Validators by value name; values with other names must be plain JSON (``_is_plain``)."""


# -- writing ---------------------------------------------------------------------------------------------


def event_line(kind: str, **values) -> str:
    """Format an event as a line of JSON, with ``time`` (seconds since 1970).

    Numbers that are not finite become null; characters that UTF-8 cannot encode become question marks.
    """
    event = {"event": kind, "time": round(time.time(), 3), **values}
    line = json.dumps(finite(event), ensure_ascii=False, allow_nan=False)
    return line.encode("utf-8", "replace").decode()


def finite(value: Any) -> Any:
    """Replace numbers in JSON values that are not finite by None."""
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {name: finite(item) for name, item in value.items()}
        case list() | tuple():
            return [finite(item) for item in value]
    return value


class EventWriter:
    """Writer of events, one JSON object per line, to a run's file and a stream.

    Args:
        path: the run's ``events.jsonl``.
        reserve: file that reserves disk space for the final event of a run that filled the disk.
        stream: additional output, or None.

    Raises:
        OSError: a file cannot be written.
    """

    def __init__(self, path: Path, reserve: Path, stream: IO[str] | None) -> None:
        self._stream = stream
        self._path = path
        self._reserve = reserve
        self._torn = False
        self._file = path.open("a+b", buffering=0)  # unbuffered: nothing remains to be written on close
        if end := self._file.seek(0, os.SEEK_END):
            self._file.seek(end - 1)
            self._torn = self._file.read(1) != b"\n"  # a killed trainer's last line
        with name_errors(reserve):
            reserve.write_bytes(os.urandom(_RESERVE))

    def __call__(self, kind: str, **values) -> None:
        """Write one event.

        Raises:
            OSError: the run's file cannot be written.
        """
        line = event_line(kind, **values)
        if self._stream is not None:
            try:
                print(line, file=self._stream, flush=True)
            except OSError:  # broken pipe or full disk; the run's own file decides
                self._stream = None
        self._append(b"\n" * self._torn + line.encode() + b"\n")

    def write_final(self, kind: str, **values) -> None:
        """Write the event that ends a run into the reserved disk space; ignore failures."""
        with suppress(OSError):
            self._reserve.unlink(missing_ok=True)
        with suppress(OSError):
            self(kind, **values)

    def close(self) -> None:
        """Close the file and release the reserved disk space."""
        self._file.close()
        with suppress(OSError):
            self._reserve.unlink(missing_ok=True)

    def _append(self, data: bytes) -> None:
        self._torn = True
        while data:
            try:
                written = self._file.write(data)
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self._path)) from error
            if not written:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
            data = data[written:]
        self._torn = False
