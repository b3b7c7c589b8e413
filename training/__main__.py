"""The trainer's command line: ``lodgs --help``, or ``python -m training --help`` beside ``training``."""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import signal
import sys
import tomllib
from collections.abc import Callable
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from . import VERSION
from .errors import LodgsError, is_out_of_memory

if TYPE_CHECKING:
    from .runs.job import Job
    from .splats.similarity import Similarity

PROGRAM = "lodgs" if __package__ == "lodgs" else "python -m training"
_OTHERS = " (and, with splat-transform, .spz, .sog and others: see docs/formats.md)"
_INSTALL = "Install the packages of requirements/trainer.txt."


def main(arguments: list[str] | None = None) -> int:
    """Runs one command.

    Args:
        arguments: what follows the program's name; None for those of this process.

    Returns:
        An exit code: 0 done, 1 crash, 2 bad input, 3 cancelled. Mistakes are told in a sentence.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what is read by programs is UTF-8, whatever a console has
            stream.reconfigure(encoding=None if stream.isatty() else "utf-8", errors="backslashreplace")
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["check"]:  # answers in any Python of this version, with the standard library alone
        return _check()
    try:
        chosen = _parser().parse_args(arguments)
        code = _COMMANDS[chosen.command](chosen)
        if chosen.command not in ("train", "blocks"):  # whose run's folder has all that it prints
            sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever read our output has seen enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return 0
    except LodgsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        print("error: There is not enough memory. Close other programs, or ask for less.", file=sys.stderr)
        return 2
    except OSError as error:
        about = f" ({error.filename})" if error.filename else ""
        print(f"error: {error.strerror or error}{about}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 3
    except ModuleNotFoundError:
        if not (problems := _environment()["problems"]):
            raise
        print(f"error: {problems[0]} {_INSTALL}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    from .cli.job_options import add_options, parse_size
    from .scenes.reconstruct import LENSES, PRESETS
    from .splats.formats import FORMATS

    parser = argparse.ArgumentParser(prog=PROGRAM, description="Gaussian splats with levels of detail.")
    parser.add_argument("--version", action="version", version=f"lodgs {VERSION}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser(
        "train",
        help="photographs to splats, or resume the run that the same command began",
        description="Says what happens as JSON, one event a line.",
    )
    add_options(train)

    blocks = commands.add_parser("blocks", help="a scene that is too large for one run, in cells")
    whats = blocks.add_subparsers(dest="what", required=True, metavar="WHAT")
    plan = whats.add_parser(
        "plan", help="divide a job into blocks, each an ordinary run, and say what each takes"
    )
    add_options(plan)
    plan.add_argument(
        "--block-splats", type=_amount, default=0, metavar="N",
        help="instead of --cells: as few cells as have N splats each, at most",
    )  # fmt: skip
    plan.add_argument(
        "--block-memory", type=_amount, default=0, metavar="MB",
        help="instead of --cells: as few as take so much memory each, by the plan's estimate",
    )  # fmt: skip
    goes = whats.add_parser("run", help="train the blocks of a plan, or go on, and put them together")
    goes.add_argument("run", type=Path, help="run folder of the plan")
    goes.add_argument(
        "--on", default="here", metavar="WHERE",
        help="here, one by one (default); local:N, N at a time; or a Dask scheduler, tcp://HOST:8786",
    )  # fmt: skip
    goes.add_argument(
        "--only", metavar="PART",
        help="train here this part alone: coarse, block-3 or seam-3; nothing where there is none",
    )  # fmt: skip
    goes.add_argument(
        "--takes", action="append", default=[], metavar="NAME=NUMBER",
        help="what each block takes of the resources that Dask workers have, such as GPU=1",
    )  # fmt: skip

    methods = commands.add_parser("methods", help="say which methods there are, or what one can be told")
    methods.add_argument("name", nargs="?", metavar="NAME", help="method whose parameters to list")

    evaluate = commands.add_parser(
        "evaluate", help="measure a finished run, also a step aside of its photographs"
    )
    evaluate.add_argument("run", type=Path, help="run folder")
    _add_controls(evaluate)
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
    render.add_argument("--size", type=parse_size, metavar="WxH", help="pixels; otherwise the camera's own")
    render.add_argument("--level", type=int, default=0, help="level to draw (otherwise the finest)")
    render.add_argument(
        "--by-distance", action="store_true", help="draw levels by distance; so does any of these:"
    )
    _add_controls(render)
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
    render.add_argument("--backend", default="auto", help="auto, cpu, cuda, gpu or reference")

    capture = commands.add_parser(
        "capture", help="pictures of splats that have no photographs, as a COLMAP scene to train from"
    )
    capture.add_argument(
        "source", type=Path, help="bundle, folder of levels, any 3DGS PLY, or a run's folder"
    )
    capture.add_argument("--out", type=Path, required=True, help="folder of the scene; not there yet")
    capture.add_argument(
        "--cameras", type=Path, metavar="DIR", help="camera files (*.json) to draw; otherwise from all around"
    )
    capture.add_argument("--views", type=int, default=64, help="how many from all around (default 64)")
    capture.add_argument(
        "--view-width", type=int, default=960, help="pixels that these are wide (default 960)"
    )
    capture.add_argument("--backend", default="auto", help="auto, cpu, cuda, gpu or reference")

    scene = commands.add_parser(
        "scene",
        help="photographs alone, or what another program has exported, as a COLMAP scene",
        description="Given again, finding the cameras of photographs goes on where it stopped.",
    )
    given = scene.add_mutually_exclusive_group(required=True)
    given.add_argument(
        "--photos", type=Path, metavar="DIR", help="folder of photographs, whose cameras are to be found"
    )
    given.add_argument(
        "--from", dest="source", type=Path, metavar="DIR",
        help="folder of the export, told by what is in it: transforms.json (nerfstudio, instant-ngp, "
        "NeRF-synthetic), Polycam, Record3D, Metashape XML, OpenMVG, Bundler",
    )  # fmt: skip
    scene.add_argument(
        "--out", type=Path, metavar="DIR",
        help="folder that becomes the scene; of an export otherwise the folder itself",
    )  # fmt: skip
    scene.add_argument(
        "--preset", choices=list(PRESETS), default="draft",
        help="features of photographs 1000 pixels wide (default), or twice as many, of 1600 pixels",
    )  # fmt: skip
    scene.add_argument(
        "--ordered", action="store_true", help="names follow the way that was walked: compares neighbours"
    )
    scene.add_argument(
        "--lens", choices=LENSES, default="",
        help="which photographs one lens took: all, those of a folder, or each its own (otherwise one, if "
        "all are of one size)",
    )  # fmt: skip
    scene.add_argument(
        "--masks", type=Path, metavar="DIR",
        help="pictures that are black where nothing is to be recognised: of a.jpg a.jpg.png, or a.png",
    )  # fmt: skip

    undistort = commands.add_parser(
        "undistort", help="undo a scene's lens distortion once, for all runs and for Blender"
    )
    undistort.add_argument("scene", type=Path, help="COLMAP folder")
    undistort.add_argument("--model", type=Path, metavar="DIR", help="folder of its model")
    undistort.add_argument("--images", type=Path, metavar="DIR", help="folder of its photographs")

    model = commands.add_parser(
        "model", help="views that Blender captured of its own scene, as the COLMAP model of their folder"
    )
    model.add_argument("folder", type=Path, help="what `blender --command lodgs capture` has filled")

    serve = commands.add_parser("serve", help="draw frame after frame for Blender")
    serve.add_argument("folder", type=Path, help="folder for arrays, new or empty; removed at the end")
    serve.add_argument("--backend", default="auto", help="auto, cpu, cuda, gpu or reference")

    edit = commands.add_parser(
        "edit",
        help="a copy without clutter (what lies outside of crops, floaters, ...), in another look, or turned,"
        " scaled and moved",
        description="Every level is edited alike, and stays what its rule chooses from. Places and lengths "
        "of what goes are in the splats' own units; lodgs info tells their bounds. What is left is turned "
        "first, then scaled, then moved. Numbers below 0 go behind a =, as in --translate=-1,0,2.",
    )
    edit.add_argument(
        "source", type=Path, help=f"bundle, folder of levels, a run's folder, any 3DGS PLY{_OTHERS}"
    )
    edit.add_argument("--out", type=Path, help="file, or folder, to write in the form of the source")
    edit.add_argument(
        "--plain", type=Path, action="append", default=[], metavar="FILE",
        help="file of the finest level alone: " + ", ".join(kind.suffix for kind in FORMATS),
    )  # fmt: skip
    edit.add_argument("--folder", type=Path, metavar="DIR", help="folder of levels to write")
    edit.add_argument(
        "--streamed",
        type=Path,
        metavar="DIR",
        help="folder of levels to write as browsers load them",
    )
    edit.add_argument(
        "--antialiased", action="store_true",
        help="--plain and --streamed are for programs that know Mip-Splatting's filter: opacities stay as "
        "they were trained",
    )  # fmt: skip
    edit.add_argument(
        "--crop-box", type=float, nargs=6, action="append", default=[], metavar="N",
        help="two opposite corners of a box, X Y Z X Y Z; of several boxes and spheres any one counts",
    )  # fmt: skip
    edit.add_argument(
        "--crop-sphere", type=float, nargs=4, action="append", default=[], metavar="N",
        help="centre and radius of a sphere, X Y Z R",
    )  # fmt: skip
    edit.add_argument(
        "--keep", choices=("inside", "outside", "all"), default="inside",
        help="what stays of boxes and spheres (default inside); all: nothing goes, the look counts in them",
    )  # fmt: skip
    edit.add_argument(
        "--max-size", type=float, metavar="N", help="drop splats with a larger standard deviation"
    )
    edit.add_argument("--min-opacity", type=float, metavar="N", help="drop fainter splats; from 0 to 1")
    edit.add_argument(
        "--drop-floaters", action="store_true", help="drop clusters of few splats with nothing near them"
    )
    edit.add_argument(
        "--gap", type=float, metavar="N",
        help="how far off floaters are at least (otherwise by how far most splats reach)",
    )  # fmt: skip
    edit.add_argument(
        "--share", type=float, metavar="N",
        help="how large clusters of floaters are at most, as a share of all splats (default 0.001)",
    )  # fmt: skip
    edit.add_argument(
        "--scene",
        type=Path,
        metavar="DIR",
        help="COLMAP folder of the photographs, for --max-distance, --min-views and --ground",
    )
    edit.add_argument(
        "--max-distance", type=float, metavar="N", help="drop splats farther from every photograph's eye"
    )
    edit.add_argument(
        "--min-views", type=int, metavar="N", help="drop splats in the frames of fewer photographs"
    )
    places = edit.add_argument_group("where what is left stands")
    _add_placement(places)
    places.add_argument(
        "--ground", action="store_true", help="first stand upright, with the ground that is found at z = 0"
    )
    look = edit.add_argument_group("look, of all that stays, or with --keep all in boxes and spheres")
    look.add_argument("--exposure", type=float, metavar="N", help="stops: 1 is twice the light")
    look.add_argument(
        "--temperature", type=float, metavar="K",
        help="white balance: the light that is to look white, in kelvins; above 6500 warmer",
    )  # fmt: skip
    look.add_argument("--tint", type=float, nargs=3, metavar="N", help="colour that white gets, each 0 to 1")
    look.add_argument("--saturation", type=float, metavar="N", help="0 is grey, 1 as it is")
    look.add_argument("--opacity", type=float, metavar="N", help="factor on opacities, 0 to 1")

    info = commands.add_parser("info", help="say what a bundle or any 3DGS PLY holds")
    info.add_argument("file", type=Path)

    commands.add_parser("check", help="say as JSON whether this Python can train")
    devices = commands.add_parser("devices", help="say what this computer can train on, and try it")
    devices.add_argument("--time", action="store_true", help="measure a training step on each, too")
    devices.add_argument(
        "--json", action="store_true", help="only what drivers say, as JSON; nothing is tried"
    )

    return parser


def _add_placement(parser: argparse._ActionsContainer) -> None:
    """The options that place splats elsewhere."""
    parser.add_argument(
        "--upright", action="store_true", help="first turn as the file says that its scene stands upright"
    )
    parser.add_argument(
        "--rotate", type=_reals(3), default=(0, 0, 0), metavar="X,Y,Z",
        help="degrees about x, then y, then z, as Blender's Euler angles",
    )  # fmt: skip
    parser.add_argument("--scale", type=float, default=1.0, metavar="N", help="times the size")
    parser.add_argument(
        "--translate", type=_reals(3), default=(0, 0, 0), metavar="X,Y,Z", help="shift in the new units"
    )
    parser.add_argument(
        "--matrix", type=_reals(16), metavar="A,B,...",
        help="16 numbers, row by row, instead of these three; no stretching, shearing, mirroring",
    )  # fmt: skip


def _placement(chosen: argparse.Namespace) -> Similarity | None:
    """What the options of :func:`_add_placement` say but for --upright; None: nothing."""
    import numpy as np

    from .splats.similarity import Similarity

    unmoved = (chosen.rotate, chosen.scale, chosen.translate) == ((0, 0, 0), 1.0, (0, 0, 0))
    if chosen.matrix is None:
        return None if unmoved else Similarity.from_angles(chosen.rotate, chosen.scale, chosen.translate)
    if not unmoved:
        raise LodgsError("--matrix says all that --rotate, --scale and --translate say.", "Choose one.")
    return Similarity.from_matrix(np.reshape(chosen.matrix, (4, 4)))


def _add_controls(parser: argparse.ArgumentParser) -> None:
    """An option for each control that any rule has."""
    from .lod.rule import every_control

    group = parser.add_argument_group("levels by distance, as their method's rule has it")
    for control in every_control().values():
        default = "" if control.follows else f" (default {control.default:g}, or what the file records)"
        group.add_argument(
            f"--{control.name.replace('_', '-')}", type=int if control.whole else float, metavar="N",
            help=control.about.replace("%", "%%") + default,
        )  # fmt: skip


def _controls(chosen: argparse.Namespace) -> dict[str, float]:
    """The controls that were given, by name."""
    from .lod.rule import every_control

    asked = {name: getattr(chosen, name) for name in every_control()}
    return {name: value for name, value in asked.items() if value is not None}


def _amount(text: str) -> int:
    if text.isdecimal() and 0 < int(text) < 2**31:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text} is no whole number above 0")


def _reals(count: int) -> Callable[[str], tuple[float, ...]]:
    """What reads so many numbers between commas."""

    def read(text: str) -> tuple[float, ...]:
        try:
            found = tuple(map(float, text.split(",")))
        except ValueError:
            found = ()
        if len(found) != count:
            raise argparse.ArgumentTypeError(f"{text} is not {count} numbers with commas between them")
        return found

    return read


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
    from .cli.job_options import job_from_options

    return _trained(lambda: job_from_options(chosen))


def _trained(job_of: Callable[[], Job], **where: Any) -> int:
    """Trains a job; whatever is wrong with it is told as the run's events are."""
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):  # the last is Windows' CTRL_BREAK_EVENT
        if hasattr(signal, name):  # heard also while torch loads, which takes seconds
            signal.signal(getattr(signal, name), signal.default_int_handler)
    from .runs.events import event_line

    try:
        job = job_of()
        problems = _environment()["problems"]
        if problems:
            raise LodgsError(problems[0], _INSTALL)
        from .runs.train import train
    except LodgsError as error:
        print(event_line("error", what=error.what, remedy=error.remedy), flush=True)
        return 2
    except KeyboardInterrupt:
        print(event_line("cancelled", message="Stopped before training began."), flush=True)
        return 3
    return train(job, sys.stdout, **where)


def _blocks(chosen: argparse.Namespace) -> int:
    return (_plan_blocks if chosen.what == "plan" else _run_blocks)(chosen)


def _plan_blocks(chosen: argparse.Namespace) -> int:
    from .cli.job_options import job_from_options
    from .runs.blocks.plan import choose_cells, plan, plan_table, read_planned_scene, write_plan
    from .runs.folder import RunFolder
    from .runs.job import save_job

    job = job_from_options(chosen).resolved()
    scene = read_planned_scene(job)
    if chosen.block_splats or chosen.block_memory:
        if job.cells:
            raise LodgsError("It is said how many cells, and how large they may be.", "Leave out one.")
        job = job.with_cells(choose_cells(job, chosen.block_splats, chosen.block_memory * 10**6, scene))
    if not job.cells:
        raise LodgsError(
            "It is not said how many cells.",
            "Add --cells 2x4, for 2 columns of 4 each, or --block-splats 1000000.",
        )
    planned = plan(job, scene)
    folder = RunFolder(job.out)
    folder.create()
    if folder.job.exists():
        save_job(job, folder)
    write_plan(job, folder, scene, planned)
    save_job(job, folder)  # now that it can be
    print(plan_table(planned))
    print(f"Train them with: {PROGRAM} blocks run {folder.path}", flush=True)
    return 0


def _run_blocks(chosen: argparse.Namespace) -> int:
    from .cli.job_options import parse_resources
    from .runs.blocks.plan import read_plan, read_planned_job
    from .runs.blocks.train import prepare_part
    from .runs.folder import RunFolder

    if not chosen.only:
        return _trained(
            lambda: read_planned_job(chosen.run), on=chosen.on, resources=parse_resources(chosen.takes)
        )
    division = read_plan(RunFolder(chosen.run))
    part = division.part(chosen.only)
    if part is None:
        return 0
    prepare_part(division, part)
    return _trained(lambda: part.job)


def _methods(chosen: argparse.Namespace) -> int:
    from .cli.methods import describe_method, describe_methods

    print(describe_method(chosen.name) if chosen.name else describe_methods())
    return 0


def _evaluate(chosen: argparse.Namespace) -> int:
    from .runs.measure import evaluate_run, format_report

    print(format_report(evaluate_run(chosen.run, _controls(chosen), chosen.picture, chosen.far, _warn)))
    return 0


def _render(chosen: argparse.Namespace) -> int:
    from .lod.rule import find_rule
    from .lod.selection import unknown_rule
    from .render.command import RenderSource, render
    from .scenes.cameras import check_render_size, read_camera

    if chosen.size:
        check_render_size(*chosen.size)
    given = _controls(chosen)
    if (given or chosen.by_distance) and chosen.level:
        raise LodgsError("--level draws one level, the other options levels by distance.", "Choose one.")
    source = RenderSource.read(chosen.source, _warn)
    camera, near = read_camera(chosen.camera) if chosen.camera else source.view(chosen.view, chosen.scene)
    if chosen.size:
        camera = camera.resized(*chosen.size)
    by_distance = given if given or chosen.by_distance else None
    if source.rule and find_rule(source.rule) is None and by_distance is None and not chosen.level:
        _warn(" ".join(unknown_rule(source.rule)))
    drawn = render(
        source, camera, near, chosen.out, level=chosen.level, given=by_distance,
        background=chosen.background, holdout=chosen.holdout, backend=chosen.backend, warn=_warn,
    )  # fmt: skip
    read = f" of {drawn.bytes_read / 1e6:.1f} MB" if drawn.bytes_read else ""
    print(f"{chosen.out}: {drawn.loaded:,} splats loaded{read}")
    return 0


def _capture(chosen: argparse.Namespace) -> int:
    from .runs.capture import capture
    from .runs.job import DOME, check_views

    check_views(chosen.views, chosen.view_width)
    views, points = capture(
        chosen.source, chosen.out, chosen.cameras or DOME, chosen.views, chosen.view_width,
        backend=chosen.backend, warn=_warn,
    )  # fmt: skip
    print(f"{chosen.out}: {views} views, {points:,} points")
    return 0


def _scene(chosen: argparse.Namespace) -> int:
    if chosen.photos:
        return _reconstruct(chosen)
    from .scenes.formats import convert_export

    made = convert_export(chosen.source, chosen.out)
    for message in made.warnings:
        _warn(message)
    print(f"{made.folder}: {made.views} views, {made.points:,} points, from {made.what}")
    return 0


def _reconstruct(chosen: argparse.Namespace) -> int:
    from .scenes.reconstruct import reconstruct

    if chosen.out is None:
        raise LodgsError("It is not said where the scene is to be.", "Add --out DIR.")

    def tell(what: str, done: int, of: int) -> None:
        print(f"{what} {done} of {of}" if of > 1 else what, file=sys.stderr, flush=True)

    made = reconstruct(
        chosen.photos, chosen.out, preset=chosen.preset, ordered=chosen.ordered, lens=chosen.lens,
        masks=chosen.masks, tell=tell,
    )  # fmt: skip
    for message in made.left_out:
        _warn(message)
    print(f"{made.folder}: {made.points:,} points, {made.error:.2f} pixels off in the mean. {made.words}")
    return 0


def _undistort(chosen: argparse.Namespace) -> int:
    from .scenes.colmap import read_scene
    from .scenes.undistort import CACHE, undistorted

    scene = read_scene(chosen.scene, chosen.model, chosen.images)
    found = undistorted(scene, scene.folder / CACHE)
    for message in found.warnings:
        _warn(message)
    print(f"{found.images_folder}: {len(found.cameras)} photographs, {len(scene.distorted)} straightened")
    return 0


def _model(chosen: argparse.Namespace) -> int:
    from .scenes.rendered import write_model

    views, points = write_model(chosen.folder)
    print(f"{chosen.folder}: {views} views, {points:,} points")
    return 0


def _warn(message: str) -> None:
    print(f"warning: {message}", file=sys.stderr)


def _serve(chosen: argparse.Namespace) -> int:
    from .render.serve import serve

    return serve(chosen.folder, chosen.backend, sys.stdin.buffer, sys.stdout)


def _edit(chosen: argparse.Namespace) -> int:
    from .editing.cleaning import Cleaning
    from .editing.edit import edit
    from .editing.look import RANGES, Look
    from .lod.crop import Crop
    from .runs.folder import RunFolder
    from .splats.formats import as_ply

    names = "max_size", "min_opacity", "max_distance", "min_views", "gap", "share"
    given = {name: value for name in names if (value := getattr(chosen, name)) is not None}
    for name, value in given.items():
        if not 0 <= value < float("inf"):
            raise LodgsError(f"--{name.replace('_', '-')} cannot be {value:g}.", "Give a number from 0 on.")
    outside = chosen.keep == "outside"
    crops = [Crop.box(box[:3], box[3:], outside) for box in chosen.crop_box]
    crops += [Crop.sphere(sphere[:3], sphere[3], outside) for sphere in chosen.crop_sphere]
    parts = {name: value for name in RANGES if (value := getattr(chosen, name)) is not None}
    if "tint" in parts:
        parts["tint"] = tuple(parts["tint"])
    look, places = Look(**parts), [None]
    if chosen.keep == "all":
        if crops and not parts:
            raise LodgsError("With --keep all nothing goes.", "Say what is to look otherwise in there.")
        crops, places = [], crops or [None]
    if given.keys() & {"max_distance", "min_views"} and chosen.scene is None:
        raise LodgsError("Photographs' views are in their scene.", "Name its folder with --scene.")
    points = None
    if chosen.scene is not None:
        from .scenes.colmap import read_scene

        scene = read_scene(chosen.scene)
        given["cameras"], points = tuple(scene.cameras), scene.points
    if not (chosen.out or chosen.plain or chosen.folder or chosen.streamed):
        raise LodgsError("It is not said what to write.", "Add --out FILE, or --plain, --folder, --streamed.")
    cleaning = Cleaning(tuple(crops), drop_floaters=chosen.drop_floaters, **given)
    run = RunFolder(chosen.source)
    with as_ply(run.bundle if run.bundle.exists() else run.path) as source:
        print(
            edit(
                source, chosen.out, cleaning, _warn,
                placement=_placement(chosen), upright=chosen.upright, ground=chosen.ground, points=points,
                looks=[(place, look) for place in places] if parts else (),
                plain=chosen.plain, folder=chosen.folder, streamed=chosen.streamed,
                antialiased=chosen.antialiased,
            )
        )  # fmt: skip
    return 0


def _info(chosen: argparse.Namespace) -> int:
    from .cli.info import describe
    from .splats.formats import as_ply

    with as_ply(chosen.file) as there:
        print(describe(there).replace(str(there), str(chosen.file)))
    return 0


def _devices(chosen: argparse.Namespace) -> int:
    from .rasterize.devices import Devices, describe

    print(json.dumps(Devices.found().as_json()) if chosen.json else describe(chosen.time))
    return 0


def _check() -> int:
    found = _environment()
    print(json.dumps(found))
    return 0 if found["ok"] else 2


def _environment() -> dict:
    """Versions of what training needs, and one sentence for each thing that is missing or too old."""
    found: dict = {"lodgs": VERSION, "python": sys.version.split()[0], "executable": sys.executable}
    problems = []
    for package, oldest in _requirements():
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            problems.append(f"The package {package} is missing in {sys.executable}.")
            continue
        if _numbers(found[package]) < _numbers(oldest):
            problems.append(f"{package} is {found[package]}; training needs {oldest} or newer.")
    with suppress(metadata.PackageNotFoundError):  # for several cells at once
        found["distributed"] = metadata.version("distributed")
    return {**found, "ok": not problems, "problems": problems}


def _requirements() -> list[tuple[str, str]]:
    """Name and oldest version of each package that training needs: from pyproject.toml, as pip has them."""
    project = Path(__file__).resolve().parents[1] / "pyproject.toml"
    if project.is_file():  # a checkout or the extension
        wanted = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["dependencies"]
    else:
        wanted = [line for line in metadata.requires("lodgs") or () if "extra ==" not in line]
    found = (re.match(r"([\w-]+)>=([\d.]+)", line) for line in wanted)
    return [(entry[1], entry[2]) for entry in found if entry]


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split("+", maxsplit=1)[0].split(".")[:2] if part.isdigit()]


_COMMANDS = {
    "train": _train,
    "blocks": _blocks,
    "methods": _methods,
    "evaluate": _evaluate,
    "render": _render,
    "capture": _capture,
    "scene": _scene,
    "undistort": _undistort,
    "model": _model,
    "serve": _serve,
    "edit": _edit,
    "info": _info,
    "devices": _devices,
}


def run() -> NoReturn:
    """The command ``lodgs``: ends the process with :func:`main`'s code."""
    code = main()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # a full disk, of which all was said that could be
            stream.flush()
    os._exit(code)  # native thread pools can hang a normal exit


if __name__ == "__main__":
    run()
