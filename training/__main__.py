"""The trainer's command line: ``python -m training --help``, run from the folder that holds ``training``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from .errors import LodgsError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m training", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    train = commands.add_parser("train", help="run a job, or resume the run that it began")
    train.add_argument("job", type=Path, help="job file (TOML or JSON); a run's own job.toml resumes it")

    evaluate = commands.add_parser("evaluate", help="measure a finished run on its held-out views")
    evaluate.add_argument("run", type=Path, help="run folder")
    evaluate.add_argument(
        "--gamma", type=float, default=1.0, help="screen size threshold in pixels (default 1)"
    )
    evaluate.add_argument(
        "--from", type=int, default=0, dest="start", help="coarsest level of the selective view"
    )
    evaluate.add_argument("--to", type=int, default=0, dest="end", help="finest level of the selective view")
    evaluate.add_argument(
        "--offset", type=float, default=0.0, help="levels finer or coarser than the distance asks (Octree-GS)"
    )
    evaluate.add_argument("--picture", type=Path, help="PNG to write: the levels side by side from one view")

    evaluate.add_argument(
        "--far", action="store_true", help="measure as well how levels do from 2, 4 and 8 times the distance"
    )

    info = commands.add_parser("info", help="say what a bundle or any 3DGS PLY holds")
    info.add_argument("file", type=Path)

    commands.add_parser("check", help="say as JSON whether this Python can train")

    chosen = parser.parse_args(arguments)
    try:
        code = _COMMANDS[chosen.command](chosen)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever read our output has seen enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return 0
    except LodgsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _train(chosen: argparse.Namespace) -> int:
    from .runs.folder import event_line
    from .runs.job import Job

    try:
        job = Job.from_file(chosen.job)
        problems = _environment()["problems"]
        if problems:
            raise LodgsError(problems[0], "Install the packages of requirements/trainer.txt.")
    except LodgsError as error:
        print(event_line("error", what=error.what, remedy=error.remedy), flush=True)
        return 2
    from .runs.train import train

    return train(job, sys.stdout)


def _evaluate(chosen: argparse.Namespace) -> int:
    from .evaluate.protocol import evaluate_run, table
    from .lod.selection import Detail

    detail = Detail(chosen.gamma, chosen.start, chosen.end, chosen.offset)
    print(table(evaluate_run(chosen.run, detail, chosen.picture, chosen.far)))
    return 0


def _info(chosen: argparse.Namespace) -> int:
    from .splats.bundle import describe

    print(describe(chosen.file))
    return 0


def _check(_: argparse.Namespace) -> int:
    found = _environment()
    print(json.dumps(found))
    return 0 if found["ok"] else 2


def _environment() -> dict:
    """Versions of what training needs, and one sentence for each thing that is missing or too old."""
    from importlib import metadata

    from . import VERSION

    found: dict = {"lodgs": VERSION, "python": sys.version.split()[0], "executable": sys.executable}
    problems = []
    minimum = {"torch": "2.4", "numba": "0.60", "numpy": "1.26", "scipy": "1.11", "pycolmap": "3.11",
               "plyfile": "1.0", "pillow": "10.0", "OpenEXR": "3.3", "torchmetrics": "1.4"}  # fmt: skip
    for package, oldest in minimum.items():
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            problems.append(f"The package {package} is missing in {sys.executable}.")
            continue
        if _numbers(found[package]) < _numbers(oldest):
            problems.append(f"{package} is {found[package]}; training needs {oldest} or newer.")
    return {**found, "ok": not problems, "problems": problems}


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split("+", maxsplit=1)[0].split(".")[:2] if part.isdigit()]


_COMMANDS = {"train": _train, "evaluate": _evaluate, "info": _info, "check": _check}

if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # native thread pools can hang a normal exit
