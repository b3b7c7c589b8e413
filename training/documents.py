"""Reading of JSON and TOML from untrusted sources, with limits on their contents.

Jobs, cameras, manifests, header comments, events and requests are all read here. The result is a dict of
plain values: nesting is at most `MAX_NESTING` deep, every number is finite and every text can be written
again. Time and memory grow linearly with the length of the text, which is limited.
"""

from __future__ import annotations

import io
import json
import math
import re
import reprlib
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, AnyStr

from .errors import LodgsError, printable, read_error
from .files import open_regular

MAX_JSON_BYTES = 1 << 20
"""Maximum size of one JSON text: a file, or one line of a JSON-lines stream. Ours have a few thousand
bytes."""
MAX_TOML_BYTES = 1 << 14
"""Maximum size of one TOML text. The parser's time grows with the square of a dotted key's length."""
MAX_NESTING = 16
"""Maximum nesting depth of objects and lists; ours need six."""
MAX_INTEGER = 2**63 - 1
"""Largest integer that 64 bits hold."""

_LINE_HEAD = 1 << 16
"""Bytes at the start of a text that contain the end of a line."""
_PAGE = "a web page in place of the file", "Download it again in a browser."
_STAND_INS = {
    b"version https://git-lfs.github.com/spec/": (
        "a Git LFS pointer in place of the file",
        "Run `git lfs pull` in its repository, or download the file itself.",
    ),
    b"/annex/objects/": (
        "a git-annex pointer in place of the file",
        "Run `git annex get` in its repository, or download the file itself.",
    ),
    b"<!doctype html": _PAGE,
    b"<html": _PAGE,
}
"""Descriptions and remedies of files that stand in for others, by their first characters in small letters."""
DECIMAL_COMMAS = "its numbers have decimal commas"
_DECIMAL_COMMA = re.compile(r"(?<![^\s'\"])[-+]?\d*,\d+(?:[eE][-+]?\d+)?(?![^\s'\"])")
_UNPRINTABLE = re.compile("[\0\ud800-\udfff]")
_QUOTES = reprlib.Repr()
_QUOTES.maxstring = _QUOTES.maxother = 200


def open_file(path: str | Path) -> IO[bytes]:
    """Open a regular file for reading. Pipes and devices, which may have no end, are refused.

    Raises:
        LodgsError: the file does not exist, is not a regular file, may not be read, or stands in for another.
    """
    try:
        file = open_regular(path)
        head = file.read(64).lstrip().lower()
        stand_in = next((value for start, value in _STAND_INS.items() if head.startswith(start)), None)
        if stand_in is None:
            file.seek(0)
            return file
        file.close()
        raise LodgsError(f"Cannot read {printable(path)}: it is {stand_in[0]}.", stand_in[1])
    except OSError as error:
        raise read_error(path, error, "Check the path and its permissions.") from None
    except ValueError:  # a NUL or half a surrogate pair
        raise LodgsError(
            f"Cannot read {printable(path)}: the name is not a valid file name.", "Check the path."
        ) from None


def open_text(path: str | Path) -> IO[bytes]:
    """Open a text file that starts with ASCII for reading, converted to UTF-8 without byte-order mark.

    Files with the mark or the zero bytes of UTF-16 and UTF-32, which Windows programs write, are converted to
    a temporary file. Other bytes stay as they are.

    Raises:
        LodgsError: see :func:`open_file`, or the text is not valid.
    """
    file = open_file(path)
    head = file.read(32)
    file.seek(0)
    encoding = json.detect_encoding(head)
    if encoding == "utf-8" or not re.match(r"[\s!-~]{3}", head.decode(encoding, "ignore")):
        return file
    return _convert(file, path, encoding, "surrogateescape" if encoding == "utf-8-sig" else "strict")


def open_lines(path: str | Path) -> IO[bytes]:
    """Open a text file as :func:`open_text`, with lines that end in LF.

    Old Mac programs and some spreadsheets end lines with CR alone. Such files are converted.

    Raises:
        LodgsError: as :func:`open_text`.
    """
    file = open_text(path)
    head = file.read(_LINE_HEAD)
    file.seek(0)
    if b"\r" not in head or b"\n" in head:
        return file
    return _convert(file, path, "utf-8", "surrogateescape")


def _convert(file: IO[bytes], path: str | Path, encoding: str, errors: str) -> IO[bytes]:
    """Return a temporary file with the text of a file as UTF-8 and with LF, and close the file.

    Raises:
        LodgsError: the text is not valid.
    """
    with ExitStack() as stack:
        converted = stack.enter_context(tempfile.TemporaryFile())
        try:
            with io.TextIOWrapper(file, encoding, errors) as text:
                while block := text.read(1 << 20):
                    converted.write(block.encode("utf-8", errors))
        except ValueError as error:
            raise LodgsError(f"Cannot read {printable(path)}: {error}.", "Save it as UTF-8.") from error
        converted.seek(0)
        stack.pop_all()
    return converted


def decode_text(data: bytes) -> str:
    """Decode a text of another program: UTF-8, UTF-16 or UTF-32, else Windows-1252."""
    try:
        return data.decode(json.detect_encoding(data))
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def damage_error(path: Path, error: Exception, remedy: str) -> LodgsError:
    """Return the error for a file that cannot be parsed, with the reason of the parser."""
    reason = f"the file is damaged or truncated ({error})"
    if has_decimal_commas(str(error)):
        reason, remedy = DECIMAL_COMMAS, "Export it again with decimal points, such as 0.5."
    return LodgsError(f"Cannot read {path}: {reason}.", remedy)


def has_decimal_commas(text: str) -> bool:
    """Return True if a text contains a number with a decimal comma, as programs write in some languages."""
    return _DECIMAL_COMMA.search(text) is not None


def read_lines(file: IO[AnyStr], max_length: int) -> Iterator[AnyStr]:
    """Yield the lines of a file, which may be one endless line.

    Raises:
        ValueError: a line has ``max_length`` bytes or characters.
    """
    while line := file.readline(max_length):
        if len(line) == max_length:
            raise ValueError(f"a line exceeds {max_length:,} bytes")
        yield line


def quote(value: Any) -> str:
    """Format a value for a message: shortened, with unprintable characters escaped."""
    return printable(_QUOTES.repr(value))


def read_json(
    path: str | Path, label: str = "", max_bytes: int = MAX_JSON_BYTES, max_nesting: int = MAX_NESTING
) -> dict:
    """Read the object in a JSON file.

    Args:
        label: subject of error messages, such as "The camera view.json"; "" for the path.
        max_bytes: maximum size of the file.
        max_nesting: maximum nesting depth, at most some hundreds.

    Raises:
        LodgsError: the file cannot be read, or as `parse_json`.
    """
    return parse_json(
        read_bytes(path, max_bytes), label or printable(path), max_bytes, max_nesting=max_nesting
    )


def read_toml(path: str | Path, label: str = "") -> dict:
    """Read the table in a TOML file; ``label`` as for `read_json`.

    Raises:
        LodgsError: the file cannot be read, is not valid TOML, or exceeds a limit of this module.
    """
    try:
        table = tomllib.loads(_decode(read_bytes(path, MAX_TOML_BYTES), MAX_TOML_BYTES))
        _check(table, MAX_NESTING)
    except (ValueError, RecursionError) as error:
        raise _not_valid(label or printable(path), error) from error
    return table


def parse_json(
    text: str | bytes,
    label: str,
    max_bytes: int = MAX_JSON_BYTES,
    finite: bool = True,
    max_nesting: int = MAX_NESTING,
) -> dict:
    """Parse a JSON object.

    Args:
        text: bytes are decoded as UTF-8, UTF-16 or UTF-32.
        label: subject of error messages, such as "The camera view.json".
        max_bytes: maximum length of the text.
        finite: refuse NaN and infinity. False for files of other programs, whose numbers are checked one by
            one.
        max_nesting: maximum nesting depth, at most some hundreds.

    Raises:
        LodgsError: the text is not valid JSON, is not an object, or exceeds a limit of this module.
    """
    try:
        values = json.loads(_decode(text, max_bytes), parse_int=_parse_int)
        if not isinstance(values, dict):
            raise ValueError("it is not an object")
        _check(values, max_nesting, finite=finite)
    except (ValueError, RecursionError) as error:
        raise _not_valid(label, error, max_nesting) from error
    return values


def read_bytes(path: str | Path, max_bytes: int) -> bytes:
    """Read a regular file, but at most one byte more than the limit.

    Raises:
        LodgsError: the file cannot be read.
    """
    with open_file(path) as file:
        try:
            return file.read(max_bytes + 1)
        except OSError as error:
            raise LodgsError(f"Cannot read {printable(path)}: {error.strerror}.") from error


def _decode(text: str | bytes, max_bytes: int) -> str:
    if len(text) > max_bytes:
        raise ValueError(f"it is longer than {max_bytes:,} bytes")
    if isinstance(text, str):
        return text
    return text.decode(json.detect_encoding(text))


class _TooDeepError(ValueError):
    """A value nests deeper than allowed."""


def _check(value: Any, depth: int, key: str = "a value", finite: bool = True) -> None:
    """Raise ValueError unless this module allows a value, nested at most ``depth`` deep.

    Args:
        key: nearest key above the value, for the message.
    """
    match value:
        case dict() | list() if depth == 0:
            raise _TooDeepError
        case dict():
            for name, item in value.items():
                _check(name, depth - 1, "a key")
                _check(item, depth - 1, name, finite)
        case list():
            for item in value:
                _check(item, depth - 1, key, finite)
        case float() if finite and not math.isfinite(value):
            raise ValueError(f"{key[:200]} = {value} is not a finite number")
        case int() if abs(value) > MAX_INTEGER:
            raise ValueError(f"{key[:200]} has too many digits")
        case str() if _UNPRINTABLE.search(value):
            raise ValueError(f"{key[:200]} contains invalid characters")
        case None | bool() | int() | float() | str():
            pass
        case _:  # TOML's dates and times
            raise ValueError(f"{key[:200]} is a {type(value).__name__}")


def _parse_int(digits: str) -> int:
    if len(digits) > 20:
        raise ValueError("a number in it has too many digits")
    return int(digits)


def _not_valid(label: str, error: Exception, max_nesting: int = MAX_NESTING) -> LodgsError:
    reason = "it nests too deep" if isinstance(error, RecursionError) else str(error)
    if isinstance(error, _TooDeepError):
        reason = f"it nests deeper than {max_nesting} levels"
    return LodgsError(f"{label} is not valid: {reason}.", "Correct it and try again.")
