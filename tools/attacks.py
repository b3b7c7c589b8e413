"""Kill trainers at random times and fill disks: results must not change, and errors must be reported.

    python tools/attacks.py [--kills 60] [--disks 20] [--seed 0]

Runs take seconds on a tiny scene with a distorted lens; one trains a tree with too little memory for its
nodes. Needs fork, so not on Windows. A killed run is resumed and killed again; it must give the bits and
files of an undisturbed run. Running out of disk space (a small tmpfs, which needs root on Linux) must end in
the message that Blender's panel shows, and the run must finish once there is space. Results are written to
build/attacks.json.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.context import ForkProcess as Process
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

os.environ |= {"LODGS_CHECKPOINT_SECONDS": "0", "OMP_NUM_THREADS": "1"}

import numpy as np  # noqa: E402

import training.runs.train  # noqa: E402, F401 - loaded once, before forking
from tests.training.conftest import FOCAL, HEIGHT, WIDTH, write_tiny_scene  # noqa: E402
from tools.small_disk import DISK_FULL_MESSAGES, contents, small_disk  # noqa: E402
from training import __main__, files  # noqa: E402
from training.errors import LodgsError  # noqa: E402
from training.optimize.method import Method  # noqa: E402
from training.optimize.out_of_core import row_file  # noqa: E402
from training.runs.events import EventWriter  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402
from training.runs.job import Job  # noqa: E402
from training.runs.outcome import run_outcome  # noqa: E402
from training.scenes.undistort import CACHE_FOLDER  # noqa: E402
from training.splats.gaussians import Splats  # noqa: E402
from training.splats.ply import write_ply  # noqa: E402

PARAMETERS: dict[str, dict] = {
    "flod": {"levels": 3, "steps": [11, 12, 14], "finish_share": 0.4, "footprint": 6.0, "max_splats": 300},
    "octree": {"levels": 3, "steps": 40, "refine_steps": 8, "footprint": 6.0, "max_splats": 300},
    "tree": {"tune_steps": 40, "pixels": 3.0, "resize_interval": 9, "sh_degree": 3},
}
BASE_SPLATS = 3000
"""Splats of a tree's base. Its nodes need several times the megabyte that the job allows."""
KINDS = ("undistort", "checkpoint", "level", "bundle", "event", "step", "rows")
"""Activities during which a trainer is killed."""
KILLS_PER_RUN = 3
FORK = get_context("fork")


# -- trainer ------------------------------------------------------------------------------------------


def train_until_killed(job: Path, kind: str, number: int, share: float, counts_file: Path | None) -> None:
    """Train a job, count activities, and kill this process at the given activity.

    Args:
        job: job file.
        kind: one of KINDS; any other value never kills.
        number: how many activities of this kind to complete first.
        share: share of the data being written that reaches the disk.
        counts_file: output file for the counts.
    """
    counts: dict[str, int] = dict.fromkeys(KINDS, 0) | {"peak": 0}

    def activity(current: str, write_part=None) -> None:
        counts[current] += 1
        if current == kind and counts[current] > number:
            if write_part:
                write_part()
            os.kill(os.getpid(), signal.SIGKILL)

    def kind_of(path: str) -> str:
        names = {"checkpoints": "checkpoint", "levels": "level"}
        return "bundle" if "bundle.ply" in path else names.get(Path(path).parent.name, "event")

    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    fsync, replace, train_step, append = os.fsync, os.replace, Method.train_step, EventWriter._append
    write = row_file._write

    def sync(descriptor: int) -> None:
        link = f"/proc/self/fd/{descriptor}"
        path = os.readlink(link) if os.path.exists(link) else ""
        if path.endswith(".tmp"):
            size = os.fstat(descriptor).st_size
            activity(kind_of(path), lambda: os.truncate(path, int(size * share)))
        fsync(descriptor)

    def move(source, target) -> None:
        if str(source).endswith(".tmp"):
            run = Path(target).parents[target.parent.name in ("checkpoints", "levels")]
            sizes = sum(path.stat().st_size + 4096 for path in run.rglob("*") if path.is_file())
            counts["peak"] = max(counts["peak"], sizes)
            activity(kind_of(str(target)))
        replace(source, target)
        if str(source).endswith(".tmp"):
            activity(kind_of(str(target)))

    def step(self, number: int):
        activity("step")
        return train_step(self, number)

    def append_event(self, data: bytes) -> None:
        activity("event", lambda: self._file.write(data[: int(len(data) * share)]))
        append(self, data)

    def write_back(file, blocks) -> None:
        activity("rows", lambda: write(file, blocks.reshape(-1)[: int(blocks.size * share)]))
        write(file, blocks)

    row_file._write = write_back
    files.os.fsync, files.os.replace = sync, move  # type: ignore[assignment]
    Method.train_step, EventWriter._append = step, append_event
    code = __main__.main(["train", str(job)])
    if counts_file is not None:
        counts_file.write_text(json.dumps(counts))
    os._exit(code)


# -- attacks ---------------------------------------------------------------------------------------------


class TrainerAttack:
    """Scene, jobs, and the results of undisturbed runs.

    Args:
        work: working folder.
        rng: random generator for the times of attacks.
    """

    def __init__(self, work: Path, rng: random.Random) -> None:
        self.work = work
        self.rng = rng
        self.scene = write_tiny_scene(work / "scene")
        (
            self.scene / CACHE_FOLDER
        ).touch()  # a file instead of a folder, so that each run undistorts photos itself
        model = self.scene / "sparse" / "0"
        camera = f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.02\n"
        (model / "cameras.txt").write_text(camera)
        points = (model / "points3D.txt").read_text().splitlines()
        without_tracks = [" ".join(line.split()[:8]) + "\n" for line in points]
        (model / "points3D.txt").write_text("".join(without_tracks))
        write_ply(work / "base.ply", base_splats())
        self.counts = {}
        self.expected = {}
        for method in PARAMETERS:
            out = work / f"undisturbed-{method}"
            counts = work / f"{method}.json"
            code = exit_code(self._start(self.job(method, out), counts=counts))
            assert code == 0, f"undisturbed run ended with {code}"
            self.counts[method], self.expected[method] = json.loads(counts.read_text()), contents(out)

    def job(self, method: str, out: Path) -> Path:
        """Write the job file of a run; return its path."""
        path = out.with_name(f"{out.name}.json")
        keys = {
            "scene": str(self.scene), "out": str(out), "method": method, "backend": "cpu", "image_scale": 1.0,
            "test_every": 4, "parameters": PARAMETERS[method],
        }  # fmt: skip
        if method == "tree":
            keys |= {"base": str(self.work / "base.ply"), "splat_memory": 1}
        path.write_text(json.dumps(keys))
        return path

    def _start(self, job: Path, kind="-", number=0, share=0.0, counts: Path | None = None) -> Process:
        return start_fork(train_until_killed, job, kind, number, share, counts)

    def kill_runs(self, kills: int) -> dict:
        """Kill this many trainers; return the results of their runs."""
        results = {"killed": dict.fromkeys(KINDS, 0), "runs": 0, "outlived": 0, "wrong": []}
        kinds = [kind for _ in range(kills) for kind in KINDS]
        while sum(results["killed"].values()) < kills:
            method = list(PARAMETERS)[results["runs"] % len(PARAMETERS)]
            out = self.work / "killed"
            shutil.rmtree(out, ignore_errors=True)
            job = self.job(method, out)
            for _ in range(KILLS_PER_RUN):
                possible = {"undistort": not any(out.glob("undistorted/*")), "rows": method == "tree"}
                kind = next((k for k in kinds if possible.get(k, True)), "-")
                if kind == "undistort":
                    killed = self._kill_undistorting(job, out, results)
                else:
                    total = self.counts[method].get(kind, 0)
                    number = self.rng.randrange(max(total // (1 if total < 9 else KILLS_PER_RUN), 1))
                    killed = exit_code(self._start(job, kind, number, self.rng.random())) == -signal.SIGKILL
                if killed:
                    kinds.remove(kind)
                    results["killed"][kind] += 1
                    state, message = run_outcome(RunFolder(out), None)
                    if state not in ("interrupted", "done"):
                        results["wrong"].append(f"{method}, {kind}: {state} {message}")
            self._finish(method, job, out, results, results["killed"])
        return results

    def _kill_undistorting(self, job: Path, out: Path, results: dict) -> bool:
        trainer = self._start(job)
        while not any(out.glob("undistorted/undistorting-*")):
            if not trainer.is_alive():
                return False
            time.sleep(0.002)
        time.sleep(self.rng.uniform(0, 1.2))
        children_file = Path(f"/proc/{trainer.pid}/task/{trainer.pid}/children")
        children = children_file.read_text().split() if children_file.exists() else []
        trainer.kill()
        killed = exit_code(trainer) == -signal.SIGKILL
        deadline = time.monotonic() + 10
        while any(map(is_alive, children)) and time.monotonic() < deadline:
            time.sleep(0.05)
        results["outlived"] += sum(map(is_alive, children))
        return killed

    def fill_disks(self, disks: int) -> dict:
        """Train on disks that are too small, from nearly empty to nearly sufficient; return the results."""
        results = {"full": 0, "runs": 0, "wrong": [], "messages": {}}
        for number in range(disks):
            method = list(PARAMETERS)[number % len(PARAMETERS)]
            size = int(self.counts[method]["peak"] * (0.02 + 0.96 * number / max(disks - 1, 1)))
            with small_disk(self.work / "disk", size) as folder:
                run = RunFolder(folder / "run")
                log = run.log
                try:
                    run.create()
                    Job.from_file(self.job(method, self.work / "full")).resolved().write(run.job)
                    code = self._train(run)
                    state, problem = run_outcome(run, code)
                except LodgsError as error:
                    state, problem = "failed", str(error)
                text = log.read_text() if log.exists() else ""
                reported = any(message in problem for message in DISK_FULL_MESSAGES)
                if state == "failed" and reported and "Traceback" not in text:
                    results["full"] += 1
                    message = problem.replace(str(folder), "RUN")
                    results["messages"][message] = results["messages"].get(message, 0) + 1
                elif state != "done":
                    results["wrong"].append(f"{method}, {size} bytes: {state}: {problem} {text[-300:]}")
                subprocess.run(["mount", "-o", "remount,size=1g", str(folder)], check=True)
                Job.from_file(self.job(method, run.path)).resolved().write(run.job)
                (folder / "run.json").unlink()
                self._finish(method, run.job, run.path, results, size)
        return results

    def _train(self, run: RunFolder) -> int:
        """Train a run with its output in the run folder, as Blender does."""
        command = [sys.executable, "-m", "training", "train", str(run.job), "--out", str(run.path)]
        with open(run.output, "wb") as output, open(run.log, "ab") as log:
            return subprocess.call(command, cwd=ROOT, stdout=output, stderr=log)

    def _finish(self, method: str, job: Path, out: Path, results: dict, attack: object) -> None:
        """Resume a run to its end and compare it with the undisturbed one."""
        code = exit_code(self._start(job))
        results["runs"] += 1
        expected = self.expected[method]
        files = contents(out)
        differing = [name for name in expected.keys() | files.keys() if expected.get(name) != files.get(name)]
        if code or differing:
            results["wrong"].append(f"{method}, {attack}: code {code}, different: {sorted(differing)}")


def base_splats() -> Splats:
    """Return random splats near the points of the tiny scene."""
    rng = np.random.default_rng(0)
    means = rng.normal(0, rng.choice([0.2, 0.8], (BASE_SPLATS, 1)), (BASE_SPLATS, 3))
    quats, log_scales = rng.normal(size=(BASE_SPLATS, 4)), rng.normal(-4.5, 0.4, (BASE_SPLATS, 3))
    logits, sh = rng.normal(0, 2, BASE_SPLATS), rng.normal(0, 0.3, (BASE_SPLATS, 16, 3))
    arrays = (array.astype(np.float32) for array in (means, quats, log_scales, logits, sh))
    means, quats, log_scales, logits, sh = arrays
    return Splats(means, quats, log_scales, logits, sh)


def start_fork(function: Callable[..., object], *arguments: object) -> Process:
    """Start a function in a fork of this process, which saves loading torch."""
    process = FORK.Process(target=function, args=arguments)
    process.start()
    return process


def exit_code(process: Process) -> int | None:
    """Wait for a process and return its exit code."""
    process.join()
    return process.exitcode


def is_alive(pid: str) -> bool:
    """Return whether a process runs, on Linux."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def main() -> int:
    """Run the attacks, print and write results; return 1 if results differ or an error was not reported."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--disks", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lodgs-attacks-") as folder:
        attack = TrainerAttack(Path(folder), random.Random(options.seed))
        figures = {"kills": attack.kill_runs(options.kills)}
        if sys.platform == "linux" and os.geteuid() == 0:
            figures["disks"] = attack.fill_disks(options.disks)
        else:
            print("Skipping full disks: mounting a small tmpfs needs root on Linux.")
    report = ROOT / "build" / "attacks.json"
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))
    return int(any(figure["wrong"] or figure.get("outlived") for figure in figures.values()))


if __name__ == "__main__":
    sys.exit(main())
