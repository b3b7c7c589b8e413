"""The trainer's Python environment: selection and checks of the Python that has PyTorch."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event

from ...training.errors import LodgsError
from .. import extension
from ..data.paths import absolute_path
from . import processes

VARIABLE = "LODGS_TRAINER_PYTHON"
"""Environment variable with the path of the trainer's Python. It overrides the preferences."""

VERSIONS = ((3, 11), (3, 14))
"""Oldest and newest Python version that the pinned packages support."""

TIMEOUT = 60.0
"""Seconds after which a check is abandoned."""

READY = "lodgs-ready.json"
"""File in an environment that is completely installed and tested."""

_REMEDY = (
    "Press Install Trainer in the preferences of LODGS, or choose another Python there or in the environment "
    f"variable {VARIABLE}."
)


@dataclass
class EnvironmentReport:
    """Result of checking a trainer's Python.

    Attributes:
        python: path of the Python.
        problems: one sentence per problem.
        versions: package versions by package.
        graphics: name of the graphics card used for training. Empty if there is none.
        devices: sentence on the device that trains and on faster alternatives. Empty if not checked.
    """

    python: str
    problems: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    graphics: str = ""
    devices: str = ""

    @property
    def ok(self) -> bool:
        return not self.problems


report: EnvironmentReport | None = None
"""Result of the last check, shown in the preferences. None if this environment is not checked yet."""


def environments_folder() -> Path:
    """Return the folder of the managed environments, which are numbered folders (``environment_setup``)."""
    return extension.user_folder("trainer")


def ready_environments() -> list[Path]:
    """Return the usable managed environments, newest first. The newest one is used."""
    numbered = [path for path in environments_folder().glob("[0-9]*") if path.name.isdecimal()]
    return sorted((p for p in numbered if (p / READY).exists()), key=lambda p: int(p.name), reverse=True)


def trainer_python() -> Path:
    """Return the trainer's Python: from $LODGS_TRAINER_PYTHON, the preferences, or a managed environment.

    Raises:
        LodgsError: no Python is set up.
    """
    path = os.environ.get(VARIABLE) or extension.preferences().python
    if path:
        return absolute_path(path)
    for newest in ready_environments()[:1]:
        return python_of(newest)
    raise LodgsError(
        "Cannot start the trainer: it is not installed.",
        "Press Install Trainer in the preferences of LODGS. Or set Trainer Python there, or the environment "
        f"variable {VARIABLE}, to a Python with the wheel of LODGS.",
    )


def check(python: Path) -> EnvironmentReport:
    """Check whether a Python can train (``python -m training check``). Takes about half a second."""
    report = EnvironmentReport(str(python))
    try:
        process = run_module(python, "check")
        answer = json.loads(process.stdout.strip().splitlines()[-1])
        report.problems = [str(problem) for problem in answer.pop("problems")]
        report.versions = {k: v for k, v in answer.items() if isinstance(v, str)}
    except FileNotFoundError:
        report.problems = [f"Python {python} does not exist."]
    except PermissionError:
        report.problems = [f"Python {python} is not executable."]
    except subprocess.TimeoutExpired:
        report.problems = [f"Python {python} did not answer within {TIMEOUT:.0f} s."]
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError):
        report.problems = [_failed_check_reason(python)]
    folder = extension.user_folder()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not os.access(existing, os.W_OK):
        report.problems.append(f"Cannot write to the folder {folder}.")
    return report


def require(python: Path, at_once: int = 1) -> None:
    """Raise an error if a Python cannot train.

    Args:
        python: path of the Python.
        at_once: number of cells of a large scene to train at the same time.

    Raises:
        LodgsError: a package is missing, or another problem.
    """
    report = check(python)
    if not report.ok:
        raise LodgsError(report.problems[0], _REMEDY)
    if at_once > 1 and "distributed" not in report.versions:
        raise LodgsError(
            f"Cannot train {at_once} cells at once: {python} has no Dask.",
            "Press Install Trainer in the preferences of LODGS, install requirements/cluster.txt there, "
            "or set Cells at Once to 1.",
        )


def check_current() -> EnvironmentReport:
    """Check the trainer's Python. Store the result for the preferences.

    Raises:
        LodgsError: no Python is set up.
    """
    global report
    report = check(trainer_python())
    if report.ok:
        _add_devices(report)
    return report


def _add_devices(report: EnvironmentReport) -> None:
    """Add the devices that train (``python -m training devices --json``). Takes some seconds."""
    with suppress(OSError, ValueError, IndexError, AttributeError, subprocess.TimeoutExpired):
        process = run_module(Path(report.python), "devices", "--json")
        answer = json.loads(process.stdout.strip().splitlines()[-1])
        report.graphics = str(answer.get("graphics", ""))
        report.devices = str(answer.get("sentence", ""))


def python_of(environment: Path) -> Path:
    """Return the path of the Python in an environment's folder."""
    if sys.platform == "win32":
        return environment / "Scripts" / "python.exe"
    return environment / "bin" / "python"


def run_module(
    python: Path, *arguments: str, timeout: float = TIMEOUT, stop: Event | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command of the trainer and return its output.

    Args:
        stop: event that ends the program.

    Raises:
        OSError, subprocess.TimeoutExpired: the program does not start, does not end in time, or is stopped.
    """
    return _run(python, "-m", "training", *arguments, timeout=timeout, stop=stop)


def _run(
    python: Path, *arguments: str, timeout: float = TIMEOUT, stop: Event | None = None
) -> subprocess.CompletedProcess[str]:
    end = time.monotonic() + timeout
    with subprocess.Popen(
        [str(python), *arguments],
        cwd=extension.FOLDER,
        env=processes.environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        errors="replace",
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    ) as process:
        while True:
            try:
                output, log = process.communicate(timeout=processes.INTERVAL)
                return subprocess.CompletedProcess(process.args, process.returncode, output, log)
            except subprocess.TimeoutExpired:
                if time.monotonic() > end or (stop is not None and stop.is_set()):
                    process.kill()
                    raise


def python_version(python: Path) -> tuple[int, int]:
    """Return (major, minor), or (0, 0) if the program is no Python."""
    try:
        answer = _run(python, "-c", "import sys; print(*sys.version_info[:2])").stdout.split()
        return int(answer[0]), int(answer[1])
    except (OSError, ValueError, IndexError, subprocess.TimeoutExpired):
        return 0, 0


def _failed_check_reason(python: Path) -> str:
    major, minor = version = python_version(python)
    if version == (0, 0):
        return f"{python} is not a Python interpreter."
    if version < VERSIONS[0]:
        oldest = ".".join(map(str, VERSIONS[0]))
        return f"{python} is Python {major}.{minor}, but training needs {oldest} or newer."
    return f"{python} cannot run the trainer."
