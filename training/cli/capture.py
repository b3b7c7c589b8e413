"""``lodgs capture``: render views of splats as a COLMAP scene to train from."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..runs.job import AUTO, KEYS
from ..settings import check_value
from .options import BACKEND_HELP, SOURCE_HELP, add_setting, option_name, require_effect, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, help=SOURCE_HELP)
    parser.add_argument("--out", type=Path, required=True, help="new folder for the scene")
    parser.add_argument(
        "--cameras", type=Path, metavar="DIR",
        help="folder of camera files (*.json) to render (default: cameras of the source, else all around and "
        "close to the surface)",
    )  # fmt: skip
    for name in ("views", "view_width"):
        add_setting(parser, KEYS[name], KEYS[name].default)
    parser.add_argument("--backend", default="auto", help=BACKEND_HELP)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..runs.capture import capture

    for name in ("views", "view_width"):
        check_value(KEYS[name], getattr(options, name))
        if options.cameras:
            changed = getattr(options, name) != KEYS[name].default
            require_effect({option_name(name): changed}, "views without --cameras")
    views, points = capture(
        options.source, options.out, options.cameras or AUTO, options.views, options.view_width,
        backend=options.backend, warn=warn,
    )  # fmt: skip
    print(f"{options.out}: {views} views, {points:,} points")
    return 0
