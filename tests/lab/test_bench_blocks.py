"""The makespan model of lab/bench_blocks.py, against cases that are worked by hand."""

import json
import sys

import pytest

from lab import bench_blocks
from lab.bench_blocks import makespan, model, workers_of


def test_whoever_is_free_takes_the_next():
    """Of two, the second is free at 1 and takes 4, the first at 3 and takes 1, and at 4 it takes 5."""
    assert makespan([3, 1, 4, 1, 5], 2) == 9
    assert makespan([3, 1, 4, 1, 5], 1) == 14
    assert makespan([3, 1, 4, 1, 5], 5) == makespan([3, 1, 4, 1, 5], 64) == 5
    assert makespan([], 3) == 0


def test_what_is_coarse_and_what_comes_after_is_not_divided():
    """Seven parts with a second of overhead each: coarse levels of 10 s, blocks of 4 s, seams of 1 s."""
    row = {
        "starting_s": 2.0, "after_s": 3.0, "overhead_s": 7.0,
        "parts_s": {"coarse": [10.0], "block": [4.0, 4.0, 4.0], "seam": [1.0, 1.0, 1.0]},
    }  # fmt: skip
    assert model(row, 1) == pytest.approx(2 + 11 + 15 + 6 + 3)
    assert model(row, 2) == pytest.approx(2 + 11 + 10 + 4 + 3)
    assert model(row, 64) == pytest.approx(2 + 11 + 5 + 2 + 3)
    assert model(row, 3, times=2) == pytest.approx(2 + 22 + 10 + 4 + 6)


def test_places_say_how_many_work():
    assert [workers_of(on) for on in ("here", "local:1", "local:2")] == [1, 1, 2]


@pytest.mark.slow
def test_a_plan_is_measured_and_drawn(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_blocks, "STARTS", 1)
    out = tmp_path / "blocks.json"
    short = "--method 3dgs --set steps=20 --set max_splats=200 --polish 0 --image-scale 1 --test-every 4"
    where = ["--on", "here", "--cells", "1x1", "--out", str(out), "--work", str(tmp_path / "work")]
    monkeypatch.setattr(sys, "argv", ["bench", *where, "--scene", str(tiny_scene), *short.split()])
    bench_blocks.main()
    saved = json.loads(out.read_text())
    (row,) = saved["rows"]
    assert list(row["parts_s"]) == ["block"] and len(row["parts_s"]["block"]) == 1
    assert row["ideal_s"] == row["own_s"] == pytest.approx(row["parts_s"]["block"][0], abs=0.01)
    assert row["wall_s"] == pytest.approx(row["starting_s"] + row["training_s"] + row["after_s"], abs=0.02)
    assert saved["model_s"]["1"] == pytest.approx(row["wall_s"], abs=0.2), "one worker took what was measured"
    assert out.with_suffix(".png").stat().st_size > 10_000
