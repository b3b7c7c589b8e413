"""Options of a training job, shared by ``lodgs train`` and ``blender --command lodgs train``. No torch."""

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


def _natural(text: str) -> int:
    try:
        if 0 <= (value := int(text)) < 2**31:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text} is not a whole number from 0 to {2**31 - 1}")


_OPTIONS: dict[str, dict] = {
    "scene": {"metavar": "DIR", "help": "folder of the COLMAP scene"},
    "out": {"metavar": "RUN", "help": "run folder; the same command resumes a run in it"},
    "method": {"choices": list(METHODS), "help": "training method; lodgs methods describes them"},
    "preset": {"choices": list(PRESETS), "help": "training effort"},
    "base": {"metavar": "PATH", "help": "run, bundle or PLY to start from instead of the scene's points"},
    "capture": {
        "metavar": "dome|DIR",
        "help": "instead of a scene, train on renders of the base: from all around (dome), or from a folder "
        "of camera files",
    },
    "views": {"metavar": "N", "type": _natural, "help": "number of dome views"},
    "view_width": {"metavar": "N", "type": _natural, "help": "width of dome views in pixels; aspect 3:2"},
    "image_scale": {"metavar": "FACTOR", "type": float, "help": "training image size over photo size"},
    "test_every": {"metavar": "N", "type": _natural, "help": "hold out every N-th view; 0 holds out none"},
    "validation": {
        "action": "store_true",
        "help": "for tuning: hold out the views between the held-out ones instead, and exclude those",
    },
    "seed": {"metavar": "N", "type": _natural, "help": "random seed"},
    "backend": {"choices": list(BACKENDS), "help": "rasterizer; auto is cuda if that works, else cpu"},
    "exposure": {"metavar": "STOPS", "type": float, "help": "stops added to linear (EXR) images"},
    "photo_memory": {
        "metavar": "MB",
        "type": _natural,
        "help": "budget for photos in memory; 0 uses a quarter of the free memory, at most 2048",
    },
    "splat_memory": {
        "metavar": "MB",
        "type": _natural,
        "help": "budget for splats in memory (method tree); 0 uses half of the free memory",
    },
    "region": {
        "metavar": "SHAPE",
        "help": "region to train in detail: 'box X Y Z X Y Z' (two opposite corners) or 'sphere X Y Z "
        "RADIUS', in the scene's coordinates. The rest is trained coarsely",
    },
    "cells": {
        "metavar": "CxR",
        "help": "divide the ground into columns x rows of cells, train them one by one, and merge them",
    },
    "polish": {
        "metavar": "N",
        "type": _natural,
        "help": "steps that fit the borders of neighbouring cells to each other at the end; 0 disables",
    },
    "model": {"metavar": "DIR", "help": "folder of the COLMAP model, if not in the usual place"},
    "images": {"metavar": "DIR", "help": "folder of the photos, if not in the usual place"},
}
"""Arguments of argparse for each key of a job; defaults are the job's own."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add a job file and an option for each key of a :class:`Job`; options override the file."""
    parser.add_argument(
        "job", nargs="?", type=Path, metavar="JOB",
        help="job file (TOML or JSON), or the scene's folder; a run's job.toml resumes the run",
    )  # fmt: skip
    defaults = {key.name: key.default for key in fields(Job)}
    for name, option in _OPTIONS.items():
        has_default = defaults[name] is not False and defaults[name] not in ("", MISSING)
        default = f" (default {defaults[name]})" if has_default else ""
        option = option | {"help": option["help"] + default}
        parser.add_argument(f"--{name.replace('_', '-')}", default=argparse.SUPPRESS, **option)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="parameter of the method, repeatable; lodgs methods NAME lists them",
    )  # fmt: skip


def job_from_options(options: argparse.Namespace) -> Job:
    """Return the checked job of :func:`add_options`'s options; paths are relative to the current folder.

    Raises:
        LodgsError: neither a job file nor a scene and a run folder, or an invalid value.
    """
    changes = {name: value for name, value in vars(options).items() if name in _OPTIONS}
    values = {}
    if options.job and options.job.is_dir():
        changes = {"scene": str(options.job)} | changes
    elif options.job:
        values = asdict(Job.from_file(options.job))
    keys = values.keys() | changes.keys()
    if "out" not in keys or not keys & {"scene", "capture"}:
        raise LodgsError(
            "Cannot train: no job, or no run folder.", "Give a job file, or the scene's folder and --out RUN."
        )
    parameters = values.get("parameters", {}) | dict(map(_assignment, options.set))
    return Job.from_dict(values | changes | {"parameters": parameters})


def options_of(job: Job, exclude: Collection[str] = ()) -> list[str]:
    """Return the options that :func:`job_from_options` turns into this job; defaults are omitted.

    Args:
        exclude: keys to omit.
    """
    values = {key.name: getattr(job, key.name) for key in fields(Job) if key.name in _OPTIONS}
    defaults = {key.name: key.default for key in fields(Job)}
    words: list[str] = []
    for name, value in values.items():
        if name not in exclude and value != defaults[name]:
            option = f"--{name.replace('_', '-')}"
            words += [option] if _OPTIONS[name].get("action") else [option, str(value)]
    for name, value in job.parameters.items():
        words += ["--set", f"{name}={json.dumps(value)}"]
    return words


def parse_resources(texts: list[str]) -> dict[str, float] | None:
    """Parse ``NAME=NUMBER`` texts into numbers by name; None without any.

    Raises:
        LodgsError: invalid text.
    """
    resources = {}
    for text in texts:
        name, value = _assignment(text)
        if not name or not isinstance(value, (int, float)) or not 0 < value < 2**31:
            raise LodgsError(f"{printable(text[:200])} is not NAME=NUMBER.", "For example: GPU=1")
        resources[name] = float(value)
    return resources or None


def _assignment(text: str) -> tuple[str, object]:
    """Parse ``name=value``, where the value is JSON (a number, a list of numbers) or a plain word."""
    name, _, value = text.partition("=")
    if value.isidentifier() and value not in ("true", "false", "null"):
        return name.strip(), value
    try:
        return name.strip(), parse_json(f'{{"value": {value}}}', "--set")["value"]
    except (LodgsError, KeyError):
        raise LodgsError(
            f"--set {printable(text[:200])} is not NAME=VALUE.", "For example: --set max_splats=50000"
        ) from None
