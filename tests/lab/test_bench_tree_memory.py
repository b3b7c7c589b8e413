"""Benchmark of trees larger than memory, with a small tree."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from lab.bench_tree_memory import add_row

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the resident memory from /proc")
def test_tree_of_ten_times_the_budget_stays_within_its_memory_limit(tmp_path):
    """With all nodes in memory, the process would need 90 MB more."""
    out = tmp_path / "tree.json"
    command = [sys.executable, "lab/bench_tree_memory.py", "--tiny", "--out", str(out)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    (row,) = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert row["budget_mb"] == 10 and row["splats"] * 180 > 9.9 * 10e6
    assert row["allowed_mb"] == pytest.approx(11 + row["program_mb"] + row["drawing_mb"])
    assert row["peak_mb"] <= row["allowed_mb"]
    assert row["drawn"] == pytest.approx(10_000, rel=0.3) and 0 < row["reused"] < 1


def test_rows_of_other_caches_are_kept(tmp_path):
    report = tmp_path / "tree.json"
    for budget, seconds in ((100, 1), (200, 2), (100, 3)):
        add_row(report, {"name": "graph", "times": 3, "budget_mb": budget, "step_s": seconds})
    rows = json.loads(report.read_text(encoding="utf-8"))["rows"]
    assert [(row["budget_mb"], row["step_s"]) for row in rows] == [(200, 2), (100, 3)]
