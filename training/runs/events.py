"""The events of a run: the lines that the trainer writes, and the one door where they are read.

Whoever reads a run's folder reads what somebody else may have written, damaged or made up. What leaves
:func:`read_events` is well-formed: of a known kind, with all that its readers rely on, numbers that are
finite and in range, texts that can be shown, and paths that do not lead out of the run's folder.
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
from typing import IO

import numpy as np

from ..errors import LodgsError
from ..files import open_regular
from ..splats.bundle import MAX_LEVELS, META_SHAPES

PROTOCOL = 1
"""Version of the events; raised when a reader of older ones would misunderstand."""

MAX_BYTES, MAX_LINE, MAX_EVENTS = 1 << 26, 1 << 18, 300_000
"""Bounds of the file, of a line in it and of the number of events: a month of training keeps within them."""

BLOCK_KINDS = ("coarse", "block", "seam")
"""What of a scene in cells is trained by itself: levels of the whole, a cell, the borders of one."""
BLOCK_STATES = ("waiting", "running", "done", "cancelled", "failed")
"""How that gets on."""

_MOST_TEXT, _MOST_NUMBER, _DEEPEST = 10_000, 1e30, 8
_RESERVE = 1 << 16  # bytes


# -- reading ---------------------------------------------------------------------------------------------


def read_events(path: Path, since: int = 0) -> tuple[list[dict], int]:
    """The whole lines after byte ``since``, as events, and the byte to go on from next time.

    A last line without its end is left for later. A line that is no event (from a killed trainer), or of a
    kind that this version does not know, is passed over; so is a value that nobody relies on and that is not
    of its name's kind. Where one is missing that is relied on, a warning stands instead, one for each kind.

    Raises:
        LodgsError: the file is too long to be a run's.
        OSError: it cannot be read, or is no file.
    """
    try:
        file = open_regular(path)
    except FileNotFoundError:
        return [], 0
    events: list[dict] = []
    odd: set[str] = set()
    with file:
        size = os.fstat(file.fileno()).st_size
        offset = file.seek(since if 0 <= since <= size else 0)
        while line := file.readline(MAX_LINE):
            if line[-1:] != b"\n" and len(line) < MAX_LINE:
                break
            offset += len(line)
            if offset > MAX_BYTES or len(events) == MAX_EVENTS:
                raise LodgsError(f"{path} is too long to be a run's events.", "Choose another run folder.")
            said = _object(line)
            if said is None:
                continue
            kind = said["event"]
            event = _well_formed(said)
            if event is None and kind not in odd:
                odd.add(kind)
                message = f"The trainer sent a '{kind}' that this version does not understand."
                event = {"event": "warning", "message": message}
            if event is not None:
                events.append(event)
    return events, offset


def _object(line: bytes) -> dict | None:
    """The JSON object of a line, if it is one of a kind that is known."""
    if not line.startswith(b"{"):
        return None
    try:
        said = json.loads(line, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None
    kind = said.get("event")
    return said if isinstance(kind, str) and kind in _NEEDED else None


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _well_formed(said: dict) -> dict | None:
    """An event without the values that are not what their names say; None where one is relied on."""
    kept = {name: value for name, value in said.items() if _VALUES.get(name, _is_plain)(value)}
    return kept if _NEEDED[said["event"]] <= kept.keys() else None


def _is_text(value: object) -> bool:
    if not isinstance(value, str) or len(value) > _MOST_TEXT or "\0" in value:
        return False
    return not any("\ud800" <= character <= "\udfff" for character in value)


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and -_MOST_NUMBER <= value <= _MOST_NUMBER  # pyright: ignore


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**31


def _is_level(value: object) -> bool:
    return type(value) is int and 1 <= value <= MAX_LEVELS


def _is_bool(value: object) -> bool:
    return isinstance(value, bool)


def _is_path(value: object) -> bool:
    """Whether a value is a path that, taken word for word, stays inside the folder it is relative to."""
    if not isinstance(value, str) or not _is_text(value) or value in ("", ".") or ":" in value:
        return False
    return not any(
        path.is_absolute() or path.drive or path.root or ".." in path.parts
        for path in (PurePosixPath(value), PureWindowsPath(value))
    )


def _are_blocks(value: object) -> bool:
    """What a ``progress`` event says of each block of a scene in cells."""
    return isinstance(value, list) and all(
        isinstance(each, dict)
        and each.get("kind") in BLOCK_KINDS
        and each.get("state") in BLOCK_STATES
        and all(_is_count(each.get(name)) for name in ("block", "step", "of"))
        for each in value
    )


def _are_numbers(value: object) -> bool:
    if not isinstance(value, dict) or len(value) > 100:
        return False
    return all(_is_text(name) and _is_number(number) for name, number in value.items())


def _is_plain(value: object, depth: int = 0) -> bool:
    """Whether a value of any kind is small, not nested deeply, and can be shown and written again."""
    match value:
        case None | bool():
            return True
        case int() | float():
            return _is_number(value)
        case str():
            return _is_text(value)
        case list():
            return depth < _DEEPEST and all(_is_plain(each, depth + 1) for each in value)
        case dict():
            return depth < _DEEPEST and all(
                _is_text(name) and _is_plain(each, depth + 1) for name, each in value.items()
            )
    return False


def _is_meta(value: object) -> bool:
    if not isinstance(value, dict) or not _is_plain(value):
        return False
    return all(_has_shape(value[name], shape) for name, shape in META_SHAPES.items() if name in value)


def _has_shape(value: object, shape: tuple[int, ...]) -> bool:
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        return False
    return array.shape == shape and array.dtype.kind in "if"


_NEEDED: dict[str, set[str]] = {
    "hello": {"event"},
    "status": {"message"},
    "progress": {"level", "levels", "step", "of", "loss", "psnr", "splats", "steps_per_s", "eta_s"},
    "level": {"level", "path", "splats"},
    "warning": {"message"},
    "error": {"what"},
    "cancelled": {"event"},
    "done": {"event"},
}
"""What readers rely on, by kind."""

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
    "blocks": _are_blocks,
}
"""What values are by their names; those of other names are anything plain."""


# -- writing ---------------------------------------------------------------------------------------------


def event_line(kind: str, **values) -> str:
    """One event of the protocol as a line of JSON; ``time`` (seconds since 1970) is added.

    Numbers that are not finite become null, and what a name has that is no text a question mark.
    """
    event = {"event": kind, "time": round(time.time(), 3), **values}
    line = json.dumps(_finite(event), ensure_ascii=False, allow_nan=False)
    return line.encode("utf-8", "replace").decode()


def _finite(value):
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {name: _finite(each) for name, each in value.items()}
        case list() | tuple():
            return [_finite(each) for each in value]
    return value


class EventWriter:
    """Speaks the protocol: one JSON object a line, to a run's events and to a stream.

    Args:
        path: the run's ``events.jsonl``.
        reserve: a file that keeps some room on the disk for the last words of a run that has filled it.
        stream: where the events go besides.

    Raises:
        OSError: a file cannot be written.
    """

    def __init__(self, path: Path, reserve: Path, stream: IO[str] | None) -> None:
        self._stream, self._reserve, self._torn = stream, reserve, False
        self._file = path.open("a+b", buffering=0)  # so that closing has nothing left to write
        if end := self._file.seek(0, os.SEEK_END):
            self._file.seek(end - 1)
            self._torn = self._file.read(1) != b"\n"  # a killed trainer's last line
        reserve.write_bytes(os.urandom(_RESERVE))

    def __call__(self, kind: str, **values) -> None:
        """Writes one event.

        Raises:
            OSError: the run's file cannot be written.
        """
        line = event_line(kind, **values)
        if self._stream is not None:
            try:
                print(line, file=self._stream, flush=True)
            except OSError:  # the reader is gone, or the disk is full; the run's own file is what counts
                self._stream = None
        self._append(b"\n" * self._torn + line.encode() + b"\n")

    def write_final(self, kind: str, **values) -> None:
        """Writes the event that ends a run, in the room that was kept for it; if that fails, nobody hears."""
        with suppress(OSError):
            self._reserve.unlink(missing_ok=True)
        with suppress(OSError):
            self(kind, **values)

    def close(self) -> None:
        """Closes the file and gives up the reserve; nothing can be said after it."""
        self._file.close()
        with suppress(OSError):
            self._reserve.unlink(missing_ok=True)

    def _append(self, data: bytes) -> None:
        self._torn = True
        while data:
            written = self._file.write(data)
            if not written:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            data = data[written:]
        self._torn = False
