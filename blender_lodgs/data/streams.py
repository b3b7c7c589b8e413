"""Streaming of large files: the scene stores the coarsest splats, LODGS reads finer ones from the file.

The scene's objects hold the coarsest splats as complete levels: modifiers, exports and saved files use these.
LODGS draws finer splats from the file as the camera approaches. One budget covers both.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy

from ..attributes import HIDDEN
from .paths import absolute_path, automatic_path, library_of, stored_path

RESIDENT_SHARE = 0.25
"""Share of the budget for the scene's own objects."""
MAX_RESIDENT = 250_000
"""Maximum number of splats in the scene's own objects: Blender evaluates them in its main thread."""


@dataclass(frozen=True)
class Source:
    """File with a scene's finer splats.

    Attributes:
        scene: ``session_uid`` of the root.
        path: bundle.
        total: number of splats in the bundle.
        budget: maximum number of streamed splats in memory, in addition to those of the scene's objects.
        scene_splats: number of splats in the scene's objects.
        level: number of the finest level; streamed splats replace it.
        file_changes: counter that changes when the file may have been replaced.
    """

    scene: int
    path: Path
    total: int
    budget: int
    scene_splats: int
    level: int
    file_changes: int


def resident_count(budget: int) -> int:
    """Return the maximum number of splats of a larger file in the scene's objects."""
    return max(min(int(RESIDENT_SHARE * budget), MAX_RESIDENT), 1)


def start_streaming(root: bpy.types.Object, path: Path, budget: int, total: int) -> None:
    """Start streaming for a scene that holds the coarsest splats of a file."""
    stream = root.lodgs.stream
    stream.file = stored_path(path)
    stream.budget, stream.total, stream.scene_splats = budget, total, _count_splats(root)
    stream.file_changes += 1


def stop_streaming(root: bpy.types.Object) -> None:
    """Stop streaming; the scene shows only its own splats."""
    root.lodgs.stream.file = ""


def file_of(root: bpy.types.Object) -> Path | None:
    """Return the file whose top a scene holds, or None.

    Raises:
        LodgsError: the path names a device.
    """
    file = root.lodgs.stream.file
    return absolute_path(file, library_of(root)) if file else None


def source_of(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Source | None:
    """Return the source of a scene's finer splats.

    Args:
        depsgraph: use animated settings as evaluated in it; None for the original ones.

    Returns:
        None if the scene has all splats, shows a single level, or was edited, or if its file is on another
        computer, see ``automatic_path``.
    """
    settings, evaluated = root.lodgs, root.evaluated_get(depsgraph) if depsgraph else root
    path = automatic_path(settings.stream.file, library_of(root))
    if path is None or evaluated.lodgs.mode != "SELECTIVE" or is_edited(root):
        return None
    stream = settings.stream
    finest = max(item.number for item in settings.existing_levels)
    budget = max(stream.budget - stream.scene_splats, 0)
    return Source(
        root.session_uid, path, stream.total, budget, stream.scene_splats, finest, stream.file_changes
    )


def is_edited(root: bpy.types.Object) -> bool:
    """Return True if splats of a scene were added, removed or hidden since it was read from its file."""
    levels = [item.object.data for item in root.lodgs.existing_levels]
    if any(HIDDEN in cloud.attributes for cloud in levels):
        return True
    return not levels or _count_splats(root) != root.lodgs.stream.scene_splats


def _count_splats(root: bpy.types.Object) -> int:
    return sum(len(item.object.data.points) for item in root.lodgs.existing_levels)
