"""The Python outside Blender that has PyTorch: which one it is, and whether it can train."""

from __future__ import annotations

import json
import os
import subprocess
import sys
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

READY = "lodgs-ready.json"
"""File in an environment that was made to the end and has been tried: without it, it is none."""

_REMEDY = "Make an environment in the preferences of LODGS, or choose another Python there."


@dataclass
class Report:
    """What is known of a trainer's Python.

    Attributes:
        problems: a sentence for each.
        versions: by package.
        graphics: name of the graphics card that it would train on, where there is one.
        devices: what trains on this computer, and what might be faster; empty where that was not asked.
    """

    python: str
    problems: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    graphics: str = ""
    devices: str = ""

    @property
    def ok(self) -> bool:
        return not self.problems


report: Report | None = None
"""The last check, for the preferences; None before there was one of this environment."""


def folder() -> Path:
    """Where the environments lie that the extension makes, in numbered folders (``environment_setup``)."""
    return extension.user_folder("trainer")


def made() -> list[Path]:
    """The environments that the extension has made, newest first: that one serves."""
    numbered = [path for path in folder().glob("[0-9]*") if path.name.isdecimal()]
    return sorted((p for p in numbered if (p / READY).exists()), key=lambda p: int(p.name), reverse=True)


def trainer_python() -> Path:
    """The Python that trains: the one in $LODGS_TRAINER_PYTHON, in the preferences, or the one made here.

    Raises:
        LodgsError: none is set up.
    """
    path = os.environ.get(VARIABLE) or extension.preferences().python
    if path:
        return Path(bpy.path.abspath(path))
    for newest in made()[:1]:
        return python_of(newest)
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
    ours = extension.user_folder()
    there = next(place for place in (ours, *ours.parents) if place.exists())
    if not os.access(there, os.W_OK):
        report.problems.append(f"The folder {ours} cannot be written.")
    return report


def require(python: Path, at_once: int = 1) -> None:
    """Make sure that a Python can train.

    Args:
        at_once: how many cells of a large scene at a time.

    Raises:
        LodgsError: it cannot; says what is missing.
    """
    report = check(python)
    if not report.ok:
        raise LodgsError(report.problems[0], _REMEDY)
    if at_once > 1 and "distributed" not in report.versions:
        raise LodgsError(
            f"Training {at_once} cells at once needs Dask, which {python} does not have.",
            "Make an environment in the preferences of LODGS, install requirements/cluster.txt there, or set "
            "Cells at Once to 1.",
        )


def check_now() -> Report:
    """Check the trainer's Python and keep the result for the preferences.

    Raises:
        LodgsError: none is set up.
    """
    global report
    report = check(trainer_python())
    if report.ok:
        _ask_devices(report)
    return report


def _ask_devices(report: Report) -> None:
    """Adds what this computer can train on (``python -m training devices --json``); takes some seconds."""
    with suppress(OSError, ValueError, IndexError, AttributeError, subprocess.TimeoutExpired):
        answer = _ask(Path(report.python), "-m", "training", "devices", "--json")
        found = json.loads(answer.stdout.strip().splitlines()[-1])
        report.graphics, report.devices = str(found.get("graphics", "")), str(found.get("sentence", ""))


def python_of(environment: Path) -> Path:
    """The Python of an environment by its folder."""
    if sys.platform == "win32":
        return environment / "Scripts" / "python.exe"
    return environment / "bin" / "python"


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


def version_of(python: Path) -> tuple[int, int]:
    """(major, minor), or (0, 0) if it is no Python."""
    try:
        answer = _ask(python, "-c", "import sys; print(*sys.version_info[:2])").stdout.split()
        return int(answer[0]), int(answer[1])
    except (OSError, ValueError, IndexError, subprocess.TimeoutExpired):
        return 0, 0


def _why_no_answer(python: Path) -> str:
    major, minor = version = version_of(python)
    if version == (0, 0):
        return f"{python} is no Python."
    if version < VERSIONS[0]:
        oldest = ".".join(map(str, VERSIONS[0]))
        return f"{python} is Python {major}.{minor}; training needs {oldest} or newer."
    return f"{python} cannot run the trainer."
