"""A replacement for the trainer's Python. It writes the events of a run; $LODGS_FAKE selects a failure.

Cells train half of their steps, then wait for the file ``go on``.

- ``""``        two levels, then ``done``
- ``chunks``    two levels of LODGE, sent a second time with their chunk columns
- ``far``       two levels with the local origin ORIGIN
- ``tree``      leaves, then all nodes of a tree
- ``two halves``  two levels, then ``done`` once the file ``go on`` exists
- ``slow``      steps until it is cancelled, at most half an hour
- ``killed``    one level, then SIGKILL to itself
- ``crash``     one level, then a traceback and exit code 1
- ``garbage``   noise on stdout and between the events, then as ``""``
- ``odd``       an event with a field of the wrong type
- ``mute``      no event, and cancelling has no effect
- ``full``      an ``error`` event, as with a full disk
- ``refused``   an ``error`` event on stdout only, as for a run folder of another job
"""

import json
import os
import signal
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, os.getcwd())

import numpy as np

from training.errors import LodgsError
from training.methods import METHODS
from training.runs.events import PROTOCOL, EventWriter
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply

COUNTS = {1: 5, 2: 20}
"""Splats by level."""
STEPS = 20
"""Steps of a cell."""
ORIGIN = [500_000.0, 4_200_000.0, 300.0]
"""Local origin of the levels in the mode ``far``."""
LEAVES = 3000
"""Leaves of a tree."""


def splats(count: int) -> Splats:
    rng = np.random.default_rng(count)
    return Splats(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), -3, np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def main() -> int:
    mode, command = os.environ.get("LODGS_FAKE", ""), sys.argv[3]
    METHODS["flod"] = replace(METHODS["flod"], from_base=True)  # tests of bases train it
    job = Job.from_file(Path(sys.argv[5], "job.toml") if command == "blocks" else Path(sys.argv[4]))
    folder = RunFolder(job.out)
    if mode == "mute":
        time.sleep(1000)
    if mode == "refused":
        what, remedy = "The run folder belongs to another job.", "Choose another."
        print(json.dumps({"event": "error", "what": what, "remedy": remedy}))
        return 2
    try:
        with folder.locked():
            return run(mode, job, folder, EventWriter(folder.events_file, folder.reserve, sys.stdout))
    except LodgsError as error:
        print(json.dumps({"event": "error", "what": error.what, "remedy": error.remedy}))
        return 2


def run(mode: str, job: Job, folder: RunFolder, emit: EventWriter) -> int:
    emit("hello", protocol=PROTOCOL, version="0", method=job.method, preset=job.preset, scene=job.scene,
        out=job.out, pid=os.getpid())  # fmt: skip
    emit("warning", message="One photograph is missing.")
    if mode == "full":
        emit(
            "error", what="The disk is full; training stopped.", remedy="Free some space and resume the run."
        )
        return 2
    if mode == "odd":
        emit("progress", stage="level 1 of 2", step=None)
        emit("level", level="one", path=3)
        return 1
    for step in range(100_000 if mode == "slow" else 2):
        emit("progress", stage="level 1 of 2", level=1, levels=2, step=step + 1, of=10_000, loss=0.5,
            psnr=20.0, splats=5, steps_per_s=20.0, eta_s=60.0)  # fmt: skip
        if folder.take_cancel():
            emit("cancelled", step=step, message="Stopped.")
            return 3
        if mode == "slow":
            time.sleep(0.02)
    if mode == "tree":
        return train_tree(folder, emit)
    if job.cells and not train_cells(job, folder, emit, sys.argv[6:]):
        emit("cancelled", message="Stopped; the run can be resumed.")
        return 3
    levels, tables = [], {}
    origin = {"origin": ORIGIN} if mode == "far" else {}
    for number, count in COUNTS.items():
        path = folder.level_file(number)
        levels.append(Level(number, splats(count), {"s_min": 0.1 if number == 1 else 0.0}))
        write_ply(path, levels[-1].splats)
        emit(
            "level", level=number, path=f"levels/{path.name}", splats=count, psnr=20.0,
            facts=levels[-1].facts, rule="bands", scene_facts={}, controls={"gamma": 2.0},
            cumulative=False, meta=origin,
        )  # fmt: skip
        if mode == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if mode == "crash":
            raise RuntimeError("the card caught fire")
        if mode == "garbage":
            print("garbage {on stdout")
            with folder.events_file.open("ab") as file:
                file.write(b'not json\n{"no": "event"}\n[1, 2]\n\xff\xfe\n')
    rule = "bands"
    if mode == "chunks":
        rule, tables = "chunks", {"chunks": {name: np.float32([1, 2]) for name in ("x", "y", "z", "radius")}}
        for level in levels:
            level.facts = {"d_l": 4.0 if level.number == 1 else 0.0}
            level.splats.extras["chunks_0"] = np.arange(len(level.splats), dtype=np.float32)
            path = folder.level_file(level.number)
            write_ply(path, level.splats)
            emit(
                "level", level=level.number, path=f"levels/{path.name}", splats=len(level.splats), again=True,
                facts=level.facts, rule=rule, scene_facts={}, controls={}, cumulative=False, meta={},
            )  # fmt: skip
    while mode == "two halves" and not (folder.path / "go on").exists():
        time.sleep(0.02)
    controls = {"gamma": 2.0} if rule == "bands" else {}
    meta = {"camera_center": [1.0, 2.0, 3.0], "focal_px": 100.0, **origin}
    write_bundle(folder.bundle, Bundle(job.method, levels, rule, {}, controls, meta=meta, tables=tables))
    emit("done", bundle=folder.bundle.name, seconds=1.0, train_psnr=21.5, veil={"mean": 0.01, "max": 0.25},
        oversized=0)  # fmt: skip
    return 0


@dataclass
class Cell:
    """A simulated cell: one step per update, half of the steps until ``go on`` exists."""

    number: int
    folder: RunFolder
    state: str = "running"

    @property
    def step(self) -> int:
        steps = self.folder.path / "steps"
        return len(steps.read_bytes()) if steps.exists() else 0

    def update(self, limit: int) -> None:
        if self.state == "running" and self.folder.take_cancel():
            self.state = "cancelled"
        if self.state == "cancelled" and self.folder.take_resume():
            self.state = "running"
        if self.state == "running" and self.step < limit:
            with (self.folder.path / "steps").open("ab") as steps:
                steps.write(b".")
        if self.step == STEPS:
            self.state = "done"


def train_cells(job: Job, folder: RunFolder, emit: EventWriter, options: list[str]) -> bool:
    """Train cells as ``lodgs train`` does; return True if all are done."""
    print(*options, file=sys.stderr)  # for the log
    columns, rows = job.grid
    cells = [Cell(n, RunFolder(folder.blocks / str(n))) for n in range(1, columns * rows + 1)]
    for cell in cells:
        cell.folder.path.mkdir(parents=True, exist_ok=True)
        cell.folder.take_cancel()
    if resumed := [cell for cell in cells if cell.folder.take_resume()]:
        for cell in cells:
            cell.state = "running" if cell in resumed else "cancelled"
    while any(cell.state == "running" for cell in cells):
        if folder.take_cancel():
            return False
        for cell in cells:
            cell.update(STEPS if (folder.path / "go on").exists() else STEPS // 2)
        states = [
            {"block": b.number, "kind": "block", "state": b.state, "step": b.step, "of": STEPS} for b in cells
        ]
        emit("progress", stage="training cells", level=1, levels=1, step=sum(b.step for b in cells),
            of=STEPS * len(cells), loss=0.5, psnr=20.0, splats=5, steps_per_s=20.0, eta_s=60.0,
            blocks=states)  # fmt: skip
        time.sleep(0.02)
    return all(cell.state == "done" for cell in cells)


def train_tree(folder: RunFolder, emit: EventWriter) -> int:
    """Write the leaves, then all levels, like the method ``tree``."""
    from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages

    bundle = tree_of(random_leaves(LEAVES, np.random.default_rng(5)))
    for numbers in ((2,), (1, 2)):
        for level in bundle.levels:
            if level.number in numbers:
                path = folder.level_file(level.number)
                write_ply(path, level.splats)
                emit(
                    "level", level=level.number, path=f"levels/{path.name}", splats=len(level.splats),
                    facts={}, rule="cut", scene_facts={}, controls={}, cumulative=False, meta={},
                    more=level.number < 2,
                )  # fmt: skip
    write_in_pages(folder.bundle, bundle)
    emit("done", bundle=folder.bundle.name, seconds=1.0)
    return 0


if __name__ == "__main__":
    sys.exit(main())
