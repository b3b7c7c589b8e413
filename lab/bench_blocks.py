"""What dividing a scene costs beside training its blocks, and what more workers bring: ``make bench-blocks``.

A plan of examples/lantern_walk is trained with ``lodgs blocks run`` where ``--on`` says, each worker with one
thread. Times are those that the run and its parts tell in their events. A part's own time is from its
trainer's first word to its last, and the seconds in which a trainer starts, measured by itself; whoever calls
``lodgs train`` for one part after the other has both. All else that passes while parts are trained is the
engine's overhead: starting Dask, giving parts out, looking how they get on, waiting. What no engine could
help, a worker without work because parts are not equally long, is taken out: ideally each worker takes the
next part as soon as it is free, in the order of their numbers. The model for 1 to 64 workers is that ideal,
with the overhead that one worker had for each part, and what comes before and after. Saves
build/bench/blocks.json, and draws blocks.png beside it.
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

from training.runs.blocks.plan import BLOCK, COARSE, read_plan  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402

ON = ("here", "local:1", "local:2")
MOST_WORKERS = 64
STARTS = 3
"""How often the start of a trainer is measured."""
JOB = (
    "--scene", str(ROOT / "examples" / "lantern_walk"), "--method", "flod", "--test-every", "8",
)  # fmt: skip


def workers_of(on: str) -> int:
    """How many parts are trained at a time."""
    return int(on.partition(":")[2] or 1)


def makespan(seconds: Sequence[float], workers: int) -> float:
    """When the last of these tasks ends, if whoever is free takes the next one.

    Graham's list scheduling (Bounds on multiprocessing timing anomalies, 1969), in the order that is given.
    """
    free = [0.0] * workers
    for each in seconds:
        first = min(range(workers), key=free.__getitem__)
        free[first] += each
    return max(free)


def lodgs(*arguments: str) -> float:
    """Runs a command with one thread a trainer; returns the seconds that it took."""
    begun = time.monotonic()
    subprocess.run(
        [sys.executable, "-m", "training", *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL,
        env={**os.environ, "LODGS_THREADS": "1"},
    )  # fmt: skip
    return time.monotonic() - begun


def own_seconds(folder: RunFolder) -> float:
    """From a part's trainer's first word to its last."""
    events = folder.events()[0]
    return events[-1]["time"] - events[0]["time"]


def parts_of(run: RunFolder) -> tuple[dict[str, list[float]], float]:
    """The own times of a run's parts by stage, which begins when the one before it is over; of these a start.

    A trainer whose part is finished starts and ends at once.
    """
    stages = [stage for stage in read_plan(run).stages if stage]
    finished = str(stages[0][0].folder.job)
    start = statistics.median(lodgs("train", finished) for _ in range(STARTS))
    parts = {
        stage[0].kind: [round(own_seconds(part.folder) + start, 3) for part in stage] for stage in stages
    }
    return parts, start


def measure(work: Path, on: str, cells: str, further: Sequence[str]) -> dict:
    """Trains the plan in a new folder; what took how long."""
    run = RunFolder(work / on.replace(":", "-"))
    shutil.rmtree(run.path, ignore_errors=True)
    planning = lodgs("blocks", "plan", *JOB, "--cells", cells, "--out", str(run.path), *further)
    wall = lodgs("blocks", "run", str(run.path), "--on", on)
    (parts, start), workers = parts_of(run), workers_of(on)
    events = run.events()[0]
    training = next(e["time"] for e in events if e.get("message", "").startswith("Putting "))
    training -= events[0]["time"]
    after = events[-1]["time"] - events[0]["time"] - training
    ideal = sum(makespan(each, workers) for each in parts.values())
    own = sum(map(sum, parts.values()))
    return {
        "on": on, "workers": workers, "cells": cells, "planning_s": round(planning, 2),
        "wall_s": round(wall, 2), "starting_s": round(wall - training - after, 2),
        "training_s": round(training, 2),
        "after_s": round(after, 2), "start_s": round(start, 2), "parts_s": parts, "own_s": round(own, 2),
        "ideal_s": round(ideal, 2),
        "overhead_s": round(training - ideal, 2),
        "overhead_share": round((training - ideal) * workers / own, 4),
    }  # fmt: skip


def model(row: dict, workers: int, times: int = 1) -> float:
    """Seconds of the whole command with so many workers, from what one worker has taken.

    Args:
        times: how many plans like the measured one the blocks are of; what comes after them grows with it.
    """
    parts = row["parts_s"]
    each = row["overhead_s"] / sum(map(len, parts.values()))
    seconds = row["starting_s"] + row["after_s"] * times
    for kind, stage in parts.items():
        stage = [own + each for own in stage]
        seconds += sum(stage) * times if kind == COARSE else makespan(stage * times, workers)
    return seconds


def plot(path: Path, rows: Sequence[dict]) -> None:
    """The model for 1 to 64 workers, and what was measured."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    one = next(row for row in rows if row["on"] == "here")
    count, counts = len(one["parts_s"][BLOCK]), range(1, MOST_WORKERS + 1)
    figure, axes = pyplot.subplots(figsize=(7, 4))
    for times, style in ((1, "-"), (-(-MOST_WORKERS // count), "--")):
        least = model(one, 1, times)
        faster = [least / model(one, workers, times) for workers in counts]
        axes.plot(counts, faster, style, label=f"model, {times * count} blocks")
    for row in rows:
        axes.plot(row["workers"], one["wall_s"] / row["wall_s"], "o", label=f"measured, {row['on']}")
    axes.plot(counts, counts, ":", color="grey", label="as many times as workers")
    axes.set(xscale="log", yscale="log", xlabel="workers", ylabel="times faster than one")
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
    """Prints and saves what was measured, and the model where one worker was."""
    for row in rows:
        print(
            f"{row['on']:<8} {row['wall_s']:7.1f} s, parts {row['own_s']:7.1f} s on {row['workers']} workers "
            f"(ideally {row['ideal_s']:.1f} s): overhead {row['overhead_s']:.1f} s, "
            f"{100 * row['overhead_share']:.1f} % of the parts' time; a trainer starts in "
            f"{row['start_s']:.1f} s; before {row['starting_s']:.1f} s, after {row['after_s']:.1f} s"
        )
    saved: dict = {"rows": rows}
    if one := next((row for row in rows if row["on"] == "here"), None):
        counts = [2**power for power in range(7)]
        saved["model_s"] = {workers: round(model(one, workers), 1) for workers in counts}
        plot(path.with_suffix(".png"), rows)
    path.write_text(json.dumps(saved, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description="measure what dividing a scene costs")
    parser.add_argument("--out", type=Path, default=Path("build/bench/blocks.json"))
    parser.add_argument("--work", type=Path, default=Path("build/bench/blocks"), help="where runs lie")
    parser.add_argument("--on", nargs="+", default=ON, help="rows of others that were measured before stay")
    parser.add_argument("--cells", default="3x2")
    options, further = parser.parse_known_args()  # the others are of lodgs train
    options.out.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(options.out.read_text(encoding="utf-8"))["rows"] if options.out.exists() else []
    rows = {row["on"]: row for row in known}
    for on in options.on:
        rows[on] = measure(options.work, on, options.cells, further)
        report(options.out, sorted(rows.values(), key=lambda row: (row["workers"], row["on"])))
    print(f"{options.out} and {options.out.with_suffix('.png').name}")


if __name__ == "__main__":
    main()
