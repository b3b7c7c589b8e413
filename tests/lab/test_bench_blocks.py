"""Makespan model of lab/bench_blocks.py, against manually computed cases."""

import json
import sys

import pytest

from lab import bench_blocks
from lab.bench_blocks import makespan, model, workers_of


def test_free_workers_take_the_next_task():
    """With two workers, the second is free at 1 and takes 4; the first takes 1 at 3 and 5 at 4."""
    assert makespan([3, 1, 4, 1, 5], 2) == 9
    assert makespan([3, 1, 4, 1, 5], 1) == 14
    assert makespan([3, 1, 4, 1, 5], 5) == makespan([3, 1, 4, 1, 5], 64) == 5
    assert makespan([], 3) == 0


def test_model_does_not_parallelise_the_coarse_part_and_merging():
    """Parts with one second of overhead each: coarse part 10 s, blocks 4 s, seams 1 s."""
    row = {
        "starting_s": 2.0, "after_s": 3.0, "overhead_s": 7.0,
        "parts_s": {"coarse": [10.0], "block": [4.0, 4.0, 4.0], "seam": [1.0, 1.0, 1.0]},
    }  # fmt: skip
    assert model(row, 1) == pytest.approx(2 + 11 + 15 + 6 + 3)
    assert model(row, 2) == pytest.approx(2 + 11 + 10 + 4 + 3)
    assert model(row, 64) == pytest.approx(2 + 11 + 5 + 2 + 3)
    assert model(row, 3, times=2) == pytest.approx(2 + 22 + 10 + 4 + 6)


def test_number_of_workers():
    assert [workers_of(on) for on in ("here", "local:1", "local:2")] == [1, 1, 2]


@pytest.mark.slow
def test_plan_is_measured_and_plotted(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_blocks, "STARTS", 1)
    out = tmp_path / "blocks.json"
    options = "--method 3dgs --set steps=20 --set max_splats=200 --polish 0 --image-scale 1 --test-every 4"
    paths = ["--on", "here", "--cells", "1x1", "--out", str(out), "--work", str(tmp_path / "work")]
    monkeypatch.setattr(sys, "argv", ["bench", *paths, "--", "--scene", str(tiny_scene), *options.split()])
    bench_blocks.main()
    saved = json.loads(out.read_text())
    (row,) = saved["rows"]
    assert list(row["parts_s"]) == ["block"] and len(row["parts_s"]["block"]) == 1
    assert row["ideal_s"] == row["own_s"] == pytest.approx(row["parts_s"]["block"][0], abs=0.01)
    assert row["wall_s"] == pytest.approx(row["starting_s"] + row["training_s"] + row["after_s"], abs=0.02)
    assert saved["model_s"]["1"] == pytest.approx(row["wall_s"], abs=0.2), (
        "the model of one worker equals the measurement"
    )
    assert out.with_suffix(".png").stat().st_size > 10_000
