"""Reload of the splats of scenes whose file another program has written again.

A timer compares the file's size and time. A file that still changes is left alone until the next comparison.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import bpy

from ...training.errors import LodgsError
from .. import extension
from . import importing, photographs, roots, scenes
from .importing import SplatsFile, file_stamp
from .paths import absolute_path, automatic_path

INTERVAL = 1.0
"""Seconds between two comparisons, and the time that a file must stay unchanged before it is read."""


@dataclass
class FileWatch:
    """State of the reload of one scene.

    Attributes:
        handled: version of the file that was read or could not be read; it survives undo.
        pending: newer version at the last comparison.
        reading: file that is being read.
        notes: sentences about the last reload.
        problem: reason why the last reload failed, with its remedy; empty otherwise.
    """

    handled: str
    pending: str = ""
    reading: Future[SplatsFile] | None = None
    notes: tuple[str, ...] = ()
    problem: str = ""


_watches: dict[int, FileWatch] = {}
"""States by ``session_uid`` of the root."""


def read_source(root: bpy.types.Object) -> Callable[[], SplatsFile]:
    """Return a function that reads the file of a scene again; it may run in a thread.

    Raises:
        LodgsError: the scene was not imported from a file, or its path names a device.
    """
    settings = root.lodgs
    if not settings.source.file:
        raise LodgsError(
            f"Cannot reload '{root.name}': it was not imported from a splat file.", "Import the file instead."
        )
    path = absolute_path(settings.source.file, root.library)
    budget = settings.stream.budget if settings.stream.file else 0
    return importing.splats_reader(path, budget)


def replace_splats(root: bpy.types.Object, file: SplatsFile) -> list[str]:
    """Replace the levels of a scene by those of its file, read again.

    Placement, crops, looks, modifiers and materials stay. Paint is transferred by position. Hidden splats
    stay hidden if the file has the same splats in the same order (``cleaning.same_rows``).

    Returns:
        Sentences about the result and about lost edits.

    Raises:
        LodgsError: the file has invalid values. The scene is unchanged in that case.
    """
    settings = root.lodgs
    existing = root.lodgs.existing_levels
    previous = sum(len(item.object.data.points) for item in existing)
    finest = max((item.number for item in existing), default=0)
    deleted = 0 if settings.stream.file else settings.source.count - previous
    scenes.check_facts(root, file.bundle)
    shown_level, watch = settings.single_level, settings.source.watch
    views = [view.data.lodgs for view in photographs.views(root)]
    held_out = [(view, view.held_out) for view in views if view.is_property_set("held_out")]
    importing.refill(root, file)
    for view, value in held_out:  # the views stay
        view.held_out = value
    importing.set_source(root, file)
    settings.source.watch = watch
    if existing and shown_level != finest:
        settings.single_level = shown_level
    _watches[root.session_uid] = FileWatch(file.stamp)
    return _describe(root, previous, deleted)


def _describe(root: bpy.types.Object, previous: int, deleted: int) -> list[str]:
    """Return sentences about reloaded splats.

    Args:
        previous: number of splats before the reload.
        deleted: number of splats that had been deleted in Blender.
    """
    count = sum(len(item.object.data.points) for item in root.lodgs.levels)
    sentences = [f"Reloaded {count:,} splats (before: {previous:,})."]
    if lost := sum(item.lost for item in root.lodgs.levels):
        sentences.append(f"{lost:,} hidden splats are shown again: the file has other splats.")
    if deleted > 0:
        sentences.append(f"{deleted:,} splats that were deleted in Blender are in the file again.")
    return sentences


def watch_of(root: bpy.types.Object) -> FileWatch | None:
    """Return the state of a scene's automatic reload; None before the first comparison."""
    return _watches.get(root.session_uid)


def check_files() -> float:
    """Reload the watched scenes whose files have changed, one step at a time; return INTERVAL."""
    for root in [obj for obj in bpy.data.objects if obj.lodgs.is_root and obj.lodgs.source.watch]:
        if roots.is_local(root) and root.users_scene:
            _check(root, _watches.setdefault(root.session_uid, FileWatch(root.lodgs.source.file_version)))
    return INTERVAL


def _check(root: bpy.types.Object, watch: FileWatch) -> None:
    """Compare the file of a scene, start to read a new version, or show the version that was read."""
    if watch.reading is not None:
        if watch.reading.done() and bpy.context.mode == "OBJECT" and not _in_stroke():
            reading, watch.reading = watch.reading, None
            _show(root, watch, reading)
            extension.redraw()
        return
    path = automatic_path(root.lodgs.source.file, root.library)
    stamp = file_stamp(path) if path is not None else ""
    if not stamp or stamp == watch.handled:
        watch.pending = ""
    elif stamp != watch.pending:  # it may still be written
        watch.pending = stamp
    else:
        watch.handled, watch.pending = stamp, ""
        reader = ThreadPoolExecutor(1, "lodgs-reload")
        watch.reading = reader.submit(read_source(root))
        reader.shutdown(wait=False)


def _in_stroke() -> bool:
    """Return whether an operator of LODGS, such as the brush, is running in a window."""
    windows = bpy.context.window_manager.windows
    return any(modal.bl_idname.startswith("LODGS_") for win in windows for modal in win.modal_operators)


def _show(root: bpy.types.Object, watch: FileWatch, reading: Future[SplatsFile]) -> None:
    """Show a version that was read, as one undo step, or store the reason why it cannot be shown."""
    try:
        with extension.in_window():
            notes = replace_splats(root, reading.result())
            _watches[root.session_uid].notes = (f"{time.strftime('%H:%M')}: {notes[0]}", *notes[1:])
            extension.undo_step("Reload Splats")
    except LodgsError as error:
        watch.problem = str(error)
    except MemoryError:
        watch.problem = "Out of memory. Close other files and programs."


def register() -> None:
    if not bpy.app.background:
        bpy.app.timers.register(check_files, first_interval=INTERVAL, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(check_files):
        bpy.app.timers.unregister(check_files)
    _watches.clear()
