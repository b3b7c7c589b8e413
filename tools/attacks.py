"""Trainers killed at random moments and disks that fill up: nothing is lost, and every end is told.

    python tools/attacks.py [--kills 60] [--disks 20] [--seed 0]

Runs of seconds on a tiny scene with a distorted lens, one of a tree without room for its nodes; not on
Windows, where processes do not fork. A killed run is resumed, and killed again, and must end with the bits of
an undisturbed one, with no file too many. A disk (a tmpfs, for which one has to be root on Linux) that is too
small must be told as Blender's panel tells it, in a sentence, and given room the run must end as well
as any. Figures go to build/attacks.json.
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
from multiprocessing import get_context
from multiprocessing.context import ForkProcess as Process
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

os.environ |= {"LODGS_CHECKPOINT_SECONDS": "0", "OMP_NUM_THREADS": "1"}

import numpy as np  # noqa: E402

import training.runs.train  # noqa: E402, F401 - loaded once for all that are killed
from tests.training.conftest import FOCAL, HEIGHT, WIDTH, write_tiny_scene  # noqa: E402
from tools.attacks_blocks import FULL_SAYS, contents, disk  # noqa: E402
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
    "flod": {"levels": 3, "steps": [10, 12, 14], "finish_share": 0.4, "footprint": 6.0, "max_splats": 300},
    "octree": {"levels": 3, "steps": 40, "footprint": 6.0, "far_share": 0.2, "max_splats": 300},
    "tree": {"tune_steps": 40, "pixels": 3.0, "resize_interval": 9, "sh_degree": 3},
}
BASE_SPLATS = 3000
"""Of the base of a tree, whose nodes take several times the one megabyte that its job gives them."""
KINDS = ("undistort", "checkpoint", "level", "bundle", "event", "step", "rows")
"""What a trainer is busy with when it is killed."""
KILLS_A_RUN = 3
FORK = get_context("fork")


# -- the victim ------------------------------------------------------------------------------------------


def victim(job: Path, kind: str, number: int, share: float, counts_file: Path | None) -> None:
    """Trains a job, counts what it is busy with, and kills itself at the N-th time of a kind.

    Args:
        kind: one of KINDS; another one for none.
        share: how much of what it was writing has got to the disk.
        counts_file: where to write what was counted.
    """
    counts: dict[str, int] = dict.fromkeys(KINDS, 0) | {"peak": 0}

    def moment(now: str, before=None) -> None:
        counts[now] += 1
        if now == kind and counts[now] > number:
            if before:
                before()
            os.kill(os.getpid(), signal.SIGKILL)

    def busy_with(path: str) -> str:
        names = {"checkpoints": "checkpoint", "levels": "level"}
        return "bundle" if "bundle.ply" in path else names.get(Path(path).parent.name, "event")

    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    fsync, replace, train_step, append = os.fsync, os.replace, Method.train_step, EventWriter._append
    write = row_file._write

    def sync(descriptor: int) -> None:
        place = f"/proc/self/fd/{descriptor}"
        path = os.readlink(place) if os.path.exists(place) else ""
        if path.endswith(".tmp"):  # as much of it as had got to the disk
            size = os.fstat(descriptor).st_size
            moment(busy_with(path), lambda: os.truncate(path, int(size * share)))
        fsync(descriptor)

    def move(source, target) -> None:
        if str(source).endswith(".tmp"):
            run = Path(target).parents[target.parent.name in ("checkpoints", "levels")]
            sizes = sum(path.stat().st_size + 4096 for path in run.rglob("*") if path.is_file())
            counts["peak"] = max(counts["peak"], sizes)
            moment(busy_with(str(target)))
        replace(source, target)
        if str(source).endswith(".tmp"):
            moment(busy_with(str(target)))

    def step(self, number: int):
        moment("step")
        return train_step(self, number)

    def say(self, data: bytes) -> None:
        moment("event", lambda: self._file.write(data[: int(len(data) * share)]))
        append(self, data)

    def write_back(file, blocks) -> None:
        moment("rows", lambda: write(file, blocks.reshape(-1)[: int(blocks.size * share)]))
        write(file, blocks)

    row_file._write = write_back
    files.os.fsync, files.os.replace = sync, move  # type: ignore[assignment]
    Method.train_step, EventWriter._append = step, say  # pyright: ignore
    code = __main__.main(["train", str(job)])
    if counts_file is not None:
        counts_file.write_text(json.dumps(counts))
    os._exit(code)


# -- attacks ---------------------------------------------------------------------------------------------


class Bench:
    """Scenes, jobs and what they give undisturbed.

    Args:
        work: a folder for all of it.
        chance: what draws moments.
    """

    def __init__(self, work: Path, chance: random.Random) -> None:
        self.work, self.chance = work, chance
        self.scene = write_tiny_scene(work / "scene")
        (self.scene / CACHE_FOLDER).touch()  # no folder: each run has to straighten photographs for itself
        model = self.scene / "sparse" / "0"
        camera = f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.02\n"
        (model / "cameras.txt").write_text(camera)
        points = (model / "points3D.txt").read_text().splitlines()
        without_tracks = [" ".join(line.split()[:8]) + "\n" for line in points]
        (model / "points3D.txt").write_text("".join(without_tracks))
        write_ply(work / "base.ply", base())
        self.counts, self.truth = {}, {}
        for method in PARAMETERS:
            out = work / f"undisturbed-{method}"
            counts = work / f"{method}.json"
            code = ended(self._victim(self.job(method, out), counts=counts))
            assert code == 0, f"an undisturbed run ends with {code}"
            self.counts[method], self.truth[method] = json.loads(counts.read_text()), contents(out)

    def job(self, method: str, out: Path) -> Path:
        """A job file of a run in a folder."""
        path = out.with_name(f"{out.name}.json")
        keys = {
            "scene": str(self.scene), "out": str(out), "method": method, "backend": "cpu", "image_scale": 1.0,
            "test_every": 4, "parameters": PARAMETERS[method],
        }  # fmt: skip
        if method == "tree":
            keys |= {"base": str(self.work / "base.ply"), "splat_memory": 1}
        path.write_text(json.dumps(keys))
        return path

    def _victim(self, job: Path, kind="-", number=0, share=0.0, counts: Path | None = None) -> Process:
        """A trainer at work; forked, so that it need not load torch."""
        process = FORK.Process(target=victim, args=(job, kind, number, share, counts))
        process.start()
        return process

    def kill_runs(self, kills: int) -> dict:
        """Kills trainers until that many are dead; what became of their runs."""
        found = {"killed": dict.fromkeys(KINDS, 0), "runs": 0, "outlived": 0, "wrong": []}
        kinds = [kind for _ in range(kills) for kind in KINDS]
        while sum(found["killed"].values()) < kills:
            method = list(PARAMETERS)[found["runs"] % len(PARAMETERS)]
            out = self.work / "killed"
            shutil.rmtree(out, ignore_errors=True)
            job = self.job(method, out)
            for _ in range(KILLS_A_RUN):
                possible = {"undistort": not any(out.glob("undistorted/*")), "rows": method == "tree"}
                kind = next((k for k in kinds if possible.get(k, True)), "-")
                if kind == "undistort":
                    dead = self._kill_undistorting(job, out, found)
                else:
                    most = self.counts[method].get(kind, 0)
                    number = self.chance.randrange(max(most // (1 if most < 9 else KILLS_A_RUN), 1))
                    dead = ended(self._victim(job, kind, number, self.chance.random())) == -signal.SIGKILL
                if dead:
                    kinds.remove(kind)
                    found["killed"][kind] += 1
                    state, said = run_outcome(RunFolder(out), None)
                    if state not in ("interrupted", "done"):
                        found["wrong"].append(f"{method}, {kind}: {state} {said}")
            self._finish(method, job, out, found, found["killed"])
        return found

    def _kill_undistorting(self, job: Path, out: Path, found: dict) -> bool:
        trainer = self._victim(job)
        while not any(out.glob("undistorted/undistorting-*")):
            if not trainer.is_alive():
                return False
            time.sleep(0.002)
        time.sleep(self.chance.uniform(0, 1.2))
        listed = Path(f"/proc/{trainer.pid}/task/{trainer.pid}/children")
        children = listed.read_text().split() if listed.exists() else []
        trainer.kill()
        dead = ended(trainer) == -signal.SIGKILL
        end = time.monotonic() + 10
        while any(map(alive, children)) and time.monotonic() < end:
            time.sleep(0.05)
        found["outlived"] += sum(map(alive, children))
        return dead

    def fill_disks(self, disks: int) -> dict:
        """Trains on disks that are too small, from nearly nothing to nearly enough; how that was told."""
        found = {"full": 0, "runs": 0, "wrong": [], "told": {}}
        for number in range(disks):
            method = list(PARAMETERS)[number % len(PARAMETERS)]
            size = int(self.counts[method]["peak"] * (0.02 + 0.96 * number / max(disks - 1, 1)))
            with disk(self.work / "disk", size) as place:
                run, log = RunFolder(place / "run"), place / "run" / "trainer.log"
                try:
                    run.create()
                    Job.from_file(self.job(method, self.work / "full")).resolved().write(run.job)
                    code = self._train(run)
                    state, problem = run_outcome(run, code)
                except LodgsError as error:
                    state, problem = "failed", str(error)
                text = log.read_text() if log.exists() else ""
                told = any(words in problem for words in FULL_SAYS)
                if state == "failed" and told and "Traceback" not in text:
                    found["full"] += 1
                    words = problem.replace(str(place), "RUN")
                    found["told"][words] = found["told"].get(words, 0) + 1
                elif state != "done":
                    found["wrong"].append(f"{method}, {size} bytes: {state}: {problem} {text[-300:]}")
                subprocess.run(["mount", "-o", "remount,size=1g", str(place)], check=True)
                Job.from_file(self.job(method, run.path)).resolved().write(run.job)
                (place / "run.json").unlink()
                self._finish(method, run.job, run.path, found, size)
        return found

    def _train(self, run: RunFolder) -> int:
        """A trainer whose output lies beside its run, as Blender starts it."""
        command = [sys.executable, "-m", "training", "train", str(run.job), "--out", str(run.path)]
        with open(run.output, "wb") as output, open(run.log, "ab") as log:
            return subprocess.call(command, cwd=ROOT, stdout=output, stderr=log)

    def _finish(self, method: str, job: Path, out: Path, found: dict, about: object) -> None:
        """Resumes a run to its end and compares it with the undisturbed one."""
        code = ended(self._victim(job))
        found["runs"] += 1
        truth, now = self.truth[method], contents(out)
        odd = [name for name in truth.keys() | now.keys() if truth.get(name) != now.get(name)]
        if code or odd:
            found["wrong"].append(f"{method}, {about}: code {code}, otherwise: {sorted(odd)}")


def base() -> Splats:
    """Splats about where the tiny scene's points are."""
    rng = np.random.default_rng(0)
    means = rng.normal(0, rng.choice([0.2, 0.8], (BASE_SPLATS, 1)), (BASE_SPLATS, 3))
    quats, log_scales = rng.normal(size=(BASE_SPLATS, 4)), rng.normal(-4.5, 0.4, (BASE_SPLATS, 3))
    logits, sh = rng.normal(0, 2, BASE_SPLATS), rng.normal(0, 0.3, (BASE_SPLATS, 16, 3))
    arrays = (each.astype(np.float32) for each in (means, quats, log_scales, logits, sh))
    means, quats, log_scales, logits, sh = arrays
    return Splats(means, quats, log_scales, logits, sh)


def ended(process: Process) -> int | None:
    """The exit code of a process, when it has ended."""
    process.join()
    return process.exitcode


def alive(pid: str) -> bool:
    """Whether a process runs, on Linux."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def main() -> int:
    """Attacks, prints figures, writes them; returns 1 where something was lost, left or not told."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--disks", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lodgs-attacks-") as folder:
        bench = Bench(Path(folder), random.Random(chosen.seed))
        figures = {"kills": bench.kill_runs(chosen.kills)}
        if sys.platform == "linux" and os.geteuid() == 0:
            figures["disks"] = bench.fill_disks(chosen.disks)
        else:
            print("Disks are not filled: only root on Linux can make small ones (mount -t tmpfs).")
    report = ROOT / "build" / "attacks.json"
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))
    return int(any(figure["wrong"] or figure.get("outlived") for figure in figures.values()))


if __name__ == "__main__":
    sys.exit(main())
