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
    _add_detail(evaluate)
    evaluate.add_argument("--picture", type=Path, help="PNG to write: the levels side by side from one view")
    evaluate.add_argument(
        "--far", action="store_true", help="measure as well how levels do from 2, 4 and 8 times the distance"
    )

    render = commands.add_parser("render", help="draw one view as a PNG, or an EXR with depth and levels")
    render.add_argument("source", type=Path, help="bundle, folder of levels, any 3DGS PLY, or a run's folder")
    eye = render.add_mutually_exclusive_group(required=True)
    eye.add_argument("--camera", type=Path, help="JSON file of a camera, as Blender's LODGS tab writes it")
    eye.add_argument("--view", metavar="IMAGE", help="name of a photograph that the splats were trained from")
    render.add_argument("--scene", type=Path, help="COLMAP folder of the photographs, where no run knows it")
    render.add_argument("--out", type=Path, required=True, help="picture to write: .png or .exr")
    render.add_argument("--size", type=_size, metavar="WxH", help="pixels; otherwise the camera's own")
    render.add_argument("--level", type=int, default=0, help="level to draw (otherwise the finest)")
    by_distance = render.add_argument_group("levels by distance, where one of these is given")
    _add_detail(by_distance, default=None)
    render.add_argument(
        "--background",
        type=_colour,
        default=(0.0, 0.0, 0.0),
        metavar="COLOUR",
        help="behind the splats: R,G,B from 0 to 1 as a display has them, or transparent (default black)",
    )
    render.add_argument(
        "--holdout",
        type=Path,
        metavar="DEPTH.exr",
        help="leave out what lies behind this Depth pass of meshes",
    )
    render.add_argument("--backend", default="auto", help="auto, cpu, cuda or reference")

    serve = commands.add_parser("serve", help="draw frame after frame for Blender")
    serve.add_argument("folder", type=Path, help="folder for arrays; removed at the end")
    serve.add_argument("--backend", default="auto", help="auto, cpu, cuda or reference")

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


def _add_detail(parser, default: float | None = 0) -> None:
    """Options of ``lod.selection.Detail``; those not given are the default."""
    gamma = 1.0 if default is not None else None
    parser.add_argument(
        "--gamma", type=float, default=gamma, help="screen size threshold in pixels (default 1)"
    )
    parser.add_argument(
        "--from", type=int, default=default, dest="start", help="coarsest level of the selective view"
    )
    parser.add_argument(
        "--to", type=int, default=default, dest="end", help="finest level of the selective view"
    )
    parser.add_argument(
        "--offset",
        type=float,
        default=default,
        help="levels finer or coarser than the distance asks (Octree-GS)",
    )


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text} is not WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def _colour(text: str) -> tuple[float, float, float] | None:
    if text == "transparent":
        return None
    try:
        red, green, blue = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text} is not R,G,B, such as 0,0.5,1, nor transparent") from None
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise argparse.ArgumentTypeError(f"{text} has a value that is not between 0 and 1")
    return red, green, blue


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


def _render(chosen: argparse.Namespace) -> int:
    from .lod.selection import Detail
    from .render.command import Source, render
    from .scenes.cameras import read_camera

    asked = {name: getattr(chosen, name) for name in ("gamma", "start", "end", "offset")}
    asked = {name: value for name, value in asked.items() if value is not None}
    if asked and chosen.level:
        raise LodgsError("--level draws one level, the other options levels by distance.", "Choose one.")
    source = Source.read(chosen.source)
    camera, near = read_camera(chosen.camera) if chosen.camera else source.view(chosen.view, chosen.scene)
    if chosen.size:
        camera = camera.resized(*chosen.size)
    render(
        source, camera, near, chosen.out, level=chosen.level, detail=Detail(**asked) if asked else None,
        background=chosen.background, holdout=chosen.holdout, backend=chosen.backend,
    )  # fmt: skip
    return 0


def _serve(chosen: argparse.Namespace) -> int:
    from .render.serve import serve

    return serve(chosen.folder, chosen.backend, sys.stdin, sys.stdout)


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


_COMMANDS = {
    "train": _train, "evaluate": _evaluate, "render": _render, "serve": _serve, "info": _info,
    "check": _check,
}  # fmt: skip

if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # native thread pools can hang a normal exit
