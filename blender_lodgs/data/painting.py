"""Paint on a splat scene, stored in columns of its levels (``training.editing.paint``).

LODGS mixes paint into the colours as it reads splats; for points and ellipsoids the look modifier does
(``looks``). Exports of unmodified splats contain the paint as separate columns, and imports restore it.

Either all levels have the columns or none. A level that is trained again takes paint over by position, from
the level that it replaces or from the finest level before all were replaced.
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
from .cleaning import splat_attribute

Color = tuple[float, float, float]

_in_stroke: dict[int, np.ndarray] = {}
"""Paint of the current stroke, by ``session_uid`` of the point cloud."""


def paint_of(cloud: bpy.types.PointCloud, rows: slice | np.ndarray = slice(None)) -> np.ndarray | None:
    """Return the paint (N, 4) of a cloud's splats or of some rows; None if it has no paint."""
    columns = [view_attribute(cloud, name) for name in paint.COLUMNS]
    return None if any(x is None for x in columns) else np.stack([x[rows] for x in columns], axis=1)  # type: ignore[index]


def is_painted(root: bpy.types.Object) -> bool:
    """Return True if a scene's levels have paint."""
    return any(paint.COLUMNS[-1] in item.object.data.attributes for item in root.lodgs.existing_levels)


def read_paint(root: bpy.types.Object) -> dict[int, np.ndarray]:
    """Return the paint (N, 4) of each level by number; zeros for levels without paint.

    Raises:
        LodgsError: the levels are only the coarsest splats of a file.
    """
    file = streams.file_of(root)
    if file is not None:
        raise LodgsError(
            f"Cannot paint '{root.name}': most of its splats are in {file.name}.",
            "Import the file with Memory Budget 0.",
        )
    paint_by_level = {}
    for item in root.lodgs.existing_levels:
        values = paint_of(item.object.data)
        paint_by_level[item.number] = (
            np.zeros((len(item.object.data.points), 4), np.float32) if values is None else values
        )
    return paint_by_level


def blend(
    painted: Mapping[int, np.ndarray], opacities: Mapping[int, np.ndarray], color: Color | None
) -> dict[int, np.ndarray]:
    """Blend a colour over the paint (N, 4) of each level.

    Args:
        painted: paint (N, 4) by level number.
        opacities: opacity (N,) of the colour by level number.
        color: display-coded colour; None for the splats' own colours, which erases paint.
    """
    result = {}
    for number, values in painted.items():
        rows = np.flatnonzero(opacities[number])
        result[number] = values.copy()
        result[number][rows] = paint.blend_paint(values[rows], opacities[number][rows], color)
    return result


def preview_paint(root: bpy.types.Object | None, painted: Mapping[int, np.ndarray]) -> None:
    """Display paint in the viewports during a stroke; an empty mapping ends the preview."""
    for cloud in [item.object.data for item in root.lodgs.existing_levels] if root is not None else ():
        changes.report_painted(cloud)
    _in_stroke.clear()
    for item in root.lodgs.existing_levels if root is not None and painted else ():
        _in_stroke[item.object.data.session_uid] = painted[item.number]


def displayed_paint(cloud: bpy.types.PointCloud, rows: slice | np.ndarray = slice(None)) -> np.ndarray | None:
    """Return the paint that viewports display on a cloud; see :func:`paint_of`."""
    preview = _in_stroke.get(cloud.session_uid)
    return paint_of(cloud, rows) if preview is None or len(preview) != len(cloud.points) else preview[rows]


def write_paint(root: bpy.types.Object, painted: Mapping[int, np.ndarray]) -> int:
    """Store the paint (N, 4) of each level; remove the columns if all levels are unpainted.

    Returns:
        The number of painted splats.
    """
    count = sum(int(np.count_nonzero(values[:, 3])) for values in painted.values())
    with changes.painting():
        for item in root.lodgs.existing_levels:
            cloud = item.object.data
            for name, column in paint.paint_columns(painted[item.number]).items():
                write_attribute(cloud, name, "FLOAT", column)
            for name in paint.COLUMNS if not count else ():
                cloud.attributes.remove(cloud.attributes[name])
            cloud.update_tag()
            changes.report_painted(cloud)
        _forget(root)
        selection.follow_crops(root)
    return count


def save_paint(root: bpy.types.Object) -> None:
    """Save the paint of the finest level for new levels that replace all others.

    The saved paint stays until the scene is painted again, so that repeated transfers do not blur it.
    """
    if root.lodgs.painted is not None or not is_painted(root):
        return
    root.lodgs.painted = saved = root.lodgs.existing_levels[-1].object.data.copy()
    saved.name = f"{root.name} paint"
    for name in [attribute.name for attribute in saved.attributes if not attribute.is_required]:
        if name not in paint.COLUMNS:
            saved.attributes.remove(saved.attributes[name])


def transfer(root: bpy.types.Object, level: Level) -> Level:
    """Return a new level with paint from the saved or existing levels, unless it has paint of its own."""
    existing = root.lodgs.existing_levels
    replaced = [item.object.data for item in existing if item.number == level.number]
    sources = [root.lodgs.painted, *replaced, *(item.object.data for item in reversed(existing))]
    source = next((cloud for cloud in sources if cloud and paint_of(cloud) is not None), None)
    if source is None or paint.COLUMNS[-1] in level.splats.extras:
        return level
    values = paint.transfer_paint(paint_of(source), splat_attribute(source, "position"), level.splats.means)
    extras = level.splats.extras | paint.paint_columns(values)
    return replace(level, splats=replace(level.splats, extras=extras))


def _forget(root: bpy.types.Object) -> None:
    if (saved := root.lodgs.painted) is not None:
        root.lodgs.painted = None
        bpy.data.pointclouds.remove(saved)
