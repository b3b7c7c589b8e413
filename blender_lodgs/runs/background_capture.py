"""Capturing the Blender scene from the panel: another Blender renders its views in background."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.scenes.rendered import CAMERAS
from .. import extension
from ..data import viewpoints
from . import environment, processes
from .messages import duration


class Capturing:
    """A Blender that renders views, and what the panel shows of it.

    Attributes:
        folder: the COLMAP scene that it makes.
        message: what it is doing.
        fraction: how much is done, 0 to 1.
        problem: why it failed; empty when it did not.
        running: whether it is still at work.
    """

    def __init__(self, folder: Path, count: int, process: subprocess.Popen, log: Path, copy: Path) -> None:
        self.folder, self.message, self.fraction, self.problem = folder, "Opening the scene", 0.0, ""
        self.running = True
        self._count, self._process, self._log, self._copy = count, process, log, copy
        self._cancelled = False
        self._began, self._before = time.monotonic(), self._there()

    def cancel(self) -> None:
        """Stops it; the same capture goes on from there."""
        self._cancelled = True
        self._process.terminate()

    def step(self) -> bool:
        """For ``processes.follow``: show what is new; return whether it goes on."""
        code, there = self._process.poll(), self._there()
        self.running, self.fraction = code is None, there / self._count
        if there > self._before:
            left = (time.monotonic() - self._began) / (there - self._before) * (self._count - there)
            self.message = f"View {min(there + 1, self._count)} of {self._count}, {duration(left)} left"
        if there == self._count:
            self.message = "Finding points"
        if code is not None:
            self._copy.unlink(missing_ok=True)
            self.message = "Captured" if code == 0 else f"Stopped after {there} of {self._count} views"
            self.problem = "" if code == 0 or self._cancelled else self._why(code, there)
        extension.redraw()
        return self.running

    def _why(self, code: int, there: int) -> str:
        if there == self._before and not 0 <= code < 256:  # which only the system gives
            return (
                "Blender crashed at the first view. EEVEE and Workbench need graphics, in background too. "
                f"Where there are none choose Cycles; {self._log} tells more."
            )
        return processes.problem_of(self._log, code)

    def _there(self) -> int:
        return len(list((self.folder / CAMERAS).glob("*.json")))


current: Capturing | None = None
"""The capture that is at work, or was last."""


def folder_of(scene: bpy.types.Scene) -> Path:
    """Where a Blender scene is captured to.

    Raises:
        LodgsError: no folder is chosen, and the .blend is not saved.
    """
    folder = scene.lodgs_capture.folder
    if not folder and not bpy.data.filepath:
        raise LodgsError("The .blend is not saved yet.", "Save it, or choose a folder for the capture.")
    return Path(bpy.path.abspath(folder or "//lodgs_capture")).resolve()


def start(context: bpy.types.Context) -> Capturing:
    """Begin to capture the Blender scene as it is now, or go on with it.

    Raises:
        LodgsError: one is at work, no trainer, no such views, or the folder cannot be written.
    """
    global current
    if current is not None and current.running:
        raise LodgsError("A capture is at work already.", "Wait for it or cancel it.")
    folder = folder_of(context.scene)
    count = len(viewpoints.of_scene(context, *viewpoints.size(context.scene, context.scene.lodgs_capture)))
    environment.require(environment.trainer_python())
    copy, log = folder / "capture.blend", folder / "capture.log"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True, check_existing=False)
        trusted = [] if bpy.app.autoexec_fail else ["--enable-autoexec"]  # as it is here
        command = [
            bpy.app.binary_path,
            *trusted,
            "--command",
            "lodgs",
            "capture",
            str(copy),
            "--out",
            str(folder),
        ]
        process = processes.spawn(command, log=log, output=folder / "capture.out")
    except (OSError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or str(error).strip()
        raise LodgsError(f"{folder} cannot be captured to: {why}.", "Choose another folder.") from error
    current = Capturing(folder, count, process, log, copy)
    return current


def unregister() -> None:
    """A capture ends with Blender: another one goes on with it."""
    if current is not None and current.running:
        current.cancel()
