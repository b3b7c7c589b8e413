"""Events and logs of a run's folder."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from training.runs.folder import RunFolder

META = {"camera_center": [0, 0, 1], "up_rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}
LEVEL = {
    "event": "level", "level": 1, "path": "levels/level_1.ply", "splats": 7, "psnr": 20.5, "rule": "bands",
    "facts": {"s_min": 0.1}, "scene_facts": {}, "controls": {"gamma": 1.0}, "cumulative": False,
    "again": False, "more": False, "meta": META,
}  # fmt: skip
PROGRESS = {
    "event": "progress", "stage": "level 1 of 5", "level": 1, "levels": 5, "step": 3, "of": 9, "loss": 0.1,
    "psnr": 20.0, "splats": 7, "steps_per_s": 2.5, "eta_s": 3.0,
}  # fmt: skip
EVENTS = [
    {"event": "hello", "time": 1.5, "protocol": 1, "version": "0.1", "method": "flod", "pid": 7},
    {"event": "status", "message": "Reading the scene"},
    PROGRESS,
    {"event": "warning", "message": "ü"},
    LEVEL,
    {"event": "error", "what": "The disk is full.", "remedy": "Free some space.", "cause": "disk"},
    {"event": "cancelled", "step": 3, "message": "Stopped."},
    {"event": "done", "bundle": "bundle.ply", "seconds": 3.5, "train_psnr": 30.0},
]


def lines(events: list) -> bytes:
    return b"".join(json.dumps(event).encode() + b"\n" for event in events)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    folder.create()
    return folder


def follow(run: RunFolder) -> None:
    """Use a run like the panel does: texts are printable, and events are valid for their readers."""
    events, offset = run.events()
    assert run.events(offset)[0] == []
    for event in events:
        json.dumps(event, allow_nan=False).encode()
        assert event["event"] in {known["event"] for known in EVENTS}
    for level in run.levels():
        assert level["level"] >= 1 and level["splats"] >= 0
        assert (run.path / level["path"]).resolve().is_relative_to(run.path.resolve())
    assert run.state() in {"empty", "running", "done", "cancelled", "failed", "interrupted"}
    run.last_event("error", "done")
    run.log_tail(1).encode()


@pytest.mark.cases(short=80, weight=2)
@given(content=corrupted([lines(EVENTS), lines(EVENTS[:5] * 3)]))
def test_corrupt_event_files(run, content):
    run.events_file.write_bytes(content)
    run.log.write_bytes(content)
    attempt("events", lambda: follow(run), content)


@pytest.mark.cases(short=40, weight=2)
@given(values=st.lists(st.sampled_from(EVENTS).flatmap(corrupted_value), min_size=1, max_size=4))
def test_events_with_unusual_values(run, values):
    run.events_file.write_bytes(lines(values))
    attempt("events", lambda: follow(run), values)
