"""Limits and errors of the JSON and TOML readers."""

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
from training.files import check_folder


def nested(depth: int, inner: str = "1") -> str:
    return '{"a":' + "[" * (depth - 1) + inner + "]" * (depth - 1) + "}"


def test_json_values_are_unchanged():
    text = b'{"a": [1, -2.5e-3, true, null, "\\u00fc\\ud83d\\ude00"], "b": {"c": "/x"}}'
    assert parse_json(text, "It") == {"a": [1, -0.0025, True, None, "ü😀"], "b": {"c": "/x"}}
    assert parse_json("\ufeff".encode() + text, "It") == parse_json(text, "It")  # byte-order mark


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "Expecting value"),
        (b"[1]", "not an object"),
        (b'{"a": 1', "Expecting"),
        (b'{"a": "\xff"}', "decode"),
        (b'{"a": NaN}', "a = nan is not a finite number"),
        (b'{"a": [-Infinity]}', "a = -inf is not"),
        (b'{"a": 1e400}', "a = inf is not"),
        (b'{"a": %d}' % (MAX_INTEGER + 1), "too many digits"),
        (b'{"a": 1%s}' % (b"0" * 5000), "too many digits"),
        (b'{"a": "\\u0000"}', "invalid characters"),
        (b'{"\\ud800": 1}', "invalid characters"),
        (nested(MAX_NESTING + 1).encode(), "nests deeper than 16"),
        (nested(400_000).encode(), "nests too deep"),
        (b'{"a": "' + b"x" * MAX_JSON_BYTES + b'"}', "longer than 1,048,576 bytes"),
    ],
)
def test_invalid_json_raises_one_sentence(text, reason):
    with pytest.raises(LodgsError, match=r"^The camera c is not valid: ") as caught:
        parse_json(text, "The camera c")
    assert reason in caught.value.what


def test_limits_are_inclusive():
    assert parse_json(nested(MAX_NESTING), "It")
    assert parse_json(f'{{"a": {-MAX_INTEGER}}}', "It") == {"a": -MAX_INTEGER}


def test_toml_with_byte_order_mark_and_windows_line_ends_is_read(tmp_path):
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
        # unlimited, this line would take the parser minutes
        ("a." * 100_000 + "a = 1", f"longer than {MAX_TOML_BYTES:,} bytes"),
        ("a = 2026-01-01", "a is a date"),
        ("a = 1\na = 2", "Cannot overwrite"),
    ],
)
def test_invalid_toml_raises_one_sentence(tmp_path, text, reason):
    path = tmp_path / "job.toml"
    path.write_text(text)
    with pytest.raises(LodgsError, match=r"^The job is not valid: ") as caught:
        read_toml(path, "The job")
    assert reason in caught.value.what


def test_link_that_leads_nowhere_is_named(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "unplugged")
    sentence = rf"link:? (it |the folder )?links to {tmp_path / 'unplugged'}, which does not exist"
    with pytest.raises(LodgsError, match=sentence):
        open_file(tmp_path / "link")
    with pytest.raises(LodgsError, match=sentence):
        check_folder(tmp_path / "link", "Choose another.")


def test_only_regular_files_are_opened(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, "/dev/zero"):
        with pytest.raises(LodgsError, match=r"Cannot read .*: not a file"):
            read_json(path)
    with pytest.raises(LodgsError, match="No such file"):
        open_file(tmp_path / "none.json")
    for name in ("a\0b", "a\ud800b"):
        with pytest.raises(LodgsError, match="not a valid file name") as caught:
            open_file(tmp_path / name)
        caught.value.what.encode()  # a message can be shown


def test_errors_are_printable_and_shortened():
    error = LodgsError("a\udce9\0b" + 5000 * "(" + "end", "Do\0 it.")
    assert str(error).encode() and "\0" not in str(error)
    assert error.what.startswith(r"a\xdce9\x00b(((") and error.what.endswith("end")
    assert len(error.what) < 1100 and error.remedy == r"Do\x00 it."


def test_piped_output_is_utf_8_on_any_console():
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    process = subprocess.run(
        [sys.executable, "-m", "training", "methods", "tree"],
        env=environment,
        capture_output=True,
        cwd=Path(__file__).parents[2],
    )
    assert process.returncode == 0 and "⁴" in process.stdout.decode("utf-8")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n",
            r"Git LFS pointer .* `git lfs pull`",
        ),
        ("/annex/objects/SHA256E-s8148--4d7a.bin\n", r"git-annex pointer .* `git annex get`"),
        ("<!DOCTYPE html><title>Virus scan warning</title>", "web page .* in a browser"),
        ("\r\n<html><body>Sign in", "web page .* in a browser"),
    ],
)
def test_stand_ins_for_files_are_named(tmp_path, text, message):
    path = tmp_path / "points3D.bin"
    path.write_text(text)
    with pytest.raises(LodgsError, match=message):
        open_file(path)


def test_starts_of_stand_ins_are_no_stand_ins(tmp_path):
    path = tmp_path / "points3D.bin"
    path.write_bytes(b"version https")  # shorter than the mark
    with open_file(path) as file:
        assert file.read() == b"version https"
