"""The command line without a window: ``blender --command lodgs --help``."""

from __future__ import annotations

import argparse
import re
import signal
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy

from ..training.cli.info import describe
from ..training.cli.job_options import add_options, job_from_options, parse_size
from ..training.cli.methods import describe_method, describe_methods
from ..training.editing.bake_filter import without_filter
from ..training.editing.edit import Joined, finish
from ..training.errors import LodgsError
from ..training.evaluate.messages import summary_lines
from ..training.runs.folder import RunFolder
from ..training.runs.job import Job, check_views
from ..training.splats.bundle import write_bundle
from ..training.splats.dialects import Warn
from ..training.splats.formats import PLY, find_format, write_splats
from . import extension
from .data import scenes, viewpoints
from .render.capture import noise, render_views, write_model
from .render.video import MOST_FRAMES, extract_frames
from .runs import environment, jobs, photo_preparation
from .runs.messages import format_duration, level_line
from .runs.watch import Watch

DONE, CRASHED, BAD_INPUT, CANCELLED = 0, 1, 2, 3
"""Exit codes, as the trainer's own."""


def main(arguments: list[str]) -> int:
    """Run one command.

    Args:
        arguments: what follows ``blender --command lodgs``.

    Returns:
        An exit code. Errors of the user are a sentence on standard error.
    """
    try:
        args = _parser().parse_args(arguments)
    except SystemExit as stop:  # argparse has printed its help or the mistake
        return int(stop.code or 0)
    try:
        return args.command(args)
    except LodgsError as error:
        _print(f"error: {error}")
        return BAD_INPUT
    except RuntimeError as error:  # an operator of Blender's own, such as saving, says no
        _print(str(error).strip())
        return CRASHED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="blender --command lodgs",
        description="Splats with levels of detail.",
        epilog="The trainer's Python is that of the preferences, or of the environment variable "
        f"{environment.VARIABLE}. Exit codes: 0 done, 1 crash, 2 bad input, 3 cancelled.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="photographs to splats: import, train, save, export")
    train.set_defaults(command=_train)
    add_options(train)
    train.add_argument("--blend", type=Path, help=".blend file to save, with the levels and their selection")
    train.add_argument("--export", type=Path, help="bundle to write")

    methods = commands.add_parser("methods", help="say which methods there are, or what one can be told")
    methods.set_defaults(command=_methods)
    methods.add_argument("name", nargs="?", metavar="NAME", help="method whose parameters to list")

    convert = commands.add_parser("import", help="a COLMAP folder or any file of splats to a .blend")
    convert.set_defaults(command=_import)
    convert.add_argument("source", type=Path, help="folder or file")
    convert.add_argument("--blend", type=Path, required=True, help=".blend file to save")

    export = commands.add_parser(
        "export", help="the levels of a .blend to a bundle, or the finest to another kind of file"
    )
    export.set_defaults(command=_export)
    export.add_argument("blend", type=Path, help=".blend file")
    export.add_argument(
        "bundle", type=Path, help="bundle to write (.ply); or .spz, .sog, .compressed.ply, .splat"
    )
    export.add_argument("--root", help="name of the scene root, where the file holds several")
    export.add_argument(
        "--placed",
        action="store_true",
        help="where the scene stands in the .blend, not in COLMAP's coordinates",
    )
    export.add_argument(
        "--as-trained", action="store_true", help="without the look that the scene has in the .blend"
    )

    capture = commands.add_parser(
        "capture",
        help="any Blender scene to a COLMAP scene of its renders, to train from",
        description="Renders views with the scene's own engine, writes their exact cameras and a model of "
        "them. What is not said is as the file's LODGS tab has it. Given again, it goes on where it stopped.",
    )
    capture.set_defaults(command=_capture)
    capture.add_argument("blend", type=Path, help=".blend file")
    capture.add_argument("--out", type=Path, required=True, help="folder that becomes the COLMAP scene")
    where = capture.add_mutually_exclusive_group()
    where.add_argument("--around", action="store_true", help="views around what is selected, or all")
    where.add_argument("--above", action="store_true", help="a grid above what is selected, or all")
    where.add_argument("--cameras", action="store_true", help="every camera of the scene")
    where.add_argument("--animation", action="store_true", help="frames of the scene's camera")
    where.add_argument("--curve", metavar="NAME", help="a walk along a curve")
    capture.add_argument("--views", type=int, metavar="N", help="how many, but of cameras")
    capture.add_argument("--size", type=parse_size, metavar="WxH", help="pixels of the pictures")
    capture.add_argument(
        "--range", type=_range, metavar="A-B", help="render only these views, from 1 on, and make no model: "
        "for several computers, before one does the same without it",
    )  # fmt: skip

    frames = commands.add_parser(
        "frames", help="sharp frames of a video, from which lodgs scene --photos --ordered finds cameras"
    )
    frames.set_defaults(command=_frames)
    frames.add_argument("video", type=Path, help="any video that Blender reads")
    frames.add_argument("--out", type=Path, required=True, help="folder of the frames")
    frames.add_argument(
        "--most", type=int, default=MOST_FRAMES, metavar="N", help=f"at most so many ({MOST_FRAMES})"
    )

    info = commands.add_parser("info", help="say what a bundle or any 3DGS PLY holds")
    info.set_defaults(command=_info)
    info.add_argument("file", type=Path)
    return parser


def _train(args: argparse.Namespace) -> int:
    job = job_from_options(args)
    if job.backend == "auto":
        job = replace(job, backend=extension.preferences().backend)
    _empty_file()
    root = _imported(job)
    jobs.show(root.lodgs.training, job)  # when the .blend is opened
    watch = jobs.start_or_resume(root, job)
    with _interrupts():
        jobs.follow(watch, _Bar())
    for line in summary_lines(watch.summary):
        _print(line)
    for warning in watch.warnings:
        _print(f"warning: {warning}")
    if args.blend:
        _save(args.blend)
    if watch.problem:
        _print(f"error: {watch.problem}")
        if watch.state == "failed":
            return BAD_INPUT
        _print(watch.folder.log_tail())
        return CRASHED
    if watch.state == "cancelled":
        _print("Cancelled. The same command goes on from here.")
        return CANCELLED
    if args.export:
        write_bundle(args.export, scenes.read_levels(root))
    return DONE


def _imported(job: Job) -> bpy.types.Object:
    """What a job trains on, as a splat scene: its photographs, or its splats alone."""

    def warn(message: str) -> None:
        _print(f"warning: {message}")

    if not job.capture:
        return _photographed(Path(job.scene), warn)
    run = RunFolder(job.base)
    return scenes.import_splats(bpy.context, run.bundle if run.bundle.exists() else run.path, warn=warn)


def _photographed(folder: Path, warn: Warn) -> bpy.types.Object:
    """A COLMAP scene, its photographs straightened where their lens bends lines."""
    root = scenes.import_colmap(bpy.context, folder, warn=warn)
    photo_preparation.undistort_photos(root, warn)
    return root


def _methods(args: argparse.Namespace) -> int:
    print(describe_method(args.name) if args.name else describe_methods())
    return DONE


def _import(args: argparse.Namespace) -> int:
    _empty_file()
    if args.source.is_dir():
        _photographed(args.source.resolve(), lambda m: _print(f"warning: {m}"))
    else:
        scenes.import_splats(bpy.context, args.source.resolve(), warn=lambda m: _print(f"warning: {m}"))
    _save(args.blend)
    return DONE


def _export(args: argparse.Namespace) -> int:
    _open(args.blend)
    found = [root for root in bpy.data.objects if root.lodgs.is_root and args.root in {None, root.name}]
    if len(found) != 1:
        names = ", ".join(root.name for root in bpy.data.objects if root.lodgs.is_root) or "none"
        raise LodgsError(f"{args.blend} holds {len(found)} such scenes.", f"Name one with --root: {names}.")
    bundle = scenes.read_levels(found[0], args.placed, not args.as_trained)
    if find_format(args.bundle) is PLY:
        write_bundle(args.bundle, bundle)
    else:
        form = bundle if find_format(args.bundle).antialiased else without_filter(bundle)
        finish(write_splats(args.bundle, Joined.upto(form, form.levels[-1].number), form.meta))
    return DONE


def _capture(args: argparse.Namespace) -> int:
    _open(args.blend)
    scene = bpy.context.scene
    settings = scene.lodgs_capture
    for name in ("around", "above", "cameras", "animation", "curve"):
        if getattr(args, name):
            settings.views_from = {"around": "DOME", "above": "GRID"}.get(name, name.upper())
    if args.curve:
        settings.curve = bpy.data.objects.get(args.curve)
        if settings.curve is None or settings.curve.type != "CURVE":
            raise LodgsError(f"{args.blend} has no curve '{args.curve}'.", "Name another one.")
    width, height = args.size or viewpoints.size(scene, settings)
    views = settings.views if args.views is None else args.views
    check_views(views, width)
    settings.views = views
    if not args.range:
        environment.require(environment.trainer_python())

    def tell(number: int, count: int) -> None:
        _print(f"View {number} of {count}")

    folder, engine = args.out.resolve(), scene.render.engine
    if engine.startswith(("BLENDER_EEVEE", "BLENDER_WORKBENCH")):
        name = "Workbench" if "WORKBENCH" in engine else "EEVEE"
        _print(
            f"{name} needs graphics, in background too. If Blender crashes now, there are none: take Cycles."
        )
    if noisy := noise(scene):
        _print(f"warning: {noisy}")
    try:
        with _interrupts():
            count = render_views(bpy.context, folder, width, height, args.range, tell)
            if args.range:
                _print(f"{folder}: views {args.range[0]} to {min(args.range[1], count)} of {count}")
            else:
                _print(write_model(folder))
    except KeyboardInterrupt:
        _print("Cancelled. The same command goes on from here.")
        return CANCELLED
    return DONE


def _frames(args: argparse.Namespace) -> int:
    if args.most < 2:
        raise LodgsError(f"{args.most} frames make no scene.", "Ask for some dozens with --most.")
    if not args.video.is_file():
        raise LodgsError(f"There is no file {args.video}.", "Choose a video.")

    def tell(number: int, count: int) -> None:
        _print(f"Frames of the video: {number} of {count}")

    folder = args.out.resolve()
    count = extract_frames(args.video.resolve(), folder, args.most, tell)
    _print(f"{folder}: {count} frames")
    return DONE


def _range(text: str) -> tuple[int, int]:
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise argparse.ArgumentTypeError(f"{text} is not FIRST-LAST, such as 1-16")
    return int(first), int(last)


def _open(blend: Path) -> None:
    if not blend.is_file():
        raise LodgsError(f"There is no file {blend}.")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(blend.resolve()))
    except RuntimeError as error:
        raise LodgsError(f"{blend} cannot be opened.", "Choose a .blend, not of a newer Blender.") from error


def _info(args: argparse.Namespace) -> int:
    print(describe(args.file))
    return DONE


def _empty_file() -> None:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def _save(path: Path) -> None:
    try:
        path.resolve().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(f"The folder {path.parent} cannot be made: {error.strerror}.") from error
    bpy.ops.wm.save_as_mainfile(filepath=str(path.resolve()), check_existing=False)


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class _Bar:
    """Progress on standard error: a line for each thing done, and on a terminal a bar over the last one."""

    def __init__(self) -> None:
        self._message, self._levels, self._terminal = "", set(), sys.stderr.isatty()

    def __call__(self, watch: Watch) -> None:
        for number in sorted(watch.levels.keys() - self._levels):
            self._levels.add(number)
            self._line(level_line(watch.levels[number]))
        progress = watch.progress
        if self._terminal and watch.running and progress:
            share = progress["step"] / max(progress["of"], 1)
            bar = "█" * round(24 * share)
            print(
                f"\r\033[K{watch.message:<16} |{bar:<24}| {share:4.0%}  {progress['splats']:,} splats  "
                f"{progress['psnr']:.1f} dB in training  {progress['steps_per_s']:.1f} steps/s  "
                f"{format_duration(progress['eta_s'])} left",
                end="", file=sys.stderr, flush=True,
            )  # fmt: skip
        elif (
            message := re.sub(r"\d+", "", watch.message)
        ) != self._message:  # a line for all that is counted
            self._message = message
            self._line(watch.message)

    def _line(self, text: str) -> None:
        _print(("\r\033[K" if self._terminal else "") + text)


@contextmanager
def _interrupts():
    """Ctrl-C raises KeyboardInterrupt, as in any Python; in background Blender itself would end at once."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        if before is not None:  # None: a handler that Python did not set and cannot set again
            signal.signal(signal.SIGINT, before)


_command = None


def register() -> None:
    global _command
    _command = bpy.utils.register_cli_command("lodgs", main)


def unregister() -> None:
    global _command
    if _command is not None:
        bpy.utils.unregister_cli_command(_command)
        _command = None
