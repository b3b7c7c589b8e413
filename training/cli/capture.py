"""``lodgs capture``: render views of splats as a COLMAP scene to train from."""

from __future__ import annotations

import argparse
from pathlib import Path

from .options import BACKEND_HELP, SOURCE_HELP, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, help=SOURCE_HELP)
    parser.add_argument("--out", type=Path, required=True, help="new folder for the scene")
    parser.add_argument(
        "--cameras", type=Path, metavar="DIR",
        help="folder of camera files (*.json) to render (default: cameras all around)",
    )  # fmt: skip
    parser.add_argument("--views", type=int, default=64, help="number of cameras all around (default 64)")
    parser.add_argument("--view-width", type=int, default=960, help="their width in pixels (default 960)")
    parser.add_argument("--backend", default="auto", help=BACKEND_HELP)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..runs.capture import capture
    from ..runs.job import DOME, check_views

    check_views(options.views, options.view_width)
    views, points = capture(
        options.source, options.out, options.cameras or DOME, options.views, options.view_width,
        backend=options.backend, warn=warn,
    )  # fmt: skip
    print(f"{options.out}: {views} views, {points:,} points")
    return 0
