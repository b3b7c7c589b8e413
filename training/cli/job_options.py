"""The options of ``train``, the same for ``lodgs train`` and ``blender --command lodgs train``. No torch."""

from __future__ import annotations

import argparse
import json
from collections.abc import Collection
from dataclasses import MISSING, asdict, fields
from pathlib import Path

from ..documents import parse_json
from ..errors import LodgsError, printable
from ..methods import METHODS, PRESETS
from ..runs.job import BACKENDS, Job


def _whole(text: str) -> int:
    try:
        if 0 <= (value := int(text)) < 2**31:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text} is no whole number from 0 to {2**31 - 1}")


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of an option such as 640x480."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text} is not WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


_OPTIONS: dict[str, dict] = {
    "scene": {"metavar": "DIR", "help": "folder of the COLMAP scene"},
    "out": {"metavar": "RUN", "help": "run folder; goes on with what the same command began there"},
    "method": {"choices": list(METHODS), "help": "what to train, see the command methods"},
    "preset": {"choices": list(PRESETS), "help": "how long to train"},
    "base": {"metavar": "PATH", "help": "run, bundle or PLY to begin with instead of the scene's points"},
    "capture": {
        "metavar": "dome|DIR",
        "help": "instead of a scene, draw the base's own pictures: from all around, or from camera files",
    },
    "views": {"metavar": "N", "type": _whole, "help": "how many from all around"},
    "view_width": {"metavar": "N", "type": _whole, "help": "pixels that these are wide; they are 3:2"},
    "image_scale": {"metavar": "SHARE", "type": float, "help": "size of training images over photographs"},
    "test_every": {"metavar": "N", "type": _whole, "help": "hold out every N-th view; 0 holds out none"},
    "validation": {
        "action": "store_true",
        "help": "hold out the views between those instead, and leave those out: to try settings by",
    },
    "seed": {"metavar": "N", "type": _whole, "help": "of every random choice"},
    "backend": {"choices": list(BACKENDS), "help": "what draws; auto is cuda where that works, else cpu"},
    "exposure": {"metavar": "STOPS", "type": float, "help": "stops added to linear (EXR) images"},
    "photo_memory": {
        "metavar": "MB",
        "type": _whole,
        "help": "photographs that are kept; 0 is a quarter of the free memory, 2048 at most",
    },
    "splat_memory": {
        "metavar": "MB",
        "type": _whole,
        "help": "splats in memory, where others can be in a file (tree); 0 is half of the free memory",
    },
    "region": {
        "metavar": "SHAPE",
        "help": "what to train in detail, all else coarsely: 'box X Y Z X Y Z' (two opposite corners) or "
        "'sphere X Y Z RADIUS', in the scene's coordinates",
    },
    "cells": {
        "metavar": "CxR",
        "help": "train columns x rows of cells on the ground one by one, then put them together",
    },
    "polish": {
        "metavar": "N",
        "type": _whole,
        "help": "steps that fit each cell's borders to the cells beside it at the end; 0 for none",
    },
    "model": {"metavar": "DIR", "help": "folder of the COLMAP model, where it is not found by itself"},
    "images": {"metavar": "DIR", "help": "folder of the photographs, where it is not found by itself"},
}
"""What argparse is told of each key of a job; the defaults are the job's own."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declares a job file and, for each key of a :class:`Job`, an option that goes before the file."""
    parser.add_argument(
        "job", nargs="?", type=Path, metavar="JOB",
        help="job file (TOML or JSON), a run's own resumes it; or the scene's folder",
    )  # fmt: skip
    defaults = {key.name: key.default for key in fields(Job)}
    for name, option in _OPTIONS.items():
        unsaid = defaults[name] is False or defaults[name] in ("", MISSING)
        default = "" if unsaid else f" (default {defaults[name]})"
        option = option | {"help": option["help"] + default}
        parser.add_argument(f"--{name.replace('_', '-')}", default=argparse.SUPPRESS, **option)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="a parameter of the method, see the command methods; repeatable",
    )  # fmt: skip


def job_from_options(chosen: argparse.Namespace) -> Job:
    """The job that the options of :func:`add_options` ask for, checked; paths are relative to here.

    Raises:
        LodgsError: neither a job file nor a scene and a run folder, or an impossible value.
    """
    given = {name: value for name, value in vars(chosen).items() if name in _OPTIONS}
    if chosen.job and chosen.job.is_dir():
        given, values = {"scene": str(chosen.job)} | given, {}
    else:
        values = asdict(Job.from_file(chosen.job)) if chosen.job else {}
    said = values.keys() | given.keys()
    if "out" not in said or not said & {"scene", "capture"}:
        raise LodgsError(
            "It is not said what to train.", "Give a job file, or the scene's folder and --out RUN."
        )
    parameters = values.get("parameters", {}) | dict(map(_assignment, chosen.set))
    return Job.from_dict(values | given | {"parameters": parameters})


def options_of(job: Job, but: Collection[str] = ()) -> list[str]:
    """The options that :func:`job_from_options` makes a job of: what it says otherwise than its defaults.

    Args:
        but: keys that are left out.
    """
    said = {key.name: getattr(job, key.name) for key in fields(Job) if key.name in _OPTIONS}
    known = {key.name: key.default for key in fields(Job)}
    told: list[str] = []
    for name, value in said.items():
        if name not in but and value != known[name]:
            option = f"--{name.replace('_', '-')}"
            told += [option] if _OPTIONS[name].get("action") else [option, str(value)]
    for name, value in job.parameters.items():
        told += ["--set", f"{name}={json.dumps(value)}"]
    return told


def parse_resources(given: list[str]) -> dict[str, float] | None:
    """What ``NAME=NUMBER`` texts say, by name; None where there are none.

    Raises:
        LodgsError: one does not say so.
    """
    found = {}
    for text in given:
        name, value = _assignment(text)
        if not name or not isinstance(value, (int, float)) or not 0 < value < 2**31:
            raise LodgsError(f"{printable(text[:200])} is not NAME=NUMBER.", "For example: GPU=1")
        found[name] = float(value)
    return found or None


def _assignment(text: str) -> tuple[str, object]:
    """``name=value`` with a value as JSON has it: a number, a list of numbers; or a plain word."""
    name, _, value = text.partition("=")
    if value.isidentifier() and value not in ("true", "false", "null"):
        return name.strip(), value
    try:
        return name.strip(), parse_json(f'{{"value": {value}}}', "--set")["value"]
    except (LodgsError, KeyError):
        raise LodgsError(
            f"--set {printable(text[:200])} is not NAME=VALUE.", "For example: --set max_splats=50000"
        ) from None
