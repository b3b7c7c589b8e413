"""``lodgs train``: train splats, or resume a run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import LodgsError, error_cause
from ..runs.folder import RunFolder
from ..scenes.check import ERROR, ESTIMATE, INFO, Finding
from . import check
from .job_options import add_options, job_from_options

if TYPE_CHECKING:
    from ..runs.job import Job


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Prints events as JSON, one per line."
    add_options(parser)
    parser.add_argument(
        "--check", action="store_true",
        help="check the scene instead, and print findings that lower the quality, with their remedies, and "
        "the expected time, memory and disk space; exit code 2 if training is impossible",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    if options.check:
        return check_job(options)
    return train_job(lambda: job_from_options(options))


def check_job(options: argparse.Namespace) -> int:
    """Print the findings about the scene of a job and return the exit code."""
    from ..scenes.check import check_folder

    if not (options.job and (options.job.is_file() or RunFolder(options.job).job.is_file())):
        vars(options).setdefault("out", "run")  # nothing is written
    job = job_from_options(options)
    model, images = job.model_and_images
    scale, exposure = job.image_scale, job.exposure
    findings = []
    if not job.capture:  # it renders its own views
        findings = check_folder(Path(job.scene), model, images, image_scale=scale, exposure=exposure)
    for finding in findings:
        print(f"{finding.severity}: {finding}")
    if not job.capture and all(finding.severity == INFO for finding in findings):
        print("Nothing found that lowers the quality.", flush=True)
    if any(finding.severity == ERROR for finding in findings):
        return 2
    for finding in estimate_lines(job):
        print(f"{finding.severity}: {finding}")
    return 0


def estimate_lines(job: Job) -> list[Finding]:
    """Return the expected costs of a job, if this Python can train."""
    problems = check.environment()["problems"]
    if problems:
        return [Finding(ESTIMATE, f"No estimate: {problems[0]}", check.INSTALL)]
    from ..runs.estimate import estimate_findings

    return estimate_findings(job)


def train_job(make_job: Callable[[], Job], **placement: Any) -> int:
    """Train a job and report errors in it as events.

    Args:
        make_job: returns the job; may raise a LodgsError.
        placement: arguments of ``runs.train.train``.

    Returns:
        Exit code.
    """
    from ..runs.events import event_line

    try:
        job = make_job()
        problems = check.environment()["problems"]
        if problems:
            raise LodgsError(problems[0], check.INSTALL)
        from ..runs.train import train
    except LodgsError as error:
        _print(event_line("error", what=error.what, remedy=error.remedy, cause=error_cause(error)))
        return 2
    except KeyboardInterrupt:
        _print(event_line("cancelled", message="Stopped before training began."))
        return 3
    return train(job, sys.stdout, **placement)


def _print(line: str) -> None:
    with suppress(OSError):  # a full disk
        print(line, flush=True)
