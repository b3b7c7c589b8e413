"""Exports that the trainer writes in the background."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import bpy

from ...training.cli.options import option_name, option_words
from ...training.editing.export import DEFAULT_OPTIONS, FileOptions
from ...training.errors import LodgsError
from ...training.files import temporary_folder
from ...training.runs.folder import RunFolder
from ...training.splats.bundle import write_bundle
from ...training.splats.levels import Bundle
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
        source, log, output = folder / "levels.ply", folder / "trainer.log", folder / "trainer.out"
        write_bundle(source, bundle)
        command_line = [python, "-m", "training", command, source, *arguments]
        process = processes.spawn([str(word) for word in command_line], log, output)
        try:
            while (code := process.poll()) is None:
                if bpy.app.background:
                    time.sleep(processes.INTERVAL)
                yield []
        finally:
            with suppress(OSError):
                process.kill()
                process.wait()
        if code:
            raise LodgsError(processes.failure_reason(log, code))
        yield processes.last_lines(output)
