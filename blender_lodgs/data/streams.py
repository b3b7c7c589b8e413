"""Scenes that hold the top of a tree of splats, and read the rest from its file as it is needed.

The scene's objects hold the coarsest splats, as a tree complete by itself: modifiers, exports and saved files
work with these. What LODGS itself draws is read from the file, wherever the eye comes near. There is a budget
for both together.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..attributes import HIDDEN

HELD, MOST_HELD = 0.25, 250_000
"""Share of the budget that the scene's objects hold, and how many splats at most: Blender evaluates them anew
whenever an eye rests, and all that is done with them holds its main thread."""


@dataclass(frozen=True)
class Source:
    """Where a scene's finer splats are.

    Attributes:
        scene: its root's ``session_uid``.
        path: the bundle.
        total: its splats.
        budget: how many of them may be in memory besides those that the scene's objects hold.
        here: how many the scene's objects hold.
        level: number of the finest level, in whose place all are drawn.
        begun: another one where another file may be in the place of the last.
    """

    scene: int
    path: Path
    total: int
    budget: int
    here: int
    level: int
    begun: int


def held_of(budget: int) -> int:
    """How many splats of a larger tree the scene's objects may hold."""
    return max(min(int(HELD * budget), MOST_HELD), 1)


def begin(root: bpy.types.Object, path: Path, budget: int, total: int) -> None:
    """Has a scene that has just been given the top of a tree read the rest from its file from now on."""
    stream = root.lodgs.stream
    absolute = str(path.absolute())
    stream.file = absolute
    if bpy.data.filepath and bpy.context.preferences.filepaths.use_relative_paths:
        with suppress(ValueError):  # on another drive
            stream.file = bpy.path.relpath(absolute)
    stream.budget, stream.total, stream.here = budget, total, _held(root)
    stream.begun += 1


def end(root: bpy.types.Object) -> None:
    """Has a scene show what it holds, and no file."""
    root.lodgs.stream.file = ""


def file_of(root: bpy.types.Object) -> Path | None:
    """The file of which a scene holds the top; None where it has none."""
    file = root.lodgs.stream.file
    return Path(bpy.path.abspath(file, library=root.library)) if file else None


def source_of(root: bpy.types.Object) -> Source | None:
    """From where a scene's finer splats are to be read; None where it shows what it holds: all that there is,
    one level, or what somebody has added or taken away."""
    path, settings = file_of(root), root.lodgs
    if path is None or settings.mode != "SELECTIVE" or changed(root):
        return None
    stream = settings.stream
    finest = max(item.number for item in settings.levels if item.exists)
    budget = max(stream.budget - stream.here, 0)
    return Source(root.session_uid, path, stream.total, budget, stream.here, finest, stream.begun)


def changed(root: bpy.types.Object) -> bool:
    """Whether the splats that a scene holds are other ones than came from its file, or some are hidden."""
    levels = [item.object.data for item in root.lodgs.levels if item.exists]
    if any(HIDDEN in cloud.attributes for cloud in levels):
        return True
    return not levels or _held(root) != root.lodgs.stream.here


def _held(root: bpy.types.Object) -> int:
    return sum(len(item.object.data.points) for item in root.lodgs.levels if item.exists)
