"""``lodgs evaluate``: measure a finished run."""

from __future__ import annotations

import argparse
from pathlib import Path

from .options import add_controls, add_lpips, control_values, lpips_archive, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("run", type=Path, help="run folder")
    add_controls(parser)
    parser.add_argument("--picture", type=Path, help="PNG to write: the levels side by side from one view")
    parser.add_argument(
        "--far", action="store_true", help="also measure levels from 2, 4 and 8 times the distance"
    )
    add_lpips(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..evaluate.lpips import missing_line
    from ..runs.measure import evaluate_run
    from ..runs.report_text import format_report

    weights = lpips_archive(options)
    report = evaluate_run(options.run, control_values(options), options.picture, options.far, warn, weights)
    print(format_report(report))
    if missing := missing_line(weights):
        print(missing)
    return 0
