"""Reading events: any file content yields only well-formed events."""

import errno
import json
import math
import os
from pathlib import Path

import pytest

from training.errors import LodgsError
from training.runs.events import MAX_BYTES, MAX_LINE, EventWriter, event_line, read_events

LEVEL = {
    "event": "level", "level": 1, "path": "levels/level_1.ply", "splats": 5, "facts": {"s_min": 0.1},
    "rule": "bands", "scene_facts": {}, "controls": {}, "cumulative": False,
    "meta": {"camera_center": [0.0, 1.0, 2.0], "view": [[0, 0, 0], [0, 0, 1]]},
}  # fmt: skip
PROGRESS = {
    "event": "progress", "level": 1, "levels": 2, "step": 3, "of": 10, "loss": 0.1, "psnr": 20.0,
    "splats": 5, "steps_per_s": 2.0, "eta_s": 3.5,
}  # fmt: skip
BLOCK = {"block": 1, "kind": "block", "state": "running", "step": 3, "of": 10}


def read(tmp_path, *lines) -> list[dict]:
    path = tmp_path / "events.jsonl"
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    path.write_bytes("".join(f"{text}\n" for text in texts).encode("utf-8", "surrogatepass"))
    return read_events(path)[0]


@pytest.mark.parametrize(
    "event",
    [LEVEL, PROGRESS, PROGRESS | {"blocks": [BLOCK]}, {"event": "done", "veil": {"mean": 0.0, "max": 0.1}}],
)
def test_valid_events_round_trip(tmp_path, event):
    assert read(tmp_path, event) == [event]


@pytest.mark.parametrize(
    "change",
    [
        *(
            {"path": path}
            for path in ("/etc/passwd", "../x.ply", "a/../../x", "C:/x", "C:x", "\\\\s\\x", "", 3)
        ),
        *({"path": path} for path in ("a\0b", "file:x", "..\\x", "a\ud800")),
        *({"level": level} for level in (0, -1, 13, 2**31, 1.0, True, "one", None)),
        *({"splats": splats} for splats in (-1, 2**31, 10**400, 1.5, "5", [5])),
    ],
)
def test_malformed_levels_become_one_warning(tmp_path, change):
    (warning,) = read(tmp_path, LEVEL | change, LEVEL | change)
    assert warning["event"] == "warning" and "'level'" in warning["message"]


@pytest.mark.parametrize(
    "change",
    [
        {"meta": 3}, {"meta": {"camera_center": [1, 2]}}, {"meta": {"camera_center": "abc"}},
        {"meta": {"view": [[1], [2, 3]]}}, {"meta": {"camera_center": [1, 2, 1e300]}},
        {"facts": {"s_min": "0.1"}}, {"facts": {"s_min": 10**400}}, {"facts": []},
        {"rule": 3}, {"rule": "a\0"}, {"rule": "\ud800"}, {"rule": "x" * 20_000},
        {"cumulative": "yes"}, {"scene_facts": {"d_max": None}}, {"controls": {"gamma": True}},
    ],
)  # fmt: skip
def test_malformed_optional_values_are_dropped(tmp_path, change):
    (event,) = read(tmp_path, LEVEL | change)
    assert event == {name: value for name, value in LEVEL.items() if name not in change}


@pytest.mark.parametrize(
    "blocks", [3, [3], [{}], [BLOCK | {"state": "asleep"}], [BLOCK | {"kind": []}], [BLOCK | {"step": -1}],
               [BLOCK | {"block": "../1"}], [BLOCK, {name: 1 for name in BLOCK}]],
)  # fmt: skip
def test_malformed_blocks_are_dropped(tmp_path, blocks):
    assert read(tmp_path, PROGRESS | {"blocks": blocks}) == [PROGRESS]


@pytest.mark.parametrize("name", sorted(PROGRESS.keys() - {"event"}))
@pytest.mark.parametrize("value", ["Infinity", "NaN", "1e400", "null", '"1"', "[1]", "-1e31", "true"])
def test_progress_requires_valid_numbers(tmp_path, name, value):
    line = json.dumps(PROGRESS | {name: "@"}).replace('"@"', value)
    assert [event["event"] for event in read(tmp_path, line)] in ([], ["warning"])


def test_other_lines_are_skipped(tmp_path):
    deep = '{"event": "done", "x": ' + "[" * 100_000 + "]" * 100_000 + "}"
    long = '{"event": "warning", "message": "' + "x" * MAX_LINE + '"}'
    lines = [
        "not json",
        "[1]",
        "{}",
        '{"event": []}',
        '{"event": "unknown"}',
        '{"event": {}}',
        "\0",
        "1" * 5000,
    ]
    nested = {"event": "done", "x": [[[[[[[[[[1]]]]]]]]]]}
    events = read(tmp_path, *lines, deep, long, nested, PROGRESS)
    assert events == [{"event": "done"}, PROGRESS]


def test_oversized_file_is_rejected(tmp_path):
    path = tmp_path / "events.jsonl"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + MAX_LINE)
    with pytest.raises(LodgsError, match="too large"):
        read_events(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_named_pipe_is_rejected_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "events.jsonl")
    with pytest.raises(OSError, match="not a file"):
        read_events(tmp_path / "events.jsonl")


@pytest.mark.parametrize("since", [-5, 10**9])
def test_offset_outside_the_file_restarts_at_its_beginning(tmp_path, since):
    read(tmp_path, PROGRESS)
    assert read_events(tmp_path / "events.jsonl", since)[0] == [PROGRESS]


def test_lines_are_standard_json(tmp_path):
    line = event_line("level", psnr=math.inf, deep={"x": [math.nan, 1.5]}, name=os.fsdecode(b"caf\xe9.jpg"))
    record = json.loads(line, parse_constant=lambda name: pytest.fail(name))
    assert (record["psnr"], record["deep"], record["name"]) == (None, {"x": [None, 1.5]}, "caf?.jpg")


def test_writer_starts_a_new_line_after_an_incomplete_one(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "pro')
    events = EventWriter(path, tmp_path / "reserve", None)
    events("status", message="Reading the scene")
    events.write_final("cancelled")
    events.close()
    assert [event["event"] for event in read_events(path)[0]] == ["status", "cancelled"]
    assert os.listdir(tmp_path) == ["events.jsonl"]


def test_full_disk_at_the_start_names_the_file(tmp_path, monkeypatch):
    def fail(path, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space left") as error:
        EventWriter(tmp_path / "events.jsonl", tmp_path / "reserve", None)
    assert error.value.filename == str(tmp_path / "reserve")
