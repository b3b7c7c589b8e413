"""``lodgs check``: report whether this Python can train.

Works in every Python of a supported version, with the standard library alone.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from .. import VERSION

INSTALL = "Install the packages of requirements/trainer.txt."
"""Remedy for a missing or old package."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Exit code: 0 if this Python can train, else 2."


def run(options: argparse.Namespace | None = None) -> int:
    """Run the command and return its exit code."""
    report = environment()
    print(json.dumps(report))
    return 0 if report["ok"] else 2


def environment() -> dict:
    """Return the versions of required packages, and a sentence for each that is missing or too old."""
    report: dict = {"lodgs": VERSION, "python": sys.version.split()[0], "executable": sys.executable}
    problems = []
    for package, minimum in _requirements():
        try:
            report[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            problems.append(f"The package {package} is missing in {sys.executable}.")
            continue
        if _numbers(report[package]) < _numbers(minimum):
            problems.append(f"{package} is {report[package]}; training needs {minimum} or newer.")
    with suppress(metadata.PackageNotFoundError):  # optional: trains several cells at once
        report["distributed"] = metadata.version("distributed")
    return {**report, "ok": not problems, "problems": problems}


def _requirements() -> list[tuple[str, str]]:
    """Return name and minimum version of each required package, from pyproject.toml or the installation."""
    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if project.is_file():  # a checkout or the extension
        lines = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["dependencies"]
    else:
        lines = [line for line in metadata.requires("lodgs") or () if "extra ==" not in line]
    matches = (re.match(r"([\w-]+)>=([\d.]+)", line) for line in lines)
    return [(match[1], match[2]) for match in matches if match]


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split("+", maxsplit=1)[0].split(".")[:2] if part.isdigit()]
