"""Measurements of ``tools/bench_gpu.py --all``: parts that fail, crash or hang leave the others unchanged."""

import json
import os
import time

import pytest

from tools import bench_gpu


def answer() -> int:
    return 42


def fail() -> None:
    raise ValueError("no driver")


def crash() -> None:
    os.abort()


def hang() -> None:
    time.sleep(600)


@pytest.mark.slow
def test_failing_parts_leave_the_others_unchanged(tmp_path, monkeypatch):
    parts = bench_gpu.Parts(tmp_path / "new" / "results.json")
    monkeypatch.setattr(bench_gpu, "PART_SECONDS", 60)
    for part in (fail, crash, answer):
        parts.measure(part.__name__, part)
        assert json.loads((tmp_path / "new" / "results.json").read_text()) == parts.results
    monkeypatch.setattr(bench_gpu, "PART_SECONDS", 1)
    parts.measure("hang", hang)
    monkeypatch.setattr(parts, "_deadline", time.monotonic())
    parts.measure("late", answer)
    assert parts.results == {
        "fail": "failed: ValueError: no driver",
        "crash": "failed: the process ended with code -6",
        "answer": 42,
        "hang": "failed: stopped after 1 s",
        "late": "skipped: the time is over",
    }


def test_seeds_without_a_result_are_left_out():
    def trained(psnr, code=0):
        return {"psnr": psnr, "code": code}

    results = {
        "seed 0, cpu": trained(20.0), "seed 0, gpu": trained(20.1),
        "seed 1, cpu": trained(22.0), "seed 1, gpu": trained(22.3),
        "seed 2, cpu": trained(21.0), "seed 2, gpu": trained(None, 2),
    }  # fmt: skip
    assert bench_gpu.compare_seeds(results) == {
        "psnr": {"cpu": [20.0, 22.0, 21.0], "gpu": [20.1, 22.3, None]}, "seeds": 2, "largest_difference": 0.2,
    }  # fmt: skip
    assert bench_gpu.compare_seeds({**results, "seed 0, cuda": "failed: x"})["seeds"] == 0
    assert bench_gpu.compare_seeds({})["largest_difference"] is None


def test_trainings_that_fail_or_take_too_long_return_their_events():
    ended = bench_gpu.training("nonsense", [], 60)
    assert ended["code"] not in (0, None) and ended["psnr"] is None and ended["log"]
    stopped = bench_gpu.training("cpu", ["--method", "3dgs"], 0.1)
    assert stopped["code"] == "stopped after 0 s" and stopped["step"] is None
