"""Paint on a splat scene, stored in columns of its levels (``training.editing.paint``).

What LODGS draws has it mixed in where splats are read; for points and ellipsoids the modifier of the look has
it (``looks``). Files that keep the splats as trained keep their paint beside, and give it back.

Either all levels have the columns or none. A level that is trained anew takes paint over by the places of its
splats: from the one whose place it takes, or from the finest that was there before all were replaced.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import bpy
import numpy as np

from ...training.editing import paint
from ...training.errors import LodgsError
from ...training.splats.levels import Level
from ..attributes import view_attribute, write_attribute
from . import changes, selection, streams
from .cleaning import levels, view_of

Color = tuple[float, float, float]

_in_stroke: dict[int, np.ndarray] = {}
"""How a stroke that is not over would have painted point clouds, by ``session_uid``."""


def paint_of(cloud: bpy.types.PointCloud, rows: slice | np.ndarray = slice(None)) -> np.ndarray | None:
    """(N, 4) the paint of a cloud's splats, or of some rows of them; None where it has none."""
    found = [view_attribute(cloud, name) for name in paint.COLUMNS]
    return None if any(x is None for x in found) else np.stack([x[rows] for x in found], axis=1)  # type: ignore[index]


def is_painted(root: bpy.types.Object) -> bool:
    """Whether a scene's levels have paint."""
    return any(paint.COLUMNS[-1] in item.object.data.attributes for item in levels(root))


def read(root: bpy.types.Object) -> dict[int, np.ndarray]:
    """(N, 4) the paint of each level by its number, zeros where there is none.

    Raises:
        LodgsError: the levels are only the top of a tree in a file.
    """
    file = streams.file_of(root)
    if file is not None:
        raise LodgsError(
            f"Most of these splats are in {file.name}, which is not painted.",
            "Import it with Memory Budget 0, so that all are here.",
        )
    found = {}
    for item in levels(root):
        there = paint_of(item.object.data)
        found[item.number] = (
            np.zeros((len(item.object.data.points), 4), np.float32) if there is None else there
        )
    return found


def over(
    before: Mapping[int, np.ndarray], share: Mapping[int, np.ndarray], color: Color | None
) -> dict[int, np.ndarray]:
    """Paint (N, 4) of each level, of which shares (N,) give way to a display-coded colour; None: to the
    splats' own."""
    found = {}
    for number, there in before.items():
        rows = np.flatnonzero(share[number])
        found[number] = there.copy()
        found[number][rows] = paint.blend_paint(there[rows], share[number][rows], color)
    return found


def show(root: bpy.types.Object | None, painted: Mapping[int, np.ndarray]) -> None:
    """Has viewports show levels painted so while a stroke lasts; without any level as they are."""
    for cloud in [item.object.data for item in levels(root)] if root is not None else ():
        changes.others_painted(cloud)
    _in_stroke.clear()
    for item in levels(root) if root is not None and painted else ():
        _in_stroke[item.object.data.session_uid] = painted[item.number]


def shown_paint(cloud: bpy.types.PointCloud, rows: slice | np.ndarray = slice(None)) -> np.ndarray | None:
    """The paint that viewports show of a cloud, as :func:`paint_of`."""
    found = _in_stroke.get(cloud.session_uid)
    return paint_of(cloud, rows) if found is None or len(found) != len(cloud.points) else found[rows]


def write(root: bpy.types.Object, painted: Mapping[int, np.ndarray]) -> int:
    """Gives every level its paint (N, 4), or where there is none on any takes it away; how many splats have
    some."""
    count = sum(int(np.count_nonzero(each[:, 3])) for each in painted.values())
    with changes.painting():
        for item in levels(root):
            cloud = item.object.data
            for name, column in paint.paint_columns(painted[item.number]).items():
                write_attribute(cloud, name, "FLOAT", column)
            for name in paint.COLUMNS if not count else ():
                cloud.attributes.remove(cloud.attributes[name])
            cloud.update_tag()
            changes.others_painted(cloud)
        _forget(root)
        selection.follow_crops(root)
    return count


def keep(root: bpy.types.Object) -> None:
    """Remembers the paint of the finest level, for those that come in the place of all; until there is other
    paint, for all that come after these, or it would spread from one to the next."""
    if root.lodgs.painted is not None or not is_painted(root):
        return
    root.lodgs.painted = kept = levels(root)[-1].object.data.copy()
    kept.name = f"{root.name} paint"
    for name in [each.name for each in kept.attributes if not each.is_required]:
        if name not in paint.COLUMNS:
            kept.attributes.remove(kept.attributes[name])


def carried(root: bpy.types.Object, level: Level) -> Level:
    """A level that comes, with the paint of what was or is there, where it has none of its own."""
    there = levels(root)
    same = [item.object.data for item in there if item.number == level.number]
    sources = [root.lodgs.painted, *same, *(item.object.data for item in reversed(there))]
    source = next((cloud for cloud in sources if cloud and paint_of(cloud) is not None), None)
    if source is None or paint.COLUMNS[-1] in level.splats.extras:
        return level
    given = paint.transfer_paint(paint_of(source), view_of(source, "position"), level.splats.means)
    extras = level.splats.extras | paint.paint_columns(given)
    return replace(level, splats=replace(level.splats, extras=extras))


def _forget(root: bpy.types.Object) -> None:
    if (kept := root.lodgs.painted) is not None:
        root.lodgs.painted = None
        bpy.data.pointclouds.remove(kept)
