"""``lodgs compare``: compare methods or runs on one page."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import LodgsError
from ..files import check_folder, create_folder
from ..settings import default_of, settings_of
from .options import add_lpips, add_setting, lpips_archive, option_name, parse_factor, require_effect, warn
from .progress import notify, train

_JOB_KEYS = ("preset", "image_scale", "test_every", "seed", "backend")
"""Keys of the jobs that the command trains."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..methods import METHODS
    from ..runs.job import Job

    parser.description = (
        "Measures finished runs of one scene, and writes a page that compares quality, splats, speed and "
        "images. If scenes are named instead, it first trains each method on them. The same command resumes."
    )
    parser.add_argument("sources", type=Path, nargs="+", metavar="SOURCE", help="scenes, or run folders")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR",
        help="folder of results.md, index.html, compare.json and new runs; each of several scenes has a "
        "folder in it",
    )  # fmt: skip
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), metavar="METHOD",
        help="methods to train on a scene (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--effort", type=parse_factor, default=1.0, metavar="N",
        help="fraction of the preset's steps and pixels; images keep 200 pixels on their longer side unless "
        "--image-scale sets their size (default 1)",
    )  # fmt: skip
    add_lpips(parser)
    for name in _JOB_KEYS:
        add_setting(parser, settings_of(Job)[name])


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..files import atomic_write
    from ..runs.comparison.page import compare, format_comparison
    from ..runs.comparison.results import format_results
    from ..runs.folder import RunFolder

    is_run = [RunFolder(source).job.is_file() for source in options.sources]
    if any(is_run) and not all(is_run):
        wrong = next(source for source, known in zip(options.sources, is_run, strict=True) if not known)
        raise LodgsError(f"Cannot compare {wrong}: it is not a run.", "Name scenes only, or runs only.")
    if all(is_run):
        unused = {"--methods": options.methods, "--effort": options.effort != 1}
        require_effect(unused | {option_name(name): name in options for name in _JOB_KEYS}, "scenes")
    weights = lpips_archive(options)
    reports = []
    scenes = [None] if all(is_run) else _scene_folders(options)
    create_folder(options.out)
    for scene in scenes:
        out = options.out if len(scenes) == 1 or scene is None else options.out / scene.resolve().name
        runs = options.sources if scene is None else _train_methods(options, scene, out)
        report = compare(runs, out, warn, notify, weights)
        reports.append(report)
        print(format_comparison(report))
        print(f"{out / 'index.html'}: open it in a browser")
    with atomic_write(options.out / "results.md") as temporary:
        Path(temporary).write_text(format_results(reports), encoding="utf-8")
    return 0


def _scene_folders(options: argparse.Namespace) -> list[Path]:
    """Return the scenes to compare methods on.

    Raises:
        LodgsError: a scene does not exist, or two have the same name.
    """
    from ..runs.several import check_different_names

    for scene in options.sources:
        check_folder(scene, "Name scenes, or runs.")
    check_different_names(options.sources)
    return options.sources


def _train_methods(options: argparse.Namespace, scene: Path, out: Path) -> list[Path]:
    """Train a scene with each method, or resume, and return the folders of the finished runs.

    A method that fails is reported and left out.

    Raises:
        LodgsError: every method fails.
        KeyboardInterrupt: training was cancelled.
    """
    from ..methods import METHODS
    from ..runs.job import Job
    from ..runs.several import NamedJob, ReducedJobs, train_in_turn

    preset = vars(options).get("preset", default_of(settings_of(Job)["preset"]))
    keys = {name: vars(options)[name] for name in _JOB_KEYS if name in options}
    reduced = ReducedJobs(scene, preset, options.effort, keys)
    jobs = [
        NamedJob(f"{METHODS[name].label} on {scene.resolve().name}", reduced.job(name, out / "runs" / name))
        for name in options.methods or METHODS
    ]
    runs = []
    for (_, job), problem in zip(jobs, train_in_turn(jobs, train, notify), strict=True):
        if problem:
            warn(f"{METHODS[job.method].label} is left out: {problem}")
        else:
            runs.append(Path(job.out))
    if not runs:
        raise LodgsError(f"Cannot compare methods on {scene}: none could be trained.", "Check the scene.")
    return runs
