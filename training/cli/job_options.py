"""Options of a training job, shared by ``lodgs train`` and ``blender --command lodgs train``. No torch."""

from __future__ import annotations

import argparse
import json
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path

from ..documents import parse_json
from ..errors import LodgsError, printable
from ..runs.folder import RunFolder
from ..runs.job import Job, default_image_scale
from ..settings import settings_of
from .options import add_setting, option_words


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add a job file and an option for each key of a :class:`Job`; options override the file."""
    parser.add_argument(
        "job", nargs="?", type=Path, metavar="JOB",
        help="job file (TOML or JSON), the scene's folder, or the folder of a run to resume",
    )  # fmt: skip
    for f in settings_of(Job).values():
        add_setting(parser, f)
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="parameter of the method, repeatable; lodgs methods NAME lists them",
    )  # fmt: skip


def job_from_options(options: argparse.Namespace) -> Job:
    """Return the checked job of :func:`add_options`'s options; paths are relative to the current folder.

    Raises:
        LodgsError: neither a job file nor a scene and a run folder, or an invalid value.
    """
    changes = {name: value for name, value in vars(options).items() if name in settings_of(Job)}
    values = {}
    file = options.job
    if file and (run_job := RunFolder(file).job).is_file() and not changes.keys() & {"scene", "out"}:
        file = run_job
    if file and file.is_dir() and "scene" in changes:
        raise LodgsError(
            f"Cannot train: {file} and --scene {changes['scene']} are two folders.", "Give one of them."
        )
    if file and file.is_dir():
        changes = {"scene": str(file)} | changes
    elif file:
        values = asdict(Job.from_file(file, changes.get("preset", "")))
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
    words = option_words(job, exclude)
    if "image_scale" not in exclude and job.image_scale == Job.image_scale != default_image_scale(job.preset):
        words += ["--image-scale", str(job.image_scale)]
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
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = 0.0
        if not name.strip() or not 0 < number < 2**31:
            raise LodgsError(
                f"Cannot read resource {printable(text[:200])}: it is not NAME=NUMBER.",
                "Use for example GPU=1.",
            )
        resources[name.strip()] = number
    return resources or None


def _assignment(text: str) -> tuple[str, object]:
    """Parse ``name=value`` of ``--set``, where the value is JSON (a number, a list) or a plain word."""
    name, _, value = text.partition("=")
    if value.isidentifier() and value not in ("true", "false", "null"):
        return name.strip(), value
    try:
        return name.strip(), parse_json(f'{{"value": {value}}}', "--set")["value"]
    except (LodgsError, KeyError):
        raise LodgsError(
            f"Cannot read --set {printable(text[:200])}: it is not NAME=VALUE.",
            "Use for example max_splats=50000, or 'steps=[100, 200]' for a list.",
        ) from None
