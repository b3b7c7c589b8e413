"""Blocks of a scene in cells on a Dask cluster of this computer, with everything killed that there is.

    python tools/attacks_blocks.py [--kills 10] [--seed 0]

A scheduler and two workers are started by hand, and ``lodgs blocks run --on tcp://...`` trains a plan on
them. Killed at random moments are trainers, Dask's worker processes, and whole computers, which are a worker
with all that runs under it, or told to shut down; then, once, the scheduler, and the command itself, which
are started again. One run has a disk (a tmpfs, for which one has to be root on Linux) that is too small, and
some are stopped, by Ctrl-C as a whole and in one block, and gone on with. All must end with the bits of an
undisturbed run. Not on Windows. Figures go to build/attacks_blocks.json.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import psutil  # noqa: E402 - Dask needs it

from tests.training.conftest import write_tiny_scene  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402

CHECKPOINT_SECONDS = 1.0
WORKERS = 2
PAUSE = 0.5, 4.0
"""Seconds between two kills."""
PATIENCE = 600.0
"""Seconds in which anything must end."""
JOB = {"method": "flod", "image_scale": 1.0, "test_every": 4, "cells": "2x1"}
PARAMETERS = {"levels": 3, "footprint": 6.0, "max_splats": 300}
STEPS = (1500, 2000, 2500)
ENVIRONMENT = {
    **os.environ, "LODGS_CHECKPOINT_SECONDS": str(CHECKPOINT_SECONDS), "LODGS_THREADS": "1",
    "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT),
}  # fmt: skip
KINDS = ("worker", "trainer", "computer", "shutdown")
ONCE = ("scheduler", "command")
FULL_SAYS = ("No space left on device", "disk is full")


class Cluster:
    """A scheduler and workers, each started as a user does, on this computer.

    Attributes:
        address: of the scheduler, now and after it has been started again.
    """

    def __init__(self, work: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.address = "tcp://{}:{}".format(*free.getsockname())
        self.work, self.workers = work, []
        self.start_scheduler()
        for _ in range(WORKERS):
            self.start_worker()

    def start_scheduler(self) -> None:
        """Begins to give tasks out."""
        port = self.address.rpartition(":")[2]
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", port)

    def start_worker(self) -> None:
        """One more computer."""
        place = ("--local-directory", str(self.work / "dask"))
        self.workers.append(self._start("worker", self.address, "--nthreads", "1", *place))

    def _start(self, *what: str) -> psutil.Process:
        with (self.work / "dask.log").open("ab") as log:
            made = subprocess.Popen(
                [sys.executable, "-m", "dask", *what, "--dashboard-address", ":0"], env=ENVIRONMENT,
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        return psutil.Process(made.pid)

    def trainers(self) -> list[tuple[int, psutil.Process, psutil.Process]]:
        """Of each worker whose trainer makes steps: its place, its process below the nanny, the trainer."""
        found = []
        for place, nanny in enumerate(self.workers):
            with suppress(psutil.Error):
                for worker in nanny.children():
                    found += [(place, worker, each) for each in worker.children() if makes_steps(each)]
        return found

    def kill(self, kind: str, chance: random.Random) -> bool:
        """Kills what trains now, if anything does: one of KINDS."""
        busy = self.trainers()
        if not busy:
            return False
        place, worker, trainer = chance.choice(busy)
        with suppress(psutil.Error):
            if kind in ("computer", "shutdown"):
                for process in (self.workers.pop(place), worker, trainer):
                    process.kill() if kind == "computer" else process.terminate()
                self.start_worker()
            else:
                {"trainer": trainer, "worker": worker}[kind].kill()
            return True
        return False

    def kill_scheduler(self) -> None:
        """Kills it, and the workers' side of it, as when its computer is switched off."""
        self.scheduler.kill()
        self.scheduler.wait()

    def close(self) -> None:
        """Ends all that is left."""
        for process in (self.scheduler, *self.workers):
            with suppress(psutil.Error):
                for each in (*process.children(recursive=True), process):
                    with suppress(psutil.Error):
                        each.kill()


class BlockAttack:
    """A scene, a cluster, and what the plan gives undisturbed.

    Args:
        work: a folder for all of it.
        chance: what draws moments.
        steps: of each level.
    """

    def __init__(self, work: Path, chance: random.Random, steps: Sequence[int] = STEPS) -> None:
        self.work, self.chance = work, chance
        self.parameters = {**PARAMETERS, "steps": list(steps)}
        self.scene = write_tiny_scene(work / "scene")
        calm = self.plan(work / "undisturbed")
        code, said = self.run(calm, "here")
        assert code == 0, said
        self.truth = contents(calm.path)
        self.cluster = Cluster(work)

    def plan(self, out: Path) -> RunFolder:
        """A run's folder with a plan in it."""
        path = self.work / "job.json"
        job = {**JOB, "scene": str(self.scene), "out": str(out), "parameters": self.parameters}
        path.write_text(json.dumps(job))
        subprocess.run(
            [sys.executable, "-m", "training", "blocks", "plan", str(path)], env=ENVIRONMENT, check=True,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
        return RunFolder(out)

    def start(self, run: RunFolder, on: str = "") -> subprocess.Popen:
        """``lodgs blocks run`` in a process group of its own, as a terminal has it."""
        with (run.path / "trainer.out").open("wb") as output, run.log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "training", "blocks", "run", str(run.path), "--on",
                 on or self.cluster.address],
                env=ENVIRONMENT, stdout=output, stderr=log, start_new_session=True,
            )  # fmt: skip

    def run(self, run: RunFolder, on: str = "", meanwhile: Callable = lambda process: None):
        """Trains a plan to its end; exit code and last event."""
        process = self.start(run, on)
        until = time.monotonic() + PATIENCE
        while process.poll() is None:
            if time.monotonic() > until:
                os.killpg(process.pid, signal.SIGKILL)
                return None, {"what": f"no end in {PATIENCE:.0f} s"}
            meanwhile(process)
            time.sleep(0.1)
        return process.returncode, run.end_event() or {}

    def kill_all(self, kills: int, once: Sequence[str] = ONCE) -> dict:
        """Kills workers, trainers and computers until so many are dead, then of ONCE what is asked for."""
        kinds, once = [KINDS[i % len(KINDS)] for i in range(kills)], list(once)
        found = {"killed": dict.fromkeys(kinds, 0), "runs": 0, "begun_again": 0, "wrong": [], "lost_s": []}
        while kinds or once:
            run, due = self.plan(self.work / "killed"), [time.monotonic() + self.chance.uniform(*PAUSE)]

            def attack(process: subprocess.Popen, due=due) -> None:
                if time.monotonic() < due[0]:
                    return
                due[0] = time.monotonic() + self.chance.uniform(*PAUSE)
                if kinds and self.cluster.kill(kinds[0], self.chance):
                    found["killed"][kinds[0]] += 1
                    del kinds[0]
                elif not kinds and once and self.cluster.trainers():
                    what = once.pop(0)
                    found["killed"][what] = 1
                    process.kill() if what == "command" else self.cluster.kill_scheduler()

            code, said = self.run(run, meanwhile=attack)
            while code not in (0, None) and found["begun_again"] < 5:
                if not self.cluster.scheduler.is_running() or self.cluster.scheduler.status() == "zombie":
                    found["told"] = f"{said.get('what')} {said.get('remedy', '')}"
                    self.cluster.close()
                    self.cluster = Cluster(self.work)
                found["begun_again"] += 1
                code, said = self.run(run, meanwhile=attack)
            found["lost_s"] += list(lost(run))
            self._compare(run, code, said, found)
        found["lost_s"] = [round(each, 2) for each in sorted(found["lost_s"])]
        return found

    def fill_disk(self) -> dict:
        """A disk that has room for half of what the run writes, then for all."""
        found = {"wrong": [], "told": "", "runs": 0}
        size = sum(map(len, self.truth.values()))
        with disk(self.work / "disk", size // 2 + (1 << 18)) as place:
            run = self.plan(place / "run")
            code, said = self.run(run)
            found["told"] = f"{said.get('what')} {said.get('remedy', '')}".replace(str(place), "RUN")
            if code != 2 or not any(words in found["told"] for words in FULL_SAYS):
                found["wrong"].append(f"a full disk ends with {code}: {found['told']}")
            subprocess.run(["mount", "-o", "remount,size=1g", str(place)], check=True)
            code, said = self.run(run)
            self._compare(run, code, said, found)
        return found

    def stop(self, on: str) -> dict:
        """Cancels one block, then all by Ctrl-C, and goes on, with the one by its own job first."""
        found = {"wrong": [], "runs": 0, "stopped": []}
        run = self.plan(self.work / "stopped")
        blocks = [RunFolder(path) for path in sorted(run.blocks.glob("[0-9]*"))]

        def cancel_one(_) -> None:
            if blocks[1].last_event("progress") and not blocks[1].last_event("cancelled"):
                blocks[1].request_cancel()

        code, said = self.run(run, on, cancel_one)
        found["stopped"].append(said.get("message"))
        if code != 3 or "block 2" not in said.get("message", ""):
            found["wrong"].append(f"a block was cancelled: {code} {said}")
        shutil.rmtree(run.path)

        run, asked = self.plan(run.path), []

        def interrupt(process: subprocess.Popen) -> None:
            if not asked and all(
                block.last_event("progress") for block in blocks[: WORKERS if on != "here" else 1]
            ):
                asked.append(os.killpg(process.pid, signal.SIGINT))

        code, said = self.run(run, on, interrupt)
        found["stopped"].append(said.get("message"))
        if code != 3 or any(block.running for block in blocks):
            found["wrong"].append(f"Ctrl-C: {code} {said}, {[block.state() for block in blocks]}")
        alone = [sys.executable, "-m", "training", "train", str(blocks[1].job)]
        code = subprocess.run(alone, env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=False).returncode
        if code or blocks[1].state() != "done":
            found["wrong"].append(f"a block by itself: {code} {blocks[1].state()}")
        code, said = self.run(run, on)
        self._compare(run, code, said, found)
        return found

    def _compare(self, run: RunFolder, code: int | None, said: dict, found: dict) -> None:
        """Holds a run that is over against the undisturbed one, and removes it."""
        found["runs"] += 1
        now = contents(run.path)
        odd = [name for name in self.truth.keys() | now.keys() if self.truth.get(name) != now.get(name)]
        if code or odd:
            found["wrong"].append(f"code {code} {said.get('what', '')}, otherwise: {sorted(odd)}")
        shutil.rmtree(run.path)


def makes_steps(trainer: psutil.Process) -> bool:
    """Whether a trainer is past its start."""
    jobs = [
        Path(each) for each in trainer.cmdline() if each.endswith("job.toml")
    ]  # none of one that has ended
    told = RunFolder(jobs[0].parent).last_event("hello", "progress") if jobs else None
    return told is not None and told["event"] == "progress" and trainer.create_time() < told["time"]


def lost(run: RunFolder) -> Iterator[float]:
    """Seconds of work that each loss of a trainer has cost: from where the next one went on to its end."""
    for file in run.blocks.rglob("events.jsonl"):
        last: dict = {}
        for event in RunFolder(file.parent).events()[0]:
            if event["event"] == "progress":
                last = event
            elif event.get("message", "").startswith("Going on from step ") and last:
                step = int(event["message"].split()[4])
                yield max(last["step"] - step, 0) / max(last["steps_per_s"], 1e-6)


def contents(run: Path) -> dict[str, bytes]:
    """A run's files by name; of those that tell of times and places nothing but that they are there."""
    changing = {"events.jsonl", "lock", "job.toml"}
    outside = {"trainer.log", "trainer.out"}
    files = {path.relative_to(run).as_posix(): path for path in run.rglob("*") if path.is_file()}
    return {
        name: b"" if path.name in changing else path.read_bytes()
        for name, path in files.items()
        if path.name not in outside
    }


@contextmanager
def disk(place: Path, size: int):
    """A disk of so many bytes."""
    place.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "lodgs", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


@contextmanager
def bench(chance: random.Random, steps: Sequence[int] = STEPS) -> Iterator[BlockAttack]:
    """All that attacks need, in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="lodgs-attacks-") as folder:
        made = BlockAttack(Path(folder), chance, steps)
        try:
            yield made
        finally:
            made.cluster.close()


def main() -> int:
    """Attacks, prints figures, writes them; returns 1 where bits differ or an end was not told."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    with bench(random.Random(chosen.seed)) as made:
        figures = {"kills": made.kill_all(chosen.kills)}
        figures |= {f"stops, on {on}": made.stop(on) for on in ("here", "local:2", made.cluster.address)}
        if sys.platform == "linux" and os.geteuid() == 0:
            figures["disk"] = made.fill_disk()
        else:
            print("No disk is filled: only root on Linux can make small ones (mount -t tmpfs).")
    report = ROOT / "build" / "attacks_blocks.json"
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))
    return int(any(figure["wrong"] for figure in figures.values()))


if __name__ == "__main__":
    sys.exit(main())
