"""``lodgs page``: write a page that shows levels in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path

from .options import SOURCE_HELP, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Writes a folder with a viewer, all levels for streaming, a list of cameras and a poster. Upload it, "
        "or open it with a local server. It makes no requests to other servers."
    )
    parser.add_argument("source", type=Path, help=SOURCE_HELP)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write; with --single, an HTML file"
    )
    parser.add_argument(
        "--single", action="store_true", help="write one HTML file with one level, which needs no server"
    )
    parser.add_argument("--title", default="", help="title of the page (default: name of the run or file)")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..runs.page.write import write_page

    print(write_page(options.source, options.out, options.single, options.title, warn=warn))
    return 0
