"""``lodgs serve``: render frames for Blender, which sends requests to standard input."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .options import BACKEND_HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "folder", type=Path, help="new or empty folder for arrays, removed when the server ends"
    )
    parser.add_argument("--backend", default="auto", help=BACKEND_HELP)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..render.serve import serve

    return serve(options.folder, options.backend, sys.stdin.buffer, sys.stdout)
