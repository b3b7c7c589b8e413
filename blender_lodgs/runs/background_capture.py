"""Capture of the Blender scene from the panel: a second Blender renders the views in background."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import bpy

from ...training.errors import LodgsError, system_reason
from ...training.evaluate.messages import format_duration
from ...training.scenes.rendered_views import CAMERAS
from .. import extension
from ..data import viewpoints
from ..data.paths import absolute_path, save_file
from . import environment, processes


class BackgroundCapture:
    """A background Blender that renders views, with its progress for the panel.

    Attributes:
        folder: folder of the COLMAP scene that it creates.
        message: current step, or the result.
        fraction: progress, 0 to 1.
        problem: reason of a failure. Empty otherwise.
        running: whether the program is running.
    """

    def __init__(self, folder: Path, count: int, process: subprocess.Popen, log: Path, copy: Path) -> None:
        self.folder = folder
        self.fraction = 0.0
        self.problem = ""
        self.running = True
        self._count = count
        self._process = process
        self._log = log
        self._copy = copy
        self._cancelled = False
        self._start_time = time.monotonic()
        self._start_count = self._rendered_count()
        self.message = self._progress_text(self._start_count)

    def cancel(self) -> None:
        """Stop the program. Starting the same capture again continues it."""
        self._cancelled = True
        self._process.terminate()

    def step(self) -> bool:
        """Update the progress. Return whether the program is running, for ``processes.follow``."""
        code = self._process.poll()
        rendered = self._rendered_count()
        self.running = code is None
        self.fraction = rendered / self._count
        self.message = self._progress_text(rendered)
        if code is not None:
            self._copy.unlink(missing_ok=True)
            success = "Captured" if self._start_count < self._count else "Kept the views in the folder"
            self.message = success if code == 0 else f"Stopped after {rendered} of {self._count} views"
            self.problem = "" if code == 0 or self._cancelled else self._failure_reason(code, rendered)
        extension.redraw()
        return self.running

    def _progress_text(self, rendered: int) -> str:
        if rendered >= self._count:
            return "Finding points"
        text = f"View {rendered + 1} of {self._count}"
        if rendered == self._start_count:
            return text
        seconds_per_view = (time.monotonic() - self._start_time) / (rendered - self._start_count)
        return f"{text}, {format_duration(seconds_per_view * (self._count - rendered))} left"

    def _failure_reason(self, code: int, rendered: int) -> str:
        if rendered == self._start_count and not 0 <= code < 256:  # the system killed the program
            return (
                "Blender crashed at the first view. EEVEE and Workbench need a graphics card, even in "
                f"background. Choose Cycles if this computer has none. See {self._log}."
            )
        return processes.failure_reason(self._log, code)

    def _rendered_count(self) -> int:
        return len(list((self.folder / CAMERAS).glob("*.json")))


current: BackgroundCapture | None = None
"""The running or last capture."""


def capture_folder(scene: bpy.types.Scene) -> Path:
    """Return the output folder for captures of a Blender scene.

    Raises:
        LodgsError: no folder is chosen, and the .blend file is not saved.
    """
    folder = scene.lodgs_capture.folder
    if not folder and not bpy.data.filepath:
        raise LodgsError(
            "Cannot choose a folder for the capture: the .blend file is not saved.",
            "Save it, or choose a folder.",
        )
    return absolute_path(folder or "//lodgs_capture").resolve()


def start(context: bpy.types.Context, warn: viewpoints.Warn = print) -> BackgroundCapture:
    """Start to capture the current Blender scene, or continue an earlier capture.

    Args:
        warn: function called with a sentence for each camera that is left out.

    Raises:
        LodgsError: a capture is running, the trainer is missing, the views are invalid, or the folder is not
            writable.
    """
    global current
    if current is not None and current.running:
        raise LodgsError("Cannot capture: a capture is already running.", "Wait for it or cancel it.")
    folder = capture_folder(context.scene)
    size = viewpoints.image_size(context.scene, context.scene.lodgs_capture)
    count = len(viewpoints.capture_shots(context, *size, warn))
    environment.require(environment.trainer_python())
    copy, log = folder / "capture.blend", folder / "capture.log"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)
        save_file(copy, copy=True)
        trusted = [] if bpy.app.autoexec_fail else ["--enable-autoexec"]  # as in this Blender
        capture = ["--command", "lodgs", "capture", str(copy), "--out", str(folder)]
        command = [bpy.app.binary_path, *trusted, *capture]
        process = processes.spawn(command, log=log, output=folder / "capture.out")
    except (OSError, RuntimeError) as error:
        reason = system_reason(error) if isinstance(error, OSError) else str(error).strip()
        raise LodgsError(f"Cannot capture to {folder}: {reason}.", "Choose another folder.") from error
    current = BackgroundCapture(folder, count, process, log, copy)
    return current


def unregister() -> None:
    """Cancel the capture when Blender exits. It can be continued later."""
    if current is not None and current.running:
        current.cancel()
