"""Blender's command line in background mode: ``blender --command lodgs --help``."""

from __future__ import annotations

import argparse
import os
import re
import signal
import socket
import sys
import threading
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import bpy

from ..training.cli.info import describe
from ..training.cli.job_options import add_options, job_from_options
from ..training.cli.methods import describe_method, describe_methods
from ..training.cli.options import add_setting, parse_size
from ..training.editing.export import EXPORT_OPTIONS, export_finest_level
from ..training.errors import LodgsError, describe_system_error, system_remedy
from ..training.evaluate.messages import format_duration, summary_lines
from ..training.runs.folder import RunFolder, find_splats
from ..training.runs.job import KEYS, Job
from ..training.settings import check_value
from ..training.splats.bundle import write_bundle
from ..training.splats.formats import FORMATS, PLY, find_format
from ..training.splats.origin import describe_origin
from . import extension
from .data import importing, photographs, scenes, viewpoints
from .data.paths import save_file
from .data.view_settings import VIEW_PATTERNS, ViewPattern
from .render import engine
from .render.capture import noise_warning, render_views, write_model
from .render.video import MAX_FRAMES, extract_frames
from .runs import environment, job_settings, jobs, photo_preparation
from .runs.conversion import convert_steps
from .runs.messages import level_line
from .runs.watch import Watch

DONE, CRASHED, BAD_INPUT, CANCELLED = 0, 1, 2, 3
"""Exit codes, the same as the trainer's."""
CANCELLED_MESSAGE = "Cancelled. The same command resumes."
PATIENCE = 2.0
"""Seconds after a signal until a command ends during a slow operation of Blender, such as a render."""
_Commands = argparse._SubParsersAction  # argparse has no public name for it


def main(arguments: list[str]) -> int:
    """Run one command.

    Args:
        arguments: the arguments after ``blender --command lodgs``.

    Returns:
        An exit code. Input errors print one sentence to standard error.
    """
    try:
        args = _parser().parse_args(arguments or ["--help"])
    except SystemExit as stop:  # argparse has printed help or an error
        return int(stop.code or 0)
    try:
        with _interrupts(patience=None if args.command is _train else PATIENCE) as args.interrupted:
            return args.command(args)
    except LodgsError as error:
        _print(f"error: {error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        _print(CANCELLED_MESSAGE)
        return CANCELLED
    except Exception as error:
        described = describe_system_error(error)
        if described is None and not isinstance(error, RuntimeError):
            raise
        _print(f"error: {described or str(error).strip()}")  # else a Blender operator failed
        return CRASHED if described is None else BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="blender --command lodgs",
        description="Train, import, export and capture Gaussian splats with levels of detail.",
        epilog="The trainer's Python is set in the preferences or by the environment variable "
        f"{environment.VARIABLE}. Exit codes: 0 done, 1 crash, 2 bad input, 3 cancelled.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_train(commands)
    _add_methods(commands)
    _add_import(commands)
    _add_export(commands)
    _add_capture(commands)
    _add_frames(commands)
    _add_info(commands)
    return parser


def _add_train(commands: _Commands) -> None:
    train = commands.add_parser("train", help="import photos, train splats, save and export them")
    train.set_defaults(command=_train)
    add_options(train)
    train.add_argument("--blend", type=Path, help=".blend file to save with the levels")
    train.add_argument("--export", type=Path, help="bundle to write")


def _add_methods(commands: _Commands) -> None:
    methods = commands.add_parser("methods", help="list the methods, or the parameters of one method")
    methods.set_defaults(command=_methods)
    methods.add_argument("name", nargs="?", metavar="NAME", help="method whose parameters to list")


def _add_import(commands: _Commands) -> None:
    importer = commands.add_parser("import", help="import a COLMAP folder or a splat file into a .blend file")
    importer.set_defaults(command=_import)
    importer.add_argument("source", type=Path, help="folder or file to import")
    importer.add_argument("--blend", type=Path, required=True, help=".blend file to save")


def _add_export(commands: _Commands) -> None:
    export = commands.add_parser(
        "export", help="export the levels of a .blend file to a bundle, or the finest level to another format"
    )
    export.set_defaults(command=_export)
    export.add_argument("blend", type=Path, help=".blend file")
    other_suffixes = ", ".join(kind.suffix for kind in FORMATS if kind is not PLY)
    export.add_argument("bundle", type=Path, help=f"file to write: a bundle (.ply), or {other_suffixes}")
    export.add_argument("--root", help="name of the scene root, if the file holds several")
    add_setting(export, EXPORT_OPTIONS["placed"], value=False)
    export.add_argument("--as-trained", dest="looked", action="store_false", help="ignore the scene's look")


def _view_patterns() -> list[ViewPattern]:
    """Return the patterns of views that work without viewports."""
    return [pattern for pattern in VIEW_PATTERNS if pattern.option]


def _add_capture(commands: _Commands) -> None:
    capture = commands.add_parser(
        "capture",
        help="render a Blender scene as a COLMAP scene to train from",
        description="Render views with the scene's render engine and write their exact cameras as a COLMAP "
        "model. Options default to the settings of the file's LODGS tab. The same command resumes an "
        "interrupted capture.",
    )
    capture.set_defaults(command=_capture)
    capture.add_argument("blend", type=Path, help=".blend file")
    capture.add_argument("--out", type=Path, required=True, help="folder for the COLMAP scene")
    source = capture.add_mutually_exclusive_group()
    for pattern in _view_patterns():
        about = pattern.about[0].lower() + pattern.about[1:]
        kind = {"metavar": "NAME"} if pattern.option == "curve" else {"action": "store_true"}
        source.add_argument(f"--{pattern.option}", help=about, **kind)
    capture.add_argument("--views", type=int, metavar="N", help="number of views, except with --cameras")
    capture.add_argument("--size", type=parse_size, metavar="WxH", help="image size in pixels")
    capture.add_argument(
        "--range", type=_range, metavar="A-B", help="render only views A to B and write no model, to share a "
        "capture between computers; then run the command once without --range",
    )  # fmt: skip


def _add_frames(commands: _Commands) -> None:
    frames = commands.add_parser(
        "frames", help="extract the sharpest frames of a video, for lodgs scene --photos --ordered"
    )
    frames.set_defaults(command=_frames)
    frames.add_argument("video", type=Path, help="video in any format that Blender reads")
    frames.add_argument("--out", type=Path, required=True, help="folder for the frames")
    frames.add_argument(
        "--most", type=int, default=MAX_FRAMES, metavar="N", help=f"maximum number of frames ({MAX_FRAMES})"
    )


def _add_info(commands: _Commands) -> None:
    info = commands.add_parser("info", help="describe a bundle, a run or a 3DGS PLY file")
    info.set_defaults(command=_info)
    info.add_argument("file", type=Path, help="file or run folder to describe")


def _train(args: argparse.Namespace) -> int:
    job = job_from_options(args)
    if job.backend == "auto":
        job = replace(job, backend=extension.preferences().backend)
    _empty_file()
    root = _import_for(job)
    photographs.look_at_scene(bpy.context, root)
    job_settings.apply_job(root.lodgs.training, job)  # for the panel when the .blend is opened
    if args.interrupted():
        raise KeyboardInterrupt
    watch = jobs.start_or_resume(root, job)
    jobs.follow(watch, _ProgressBar(), args.interrupted)
    for line in summary_lines(watch.summary):
        _print(line)
    for warning in watch.warnings:
        _warn(warning)
    if args.blend:
        _save(args.blend)
    if watch.problem:
        _print(f"error: {watch.problem}")
        if watch.state == "failed":
            return BAD_INPUT
        _print(watch.folder.log_tail())
        return CRASHED
    if watch.state == "cancelled":
        _print(CANCELLED_MESSAGE)
        return CANCELLED
    if args.export:
        write_bundle(args.export, scenes.read_levels(root))
        _print(f"{args.export}: written")
    return DONE


def _import_for(job: Job) -> bpy.types.Object:
    """Import a job's photos, or its base splats if it trains on captured views, and return the scene root."""
    if not job.capture:
        return _import_photos(Path(job.scene), *job.model_and_images)
    run = RunFolder(job.base)
    return importing.import_splats(bpy.context, run.bundle if run.bundle.exists() else run.path, warn=_warn)


def _import_photos(folder: Path, model: Path | None = None, images: Path | None = None) -> bpy.types.Object:
    """Import a COLMAP scene, undistort its photos if needed and return the scene root."""
    root = importing.import_colmap(bpy.context, folder, model=model, images=images, warn=_warn)
    photo_preparation.undistort_photos(root, _warn)
    return root


def _methods(args: argparse.Namespace) -> int:
    print(describe_method(args.name) if args.name else describe_methods())
    return DONE


def _import(args: argparse.Namespace) -> int:
    _empty_file()
    if args.source.is_dir():
        root = _import_photos(args.source.resolve())
    else:
        root = importing.import_splats(bpy.context, args.source.resolve(), warn=_warn)
    photographs.look_at_scene(bpy.context, root)
    _print(f"'{root.name}': {scenes.contents(root)}")
    _save(args.blend)
    return DONE


def _export(args: argparse.Namespace) -> int:
    _open(args.blend)
    roots = [root for root in bpy.data.objects if root.lodgs.is_root]
    matches = [root for root in roots if args.root in {None, root.name}]
    if len(matches) != 1:
        names = ", ".join(root.name for root in roots) or "none"
        raise LodgsError(
            f"Cannot export {args.blend}: {len(matches)} splat scenes match.",
            f"Name one of its scenes with --root: {names}.",
        )
    bundle = scenes.read_levels(matches[0], args.placed, args.looked)
    if find_format(args.bundle) is PLY:
        write_bundle(args.bundle, bundle)
    elif find_format(args.bundle).write_levels:
        for text in convert_steps(bundle, "--levels", args.bundle.resolve()):
            if text:
                _print(text)
    else:
        export_finest_level(args.bundle, bundle)
    _print(f"{args.bundle}: written")
    if origin := describe_origin(bundle.origin):
        _print(origin)
    return DONE


def _capture(args: argparse.Namespace) -> int:
    _open(args.blend)
    scene = bpy.context.scene
    settings = scene.lodgs_capture
    for pattern in _view_patterns():
        if getattr(args, pattern.option):
            settings.views_from = pattern.identifier
    if args.curve:
        settings.curve = bpy.data.objects.get(args.curve)
        if settings.curve is None or settings.curve.type != "CURVE":
            curves = ", ".join(obj.name for obj in bpy.data.objects if obj.type == "CURVE")
            raise LodgsError(
                f"Cannot capture: {args.blend} has no curve '{args.curve}'.",
                f"Use one of its curves: {curves}." if curves else "Use another placement, such as --around.",
            )
    width, height = args.size or viewpoints.image_size(scene, settings)
    views = settings.views if args.views is None else args.views
    check_value(KEYS["views"], views)
    check_value(KEYS["view_width"], width)
    settings.views = views
    if not args.range:
        environment.require(environment.trainer_python())

    def report(number: int, count: int) -> None:
        _print(f"View {number} of {count}")

    folder = args.out.resolve()
    if scene.render.engine.startswith(("BLENDER_EEVEE", "BLENDER_WORKBENCH")):
        name = "Workbench" if "WORKBENCH" in scene.render.engine else "EEVEE"
        _print(f"{name} needs a GPU, also in background mode. If Blender crashes now, use Cycles.")
    if warning := noise_warning(scene):
        _warn(warning)
    count = render_views(bpy.context, folder, width, height, args.range, report, _warn)
    if args.range:
        _print(f"{folder}: views {args.range[0]} to {min(args.range[1], count)} of {count}")
    else:
        _print(write_model(folder))
    return DONE


def _frames(args: argparse.Namespace) -> int:
    if args.most < 2:
        raise LodgsError(
            f"Cannot make a scene of {args.most} frames: it needs at least 2.", "Set --most to 24 or more."
        )
    if not args.video.is_file():
        raise LodgsError(f"Cannot read video: {args.video} does not exist.", "Choose a video file.")

    def report(number: int, count: int) -> None:
        _print(f"Video frame {number} of {count}")

    folder = args.out.resolve()
    count = extract_frames(args.video.resolve(), folder, args.most, report)
    _print(f"{folder}: {count} frames")
    return DONE


def _range(text: str) -> tuple[int, int]:
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise argparse.ArgumentTypeError(f"{text} is not of the form FIRST-LAST, such as 1-16")
    return int(first), int(last)


def _open(blend: Path) -> None:
    if not blend.is_file():
        raise LodgsError(f"Cannot open {blend}: no such file.", "Choose an existing .blend file.")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(blend.resolve()))
    except RuntimeError as error:
        raise LodgsError(
            f"Cannot open {blend}: Blender cannot read it.",
            "Choose a .blend file of this or an older version.",
        ) from error


def _info(args: argparse.Namespace) -> int:
    print(describe(find_splats(args.file)))
    return DONE


def _empty_file() -> None:
    """Open an empty file, ready to render splats in their own colours."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    engine.use(bpy.context.scene)


def _save(path: Path) -> None:
    try:
        path.resolve().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(
            f"Cannot create folder {path.parent}: {error.strerror}.",
            system_remedy(error, "Choose another folder."),
        ) from error
    try:
        save_file(path.resolve())
    except RuntimeError as error:
        reason = str(error).strip().removeprefix("Error: ").rstrip(".")
        raise LodgsError(
            f"Cannot save {path}: {reason}.", "Free some space on this disk, or choose another folder."
        ) from error
    _print(f"{path}: written")


def _print(text: str) -> None:
    with suppress(OSError):  # a full disk
        print(text, file=sys.stderr, flush=True)


def _warn(message: str) -> None:
    _print(f"warning: {message}")


class _ProgressBar:
    """Progress on standard error: one line per finished step, and on a terminal a bar in the last line."""

    def __init__(self) -> None:
        self._message = ""
        self._levels: set[int] = set()
        self._terminal = sys.stderr is not None and sys.stderr.isatty()

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
            return
        message = re.sub(r"\d+", "", watch.message)  # print a counter's message once
        if message != self._message:
            self._message = message
            self._line(watch.message)

    def _line(self, text: str) -> None:
        _print(("\r\033[K" if self._terminal else "") + text)


@contextmanager
def _interrupts(patience: float | None):
    """Make SIGINT and SIGTERM raise KeyboardInterrupt; by default background Blender exits immediately.

    Python handles a signal only between Blender's operations, so a thread ends a process that is still busy.
    Yields a function that returns whether a signal arrived since its last call, because Blender only prints
    the exceptions of its callbacks.

    Args:
        patience: seconds from a signal until the process ends with exit code 3. None: no limit.
    """
    numbers = signal.SIGINT, signal.SIGTERM
    received: list[int] = []

    def interrupt(number: int, _: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    def interrupted() -> bool:
        count = len(received)
        received.clear()
        return count > 0

    previous = [signal.signal(number, interrupt) for number in numbers]
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    ended = threading.Event()

    def end_late() -> None:
        while number := receiver.recv(1):  # empty: the sender is closed
            if number[0] in numbers and patience is not None and not ended.wait(patience):
                _print(CANCELLED_MESSAGE)
                os._exit(CANCELLED)

    thread = threading.Thread(target=end_late, daemon=True)
    thread.start()
    try:
        yield interrupted
    finally:
        ended.set()
        signal.set_wakeup_fd(wakeup)
        sender.close()
        thread.join()
        receiver.close()
        for number, handler in zip(numbers, previous, strict=True):
            if handler is not None:  # None: the handler was not set by Python and cannot be restored
                signal.signal(number, handler)


_command = None


def register() -> None:
    global _command
    _command = bpy.utils.register_cli_command("lodgs", main)


def unregister() -> None:
    global _command
    if _command is not None:
        bpy.utils.unregister_cli_command(_command)
        _command = None
