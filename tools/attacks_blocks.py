"""Train a scene in cells on a local Dask cluster while killing its processes.

    python tools/attacks_blocks.py [--kills 10] [--seed 0]

``lodgs blocks run --on KEY`` trains a plan with a scheduler and two workers. The attack kills at random
times: trainers, Dask's worker processes, and simulated computers (a worker with all its child processes, by
kill or by shutdown); then once the scheduler and once the command, which are restarted. One run has too
little disk space (a small tmpfs, which needs root on Linux). Some runs are stopped with Ctrl-C or by
cancelling one block, and resumed. All must give the bits of an undisturbed run. Not on Windows. Results are
written to build/attacks_blocks.json.
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
from tools.small_disk import DISK_FULL_MESSAGES, contents, small_disk  # noqa: E402
from training.runs.folder import RunFolder  # noqa: E402

CHECKPOINT_SECONDS = 1.0
WORKERS = 2
PAUSE = 0.5, 4.0
"""Minimum and maximum seconds between kills."""
TIMEOUT = 600.0
"""Maximum seconds for a run."""
JOB = {"method": "flod", "image_scale": 1.0, "test_every": 4, "cells": "2x1"}
PARAMETERS = {"levels": 3, "footprint": 6.0, "max_splats": 300}
STEPS = (1500, 2000, 2500)
ENVIRONMENT = {
    **os.environ, "LODGS_CHECKPOINT_SECONDS": str(CHECKPOINT_SECONDS), "LODGS_THREADS": "1",
    "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT),
}  # fmt: skip
KINDS = ("worker", "trainer", "computer", "shutdown")
ONCE = ("scheduler", "command")


class Cluster:
    """A Dask scheduler and workers on this computer, started by their commands.

    Attributes:
        key: the scheduler's key file; its address and key stay the same after a restart.
    """

    def __init__(self, work: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            self.port = str(server.getsockname()[1])
        self.work = work
        self.key = str(work / "cluster.pem")
        self.workers = []
        self.start_scheduler()
        for _ in range(WORKERS):
            self.start_worker()

    def start_scheduler(self) -> None:
        """Start the scheduler."""
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", self.port)
        while not Path(self.key).exists():
            time.sleep(0.1)

    def start_worker(self) -> None:
        """Start another worker."""
        self.workers.append(self._start("worker"))

    def _start(self, action: str, *options: str) -> psutil.Process:
        with (self.work / "dask.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "training", "blocks", action, self.key, *options], env=ENVIRONMENT,
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        return psutil.Process(process.pid)

    def trainers(self) -> list[tuple[int, psutil.Process, psutil.Process]]:
        """Return index, worker process and trainer of each worker whose trainer makes steps."""
        active = []
        for index, nanny in enumerate(self.workers):
            with suppress(psutil.Error):
                for worker in nanny.children():
                    trainers = [child for child in worker.children() if makes_steps(child)]
                    active += [(index, worker, trainer) for trainer in trainers]
        return active

    def kill(self, kind: str, rng: random.Random) -> bool:
        """Kill a process of one of KINDS that is training; return whether one was found."""
        active = self.trainers()
        if not active:
            return False
        index, worker, trainer = rng.choice(active)
        with suppress(psutil.Error):
            if kind in ("computer", "shutdown"):
                for process in (self.workers.pop(index), worker, trainer):
                    process.kill() if kind == "computer" else process.terminate()
                self.start_worker()
            else:
                {"trainer": trainer, "worker": worker}[kind].kill()
            return True
        return False

    def kill_scheduler(self) -> None:
        """Kill the scheduler."""
        self.scheduler.kill()
        self.scheduler.wait()

    def close(self) -> None:
        """Kill all remaining processes."""
        for process in (self.scheduler, *self.workers):
            with suppress(psutil.Error):
                for member in (*process.children(recursive=True), process):
                    with suppress(psutil.Error):
                        member.kill()


class BlockAttack:
    """Scene, cluster, and the result of an undisturbed run.

    Args:
        work: working folder.
        rng: random generator for the times of attacks.
        steps: steps of each level.
    """

    def __init__(self, work: Path, rng: random.Random, steps: Sequence[int] = STEPS) -> None:
        self.work = work
        self.rng = rng
        self.parameters = {**PARAMETERS, "steps": list(steps)}
        self.scene = write_tiny_scene(work / "scene")
        undisturbed = self.plan(work / "undisturbed")
        code, event = self.run(undisturbed, "here")
        assert code == 0, event
        self.expected = contents(undisturbed.path)
        self.cluster = Cluster(work)

    def plan(self, out: Path) -> RunFolder:
        """Write a plan; return its run folder."""
        path = self.work / "job.json"
        job = {**JOB, "scene": str(self.scene), "out": str(out), "parameters": self.parameters}
        path.write_text(json.dumps(job))
        subprocess.run(
            [sys.executable, "-m", "training", "blocks", "plan", str(path)], env=ENVIRONMENT, check=True,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
        return RunFolder(out)

    def start(self, run: RunFolder, on: str = "") -> subprocess.Popen:
        """Start ``lodgs blocks run`` in a separate process group, as a terminal does."""
        with (run.path / "trainer.out").open("wb") as output, run.log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "training", "blocks", "run", str(run.path), "--on",
                 on or self.cluster.key],
                env=ENVIRONMENT, stdout=output, stderr=log, start_new_session=True,
            )  # fmt: skip

    def run(self, run: RunFolder, on: str = "", poll: Callable = lambda process: None):
        """Train a plan; return exit code and final event. ``poll`` is called repeatedly."""
        process = self.start(run, on)
        deadline = time.monotonic() + TIMEOUT
        while process.poll() is None:
            if time.monotonic() > deadline:
                os.killpg(process.pid, signal.SIGKILL)
                return None, {"what": f"not finished after {TIMEOUT:.0f} s"}
            poll(process)
            time.sleep(0.1)
        return process.returncode, run.end_event() or {}

    def kill_all(self, kills: int, once: Sequence[str] = ONCE) -> dict:
        """Kill this many workers, trainers and computers, then the processes named by ``once``."""
        kinds = [KINDS[i % len(KINDS)] for i in range(kills)]
        once = list(once)
        results = {"killed": dict.fromkeys(kinds, 0), "runs": 0, "restarts": 0, "wrong": [], "lost_s": []}
        while kinds or once:
            run = self.plan(self.work / "killed")
            due = [time.monotonic() + self.rng.uniform(*PAUSE)]

            def attack(process: subprocess.Popen, due=due) -> None:
                if time.monotonic() < due[0]:
                    return
                due[0] = time.monotonic() + self.rng.uniform(*PAUSE)
                if kinds and self.cluster.kill(kinds[0], self.rng):
                    results["killed"][kinds[0]] += 1
                    del kinds[0]
                elif not kinds and once and self.cluster.trainers():
                    target = once.pop(0)
                    results["killed"][target] = 1
                    process.kill() if target == "command" else self.cluster.kill_scheduler()

            code, event = self.run(run, poll=attack)
            while code not in (0, None) and results["restarts"] < 5:
                if not self.cluster.scheduler.is_running() or self.cluster.scheduler.status() == "zombie":
                    results["message"] = f"{event.get('what')} {event.get('remedy', '')}"
                    self.cluster.close()
                    self.cluster = Cluster(self.work)
                results["restarts"] += 1
                code, event = self.run(run, poll=attack)
            results["lost_s"] += list(lost_seconds(run))
            self._compare(run, code, event, results)
        results["lost_s"] = [round(seconds, 2) for seconds in sorted(results["lost_s"])]
        return results

    def fill_disk(self) -> dict:
        """Train on a disk with half of the required space, then with enough."""
        results = {"wrong": [], "message": "", "runs": 0}
        size = sum(map(len, self.expected.values()))
        with small_disk(self.work / "disk", size // 2 + (1 << 18)) as folder:
            run = self.plan(folder / "run")
            code, event = self.run(run)
            results["message"] = f"{event.get('what')} {event.get('remedy', '')}".replace(str(folder), "RUN")
            if code != 2 or not any(message in results["message"] for message in DISK_FULL_MESSAGES):
                results["wrong"].append(f"full disk: code {code}: {results['message']}")
            subprocess.run(["mount", "-o", "remount,size=1g", str(folder)], check=True)
            code, event = self.run(run)
            self._compare(run, code, event, results)
        return results

    def stop(self, on: str) -> dict:
        """Cancel one block, then all with Ctrl-C; resume one block by its own job, then all."""
        results = {"wrong": [], "runs": 0, "stopped": []}
        run = self.plan(self.work / "stopped")
        blocks = [RunFolder(path) for path in sorted(run.blocks.glob("[0-9]*"))]

        def cancel_one(_) -> None:
            if blocks[1].last_event("progress") and not blocks[1].last_event("cancelled"):
                blocks[1].request_cancel()

        code, event = self.run(run, on, cancel_one)
        results["stopped"].append(event.get("message"))
        if code != 3 or "block 2" not in event.get("message", ""):
            results["wrong"].append(f"cancelled block: {code} {event}")
        shutil.rmtree(run.path)

        run = self.plan(run.path)
        interrupts = []

        def interrupt(process: subprocess.Popen) -> None:
            if not interrupts and all(
                block.last_event("progress") for block in blocks[: WORKERS if on != "here" else 1]
            ):
                interrupts.append(os.killpg(process.pid, signal.SIGINT))

        code, event = self.run(run, on, interrupt)
        results["stopped"].append(event.get("message"))
        if code != 3 or any(block.running for block in blocks):
            results["wrong"].append(f"Ctrl-C: {code} {event}, {[block.state() for block in blocks]}")
        command = [sys.executable, "-m", "training", "train", str(blocks[1].job)]
        code = subprocess.run(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=False).returncode
        if code or blocks[1].state() != "done":
            results["wrong"].append(f"single block: {code} {blocks[1].state()}")
        code, event = self.run(run, on)
        self._compare(run, code, event, results)
        return results

    def _compare(self, run: RunFolder, code: int | None, event: dict, results: dict) -> None:
        """Compare a finished run with the undisturbed one, and delete it."""
        results["runs"] += 1
        expected = self.expected
        files = contents(run.path)
        differing = [name for name in expected.keys() | files.keys() if expected.get(name) != files.get(name)]
        if code or differing:
            results["wrong"].append(f"code {code} {event.get('what', '')}, different: {sorted(differing)}")
        shutil.rmtree(run.path)


def makes_steps(trainer: psutil.Process) -> bool:
    """Return whether a trainer has reported a training step."""
    jobs = [Path(argument) for argument in trainer.cmdline() if argument.endswith("job.toml")]
    event = RunFolder(jobs[0].parent).last_event("hello", "progress") if jobs else None
    return event is not None and event["event"] == "progress" and trainer.create_time() < event["time"]


def lost_seconds(run: RunFolder) -> Iterator[float]:
    """Yield the seconds of work that each killed trainer had done since its last checkpoint."""
    for file in run.blocks.rglob("events.jsonl"):
        last: dict = {}
        for event in RunFolder(file.parent).events()[0]:
            if event["event"] == "progress":
                last = event
            elif event.get("message", "").startswith("Resuming at step ") and last:
                step = int(event["message"].split()[3])
                yield max(last["step"] - step, 0) / max(last["steps_per_s"], 1e-6)


@contextmanager
def block_attack(rng: random.Random, steps: Sequence[int] = STEPS) -> Iterator[BlockAttack]:
    """Set up an attack in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="lodgs-attacks-") as folder:
        attack = BlockAttack(Path(folder), rng, steps)
        try:
            yield attack
        finally:
            attack.cluster.close()


def main() -> int:
    """Run the attacks, print and write results; return 1 if results differ or an error was not reported."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with block_attack(random.Random(options.seed)) as attack:
        figures = {"kills": attack.kill_all(options.kills)}
        figures |= {f"stops, on {on}": attack.stop(on) for on in ("here", "local:2", attack.cluster.key)}
        if sys.platform == "linux" and os.geteuid() == 0:
            figures["disk"] = attack.fill_disk()
        else:
            print("Skipping the full disk: mounting a small tmpfs needs root on Linux.")
    report = ROOT / "build" / "attacks_blocks.json"
    report.parent.mkdir(exist_ok=True)
    report.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))
    return int(any(figure["wrong"] for figure in figures.values()))


if __name__ == "__main__":
    sys.exit(main())
