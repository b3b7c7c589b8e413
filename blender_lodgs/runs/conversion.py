"""Splat files that the trainer reads or writes for Blender, in the background."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event

import bpy

from ...training.cli.options import option_name, option_words
from ...training.editing.export import DEFAULT_OPTIONS, FileOptions
from ...training.errors import LodgsError
from ...training.files import temporary_folder
from ...training.runs.folder import RunFolder
from ...training.splats.bundle import write_bundle
from ...training.splats.formats import Convert
from ...training.splats.levels import Bundle
from ..data import importing
from . import environment, processes


def compress_steps(
    bundle: Bundle, path: Path, settings: dict[str, float], run: RunFolder | None
) -> Iterator[str]:
    """Write a compressed bundle; closing the iterator stops the trainer and writes nothing.

    Args:
        settings: ``editing.export.Compression`` by name.
        run: finished run with the training views of the splats, if any.

    Yields:
        Empty texts while the trainer works, then the last line of its report.

    Raises:
        LodgsError: the trainer is missing or fails.
    """
    options = [  # Blender's numbers have single precision
        f"{option_name(name)}={round(value, 6)}" for name, value in settings.items()
    ]
    options += [f"--run={run.path}"] if run is not None and run.bundle.exists() else []
    for lines in _trainer_steps(bundle, "compress", "--out", str(path), *options):
        yield lines[-1] if lines else ""


def convert_steps(
    bundle: Bundle, option: str, path: Path, file_options: FileOptions = DEFAULT_OPTIONS
) -> Iterator[str]:
    """Write a bundle with ``lodgs edit``; closing the iterator stops the trainer and writes nothing.

    Args:
        option: option of the command that takes the file or folder: ``--plain``, ``--levels``, ``--tiles``.

    Yields:
        Empty texts while the trainer works, then its sentences about the file.

    Raises:
        LodgsError: the trainer is missing or fails.
    """
    for lines in _trainer_steps(bundle, "edit", option, str(path), *option_words(file_options)):
        yield " ".join(line for line in lines if line.endswith("."))


def page_steps(bundle: Bundle, folder: Path, title: str) -> Iterator[str]:
    """Write a page with ``lodgs page``; closing the iterator stops the trainer and writes nothing.

    Yields:
        Empty texts while the trainer works.

    Raises:
        LodgsError: the trainer is missing or fails.
    """
    for _ in _trainer_steps(bundle, "page", "--out", str(folder), f"--title={title}"):
        yield ""


def _trainer_steps(bundle: Bundle, command: str, *arguments: str) -> Iterator[list[str]]:
    """Run a command of LODGS on a bundle, and yield the lines of its report, at first none."""
    python = environment.trainer_python()
    environment.require(python)
    with temporary_folder() as folder:
        source = folder / "levels.ply"
        write_bundle(source, bundle)
        for lines in _command_steps(python, folder, command, str(source), *arguments):
            if not lines and bpy.app.background:
                time.sleep(processes.INTERVAL)
            yield lines


def _command_steps(python: Path, folder: Path, *arguments: str) -> Iterator[list[str]]:
    """Run a command of LODGS, and yield the lines of its report, at first none.

    Args:
        folder: folder for its log.
    """
    log, output = folder / "trainer.log", folder / "trainer.out"
    process = processes.spawn([str(python), "-m", "training", *arguments], log, output)
    try:
        while (code := process.poll()) is None:
            yield []
    finally:
        with suppress(OSError):
            process.kill()
            process.wait()
    if code:
        raise LodgsError(processes.failure_reason(log, code))
    yield processes.last_lines(output)


def make_converter(stop: Event | None = None) -> Convert:
    """Return a function that converts a splat file to a bundle with the trainer; it may run in a thread.

    The function raises a LodgsError if the trainer is missing, fails, or is stopped.

    Args:
        stop: event that stops the trainer.
    """
    stop = stop or Event()
    python: Path | LodgsError
    try:
        python = environment.trainer_python()  # reads Blender's preferences: not in a thread
    except LodgsError as error:
        python = error

    def convert(source: Path, target: Path) -> None:
        if isinstance(python, LodgsError):
            raise LodgsError(f"Cannot read {source.name} without the trainer.", python.remedy)
        environment.require(python)
        with temporary_folder() as folder:
            for _ in _command_steps(python, folder, "edit", str(source.resolve()), "--out", str(target)):
                if stop.wait(processes.INTERVAL):
                    raise LodgsError(f"Reading {source.name} was stopped.")

    return convert


def register() -> None:
    importing.make_converter = make_converter
