"""Finding the cameras of photographs: the trainer does it beside Blender, which then imports the scene."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from .. import extension
from ..data import scenes
from . import environment, processes

_TOLD = re.compile(r"(.*?) (\d+) of (\d+)$")


class Reconstructing:
    """A trainer that finds cameras, and what the panel shows of it.

    Attributes:
        folder: the COLMAP scene that it makes.
        message: what it is doing, or how it went.
        fraction: how much of that is done, 0 to 1.
        problem: why it failed; empty when it did not.
        running: whether it is still at work.
        root: the scene that was imported, at the end.
        warnings: a sentence for each thing that is odd in it.
    """

    def __init__(self, folder: Path, commands: list[list[str]]) -> None:
        self.folder, self.message, self.fraction, self.problem = folder, "Looking at the photographs", 0.0, ""
        self.running, self.root, self.warnings = True, None, list[str]()
        self._commands, self._log, self._cancelled = commands, folder / "colmap.log", False
        self._log.unlink(missing_ok=True)
        self._process = self._next()

    def cancel(self) -> None:
        """Stops it; the same again goes on from there."""
        self._cancelled = True
        self._process.terminate()

    def step(self) -> bool:
        """For ``processes.follow``: show what is new, import at the end; return whether it goes on."""
        code, last = self._process.poll(), processes.last_lines(self._log)[-1:]
        if code == 0 and self._commands and not self._cancelled:
            self._process, code = self._next(), None
        self.running = code is None
        if code is None and last and (told := _TOLD.match(last[0])):
            self.message, self.fraction = last[0], int(told[2]) / max(int(told[3]), 1)
        elif code == 0:
            self._import()
        elif code is not None:
            self.message = "Stopped; the same again goes on from there"
            self.problem = "" if self._cancelled else processes.problem_of(self._log, code)
        extension.redraw()
        return self.running

    def _next(self) -> subprocess.Popen:
        return processes.spawn(self._commands.pop(0), self._log, self._log.with_suffix(".out"))

    def _import(self) -> None:
        words = processes.last_lines(self._log.with_suffix(".out"))
        self.message, self.fraction = words[-1].partition(": ")[2] if words else "", 1.0
        try:
            self.root = scenes.import_colmap(bpy.context, self.folder, warn=self.warnings.append)
            bpy.ops.ed.undo_push(message="Import Photographs")
        except LodgsError as error:
            self.problem = str(error)


current: Reconstructing | None = None
"""What is at work, or was last."""


def start(
    photos: Path,
    folder: Path,
    preset: str = "draft",
    ordered: bool = False,
    lens: str = "",
) -> Reconstructing:
    """Begin to find the cameras of photographs, or go on with it.

    Args:
        photos: their folder, or a video, of which frames are taken first.
        folder: that becomes the COLMAP scene.
        preset, ordered, lens: see ``reconstruct``.

    Raises:
        LodgsError: one is at work, there is no trainer, or the folder cannot be written.
    """
    global current
    if current is not None and current.running:
        raise LodgsError("Cameras of photographs are being found already.", "Wait for that or cancel it.")
    python = environment.trainer_python()
    environment.require(python)
    commands = []
    if photos.is_file():
        video, photos, ordered, lens = photos, folder / "images", True, "one"
        command = [bpy.app.binary_path, "--command", "lodgs", "frames", str(video), "--out", str(photos)]
        commands.append(command)
    command = [str(python), "-m", "training", "scene", "--photos", str(photos), "--out", str(folder)]
    command += ["--preset", preset, *(["--ordered"] if ordered else []), *(["--lens", lens] if lens else [])]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        current = Reconstructing(folder, [*commands, command])
    except OSError as error:
        raise LodgsError(
            f"{folder} cannot be written: {error.strerror or error}.", "Choose another folder."
        ) from error
    return current


def unregister() -> None:
    """It ends with Blender: another one goes on with it."""
    if current is not None and current.running:
        current.cancel()
