"""What is done to photographs before they are trained on: programs beside Blender, one after the other.

Frames are taken from a video, cameras are found, lenses are straightened.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.scenes.colmap import Scene, read_scene
from ...training.scenes.undistort import already_undistorted
from ...training.splats.dialects import Warn
from .. import extension
from ..data import photographs, scenes
from . import environment, processes
from .watch import root_by_uid

_TOLD = re.compile(r"(.*?) (\d+) of (\d+)$")


class Preparing:
    """Programs at work, and what the panel shows of them.

    Attributes:
        message: what is done, or how it went.
        fraction: how much of that is done, 0 to 1.
        problem: why it failed; empty when it did not.
        running: whether it is still at work.
        root: the splat scene that it is for; at first None, where it is to be imported.
        warnings: a sentence for each thing that is odd.
        told: what each program said at its end, without the name of its folder.
    """

    def __init__(
        self, log: Path, commands: list[list[str]], finish: Callable[[Preparing], None], message: str
    ) -> None:
        self.message, self.fraction, self.problem = message, 0.0, ""
        self.running, self.warnings, self.told = True, list[str](), list[str]()
        self.root: bpy.types.Object | None = None
        self._log, self._commands, self._finish, self._cancelled = log, commands, finish, False
        self._log.unlink(missing_ok=True)
        self._process = self._next()

    def cancel(self) -> None:
        """Stops it; the same again goes on from there."""
        self._cancelled = True
        self._process.terminate()

    def step(self) -> bool:
        """For ``processes.follow``: show what is new, finish at the end; return whether it goes on."""
        code, last = self._process.poll(), processes.last_lines(self._log)[-1:]
        if code == 0:
            said = processes.last_lines(self._log.with_suffix(".out"))
            self.told.append(said[-1].partition(": ")[2] if said else "")
        if code == 0 and self._commands and not self._cancelled:
            self._process, code = self._next(), None
        self.running = code is None
        if code is None and last and (told := _TOLD.match(last[0])):
            self.message, self.fraction = last[0], int(told[2]) / max(int(told[3]), 1)
        elif code == 0:
            self.fraction = 1.0
            try:
                with extension.in_window():
                    self._finish(self)
            except LodgsError as error:
                self.problem = str(error)
        elif code is not None:
            self.message = "Stopped; the same again goes on from there"
            self.problem = "" if self._cancelled else processes.problem_of(self._log, code)
        extension.redraw()
        return self.running

    def _next(self) -> subprocess.Popen:
        return processes.spawn(self._commands.pop(0), self._log, self._log.with_suffix(".out"))


current: Preparing | None = None
"""What is at work, or was last."""


def find_cameras(
    photos: Path, folder: Path, preset: str = "draft", ordered: bool = False, lens: str = ""
) -> Preparing:
    """Begin to find the cameras of photographs, or go on with it; at the end the scene is imported.

    Args:
        photos: their folder, or a video, of which frames are taken first.
        folder: that becomes the COLMAP scene.
        preset, ordered, lens: see ``reconstruct``.

    Raises:
        LodgsError: something is at work, there is no trainer, or the folder cannot be written.
    """
    commands = []
    if photos.is_file():
        video, photos, ordered, lens = photos, folder / "images", True, "one"
        commands.append(
            [bpy.app.binary_path, "--command", "lodgs", "frames", str(video), "--out", str(photos)]
        )
    options = ["--preset", preset, *(["--ordered"] if ordered else []), *(["--lens", lens] if lens else [])]
    commands.append(["scene", "--photos", str(photos), "--out", str(folder), *options])
    commands.append(["undistort", str(folder)])

    def finish(work: Preparing) -> None:
        first = not scenes.roots(bpy.context.scene)
        work.root = scenes.import_colmap(bpy.context, folder, warn=work.warnings.append)
        if first:  # otherwise the artist is looking at something
            photographs.look_at_scene(bpy.context, work.root, work.warnings.append)
        work.message = work.told[-2]
        extension.undo_step("Import Photographs")

    environment.require(environment.trainer_python())
    return _start(folder / "colmap.log", commands, finish, "Looking at the photographs")


def straighten(root: bpy.types.Object, warn: Warn) -> None:
    """Undo the lens distortion of a scene's photographs, in a window while the user works on; at the end its
    views show them so. Without a trainer, or where that cannot be, there is a warning.
    """
    bent = [view for view in photographs.views(root) if view.data.lodgs.distorted]
    if not bent:
        return
    uid, told = root.session_uid, root.lodgs.training
    scene = Path(bpy.path.abspath(root.lodgs.scene_folder))
    given = {"--model": told.model, "--images": told.images}
    options = [part for name, path in given.items() if path for part in (name, path)]
    log = extension.user_folder("logs") / "undistort.log"

    def finish(work: Preparing) -> None:
        root = root_by_uid(uid)
        if root is None:  # another file is open by now
            return
        whole = _read(root)
        found = already_undistorted(whole)
        if found is not None:
            photographs.show_undistorted(bpy.context, root, whole.names, found)
        work.message = f"{len(bent)} photographs were straightened"

    try:
        work = _start(
            log, [["undistort", str(scene), *options]], finish, f"Straightening {len(bent)} photographs"
        )
    except LodgsError as error:
        warn(
            f"{len(bent)} views have lens distortion: their photographs fit the points only roughly here. "
            f"Training undistorts them. {error.what}"
        )
        return
    work.root = root
    processes.follow(work.step)
    if work.problem:
        warn(work.problem)


def _read(root: bpy.types.Object) -> Scene:
    told = root.lodgs.training
    model, images = (Path(path) if path else None for path in (told.model, told.images))
    return read_scene(Path(bpy.path.abspath(root.lodgs.scene_folder)), model, images)


def _start(
    log: Path, commands: list[list[str]], finish: Callable[[Preparing], None], message: str
) -> Preparing:
    """Has commands done; those without a program are the trainer's."""
    global current
    if current is not None and current.running:
        raise LodgsError("Other photographs are being prepared.", "Wait for that or cancel it.")
    ours = [str(environment.trainer_python()), "-m", "training"]
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        whole = [each if each[0] == bpy.app.binary_path else [*ours, *each] for each in commands]
        current = Preparing(log, whole, finish, message)
    except OSError as error:
        raise LodgsError(
            f"{log.parent} cannot be written: {error.strerror or error}.", "Choose another folder."
        ) from error
    return current


def forget() -> None:
    """How the last work went is told no longer: another scene is looked at."""
    global current
    if current is not None and not current.running:
        current = None


def unregister() -> None:
    """It ends with Blender: another one goes on with it."""
    if current is not None and current.running:
        current.cancel()
