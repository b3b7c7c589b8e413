"""``lodgs reproduce``: measure the tables of a paper on scenes."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..files import check_folder, create_folder
from ..settings import settings_of
from .options import add_setting, parse_factor, warn
from .progress import notify, train

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "lantern_garden"
"""Example scene of a source folder."""

_JOB_KEYS = ("image_scale", "test_every", "seed", "backend")
"""Keys of the jobs that the command trains."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..runs.job import Job
    from ..runs.reproduction.run import PAPERS

    parser.description = (
        "Trains the runs behind the tables of a paper with the preset paper, prints our values beside those "
        "of the paper, and says which trends hold. The same command resumes."
    )
    parser.add_argument("paper", choices=PAPERS, help="method of the paper")
    parser.add_argument(
        "--scene", type=Path, nargs="+", default=[], metavar="DIR", dest="scenes",
        help="COLMAP scenes; values are means over them (default: the example of a source folder)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of tables and runs")
    parser.add_argument(
        "--tables", nargs="+", default=(), metavar="N",
        help="numbers of tables, or names such as 'Figure 3' (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--effort", type=parse_factor, default=1.0, metavar="N",
        help="fraction of the paper's steps and pixels; images keep 200 pixels on their longer side unless "
        "--image-scale sets their size; trends of short trainings are uncertain (default 1)",
    )  # fmt: skip
    for name in _JOB_KEYS:
        add_setting(parser, settings_of(Job)[name])


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..runs.reproduction.run import reproduce

    scenes = options.scenes or [EXAMPLE]
    for scene in scenes:
        check_folder(scene, "Name a scene with --scene.")
    create_folder(options.out)
    keys = {name: vars(options)[name] for name in _JOB_KEYS if name in options}
    print(reproduce(
        options.paper, scenes, options.out, train,
        tables=options.tables, effort=options.effort, keys=keys, warn=warn, notify=notify,
    ))  # fmt: skip
    return 0
