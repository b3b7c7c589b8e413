"""Making the trainer's environment: beside the one that serves, tried, and only then in its place.

Each lies in a folder with a number, and the newest that is ready serves. So a making that fails, is cancelled
or killed takes nothing away. Programs go on with the environment that they have begun with: it is removed by
the next making that finds nothing at work in it.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.files import atomic_write
from .. import extension
from . import environment, processes

REQUIREMENTS = extension.FOLDER / "requirements" / "cluster.txt"
"""What training needs, and Dask for several cells of a large scene at once."""
CUDA_REQUIREMENTS = extension.FOLDER / "requirements" / "cuda.txt"
"""The same and what an NVIDIA GPU needs: installed where there is one, and nvcc to compile with."""

MODULES = (
    "torch", "numba", "scipy", "pycolmap", "OpenEXR", "PIL", "plyfile", "torchmetrics", "wgpu", "distributed",
)  # fmt: skip
"""What a new environment must be able to import before it serves."""


class Making:
    """A thread that runs venv and pip, and what the preferences show of it.

    Attributes:
        message: what it is doing.
        fraction: a guess of how much is done, 0 to 1 (pip does not say what is still to come).
        problem: why it failed; empty when it did not.
        running: whether it is still at work.
    """

    def __init__(self, base: Path, parent: Path, requirements: Path) -> None:
        self.message, self.fraction, self.problem, self.running = "Making the environment", 0.0, "", True
        self._base, self._parent, self._requirements = base, parent, requirements
        self._process: subprocess.Popen[str] | None = None
        self._inherited: tuple[int, ...] = ()
        self._cancelled = False
        # bpy is not for threads: what needs it is asked for here.
        self._environment, self._before = processes.environment(), environment.made()[:1]
        self._thread = threading.Thread(target=self._make, daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """Stop, and remove what was made."""
        self._cancelled = True
        self._stop()

    def step(self) -> bool:
        """For ``processes.follow``: show what is new; return whether it goes on."""
        extension.redraw()
        return self.running

    def _make(self) -> None:
        try:
            self._remove_all_but(self._before)
            folder = _new_folder(self._parent)
            with processes.using(folder) as self._inherited:  # a killed Blender's pip works on for a while
                try:
                    self._fill(folder)
                except BaseException:
                    shutil.rmtree(folder, ignore_errors=True)
                    raise
            self.message, self.fraction = "The environment is ready", 1.0
            if not self._remove_all_but([folder]):
                self.message += "; what is running goes on with the one before it"
        except (LodgsError, OSError) as error:
            kept = " The environment that was there is kept." if self._before else ""
            self.problem = "" if self._cancelled else f"{error}{kept}"
            self.message = "Cancelled" if self._cancelled else "No environment was made"
        finally:
            self.running = False

    def _fill(self, folder: Path) -> None:
        self._run("venv", [str(self._base), "-m", "venv", str(folder)])
        python = str(environment.python_of(folder))
        pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
        pins = ["--require-hashes", "--only-binary=:all:", f"--requirement={self._requirements}"]
        self._run("pip install", [*pip, *pins])
        self.message = "Trying the environment"
        self._run("The new environment", [python, "-c", f"import {', '.join(MODULES)}"])
        with atomic_write(folder / environment.READY) as file:
            file.write_text(json.dumps({"base": str(self._base)}), encoding="utf-8")

    def _run(self, what: str, command: list[str]) -> None:
        lines: list[str] = []
        with subprocess.Popen(
            command,
            cwd=extension.FOLDER,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
            pass_fds=self._inherited,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        ) as self._process:
            assert self._process.stdout is not None
            if self._cancelled:  # while this program was being started
                self._stop()
            for line in filter(None, map(str.strip, self._process.stdout)):
                lines.append(line)
                if line.startswith(("Collecting ", "Downloading ", "Installing ")):
                    self.message = brief(line)
                    self.fraction += (0.95 - self.fraction) * 0.03
        if self._cancelled or self._process.returncode:
            errors = [line for line in lines if line.lower().startswith(("error", "fatal"))] or lines
            why = " ".join(errors[-1:]).rstrip(".")
            raise LodgsError(
                f"{what} failed: {why}." if why else f"{what} failed.",
                "Check the network and the free space, then try again.",
            )

    def _remove_all_but(self, kept: list[Path]) -> bool:
        """Remove older environments and what killed makings left; False where one stays, being in use."""
        gone = True
        for path in set(self._parent.iterdir()) - set(kept):
            if path.is_symlink() or not path.is_dir():
                path.unlink(missing_ok=True)
            elif processes.in_use(path):
                gone = False
            else:
                away = path.with_suffix(".old")
                try:
                    path.rename(away)  # Windows refuses where a program runs or a file is open
                except OSError:
                    gone = False
                    continue
                compiled = Path(self._environment["PYTHONPYCACHEPREFIX"], *path.parts[1:])
                for folder in (away, compiled):
                    shutil.rmtree(folder, ignore_errors=True)
        return gone

    def _stop(self) -> None:
        """End the program that is at work, with the programs that it has started where the system can."""
        if self._process is None or self._process.poll() is not None:
            return
        if sys.platform == "win32":
            self._process.terminate()
        else:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)


current: Making | None = None
"""The environment that is being made, or was last."""


def make() -> Making:
    """Start making an environment in the extension's user folder.

    Raises:
        LodgsError: Blender may not go online, no Python fits, one is being made, or no write access.
    """
    global current
    if not bpy.app.online_access:
        raise LodgsError(
            "Making an environment downloads PyTorch, and Blender may not go online.",
            "Turn on Allow Online Access in the preferences, under System.",
        )
    if current is not None and current.running:
        raise LodgsError("An environment is being made already.", "Wait for it or cancel it.")
    parent = environment.folder()
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(f"The folder {parent} cannot be made: {error.strerror}.") from error
    gpu = shutil.which("nvidia-smi") and shutil.which("nvcc")
    current = Making(find_base(), parent, CUDA_REQUIREMENTS if gpu else REQUIREMENTS)
    environment.report = None
    return current


def find_base() -> Path:
    """A Python to make an environment from: the system's oldest (which tests run on), else Blender's own.

    Raises:
        LodgsError: there is none of a version that training's packages exist for.
    """
    oldest, newest = environment.VERSIONS
    names = [f"python{oldest[0]}.{minor}" for minor in range(oldest[1], newest[1] + 1)]
    found = [shutil.which(name) for name in (*names, "python3", "python")]
    for candidate in [*filter(None, found), sys.executable]:
        if oldest <= environment.version_of(Path(candidate)) <= newest:
            return Path(candidate)
    raise LodgsError(
        f"No Python from {oldest[0]}.{oldest[1]} to {newest[0]}.{newest[1]} was found.",
        "Install one from python.org, then make the environment again.",
    )


def brief(line: str) -> str:
    """A line of pip's in few words: "Downloading torch (206.0 MB)"."""
    verb, name = line.split()[:2]
    if verb == "Installing":
        return "Installing the packages"
    size = re.search(r" \([\d.]+ [kMG]B\)$", line)
    return f"{verb} {re.split(r'-[0-9]|[^A-Za-z0-9_.-]', name)[0]}{size[0] if size else ''}"


def _new_folder(parent: Path) -> Path:
    """A folder whose number is above all others, marked, so that no other Blender takes it for a leftover."""
    highest = max((int(path.name) for path in parent.iterdir() if path.name.isdecimal()), default=0)
    for number in itertools.count(highest + 1):
        with suppress(FileExistsError):  # another Blender was quicker
            (parent / str(number)).mkdir()
            break
    (parent / str(number) / processes.MARK).touch()
    return parent / str(number)
