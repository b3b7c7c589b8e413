"""Installation of the trainer's environment.

Environments are numbered folders, and the newest complete one is used. An installation that fails, is
cancelled or is killed leaves the previous environment in use. Running programs keep their environment: it is
removed by a later installation when no program uses it any more.
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
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import bpy

from ...training import packages
from ...training.errors import LodgsError
from ...training.files import atomic_write
from .. import extension
from . import environment, processes

REQUIREMENTS = extension.FOLDER / "requirements" / "cluster.txt"
"""Packages for training, and Dask for training several cells of a large scene at once."""
PIP_REQUIREMENTS = extension.FOLDER / "requirements" / "pip.txt"
"""A pip that understands PIP_OPTIONS."""
PIP_OPTIONS = ("--progress-bar=raw", "--resume-retries=5")
"""Options that report the progress of downloads and resume interrupted ones."""

MODULES = (
    "torch", "numba", "scipy", "pycolmap", "OpenEXR", "PIL", "plyfile", "torchmetrics", "wgpu", "distributed",
    "cryptography", "pxr", "zstandard",
)  # fmt: skip
"""Modules that a new environment must import before it is used."""

CONNECTION_PROBLEMS = {
    "CERTIFICATE_VERIFY_FAILED": "the certificate of the package index or of a proxy is not trusted",
    "connection broken by": "no connection to the package index",
}
"""Causes by a text in pip's output, the more exact ones first."""


class EnvironmentSetup:
    """A thread that runs venv and pip, with its progress for the preferences.

    Attributes:
        message: current step with the time, or the result.
        fraction: estimated progress, 0 to 1 (pip does not report the number of packages in advance).
        problem: reason of a failure. Empty otherwise.
        running: whether the thread is running.
    """

    def __init__(self, base: Path, parent: Path, requirements: Path, cuda: bool) -> None:
        self.fraction = 0.0
        self.problem = ""
        self.running = True
        self._base = base
        self._parent = parent
        self._requirements = requirements
        self._cuda = cuda
        self._process: subprocess.Popen[str] | None = None
        self._inherited: tuple[int, ...] = ()
        self._cancelled = False
        self._started = time.monotonic()
        self._task = "Creating the environment"
        # bpy is not thread-safe: read everything that needs it here
        self._variables = processes.environment()
        self._previous = environment.ready_environments()[:1]
        self._thread = threading.Thread(target=self._install, daemon=True)
        self._thread.start()

    @property
    def message(self) -> str:
        if not self.running:
            return self._task
        minutes, seconds = divmod(int(time.monotonic() - self._started), 60)
        task = "Cancelling" if self._cancelled else self._task
        return f"{task}, {minutes}:{seconds:02d} min"

    def cancel(self) -> None:
        """Stop and remove the incomplete environment."""
        self._cancelled = True
        self._stop()

    def step(self) -> bool:
        """Redraw the progress. Return whether the thread is running, for ``processes.follow``."""
        extension.redraw()
        return self.running

    def _install(self) -> None:
        try:
            self._remove_all_but(self._previous)
            folder = _new_folder(self._parent)
            # pip inherits the lock, because it outlives a killed Blender
            with processes.hold_environment(folder) as self._inherited:
                try:
                    self._fill(folder)
                except BaseException:
                    shutil.rmtree(folder, ignore_errors=True)
                    raise
            self._task = "The trainer is ready"
            self.fraction = 1.0
            if not self._remove_all_but([folder]):
                self._task += "; running programs keep the previous environment"
        except (LodgsError, OSError) as error:
            note = " The previous environment is still in use." if self._previous else ""
            self.problem = "" if self._cancelled else f"{error}{note}"
            self._task = "Cancelled" if self._cancelled else "The trainer was not installed"
        finally:
            self.running = False

    def _fill(self, folder: Path) -> None:
        """Create an environment in a folder, install the packages and test them."""
        self._run("venv", [str(self._base), "-m", "venv", str(folder)])
        python = str(environment.python_of(folder))
        pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
        self._run("pip install", [*pip, *packages.HASHED, f"--requirement={PIP_REQUIREMENTS}"])
        pip += PIP_OPTIONS
        with tempfile.TemporaryDirectory() as work:
            lock, options = self._requirements, list(packages.HASHED)
            if not self._cuda and packages.has_cpu_build() and self._install_torch(pip):
                lock = Path(work, lock.name)
                lock.write_text(packages.without_cuda(self._requirements.read_text("utf-8")), "utf-8")
                options.append("--no-deps")
            self._run("pip install", [*pip, *options, f"--requirement={lock}"])
        self._task = "Testing the environment"
        self._run("import of the packages", [python, "-c", f"import {', '.join(MODULES)}"])
        with atomic_write(folder / environment.READY) as file:
            file.write_text(json.dumps({"base": str(self._base)}), encoding="utf-8")

    def _install_torch(self, pip: list[str]) -> bool:
        """Install the CPU build of PyTorch. Return False if it cannot be downloaded."""
        try:
            self._run("pip install", [*pip, *packages.torch_cpu_options()])
        except LodgsError:
            if self._cancelled:
                raise
            return False
        return True

    def _run(self, task: str, command: list[str]) -> None:
        """Run a program to its end and follow its output.

        Args:
            task: name of the step, for errors.

        Raises:
            LodgsError: the program failed, or the setup was cancelled.
            OSError: the program cannot be started.
        """
        lines: list[str] = []
        download = "Downloading"
        with subprocess.Popen(
            command,
            cwd=extension.FOLDER,
            env=self._variables,
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
            if self._cancelled:  # while this program started
                self._stop()
            for line in filter(None, map(str.strip, self._process.stdout)):
                if line.startswith("Progress "):
                    self._task = f"{download} {format_progress(line)}"
                    continue
                lines.append(line)
                if line.startswith(("Collecting ", "Downloading ", "Installing ")):
                    self._task = shorten_pip_line(line)
                    download = self._task.partition(" (")[0]
                    self.fraction += (0.95 - self.fraction) * 0.03
        if self._cancelled or self._process.returncode:
            reason = failure_reason(lines)
            raise LodgsError(
                f"Cannot install the trainer: {task} failed{f': {reason}' if reason else ''}.",
                "Check the network and the free disk space, then try again.",
            )

    def _remove_all_but(self, keep: list[Path]) -> bool:
        """Remove older and incomplete environments. Return False if one is in use and stays."""
        all_removed = True
        for path in set(self._parent.iterdir()) - set(keep):
            if path.is_symlink() or not path.is_dir():
                path.unlink(missing_ok=True)
            elif processes.is_in_use(path):
                all_removed = False
            else:
                renamed = path.with_suffix(".old")
                try:
                    path.rename(renamed)  # Windows refuses if a program runs or a file is open
                except OSError:
                    all_removed = False
                    continue
                compiled = Path(self._variables["PYTHONPYCACHEPREFIX"], *path.parts[1:])
                for folder in (renamed, compiled):
                    shutil.rmtree(folder, ignore_errors=True)
        return all_removed

    def _stop(self) -> None:
        """Terminate the running program, and on POSIX systems its child processes."""
        if self._process is None or self._process.poll() is not None:
            return
        if sys.platform == "win32":
            self._process.terminate()
        else:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)


current: EnvironmentSetup | None = None
"""The running or last installation."""


def start() -> EnvironmentSetup:
    """Start to install an environment in the extension's user folder.

    Raises:
        LodgsError: online access is off, no Python is suitable, an installation is running, or the folder is
            not writable.
    """
    global current
    if not bpy.app.online_access:
        raise LodgsError(
            "Cannot download the trainer: Blender's online access is off.",
            "Turn on Allow Online Access in the preferences, under System.",
        )
    if current is not None and current.running:
        raise LodgsError(
            "Cannot install the trainer: it is already being installed.", "Wait for it or cancel it."
        )
    parent = environment.environments_folder()
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(
            f"Cannot create the folder {parent}: {error.strerror}.",
            "Check the permissions and the free space of this disk.",
        ) from error
    cuda = shutil.which("nvidia-smi") is not None
    current = EnvironmentSetup(find_base_python(), parent, REQUIREMENTS, cuda)
    environment.report = None
    return current


def find_base_python() -> Path:
    """Return the Python to create an environment from.

    The oldest supported Python of the system is preferred, because LODGS is tested on it. The last candidate
    is Blender's own.

    Raises:
        LodgsError: no Python of a supported version was found.
    """
    oldest, newest = environment.VERSIONS
    names = [f"python{oldest[0]}.{minor}" for minor in range(oldest[1], newest[1] + 1)]
    programs = [shutil.which(name) for name in (*names, "python3", "python")]
    for candidate in [*filter(None, programs), sys.executable]:
        if oldest <= environment.python_version(Path(candidate)) <= newest:
            return Path(candidate)
    raise LodgsError(
        f"Cannot install the trainer: no Python from {oldest[0]}.{oldest[1]} to {newest[0]}.{newest[1]} was "
        "found.",
        "Install one from python.org, then press Install Trainer again.",
    )


def shorten_pip_line(line: str) -> str:
    """Shorten a line of pip's output, such as "Downloading torch (206.0 MB)"."""
    verb, name = line.split()[:2]
    if verb == "Installing":
        return "Installing the packages"
    size = re.search(r" \([\d.]+ [kMG]B\)$", line)
    return f"{verb} {re.split(r'-[0-9]|[^A-Za-z0-9_.-]', name)[0]}{size[0] if size else ''}"


def format_progress(line: str) -> str:
    """Format a line of pip's raw progress, "Progress 96000000 of 192000000", as "96 of 192 MB"."""
    done, _, total = (line.split() + ["0"] * 4)[1:4]
    return f"{int(done) / 1e6:.0f} of {int(total) / 1e6:.0f} MB"


def failure_reason(lines: list[str]) -> str:
    """Return the cause of a failure, without a final period, from a program's output. Empty without output.

    Without a connection, pip's last error only says that there is no such package.
    """
    errors = [line for line in lines if line.lower().startswith(("error", "fatal"))] or lines
    reason = " ".join(errors[-1:]).rstrip(".")
    if "No matching distribution" in reason:
        output = "\n".join(lines)
        causes = (cause for mark, cause in CONNECTION_PROBLEMS.items() if mark in output)
        reason = next(causes, reason)
    return reason


def _new_folder(parent: Path) -> Path:
    """Create a folder with the next number and a lock file, so that other Blenders do not remove it."""
    highest = max((int(path.name) for path in parent.iterdir() if path.name.isdecimal()), default=0)
    for number in itertools.count(highest + 1):
        with suppress(FileExistsError):  # created by another Blender
            (parent / str(number)).mkdir()
            break
    (parent / str(number) / processes.MARK).touch()
    return parent / str(number)
