"""Where the eye of a splat scene is, and what has to be at hand for it, for panels."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.lod.rule import Region
from ..attributes import read_attribute
from . import objects, selection

_counts: dict[tuple[int, Region], int] = {}
"""Splats of a point cloud, by ``session_uid``, for a region: counting takes long where there are many."""


def chosen(context: bpy.types.Context, root: bpy.types.Object) -> selection.LodQuery | None:
    """What a scene's levels are chosen by as of the last evaluation; None where none is shown by distance."""
    depsgraph = context.view_layer.depsgraph
    for item in root.lodgs.levels if depsgraph is not None else ():
        if item.exists and item.object.visible_get(view_layer=context.view_layer):
            choice = selection.choice(item.object.evaluated_get(depsgraph), depsgraph)
            return choice if choice is not None and choice.rule else None
    return None


def count_loaded(root: bpy.types.Object, choice: selection.LodQuery) -> tuple[int, float]:
    """How many splats an eye may be shown while it stays in its region, and their size in 10^6 bytes.

    All that there are where the rule, or the place, has no regions.
    """
    splats, megabytes, region = 0, 0.0, choice.region()
    for item in root.lodgs.levels:
        if item.exists and item.show:
            cloud = item.object.data
            count = len(cloud.points) if region is None else _count(cloud, choice, region)
            splats += count
            megabytes += objects.megabytes(cloud) * count / max(len(cloud.points), 1)
    return splats, megabytes


def _count(cloud: bpy.types.PointCloud, choice: selection.LodQuery, region: Region) -> int:
    key = cloud.session_uid, region
    if key not in _counts:
        nothing = np.broadcast_to(np.float32(0), len(cloud.points))
        found = {name: read_attribute(cloud, name) for name in choice.columns}
        columns = {name: nothing if values is None else values for name, values in found.items()}
        _counts[key] = int(np.count_nonzero(choice.visible_in_region(columns)))
    return _counts[key]


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.id_type_updated("POINTCLOUD"):
        _counts.clear()


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_on_update)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_on_update)
