"""The bench of trees larger than memory, on a small one."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc for the resident memory")
def test_a_tree_of_ten_times_the_budget_keeps_to_what_it_is_allowed(tmp_path):
    """By the system's own count; were all nodes in memory, it would be 90 MB more."""
    out = tmp_path / "tree.json"
    command = [sys.executable, "lab/bench_tree_memory.py", "--tiny", "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert row["budget_mb"] == 10 and row["splats"] * 180 > 9.9 * 10e6
    assert row["allowed_mb"] == pytest.approx(11 + row["program_mb"] + row["drawing_mb"])
    assert row["peak_mb"] <= row["allowed_mb"]
    assert row["drawn"] == pytest.approx(10_000, rel=0.3) and 0 < row["reused"] < 1
