"""Measure the overhead of training a scene in cells, and the gain of more workers: ``make bench-blocks``.

Trains a plan of examples/lantern_walk with ``lodgs blocks run`` on the workers given by ``--on``, with one
thread each. Times come from the events of the run and its parts. The time of a part is that between its first
and last event, plus the separately measured start of a trainer. The remaining time while parts train is
overhead: starting Dask, submitting, polling and waiting. Idle workers due to unequal parts do not count as
overhead: ideally, each worker takes the next part, by number, as soon as it is free. The model for 1 to 64
workers is this ideal, plus the measured overhead per part and the time before and after training. Writes
build/bench/blocks.json and blocks.png.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from training.runs.cells.plan import CELL, COARSE, read_plan  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402

ON = ("here", "local:1", "local:2")
MAX_WORKERS = 64
STARTS = 3
"""Number of measurements of a trainer's start."""
JOB = (
    "--scene", str(ROOT / "examples" / "lantern_walk"), "--method", "flod", "--test-every", "8",
)  # fmt: skip


def workers_of(on: str) -> int:
    """Return the number of parts that are trained at a time."""
    return int(on.partition(":")[2] or 1)


def makespan(seconds: Sequence[float], workers: int) -> float:
    """Return the end time of the last task if each free worker takes the next task, in the given order.

    Graham's list scheduling (Bounds on multiprocessing timing anomalies, 1969).
    """
    free = [0.0] * workers
    for duration in seconds:
        first = min(range(workers), key=free.__getitem__)
        free[first] += duration
    return max(free)


def lodgs(*arguments: str) -> float:
    """Run a command with one thread per trainer; return its duration in seconds."""
    start = time.monotonic()
    subprocess.run(
        [sys.executable, "-m", "training", *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL,
        env={**os.environ, "LODGS_THREADS": "1"},
    )  # fmt: skip
    return time.monotonic() - start


def part_seconds(folder: RunFolder) -> float:
    """Return the time between the first and last event of a part."""
    events = folder.events()[0]
    return events[-1]["time"] - events[0]["time"]


def parts_of(run: RunFolder) -> tuple[dict[str, list[float]], float]:
    """Return the times of a run's parts by stage, and the start time of a trainer that they include.

    The start is measured with a finished part, whose trainer ends immediately.
    """
    stages = [stage for stage in read_plan(run).stages if stage]
    finished = str(stages[0][0].folder.job)
    start = statistics.median(lodgs("train", finished) for _ in range(STARTS))
    parts = {
        stage[0].kind: [round(part_seconds(part.folder) + start, 3) for part in stage] for stage in stages
    }
    return parts, start


def measure(work: Path, on: str, cells: str, options: Sequence[str]) -> dict:
    """Train the plan in a new folder; return its times."""
    run = RunFolder(work / on.replace(":", "-"))
    shutil.rmtree(run.path, ignore_errors=True)
    planning = lodgs("blocks", "plan", *JOB, "--cells", cells, "--out", str(run.path), *options)
    wall = lodgs("blocks", "run", str(run.path), "--on", on)
    (parts, start), workers = parts_of(run), workers_of(on)
    events = run.events()[0]
    training = next(e["time"] for e in events if e.get("message", "").startswith("Merging "))
    training -= events[0]["time"]
    after_s = events[-1]["time"] - events[0]["time"] - training
    ideal = sum(makespan(stage, workers) for stage in parts.values())
    total = sum(map(sum, parts.values()))
    return {
        "on": on, "workers": workers, "cells": cells, "planning_s": round(planning, 2),
        "wall_s": round(wall, 2), "starting_s": round(wall - training - after_s, 2),
        "training_s": round(training, 2),
        "after_s": round(after_s, 2), "start_s": round(start, 2), "parts_s": parts, "own_s": round(total, 2),
        "ideal_s": round(ideal, 2),
        "overhead_s": round(training - ideal, 2),
        "overhead_share": round((training - ideal) * workers / total, 4),
    }  # fmt: skip


def model(row: dict, workers: int, times: int = 1) -> float:
    """Return the modelled seconds of the command with a number of workers, from measurements of one worker.

    Args:
        row: measurements of one worker.
        workers: number of workers.
        times: size of the plan as a multiple of the measured one; scales the time after training, too.
    """
    parts = row["parts_s"]
    overhead = row["overhead_s"] / sum(map(len, parts.values()))
    seconds = row["starting_s"] + row["after_s"] * times
    for kind, stage in parts.items():
        stage = [duration + overhead for duration in stage]
        seconds += sum(stage) * times if kind == COARSE else makespan(stage * times, workers)
    return seconds


def plot(path: Path, rows: Sequence[dict]) -> None:
    """Plot the model for 1 to 64 workers, and the measurements."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    base = next(row for row in rows if row["on"] == "here")
    count, counts = len(base["parts_s"][CELL]), range(1, MAX_WORKERS + 1)
    figure, axes = pyplot.subplots(figsize=(7, 4))
    for times, style in ((1, "-"), (-(-MAX_WORKERS // count), "--")):
        single = model(base, 1, times)
        speedups = [single / model(base, workers, times) for workers in counts]
        axes.plot(counts, speedups, style, label=f"model, {times * count} blocks")
    for row in rows:
        axes.plot(row["workers"], base["wall_s"] / row["wall_s"], "o", label=f"measured, {row['on']}")
    axes.plot(counts, counts, ":", color="grey", label="linear speedup")
    axes.set(xscale="log", yscale="log", xlabel="workers", ylabel="speedup")
    ticks = [1, 2, 4, 8, 16, 32, 64]
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(ticks, [str(tick) for tick in ticks])
        axis.set_ticks([], minor=True)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def report(path: Path, rows: Sequence[dict]) -> None:
    """Print and save the measurements, and the model if one worker was measured."""
    for row in rows:
        print(
            f"{row['on']:<8} {row['wall_s']:7.1f} s, parts {row['own_s']:7.1f} s on {row['workers']} workers "
            f"(ideal {row['ideal_s']:.1f} s): overhead {row['overhead_s']:.1f} s, "
            f"{100 * row['overhead_share']:.1f} % of the parts' time; start of a trainer "
            f"{row['start_s']:.1f} s; before {row['starting_s']:.1f} s, after {row['after_s']:.1f} s"
        )
    saved: dict = {"rows": rows}
    if base := next((row for row in rows if row["on"] == "here"), None):
        counts = [2**power for power in range(7)]
        saved["model_s"] = {workers: round(model(base, workers), 1) for workers in counts}
        plot(path.with_suffix(".png"), rows)
    path.write_text(json.dumps(saved, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the overhead of training a scene in cells.")
    parser.add_argument("--out", type=Path, default=Path("build/bench/blocks.json"))
    parser.add_argument("--work", type=Path, default=Path("build/bench/blocks"), help="folder of the runs")
    parser.add_argument(
        "--on", nargs="+", default=ON, help="workers to measure; earlier results of others are kept"
    )
    parser.add_argument("--cells", default="3x2")
    parser.add_argument(
        "train", nargs="*", metavar="-- OPTION", help="options of the training, as of lodgs blocks plan"
    )
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    earlier = json.loads(options.out.read_text(encoding="utf-8"))["rows"] if options.out.exists() else []
    rows = {row["on"]: row for row in earlier}
    for on in options.on:
        rows[on] = measure(options.work, on, options.cells, options.train)
        report(options.out, sorted(rows.values(), key=lambda row: (row["workers"], row["on"])))
    print(f"{options.out} and {options.out.with_suffix('.png').name}")


if __name__ == "__main__":
    main()
