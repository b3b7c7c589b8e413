"""JSON and TOML of anybody's making: plain values, or one sentence."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from training.documents import (
    MAX_INTEGER,
    MAX_JSON_BYTES,
    MAX_NESTING,
    MAX_TOML_BYTES,
    open_file,
    parse_json,
    read_json,
    read_toml,
)
from training.errors import LodgsError


def nested(depth: int, inner: str = "1") -> str:
    return '{"a":' + "[" * (depth - 1) + inner + "]" * (depth - 1) + "}"


def test_what_json_holds_comes_out_as_it_is():
    text = b'{"a": [1, -2.5e-3, true, null, "\\u00fc\\ud83d\\ude00"], "b": {"c": "/x"}}'
    assert parse_json(text, "It") == {"a": [1, -0.0025, True, None, "ü😀"], "b": {"c": "/x"}}
    assert parse_json("\ufeff".encode() + text, "It") == parse_json(text, "It")  # as some editors begin


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "Expecting value"),
        (b"[1]", "no object"),
        (b'{"a": 1', "Expecting"),
        (b'{"a": "\xff"}', "decode"),
        (b'{"a": NaN}', "a = nan is not a finite number"),
        (b'{"a": [-Infinity]}', "a = -inf is not"),
        (b'{"a": 1e400}', "a = inf is not"),
        (b'{"a": %d}' % (MAX_INTEGER + 1), "too many digits"),
        (b'{"a": 1%s}' % (b"0" * 5000), "too many digits"),
        (b'{"a": "\\u0000"}', "characters that are none"),
        (b'{"\\ud800": 1}', "characters that are none"),
        (nested(MAX_NESTING + 1).encode(), "nests deeper than 16"),
        (nested(400_000).encode(), "nests too deep"),
        (b'{"a": "' + b"x" * MAX_JSON_BYTES + b'"}', "longer than 1,048,576 bytes"),
    ],
)
def test_what_is_not_plain_json_is_one_sentence(text, reason):
    with pytest.raises(LodgsError, match=r"^The camera c is not valid: ") as told:
        parse_json(text, "The camera c")
    assert reason in told.value.what


def test_the_bounds_themselves_are_within():
    assert parse_json(nested(MAX_NESTING), "It")
    assert parse_json(f'{{"a": {-MAX_INTEGER}}}', "It") == {"a": -MAX_INTEGER}


def test_a_toml_file_is_read_as_editors_of_any_system_write_it(tmp_path):
    path = tmp_path / "job.toml"
    path.write_bytes("\ufeffa = 1\r\n[b]\r\nc = 'ü'\r\n".encode())
    assert read_toml(path) == {"a": 1, "b": {"c": "ü"}}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a = nan", "a = nan is not a finite number"),
        ("a = 1" + "0" * 400, "too many digits"),
        ("a = " + "[" * 7000 + "]" * 7000, "nests too deep"),
        ("a." * 20 + "a = 1", "nests deeper than 16"),
        (
            "a." * 100_000 + "a = 1",
            f"longer than {MAX_TOML_BYTES:,} bytes",
        ),  # some minutes of the parser's time
        ("a = 2026-01-01", "a is a date"),
        ("a = 1\na = 2", "Cannot overwrite"),
    ],
)
def test_what_is_not_plain_toml_is_one_sentence(tmp_path, text, reason):
    path = tmp_path / "job.toml"
    path.write_text(text)
    with pytest.raises(LodgsError, match=r"^The job is not valid: ") as told:
        read_toml(path, "The job")
    assert reason in told.value.what


def test_only_files_are_opened(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, "/dev/zero"):
        with pytest.raises(LodgsError, match="could not be read: not a file"):
            read_json(path)
    with pytest.raises(LodgsError, match="No such file"):
        open_file(tmp_path / "none.json")
    for name in ("a\0b", "a\ud800b"):
        with pytest.raises(LodgsError, match="could not be read") as told:
            open_file(tmp_path / name)
        told.value.what.encode()  # a message can be shown


def test_an_error_can_be_printed_whatever_it_quotes():
    error = LodgsError("a\udce9\0b" + 5000 * "(" + "end", "Do\0 it.")
    assert str(error).encode() and "\0" not in str(error)
    assert error.what.startswith(r"a\xdce9\x00b(((") and error.what.endswith("end")
    assert len(error.what) < 1100 and error.remedy == r"Do\x00 it."


def test_what_is_printed_into_a_pipe_is_utf_8_whatever_the_console_has():
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(
        [sys.executable, "-m", "training", "methods", "tree"],
        env=environment,
        capture_output=True,
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0 and "⁴" in done.stdout.decode("utf-8")
