"""Fill disks and send SIGTERM while Blender works: no file may be half written, no work lost.

    python tools/attacks_blender.py [--disks 20] [--signals 20] [--seed 0] [--only NAME ...]

Each action of ACTIONS runs undisturbed once, in Blender's module. Then it runs on disks that are too small (a
tmpfs, which needs root on Linux). It must report an error with the name of a file or folder of the disk.
Every file under its final name must be complete, and the same action must succeed afterwards, with enough
space. Each training of TRAININGS gets SIGTERM at random times: it must end with exit code 3 and without
processes left, and the same command must give the files of the undisturbed training. Results are written to
build/attacks_blender_VERSION.json. The trainer's Python, LODGS_TRAINER_PYTHON,
makes the inputs and some exports.
"""

from __future__ import annotations

import argparse
import importlib
import io
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
from contextlib import redirect_stderr, suppress
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.blender_module import EXTENSION, start_blender  # noqa: E402
from tools.small_disk import DISK_FULL_MESSAGES, contents, disk_usage, small_disk  # noqa: E402
from tools.viewer import FOLDER as VIEWER  # noqa: E402

COUNTS = 200, 400
SIZE = 96, 72


class Action(NamedTuple):
    """An action that writes to DISK, a folder.

    Attributes:
        words: arguments of ``blender --command lodgs``, in which INPUTS and DISK are replaced by folders.
        operator: name of an operator of ``bpy.ops.lodgs``, or "render".
        options: arguments of the operator.
        same: whether equal inputs give equal files; other files are only checked to be complete.
        copied: input that the action completes: it is copied to DISK first.
    """

    words: tuple[str, ...] = ()
    operator: str = ""
    options: dict = {}
    same: bool = True
    copied: str = ""


ACTIONS = {
    "save": Action(("import", "INPUTS/bundle.ply", "--blend", "DISK/scene.blend"), same=False),
    "save photos": Action(("import", "INPUTS/scene", "--blend", "DISK/scene.blend"), same=False),
    "import export": Action((), "import_colmap", {"directory": "DISK/export"}, copied="export"),
    "export command": Action(("export", "INPUTS/scene.blend", "DISK/bundle.ply")),
    "capture command": Action(
        (
            "capture",
            "INPUTS/mesh.blend",
            "--out",
            "DISK/scene",
            "--around",
            "--views",
            "4",
            "--size",
            "64x48",
        ),
        same=False,
    ),
    "bundle": Action((), "export_bundle", {"filepath": "DISK/bundle.ply"}),
    "plain ply": Action((), "export_plain", {"filepath": "DISK/plain.ply"}),
    "plain splat": Action((), "export_plain", {"filepath": "DISK/plain.splat"}),
    "plain sog": Action((), "export_plain", {"filepath": "DISK/plain.sog"}),
    "folder": Action((), "export_folder", {"directory": "DISK/levels"}),
    "compressed": Action((), "export_compressed", {"filepath": "DISK/small.ply"}),
    "usd": Action((), "export_levels", {"filepath": "DISK/levels.usdz"}, same=False),
    "glb": Action((), "export_levels", {"filepath": "DISK/levels.glb"}),
    "tiles": Action((), "export_tiles", {"directory": "DISK/tiles"}),
    "streamed": Action((), "export_streamed", {"directory": "DISK/web"}),
    "page": Action((), "export_page", {"directory": "DISK/page"}),
    "render": Action((), "render", {"write_still": True}, same=False),
    "animation": Action((), "render", {"animation": True}, same=False),
}


FLOD = (
    "--method", "flod", "--backend", "cpu", "--image-scale", "1", "--test-every", "4", "--set", "levels=2",
    "--set", "steps=[5,6]", "--set", "footprint=6", "--set", "max_splats=900",
)  # fmt: skip
OUTPUTS = "--out", "DISK/run", "--blend", "DISK/scene.blend", "--export", "DISK/bundle.ply"
TRAININGS = {
    "train": ("train", "--scene", "INPUTS/scene", *OUTPUTS, *FLOD),
    "train captured": ("train", "--scene", "INPUTS/captured", *OUTPUTS, *FLOD),
}
"""Arguments of ``blender --command lodgs``."""
PROGRAM = ROOT / "tests" / "blender" / "as_blender.py"


class Attack:
    """Blender, inputs in a folder, and a disk.

    Args:
        work: working folder.
        rng: random generator for the times of signals.
    """

    def __init__(self, work: Path, rng: random.Random) -> None:
        self.rng = rng
        self.bpy = start_blender()
        self.inputs, self.disk = work / "inputs", work / "disk"
        self.commands = importlib.import_module(f"{EXTENSION}.blender_lodgs.commands")
        self.is_complete_file = importlib.import_module(
            f"{EXTENSION}.blender_lodgs.data.paths"
        ).is_complete_file
        self.wrong: list[str] = []
        self.messages: dict[str, int] = {}
        trainer = os.environ["LODGS_TRAINER_PYTHON"]
        subprocess.run([trainer, __file__, "--inputs", str(self.inputs)], check=True)
        self._mesh_scene(self.inputs / "mesh.blend")
        capture = ACTIONS["capture command"].words
        for words in (
            ("import", "INPUTS/bundle.ply", "--blend", "INPUTS/scene.blend"),
            tuple(word.replace("DISK/scene", "INPUTS/captured") for word in capture),
        ):
            if problem := self._command(words):
                raise RuntimeError(f"{words[0]}: {problem}")

    def fill_disks(self, name: str, disks: int) -> dict:
        """Run an action on disks of several sizes; return the number of full disks and the seconds of one."""
        self.disk.mkdir(exist_ok=True)
        with small_disk(self.disk, 1 << 30):
            self._copy(name)
            copied = disk_usage(self.disk)
            start = time.monotonic()
            if problem := self._run(name):
                raise RuntimeError(f"{name}: undisturbed action failed: {problem}")
            seconds = time.monotonic() - start
            expected, written = contents(self.disk), disk_usage(self.disk) - copied
        full = 0
        for number in range(disks):
            size = copied + int(written * (number + 0.5) / disks) // 4096 * 4096 + 4096
            with small_disk(self.disk, size):
                self._copy(name)
                problem = self._run(name)
                attack = f"{name}, {size} bytes"
                if problem:
                    full += 1
                    self._check_message(attack, problem)
                elif set(contents(self.disk)) != set(expected):
                    self.wrong.append(f"{attack}: no error, but {sorted(contents(self.disk))}")
                self._check_files(name, attack, expected)
                subprocess.run(["mount", "-o", "remount,size=1g", str(self.disk)], check=True)
                if problem := self._run(name):
                    self.wrong.append(f"{attack}: afterwards: {problem}")
                self._check_files(name, f"{attack}, afterwards", expected, complete=True)
        return {"full disks": full, "seconds": round(seconds, 2)}

    def send_signals(self, name: str, signals: int) -> dict:
        """Send SIGTERM to a training at random times; return the number of stopped ones."""
        seconds, code = self._train(name)
        if code:
            raise RuntimeError(f"{name}: undisturbed training ended with {code}: {self._log()}")
        expected = self._outputs()
        stopped = 0
        for _ in range(signals):
            delay = self.rng.uniform(0, seconds)
            shutil.rmtree(self.disk)
            _, code = self._train(name, delay)
            attack = f"{name}, signal after {delay:.2f} s"
            if code not in (0, 3) or "Traceback" in self._log():
                self.wrong.append(f"{attack}: exit code {code}: {self._log()[-400:]}")
            stopped += code == 3
            if remaining := self._remaining():
                self.wrong.append(f"{attack}: processes left: {remaining}")
            if code and (code := self._train(name)[1]):
                self.wrong.append(f"{attack}: afterwards: exit code {code}: {self._log()[-400:]}")
            files = self._outputs()
            differing = [key for key in expected.keys() | files.keys() if expected.get(key) != files.get(key)]
            if differing:
                self.wrong.append(f"{attack}: different: {sorted(differing)[:9]}")
        shutil.rmtree(self.disk)
        return {"stopped": stopped, "seconds": round(seconds, 2)}

    def _train(self, name: str, delay: float | None = None) -> tuple[float, int]:
        """Run a training in a Blender of its own, and send SIGTERM some seconds after it handles signals.

        Returns:
            Seconds from that moment to its end, and the exit code.
        """
        self.disk.mkdir(exist_ok=True)
        words = [self._word(word) for word in TRAININGS[name]]
        with open(self.inputs / "log", "wb") as log:
            process = subprocess.Popen(
                [sys.executable, str(PROGRAM), "--command", "lodgs", *words], stdout=log, stderr=log
            )
        while process.poll() is None and not handles_sigterm(process.pid):
            time.sleep(0.01)
        start = time.monotonic()
        if delay is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(delay)
            process.terminate()
        code = process.wait()
        return time.monotonic() - start, code

    def _log(self) -> str:
        return (self.inputs / "log").read_text(errors="replace")

    def _outputs(self) -> dict[str, bytes | bool]:
        """Return the files of a training by name; for a .blend file, whether it is complete."""
        files: dict[str, bytes | bool] = dict(contents(self.disk))
        blends = [file for file in files if file.endswith((".blend", ".blend1"))]
        return {key: data for key, data in files.items() if key not in blends} | {
            file: self.is_complete_file(self.disk / file) for file in blends if file.endswith(".blend")
        }

    def _remaining(self) -> list[str]:
        """Return the commands of processes that use the disk, after up to ten seconds."""
        for _ in range(100):
            commands = []
            for path in Path("/proc").glob("[0-9]*/cmdline"):
                with suppress(OSError):
                    commands.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
            if not (remaining := [command for command in commands if str(self.disk) in command]):
                return []
            time.sleep(0.1)
        return remaining

    def _word(self, word: str) -> str:
        """Return an argument with the folders in place of INPUTS and DISK."""
        return word.replace("INPUTS", str(self.inputs)).replace("DISK", str(self.disk))

    def _copy(self, name: str) -> None:
        if copied := ACTIONS[name].copied:
            shutil.copytree(self.inputs / copied, self.disk / copied)

    def _run(self, name: str) -> str:
        """Run an action; return its error, or ""."""
        action = ACTIONS[name]
        if action.words:
            return self._command(action.words)
        self.bpy.ops.wm.open_mainfile(filepath=str(self.inputs / "scene.blend"))
        if action.operator == "render":
            return self._render(action.options)
        options = {key: self._word(value) for key, value in action.options.items()}
        if "replace" in getattr(self.bpy.ops.lodgs, action.operator).get_rna_type().properties:
            options["replace"] = True
        return self._operator(getattr(self.bpy.ops.lodgs, action.operator), options)

    def _operator(self, operator: Callable, options: dict) -> str:
        try:
            return "" if operator(**options) == {"FINISHED"} else "cancelled"
        except RuntimeError as error:
            return str(error)

    def _command(self, words: tuple[str, ...]) -> str:
        words = tuple(map(self._word, words))
        with redirect_stderr(io.StringIO()) as output:
            code = self.commands.main(list(words))
        return output.getvalue() if code else ""

    def _render(self, options: dict) -> str:
        """Render frames with LODGS to the disk."""
        scene, data = self.bpy.context.scene, self.bpy.data
        camera = data.objects.new("Camera", data.cameras.new("Camera"))
        camera.location = 0, 0, 8
        scene.collection.objects.link(camera)
        scene.camera, scene.render.engine = camera, "LODGS"
        scene.render.resolution_x, scene.render.resolution_y = SIZE
        scene.render.filepath = str(self.disk / "frame_")
        scene.frame_end = 3
        with redirect_stderr(io.StringIO()) as output:  # Blender's operator ends well after its last image
            problem = self._operator(self.bpy.ops.render.render, options)
        return problem or output.getvalue()

    def _mesh_scene(self, path: Path) -> None:
        """Save a file with a cube, rendered by Cycles with one sample."""
        self.bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        self.bpy.ops.mesh.primitive_cube_add()
        scene = self.bpy.context.scene
        scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
        self.bpy.ops.wm.save_as_mainfile(filepath=str(path))

    def _check_message(self, attack: str, problem: str) -> None:
        is_named = str(self.disk) in problem
        if not is_named or not any(message in problem for message in DISK_FULL_MESSAGES):
            self.wrong.append(f"{attack}: {problem[-400:]}")
        message = (
            f"{attack.split(',', maxsplit=1)[0]}: {problem.strip().replace(str(self.disk), 'DISK')[-200:]}"
        )
        self.messages[message] = self.messages.get(message, 0) + 1

    def _check_files(self, name: str, attack: str, expected: dict, complete: bool = False) -> None:
        files = contents(self.disk)
        names = (expected.keys() | files.keys()) if complete else (expected.keys() & files.keys())
        differing = [
            file for file in names if not self._is_same(name, file, files.get(file), expected.get(file))
        ]
        if differing:
            self.wrong.append(f"{attack}: half written: {sorted(differing)[:9]}")

    def _is_same(self, name: str, file: str, data: bytes | None, expected: bytes | None) -> bool:
        if data is None or expected is None or ACTIONS[name].same:
            return data == expected or file.endswith(".blend1")
        if file.endswith(".png"):  # with the time
            return data.endswith(b"IEND\xaeB`\x82")
        if file.endswith(".blend"):
            return self.is_complete_file(self.disk / file)
        return abs(len(data) - len(expected)) < 64


def handles_sigterm(pid: int) -> bool:
    """Return whether a process has a handler of its own for SIGTERM, on Linux."""
    with suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text()
        caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
        return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
    return False


def write_inputs(folder: Path) -> None:
    """Write a scene, an export and a bundle. Needs Pillow, which Blender's Python lacks."""
    from tests.training.conftest import write_tiny_scene
    from tests.training.splats.test_formats import random_splats
    from training.splats.bundle import write_bundle
    from training.splats.levels import Bundle, Level

    write_tiny_scene(folder / "scene")
    write_export(folder / "export", folder / "scene" / "images")
    levels = [Level(n, random_splats(count, 1, n)) for n, count in enumerate(COUNTS, 1)]
    write_bundle(folder / "bundle.ply", Bundle("flod", levels))


def write_export(folder: Path, photos: Path) -> None:
    """Write an export with photos and without points, which an import converts."""
    shutil.copytree(photos, folder / "images")
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    names = sorted(path.name for path in photos.iterdir())
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose} for name in names]
    document = {"camera_angle_x": 1.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document), "utf-8")


def main() -> int:
    """Run the attacks, print and write results; return 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--disks", type=int, default=20)
    parser.add_argument("--signals", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    names = [*ACTIONS, *TRAININGS]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    parser.add_argument("--inputs", type=Path, help="write the inputs into a folder, and stop")
    options = parser.parse_args()
    if options.inputs:
        write_inputs(options.inputs)
        return 0
    if sys.platform != "linux" or os.geteuid() != 0:
        print("Skipping full disks: mounting a small tmpfs needs root on Linux.")
        return 0
    with tempfile.TemporaryDirectory(prefix="lodgs-attacks-") as folder:
        attack = Attack(Path(folder), random.Random(options.seed))
        results, reported = {}, 0
        for name in options.only:
            if name == "page" and not VIEWER.is_dir():
                print(f"Skipping {name}: the viewer is not installed (tools/viewer.py).")
                continue
            if name in TRAININGS:
                results[name] = attack.send_signals(name, options.signals)
            else:
                results[name] = attack.fill_disks(name, options.disks)
            print(name, results[name], *attack.wrong[reported:], sep="\n", flush=True)
            reported = len(attack.wrong)
    version = ".".join(map(str, attack.bpy.app.version[:2]))
    report = ROOT / "build" / f"attacks_blender_{version}.json"
    report.parent.mkdir(exist_ok=True)
    figures = {"actions": results, "messages": attack.messages, "wrong": attack.wrong}
    report.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1), flush=True)
    return int(bool(attack.wrong))


if __name__ == "__main__":
    os._exit(main())  # the module can hang when Python ends
