"""Preparation of photos for training by background programs that run one after the other.

Steps: extract frames from a video, find the cameras of the photos, undistort the photos.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.scenes.colmap import Scene, read_scene
from ...training.scenes.undistort import cached_undistorted_scene
from ...training.splats.dialects import Warn
from .. import extension
from ..data import importing, photographs, roots
from ..data.paths import absolute_path
from . import environment, processes
from .program_sequence import ProgramSequence
from .watch import root_by_uid

current: ProgramSequence | None = None
"""The running or last preparation."""


def find_cameras(
    photos: Path, folder: Path, preset: str = "draft", ordered: bool = False, lens: str = ""
) -> ProgramSequence:
    """Find the cameras of photos, then import the scene. Continue if this was started before.

    Args:
        photos: folder of photos, or a video whose frames are extracted first.
        folder: folder of the new COLMAP scene.
        preset: see ``reconstruct``.
        ordered: see ``reconstruct``.
        lens: see ``reconstruct``.

    Raises:
        LodgsError: a preparation is running, the trainer is missing, or the folder is not writable.
    """
    commands = []
    if photos.is_file():
        video = photos
        photos = folder / "images"
        ordered = True
        lens = "one"
        commands.append(
            [bpy.app.binary_path, "--command", "lodgs", "frames", str(video), "--out", str(photos)]
        )
    options = ["--preset", preset, *(["--ordered"] if ordered else []), *(["--lens", lens] if lens else [])]
    commands.append(["scene", "--photos", str(photos), "--out", str(folder), *options])
    commands.append(["undistort", str(folder)])

    def finish(work: ProgramSequence) -> None:
        is_first = not roots.roots(bpy.context.scene)
        work.root = importing.import_colmap(bpy.context, folder, warn=work.warnings.append)
        if is_first:  # otherwise keep the view of the scene that is open
            photographs.look_at_scene(bpy.context, work.root, work.warnings.append)
        work.message = work.results[-2]
        extension.undo_step("Import Photos")

    environment.require(environment.trainer_python())
    return _start(folder / "colmap.log", commands, finish, "Reading the photos")


def undistort_photos(root: bpy.types.Object, warn: Warn) -> None:
    """Undistort the photos of a scene and show the results in its views.

    With a window, this runs in the background. Problems, such as a missing trainer, are reported as warnings.
    """
    distorted = [view for view in photographs.views(root) if view.data.lodgs.distorted]
    if not distorted:
        return
    uid = root.session_uid
    settings = root.lodgs.training
    scene = absolute_path(root.lodgs.scene_folder)
    paths = {"--model": settings.model, "--images": settings.images}
    options = [text for name, path in paths.items() if path for text in (name, str(absolute_path(path)))]
    log = extension.user_folder("logs") / "undistort.log"

    def finish(work: ProgramSequence) -> None:
        root = root_by_uid(uid)
        if root is None:  # another file has been opened
            return
        scene = _read_scene(root)
        undistorted = cached_undistorted_scene(scene)
        if undistorted is not None:
            photographs.show_undistorted(bpy.context, root, scene.names, undistorted)
        work.message = f"{len(distorted)} photos were undistorted"

    try:
        work = _start(
            log, [["undistort", str(scene), *options]], finish, f"Undistorting {len(distorted)} photos"
        )
    except LodgsError as error:
        warn(
            f"{len(distorted)} views have lens distortion, so photos and points do not match exactly. "
            f"Training undistorts them. {error.what}"
        )
        return
    work.root = root
    processes.follow(work.step)
    if work.problem:
        warn(work.problem)


def _read_scene(root: bpy.types.Object) -> Scene:
    settings = root.lodgs.training
    model, images = (absolute_path(path) if path else None for path in (settings.model, settings.images))
    return read_scene(absolute_path(root.lodgs.scene_folder), model, images)


def _start(
    log: Path, commands: list[list[str]], finish: Callable[[ProgramSequence], None], message: str
) -> ProgramSequence:
    """Run commands one after the other. Commands that do not start Blender are arguments of the trainer."""
    global current
    if current is not None and current.running:
        raise LodgsError(
            "Cannot prepare the photos: other photos are already being prepared.", "Wait for them, or cancel."
        )
    trainer = [str(environment.trainer_python()), "-m", "training"]
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        programs = [
            command if command[0] == bpy.app.binary_path else [*trainer, *command] for command in commands
        ]
        current = ProgramSequence(log, programs, finish, message)
    except OSError as error:
        raise LodgsError(
            f"Cannot write to {log.parent}: {error.strerror or error}.", "Choose another folder."
        ) from error
    return current


def clear_result() -> None:
    """Clear the last result, so that the panel does not show it for another scene."""
    global current
    if current is not None and not current.running:
        current = None


def unregister() -> None:
    """Cancel the preparation when Blender exits. It can be continued later."""
    if current is not None and current.running:
        current.cancel()
