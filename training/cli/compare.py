"""``lodgs compare``: compare methods or runs on one page."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import LodgsError
from ..files import check_folder, create_folder
from ..settings import settings_of
from .options import add_setting, warn
from .progress import notify, train

_JOB_KEYS = ("preset", "image_scale", "test_every", "seed", "backend")
"""Keys of the jobs that the command trains."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..methods import METHODS
    from ..runs.job import Job

    parser.description = (
        "Measures finished runs of one scene, and writes a page that compares quality, splats, speed and "
        "images. For a scene, it first trains each method."
    )
    parser.add_argument("sources", type=Path, nargs="+", metavar="SOURCE", help="a scene, or run folders")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR",
        help="folder of index.html, compare.json and new runs",
    )  # fmt: skip
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), metavar="METHOD",
        help="methods to train on a scene (default: all)",
    )  # fmt: skip
    for name in _JOB_KEYS:
        add_setting(parser, settings_of(Job)[name])


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..runs.comparison.page import compare, format_comparison
    from ..runs.folder import RunFolder

    create_folder(options.out)
    is_run = [RunFolder(source).job.is_file() for source in options.sources]
    if all(is_run):
        runs = options.sources
    elif len(is_run) == 1:
        runs = _train_methods(options)
    else:
        wrong = next(source for source, known in zip(options.sources, is_run, strict=True) if not known)
        raise LodgsError(f"Cannot compare {wrong}: it is not a run.", "Name one scene, or runs only.")
    report = compare(runs, options.out, warn, notify)
    print(format_comparison(report))
    print(f"{options.out / 'index.html'}: open it in a browser")
    return 0


def _train_methods(options: argparse.Namespace) -> list[Path]:
    """Train a scene with each method, or resume, and return the folders of the finished runs.

    A method that fails is reported and left out.

    Raises:
        LodgsError: every method fails.
        KeyboardInterrupt: training was cancelled.
    """
    from ..methods import METHODS
    from ..runs.job import Job

    (scene,) = options.sources
    check_folder(scene, "Name a scene, or runs.")
    keys = {"scene": str(scene)} | {name: vars(options)[name] for name in _JOB_KEYS if name in options}
    names = options.methods or list(METHODS)
    runs = []
    for number, name in enumerate(names, 1):
        label = METHODS[name].label
        text = f"Training {label} ({number} of {len(names)})"
        folder = options.out / "runs" / name
        if problem := train(Job.from_dict({**keys, "method": name, "out": str(folder)}), text):
            warn(f"{label} is left out: {problem}")
        else:
            runs.append(folder)
    if not runs:
        raise LodgsError(f"Cannot compare methods on {scene}: none could be trained.", "Check the scene.")
    return runs
