"""The Python outside Blender that has PyTorch: finding one, checking it, making one."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from .. import extension
from . import processes

VARIABLE = "LODGS_TRAINER_PYTHON"
"""Environment variable that names the trainer's Python, before the preferences: for pipelines and tests."""

VERSIONS = ((3, 11), (3, 14))
"""Oldest and newest Python that the pinned packages exist for."""

REQUIREMENTS = extension.FOLDER / "requirements" / "trainer.txt"
CUDA_REQUIREMENTS = extension.FOLDER / "requirements" / "cuda.txt"
"""What an NVIDIA GPU needs besides: installed where there is one, and nvcc to compile with."""
_READY = "lodgs-ready.json"
_REMEDY = "Make an environment in the preferences of LODGS, or choose another Python there."


@dataclass
class Report:
    """What is known of a trainer's Python: its versions by package, and a sentence for each problem."""

    python: str
    problems: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        return not self.problems


def made_folder() -> Path:
    """Folder of the environment that :class:`Setup` makes."""
    return extension.user_folder("trainer")


def trainer_python() -> Path:
    """The Python that trains: the one in $LODGS_TRAINER_PYTHON, in the preferences, or the one made here.

    Raises:
        LodgsError: none is set up.
    """
    path = os.environ.get(VARIABLE) or extension.preferences().python
    if path:
        return Path(bpy.path.abspath(path))
    if (made_folder() / _READY).exists():
        return _python_of(made_folder())
    raise LodgsError(
        "Training and rendering need a Python with PyTorch, and none is set up.",
        "Make an environment in the preferences.",
    )


def check(python: Path) -> Report:
    """Ask a Python whether it can train (``python -m training check``). Takes about half a second."""
    report = Report(str(python))
    try:
        answer = _ask(python, "-m", "training", "check")
        found = json.loads(answer.stdout.strip().splitlines()[-1])
        report.problems = [str(problem) for problem in found.pop("problems")]
        report.versions = {k: v for k, v in found.items() if isinstance(v, str)}
    except FileNotFoundError:
        report.problems = [f"There is no program {python}."]
    except PermissionError:
        report.problems = [f"{python} is not a program that may be run."]
    except subprocess.TimeoutExpired:
        report.problems = [f"{python} did not answer."]
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError):
        report.problems = [_why_no_answer(python)]
    folder = extension.user_folder()
    there = next(place for place in (folder, *folder.parents) if place.exists())
    if not os.access(there, os.W_OK):
        report.problems.append(f"The folder {folder} cannot be written.")
    return report


def require(python: Path) -> None:
    """Make sure that a Python can train.

    Raises:
        LodgsError: it cannot; says what is missing.
    """
    report = check(python)
    if not report.ok:
        raise LodgsError(report.problems[0], _REMEDY)


def find_base() -> Path:
    """A Python to make an environment from: one of the system's, else Blender's own.

    Raises:
        LodgsError: there is none of a version that training's packages exist for.
    """
    oldest, newest = VERSIONS
    names = [f"python{oldest[0]}.{minor}" for minor in range(newest[1], oldest[1] - 1, -1)]
    found = [shutil.which(name) for name in (*names, "python3", "python")]
    for candidate in [*filter(None, found), sys.executable]:
        if oldest <= _version(Path(candidate)) <= newest:
            return Path(candidate)
    raise LodgsError(
        f"No Python from {oldest[0]}.{oldest[1]} to {newest[0]}.{newest[1]} was found.",
        "Install one from python.org, then make the environment again.",
    )


class Setup:
    """The making of an environment: a thread that runs venv and pip, and what the preferences show of it.

    Attributes:
        message: what it is doing.
        fraction: a guess of how much is done, 0 to 1 (pip does not say what is still to come).
        problem: why it failed; empty when it did not.
        running: whether it is still at work.
    """

    def __init__(self, base: Path, folder: Path, requirements: list[Path]) -> None:
        self.message, self.fraction, self.problem, self.running = "Making the environment", 0.0, "", True
        self._base, self._folder, self._requirements = base, folder, requirements
        self._process: subprocess.Popen[str] | None = None
        self._cancelled = False
        # bpy is not for threads: what needs it is asked for here.
        self._environment = processes.environment()
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
            shutil.rmtree(self._folder, ignore_errors=True)
            self._run([str(self._base), "-m", "venv", str(self._folder)])
            python = str(_python_of(self._folder))
            pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
            self._run([*pip, *(f"--requirement={file}" for file in self._requirements)])
            (self._folder / _READY).write_text(json.dumps({"base": str(self._base)}), encoding="utf-8")
            self.message, self.fraction = "The environment is ready", 1.0
        except (LodgsError, OSError) as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            self.problem = "" if self._cancelled else str(error)
            self.message = "Cancelled" if self._cancelled else "No environment was made"
        finally:
            self.running = False

    def _run(self, command: list[str]) -> None:
        lines: list[str] = []
        with subprocess.Popen(
            command,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        ) as self._process:
            assert self._process.stdout is not None
            if self._cancelled:  # while this program was being started
                self._stop()
            for line in map(str.strip, self._process.stdout):
                lines.append(line)
                if line.startswith(("Collecting ", "Downloading ", "Installing ")):
                    self.message = brief(line)
                    self.fraction += (0.95 - self.fraction) * 0.03
        if self._cancelled or self._process.returncode:
            errors = [line for line in lines if line.lower().startswith(("error", "fatal"))] or lines
            why = " ".join(errors[-1:]).rstrip(".")
            raise LodgsError(
                f"{Path(command[0]).name} {' '.join(command[1:4])} failed: {why}.",
                "Check the network and the free space, then try again.",
            )

    def _stop(self) -> None:
        """End the program that is at work, with the programs that it has started where the system can."""
        if self._process is None or self._process.poll() is not None:
            return
        if sys.platform == "win32":
            self._process.terminate()
        else:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)


setup: Setup | None = None
"""The environment that is being made, or was last."""

report: Report | None = None
"""The last check."""


def make() -> Setup:
    """Start making an environment in the extension's user folder.

    Raises:
        LodgsError: Blender may not go online, no Python fits, one is being made, or no write access.
    """
    global setup, report
    if not bpy.app.online_access:
        raise LodgsError(
            "Making an environment downloads PyTorch, and Blender may not go online.",
            "Turn on Allow Online Access in the preferences, under System.",
        )
    if setup is not None and setup.running:
        raise LodgsError("An environment is being made already.", "Wait for it or cancel it.")
    folder = made_folder()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(f"The folder {folder.parent} cannot be made: {error.strerror}.") from error
    requirements = [REQUIREMENTS]
    if shutil.which("nvidia-smi") and shutil.which("nvcc"):
        requirements.append(CUDA_REQUIREMENTS)
    setup, report = Setup(find_base(), folder, requirements), None
    return setup


def check_now() -> Report:
    """Check the trainer's Python and keep the result for the preferences.

    Raises:
        LodgsError: none is set up.
    """
    global report
    report = check(trainer_python())
    return report


def brief(line: str) -> str:
    """A line of pip's in few words: "Downloading torch (206.0 MB)"."""
    verb, name = line.split()[:2]
    if verb == "Installing":
        return "Installing the packages"
    size = re.search(r" \([\d.]+ [kMG]B\)$", line)
    return f"{verb} {re.split(r'-[0-9]|[^A-Za-z0-9_.-]', name)[0]}{size[0] if size else ''}"


def _python_of(folder: Path) -> Path:
    return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"


def _ask(python: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(python), *arguments],
        cwd=extension.FOLDER,
        env=processes.environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        timeout=60,
        check=False,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )


def _version(python: Path) -> tuple[int, int]:
    """(major, minor), or (0, 0) if it is no Python."""
    try:
        answer = _ask(python, "-c", "import sys; print(*sys.version_info[:2])").stdout.split()
        return int(answer[0]), int(answer[1])
    except (OSError, ValueError, IndexError, subprocess.TimeoutExpired):
        return 0, 0


def _why_no_answer(python: Path) -> str:
    major, minor = version = _version(python)
    if version == (0, 0):
        return f"{python} is no Python."
    if version < VERSIONS[0]:
        oldest = ".".join(map(str, VERSIONS[0]))
        return f"{python} is Python {major}.{minor}; training needs {oldest} or newer."
    return f"{python} cannot run the trainer."
