"""The command line without a window: ``blender --command lodgs --help``."""

from __future__ import annotations

import argparse
import json
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import bpy

from ..training.errors import LodgsError
from ..training.methods.parameters import METHODS, PRESETS
from ..training.splats.bundle import describe, write_bundle
from . import environment, jobs, scenes
from .panels.training import duration, level_line

DONE, CRASHED, BAD_INPUT, CANCELLED = 0, 1, 2, 3
"""Exit codes, as the trainer's own."""


def main(arguments: list[str]) -> int:
    """Run one command.

    Args:
        arguments: what follows ``blender --command lodgs``.

    Returns:
        An exit code. Mistakes are told on standard error in a sentence.
    """
    try:
        chosen = _parser().parse_args(arguments)
    except SystemExit as stop:  # argparse has printed its help or the mistake
        return int(stop.code or 0)
    try:
        return chosen.command(chosen)
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
    train.add_argument("--scene", type=Path, required=True, help="folder of the COLMAP scene")
    train.add_argument("--out", type=Path, required=True, help="run folder; goes on with what is there")
    train.add_argument("--method", choices=list(METHODS), default="flod")
    train.add_argument("--preset", choices=list(PRESETS), default="draft")
    train.add_argument("--image-scale", type=_share, default=0.5, help="training images over photographs")
    train.add_argument(
        "--test-every", type=_count, default=8, help="hold out every n-th view; 0 holds out none"
    )
    train.add_argument("--seed", type=_count, default=0)
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter of the method; repeatable",
    )
    train.add_argument("--blend", type=Path, help=".blend file to save, with the levels and their selection")
    train.add_argument("--export", type=Path, help="bundle to write")

    convert = commands.add_parser("import", help="a COLMAP folder, a bundle or any 3DGS PLY to a .blend")
    convert.set_defaults(command=_import)
    convert.add_argument("source", type=Path, help="folder or PLY file")
    convert.add_argument("--blend", type=Path, required=True, help=".blend file to save")

    export = commands.add_parser("export", help="the levels of a .blend to a bundle")
    export.set_defaults(command=_export)
    export.add_argument("blend", type=Path, help=".blend file")
    export.add_argument("bundle", type=Path, help="bundle to write (PLY)")
    export.add_argument("--root", help="name of the scene root, where the file holds several")

    info = commands.add_parser("info", help="say what a bundle or any 3DGS PLY holds")
    info.set_defaults(command=_info)
    info.add_argument("file", type=Path)
    return parser


def _train(chosen: argparse.Namespace) -> int:
    parameters = dict(_assignment(text) for text in chosen.set)
    _empty_file()
    root = scenes.import_colmap(bpy.context, chosen.scene.resolve(), warn=lambda m: _print(f"warning: {m}"))
    settings = root.lodgs.training
    settings.method, settings.preset = chosen.method, chosen.preset
    settings.image_scale, settings.test_every = chosen.image_scale, chosen.test_every
    settings.seed = chosen.seed

    watch = jobs.start_or_resume(root, str(chosen.out.resolve()), parameters)
    with _interrupts():
        jobs.follow(watch, _Bar())
    for warning in watch.warnings:
        _print(f"warning: {warning}")
    if chosen.blend:
        _save(chosen.blend)
    if watch.problem:
        _print(f"error: {watch.problem}")
        if watch.state == "failed":
            return BAD_INPUT
        _print(watch.folder.log_tail())
        return CRASHED
    if watch.state == "cancelled":
        _print("Cancelled. The same command goes on from here.")
        return CANCELLED
    if chosen.export:
        write_bundle(chosen.export, scenes.read_levels(root))
    return DONE


def _import(chosen: argparse.Namespace) -> int:
    _empty_file()
    if chosen.source.is_dir():
        scenes.import_colmap(bpy.context, chosen.source.resolve(), warn=lambda m: _print(f"warning: {m}"))
    else:
        scenes.import_splats(bpy.context, chosen.source.resolve())
    _save(chosen.blend)
    return DONE


def _export(chosen: argparse.Namespace) -> int:
    if not chosen.blend.is_file():
        raise LodgsError(f"There is no file {chosen.blend}.")
    bpy.ops.wm.open_mainfile(filepath=str(chosen.blend.resolve()))
    found = [root for root in bpy.data.objects if root.lodgs.is_root and chosen.root in {None, root.name}]
    if len(found) != 1:
        names = ", ".join(root.name for root in bpy.data.objects if root.lodgs.is_root) or "none"
        raise LodgsError(f"{chosen.blend} holds {len(found)} such scenes.", f"Name one with --root: {names}.")
    write_bundle(chosen.bundle, scenes.read_levels(found[0]))
    return DONE


def _info(chosen: argparse.Namespace) -> int:
    print(describe(chosen.file))
    return DONE


def _share(text: str) -> float:
    if not 0.01 <= float(text) <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0.01 and 1")
    return float(text)


def _count(text: str) -> int:
    if not 0 <= int(text) < 2**31:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and {2**31 - 1}")
    return int(text)


def _assignment(text: str) -> tuple[str, object]:
    """``name=value`` with a value as JSON has it: a number, a list of numbers."""
    name, equals, value = text.partition("=")
    try:
        if not equals:
            raise ValueError
        return name.strip(), json.loads(value)
    except ValueError:
        raise LodgsError(f"--set {text} is not NAME=VALUE.", "For example: --set max_splats=50000") from None


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

    def __call__(self, watch: jobs.Watch) -> None:
        for number in sorted(watch.levels.keys() - self._levels):
            self._levels.add(number)
            self._line(level_line(watch.levels[number]))
        progress = watch.progress
        if self._terminal and watch.running and progress:
            share = progress["step"] / max(progress["of"], 1)
            bar = "█" * round(24 * share)
            print(
                f"\r\033[K{watch.message:<16} |{bar:<24}| {share:4.0%}  {progress['splats']:,} splats  "
                f"{progress['psnr']:.1f} dB  {progress['steps_per_s']:.1f} steps/s  "
                f"{duration(progress['eta_s'])} left",
                end="", file=sys.stderr, flush=True,
            )  # fmt: skip
        elif watch.message != self._message:
            self._message = watch.message
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
