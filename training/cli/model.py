"""``lodgs model``: write the COLMAP model of views that Blender captured."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("folder", type=Path, help="folder that `blender --command lodgs capture` filled")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..scenes.rendered_views import write_rendered_model

    views, points = write_rendered_model(options.folder)
    print(f"{options.folder}: {views} views, {points:,} points")
    return 0
