"""Fill disks and send SIGTERM while every command works: errors are reported, and no file is half written.

    python tools/attacks_commands.py [--disks 20] [--signals 20] [--seed 0] [--only NAME ...]

Each command of COMMANDS runs undisturbed once, on splats of a tiny scene. Then it runs on disks that are too
small (a tmpfs, which needs root on Linux), and gets SIGTERM at random times. A full disk must end in exit
code 2 and a message with the name of the file; a signal in exit code 3 without processes left. Every file
under its final name must be that of the undisturbed command, and the same command must complete it
afterwards, with enough space. Results are written to build/attacks_commands.json. Needs fork: commands and
the trainers of cells are forks of this process, which saves loading torch.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.context import ForkProcess as Process
from pathlib import Path
from types import SimpleNamespace
from typing import IO, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

os.environ |= {"LODGS_CHECKPOINT_SECONDS": "0", "OMP_NUM_THREADS": "1", "LODGS_THREADS": "1"}

import numpy as np  # noqa: E402
import psutil  # noqa: E402
import torchmetrics  # noqa: E402, F401 - loaded once, before forking

import training.runs.train  # noqa: E402, F401 - loaded once, before forking
from tests.training.conftest import write_tiny_scene  # noqa: E402
from tests.training.scenes.test_rendered_views import views, write_views  # noqa: E402
from tools.attacks import exit_code, start_fork  # noqa: E402
from tools.small_disk import DISK_FULL_MESSAGES, contents, disk_usage, small_disk  # noqa: E402
from training import __main__  # noqa: E402
from training.errors import LodgsError  # noqa: E402
from training.rasterize import warm_up  # noqa: E402
from training.runs.cells import workers  # noqa: E402
from training.runs.page.write import VIEWER  # noqa: E402
from training.splats.gaussians import Splats  # noqa: E402
from training.splats.ply import read_ply, write_ply  # noqa: E402

FLOD = (
    "--method", "flod", "--backend", "cpu", "--image-scale", "1", "--test-every", "4", "--set", "levels=2",
    "--set", "steps=[5,6]", "--set", "footprint=6", "--set", "max_splats=900",
)  # fmt: skip
PLAIN = "INPUTS/run", "--plain"
VIEW = "--view", "00.jpg", "--size", "320x240"
VIEWS = "--views", "4", "--view-width", "64"


class Command(NamedTuple):
    """A command that writes to DISK, a folder.

    Attributes:
        arguments: arguments, in which INPUTS and DISK are replaced by folders.
        copied: input that the command changes: it is copied to DISK first.
        timed: names of files whose contents depend on the time; they are only checked for completeness.
        viewer: whether the command needs the viewer of pages.
    """

    arguments: tuple[str, ...]
    copied: str = ""
    timed: tuple[str, ...] = ()
    viewer: bool = False


COMMANDS = {
    "edit bundle": Command(("edit", "INPUTS/run", "--out", "DISK/edited.ply", "--scale", "2")),
    "edit folder": Command(("edit", "INPUTS/run", "--folder", "DISK/levels")),
    "edit ply": Command(("edit", *PLAIN, "DISK/plain.ply")),
    "edit splat": Command(("edit", *PLAIN, "DISK/plain.splat")),
    "edit compressed.ply": Command(("edit", *PLAIN, "DISK/plain.compressed.ply")),
    "edit spz": Command(("edit", *PLAIN, "DISK/plain.spz")),
    "edit sog": Command(("edit", *PLAIN, "DISK/plain.sog")),
    "edit streamed": Command(("edit", "INPUTS/run", "--streamed", "DISK/streamed")),
    "edit usd": Command(("edit", "INPUTS/run", "--levels", "DISK/levels.usdz")),
    "edit glb": Command(("edit", "INPUTS/run", "--levels", "DISK/levels.glb")),
    "edit tiles": Command(("edit", "INPUTS/run", "--tiles", "DISK/tiles")),
    "edit preview": Command(("edit", "INPUTS/run", "--drop-floaters", "--preview", "DISK/preview.png")),
    "compress": Command(("compress", "INPUTS/run", "--out", "DISK/small.ply", "--distill-steps", "4")),
    "render png": Command(("render", "INPUTS/run", *VIEW, "--out", "DISK/view.png")),
    "render exr": Command(("render", "INPUTS/run", *VIEW, "--out", "DISK/view.exr")),
    "capture": Command(("capture", "INPUTS/base.ply", "--out", "DISK/captured", *VIEWS)),
    "scene": Command(("scene", "--from", "INPUTS/export", "--out", "DISK/scene")),
    "undistort": Command(("undistort", "DISK/distorted"), "distorted"),
    "model": Command(("model", "DISK/views"), "views"),
    "page": Command(("page", "INPUTS/run", "--out", "DISK/page"), viewer=True),
    "page single": Command(("page", "INPUTS/run", "--single", "--out", "DISK/page.html"), viewer=True),
    "compare": Command(
        ("compare", "INPUTS/run", "INPUTS/second", "--out", "DISK/page"),
        timed=("page/index.html", "page/compare.json", "page/results.md"),
    ),
    "compare methods": Command(
        ("compare", "INPUTS/scene", "--out", "DISK/page", "--methods", "3dgs", "flod", "--effort", "0.0002",
         "--image-scale", "1", "--test-every", "4", "--backend", "cpu"),
        timed=("page/index.html", "page/compare.json", "page/results.md", "page/runs/3dgs/metrics.json",
               "page/runs/flod/metrics.json"),
    ),
    "reproduce": Command(
        ("reproduce", "flod", "--scene", "INPUTS/scene", "--out", "DISK/tables", "--tables", "6", "9",
         "--effort", "0.0002", "--image-scale", "1", "--test-every", "4", "--backend", "cpu"),
        timed=("tables/tables.json", "tables/tables.md"),
    ),
    "evaluate": Command(
        ("evaluate", "DISK/run", "--far", "--picture", "DISK/levels.png"), "run", timed=("run/metrics.json",)
    ),
    "train": Command(("train", "INPUTS/scene", "--out", "DISK/run", *FLOD)),
    "train distorted": Command(("train", "INPUTS/distorted", "--out", "DISK/run", *FLOD)),
    "train without points": Command(("train", "INPUTS/bare", "--out", "DISK/run", *FLOD)),
    "train captured": Command(
        ("train", "--base", "INPUTS/base.ply", "--capture", "dome", *VIEWS, "--method", "lodge",
         "--set", "tune_steps=4", "--set", "levels=2", "--image-scale", "1", "--out", "DISK/run")
    ),
    "train refined": Command(
        ("train", "INPUTS/scene", "--base", "INPUTS/base.ply", "--method", "lodge", "--set", "tune_steps=8",
         "--set", "levels=2", "--image-scale", "1", "--test-every", "4", "--backend", "cpu",
         "--out", "DISK/run")
    ),
    "train networks": Command(
        ("train", "INPUTS/scene", "--method", "octree_neural", "--set", "steps=20", "--image-scale", "1",
         "--test-every", "4", "--backend", "cpu", "--out", "DISK/run")
    ),
    "train cells": Command(("train", "INPUTS/scene", "--out", "DISK/run", "--cells", "2x1", *FLOD)),
    "blocks plan": Command(
        ("blocks", "plan", "INPUTS/scene", "--out", "DISK/blocks", "--cells", "2x1", *FLOD)
    ),
    "blocks run": Command(("blocks", "run", "DISK/blocks"), "blocks"),
}  # fmt: skip


class Undisturbed(NamedTuple):
    """Result of a command without disturbance.

    Attributes:
        files: contents of its files by name.
        copied: bytes of its inputs on the disk.
        written: largest number of bytes that it adds, with temporary files.
        seconds: duration.
    """

    files: dict[str, bytes]
    copied: int
    written: int
    seconds: float


class Attack:
    """Inputs in a folder, and the files that each undisturbed command writes.

    Args:
        work: working folder.
        rng: random generator for the times of signals.
    """

    def __init__(self, work: Path, rng: random.Random) -> None:
        self.work = work
        self.rng = rng
        self.inputs = work / "inputs"
        self.disk = work / "disk"
        self.wrong: list[str] = []
        self.messages: dict[str, int] = {}
        write_inputs(self.inputs)
        warm_up("cpu")  # forks share the loaded kernels
        for arguments in (
            ("train", "INPUTS/scene", "--out", "INPUTS/run", *FLOD),
            ("blocks", "plan", "INPUTS/scene", "--out", "INPUTS/blocks", "--cells", "2x1", *FLOD),
        ):
            if code := exit_code(self._run(arguments)):
                raise RuntimeError(f"{arguments[0]} ended with {code}: {self._log()}")
        shutil.copytree(self.inputs / "run", self.inputs / "second")

    def undisturbed(self, name: str) -> Undisturbed:
        """Run a command without disturbance."""
        shutil.rmtree(self.disk, ignore_errors=True)
        self._prepare(name)
        copied = disk_usage(self.disk)
        start, peak = time.monotonic(), 0
        process = self._start(name)
        while process.is_alive():
            with suppress(OSError):  # a file was renamed or removed meanwhile
                peak = max(peak, disk_usage(self.disk))
            time.sleep(0.01)
        if code := exit_code(process):
            raise RuntimeError(f"{name}: undisturbed command ended with {code}: {self._log()}")
        seconds = time.monotonic() - start
        peak = max(peak, disk_usage(self.disk))
        result = Undisturbed(self._contents(name), copied, peak - copied, seconds)
        shutil.rmtree(self.disk)
        return result

    def fill_disks(self, name: str, disks: int) -> int:
        """Run a command on disks of several sizes; return the number of disks that were full."""
        expected, copied, written, _ = self.undisturbed(name)
        full = 0
        for number in range(disks):
            size = copied + int(written * (number + 0.5) / disks) // 4096 * 4096 + 4096
            with small_disk(self.disk, size):
                self._prepare(name)
                code = exit_code(self._start(name))
                attack = f"{name}, {size - copied} bytes"
                if code:
                    full += 1
                    self._check_message(attack, code)
                    self._check_files(name, attack, expected)
                subprocess.run(["mount", "-o", "remount,size=1g", str(self.disk)], check=True)
                self._finish(name, attack, expected, code)
        return full

    def send_signals(self, name: str, signals: int) -> int:
        """Send SIGTERM to a command at random times; return the number of commands that it stopped."""
        expected, _, _, seconds = self.undisturbed(name)
        stopped = 0
        for _ in range(signals):
            shutil.rmtree(self.disk, ignore_errors=True)
            self._prepare(name)
            delay = 0.02 + self.rng.uniform(0, seconds)
            (self.work / "log").unlink()
            process = self._start(name)
            while not (self.work / "log").exists():  # until it handles signals
                time.sleep(0.005)
            time.sleep(delay)
            children = descendants(process.pid)
            process.terminate()
            code = exit_code(process)
            attack = f"{name}, signal after {delay:.2f} s"
            if code not in (0, 3) or (code == 3 and "Traceback" in self._log()):
                self.wrong.append(f"{attack}: exit code {code}: {self._log()[-300:]}")
            stopped += code == 3
            _, alive = psutil.wait_procs(children, timeout=10)
            if alive:
                self.wrong.append(f"{attack}: processes left: {[child.cmdline() for child in alive]}")
            self._check_files(name, attack, expected)
            self._finish(name, attack, expected, code)
        shutil.rmtree(self.disk, ignore_errors=True)
        return stopped

    def _prepare(self, name: str) -> None:
        self.disk.mkdir(exist_ok=True)
        if copied := COMMANDS[name].copied:
            shutil.copytree(self.inputs / copied, self.disk / copied)

    def _start(self, name: str) -> Process:
        return self._run(COMMANDS[name].arguments)

    def _run(self, arguments: Sequence[str]) -> Process:
        """Start a command with the folders in place of INPUTS and DISK."""
        inputs, disk = str(self.inputs), str(self.disk)
        words = [word.replace("INPUTS", inputs).replace("DISK", disk) for word in arguments]
        return start_fork(run_command, words, self.work / "log")

    def _log(self) -> str:
        return (self.work / "log").read_text(errors="replace")

    def _check_message(self, attack: str, code: int | None) -> None:
        log = self._log()
        lines = [line for line in log.splitlines() if str(self.disk) in line]
        reported = [line for line in lines if any(message in line for message in DISK_FULL_MESSAGES)]
        if code != 2 or not reported or "Traceback" in log:
            self.wrong.append(f"{attack}: exit code {code}: {log[-400:]}")
        else:
            text = re.sub(r'"time": [0-9.]+, |step_[0-9]+', "", reported[-1].replace(str(self.disk), "DISK"))
            message = f"{attack.split(',', maxsplit=1)[0]}: {text[:200]}"
            self.messages[message] = self.messages.get(message, 0) + 1

    def _contents(self, name: str) -> dict[str, bytes]:
        """Return the files of a command by name; complete ones that depend on the time without contents."""
        files = contents(self.disk)
        complete = {file for file in COMMANDS[name].timed if file in files and is_complete(files[file])}
        return files | dict.fromkeys(complete, b"")

    def _is_preview(self, file: str) -> bool:
        """Return whether a file is a complete level, maybe without splats, that training replaces later."""
        if "/levels/level_" not in file:
            return False
        with suppress(LodgsError):
            read_ply(self.disk / file)
            return True
        return False

    def _check_files(self, name: str, attack: str, expected: dict[str, bytes]) -> None:
        files = self._contents(name)
        differing = [file for file, data in files.items() if file in expected and data != expected[file]]
        differing = [file for file in differing if not self._is_preview(file)]
        if differing:
            self.wrong.append(f"{attack}: half written: {sorted(differing)}")

    def _finish(self, name: str, attack: str, expected: dict[str, bytes], code: int | None) -> None:
        """Repeat a command that has not ended well, and compare its files."""
        if name == "scene" and contents(self.disk) == expected:
            return  # it was complete; the command refuses to replace a scene
        if code:
            code = exit_code(self._start(name))
        files = self._contents(name)
        differing = [key for key in expected.keys() | files.keys() if expected.get(key) != files.get(key)]
        if code or differing:
            log = self._log()[-300:] if code else ""
            self.wrong.append(f"{attack}: afterwards: code {code} {log}, different: {sorted(differing)[:9]}")


def is_complete(data: bytes) -> bool:
    """Return whether a page, a JSON file or a Markdown file ends as it should."""
    if data.startswith(b"{"):
        with suppress(ValueError):
            return bool(json.loads(data))
        return False
    return data.endswith((b"</html>\n", b"\n"))


def write_inputs(folder: Path) -> None:
    """Write a scene; the same with a distorted lens, without points and as an export; splats; and views."""
    scene = write_tiny_scene(folder / "scene")
    distorted = folder / "distorted"
    shutil.copytree(scene, distorted)
    cameras = distorted / "sparse" / "0" / "cameras.txt"
    number, _, width, height, focal, _, x, y = cameras.read_text().split()
    cameras.write_text(f"{number} SIMPLE_RADIAL {width} {height} {focal} {x} {y} 0.02\n")
    bare = folder / "bare"
    shutil.copytree(scene, bare)
    (bare / "sparse" / "0" / "points3D.txt").write_text("")
    export = folder / "export"
    shutil.copytree(scene / "images", export / "images")
    frames = []
    for line in (scene / "sparse" / "0" / "images.txt").read_text().splitlines()[::2]:
        _, *pose, _, image = line.split()
        matrix = np.eye(4)
        w, *axis = map(float, pose[:4])
        matrix[:3, :3] = rotation(w, *axis)
        matrix[:3, 3] = [float(value) for value in pose[4:]]
        camera_to_world = np.linalg.inv(matrix) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"images/{image}", "transform_matrix": camera_to_world.tolist()})
    lens = {"fl_x": float(focal), "fl_y": float(focal), "cx": float(x), "cy": float(y)}
    lens |= {"w": int(width), "h": int(height)}
    (export / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    write_ply(folder / "base.ply", opaque_sphere())
    (folder / "views").mkdir()
    write_views(folder / "views", views(4))


def opaque_sphere() -> Splats:
    """Return opaque splats on a sphere."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(600, 3))
    means *= 2 / np.linalg.norm(means, axis=1, keepdims=True)
    quats, scales = np.tile([1.0, 0, 0, 0], (600, 1)), np.full((600, 3), -1.8)
    sh = rng.normal(0, 0.5, (600, 1, 3))
    arrays = (array.astype(np.float32) for array in (means, quats, scales, np.full(600, 6.0), sh))
    means, quats, scales, logits, sh = arrays
    return Splats(means, quats, scales, logits, sh)


def rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion."""
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


class ForkedTrainer:
    """Fork of this process in place of the ``subprocess.Popen`` of a cell's trainer."""

    def __init__(
        self, command: list[str], env: dict[str, str], stdout: IO[bytes], stderr: IO[bytes], **_: object
    ) -> None:
        self.pid = os.fork()
        if self.pid == 0:
            os.environ.update(env)
            null = os.open(os.devnull, os.O_RDWR)
            for number, descriptor in enumerate((null, stdout.fileno(), stderr.fileno())):
                os.dup2(descriptor, number)
            os.closerange(3, 1 << 12)  # such as locks of the parent
            sys.argv[1:] = command[3:]
            __main__.run()

    def wait(self) -> int:
        """Return the exit code."""
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def run_command(arguments: list[str], log: Path) -> None:
    """Run one command in this process, with its output in a file."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.argv[1:] = arguments
    workers.subprocess = SimpleNamespace(**vars(subprocess) | {"Popen": ForkedTrainer})
    __main__.run()


def descendants(pid: int | None) -> list[psutil.Process]:
    """Return the running processes that a process has started."""
    with suppress(psutil.Error):
        return psutil.Process(pid).children(recursive=True)
    return []


def main() -> int:
    """Run the attacks, print and write results; return 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--disks", type=int, default=20)
    parser.add_argument("--signals", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options = parser.parse_args()
    may_mount = sys.platform == "linux" and os.geteuid() == 0
    if not may_mount:
        print("Skipping full disks: mounting a small tmpfs needs root on Linux.")
    results, reported = {}, 0
    with tempfile.TemporaryDirectory(prefix="lodgs-attacks-") as folder:
        attack = Attack(Path(folder), random.Random(options.seed))
        for name in options.only:
            if COMMANDS[name].viewer and not VIEWER.is_dir():
                print(f"Skipping {name}: the viewer is not installed (tools/viewer.py).")
                continue
            full = attack.fill_disks(name, options.disks) if may_mount else 0
            stopped = attack.send_signals(name, options.signals) if options.signals else 0
            results[name] = {"full disks": full, "stopped": stopped}
            print(name, results[name], *attack.wrong[reported:], sep="\n", flush=True)
            reported = len(attack.wrong)
    report = ROOT / "build" / "attacks_commands.json"
    report.parent.mkdir(exist_ok=True)
    figures = {"commands": results, "messages": attack.messages, "wrong": attack.wrong}
    report.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))
    return int(bool(attack.wrong))


if __name__ == "__main__":
    sys.exit(main())
