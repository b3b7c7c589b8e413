"""``lodgs compress``: write a compressed copy of a run's levels."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..editing.export import COMPRESSION_SETTINGS, Compression
from .options import SOURCE_HELP, add_setting, setting_values, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Removes splats of low significance and quantises the others, as LightGaussian does. Only LODGS "
        "reads the result; export it as PLY for other programs. Without a run's training views, splats are "
        "only quantised."
    )
    parser.add_argument("source", type=Path, help=SOURCE_HELP)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="PLY to write")
    for f in COMPRESSION_SETTINGS.values():
        add_setting(parser, f)
    parser.add_argument(
        "--run", type=Path, help="run with the training views of a source that is not a run itself"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..runs.compress import compress

    settings = Compression(**setting_values(options, Compression))
    print(compress(options.source, options.out, settings, options.run, warn))
    return 0
