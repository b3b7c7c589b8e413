"""Detail by distance: its current camera, and the splats that it draws, loads and saves."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.lod.rule import Region, Values, find_rule
from ...training.lod.selection import unknown_rule_error
from ..attributes import read_attribute
from . import objects, scenes, selection

_HALVINGS = 5
"""Number of bisections of a control's last step to save a share of the splats."""
_counts: dict[tuple[int, Region], int] = {}
"""Number of splats by point cloud (``session_uid``) and region; counting large clouds is slow."""


def current_query(context: bpy.types.Context, root: bpy.types.Object) -> selection.LodQuery | None:
    """Return the rule arguments of a scene's levels as of the last evaluation.

    Returns:
        None if no visible level is selected by a rule.
    """
    depsgraph = context.view_layer.depsgraph
    for item in root.lodgs.levels if depsgraph is not None else ():
        if item.exists and item.object.visible_get(view_layer=context.view_layer):
            query = selection.evaluated_query(item.object.evaluated_get(depsgraph), depsgraph)
            return query if query is not None and query.rule else None
    return None


def count_loaded(root: bpy.types.Object, query: selection.LodQuery) -> tuple[int, float]:
    """Return the number and size (10^6 bytes) of splats that may be visible within the camera's region.

    If the rule has no regions, all splats of the scene count.
    """
    splats, megabytes, region = 0, 0.0, query.region()
    for item in root.lodgs.levels:
        if item.exists and item.show:
            cloud = item.object.data
            count = len(cloud.points) if region is None else _count(cloud, query, region)
            splats += count
            megabytes += objects.megabytes(cloud) * count / max(len(cloud.points), 1)
    return splats, megabytes


def saved_share(context: bpy.types.Context, root: bpy.types.Object) -> float:
    """Return the share of the finest level's splats that By Distance leaves out at the current camera."""
    visible, total = scenes.count_visible(context, root)
    finest = root.lodgs.existing_levels[-1:]
    full = total if root.lodgs.cumulative else sum(len(item.object.data.points) for item in finest)
    return max(1 - visible / full, 0.0) if full else 0.0


def reduce_detail(context: bpy.types.Context, root: bpy.types.Object, share: float) -> float:
    """Change the rule's main control until By Distance leaves out a share of the finest level's splats.

    Returns:
        The share that is left out.

    Raises:
        LodgsError: no known rule, or no value of the control saves more splats. The controls are
            then as before.
    """
    rule = find_rule(root.lodgs.rule)
    if rule is None:
        raise LodgsError(*unknown_rule_error(root.lodgs.rule))
    numbers = [item.number for item in root.lodgs.existing_levels]
    values = initial = {control.name: getattr(root.lodgs.controls, control.name) for control in rule.controls}
    saved = first = saved_share(context, root)
    previous = None
    while saved < share and (coarser := rule.less_detail(values, numbers)) is not None:
        previous, values = values, coarser
        saved = _saved_with(context, root, values)
    if saved < share and saved <= first:
        _saved_with(context, root, initial)
        raise LodgsError(
            "Cannot save splats: coarser levels draw as many at this camera.",
            "Move the camera away from the splats, or train more levels.",
        )
    if previous is not None and saved >= share:
        saved = _refine(context, root, previous, values, share)
    return saved


def _saved_with(context: bpy.types.Context, root: bpy.types.Object, values: Values) -> float:
    """Set controls of a root's rule; return :func:`saved_share` with them."""
    for name, value in values.items():
        setattr(root.lodgs.controls, name, value)
    context.view_layer.update()
    return saved_share(context, root)


def _refine(
    context: bpy.types.Context, root: bpy.types.Object, low: Values, high: Values, share: float
) -> float:
    """Bisect between controls that save less than a share and others that save more; return the saved share.

    Switches and whole numbers keep their higher value.
    """
    for _ in range(_HALVINGS):
        middle = {
            name: (low[name] + value) / 2 if isinstance(value, float) else value
            for name, value in high.items()
        }
        if _saved_with(context, root, middle) >= share:
            high = middle
        else:
            low = middle
    return _saved_with(context, root, high)


def _count(cloud: bpy.types.PointCloud, query: selection.LodQuery, region: Region) -> int:
    key = cloud.session_uid, region
    if key not in _counts:
        zeros = np.broadcast_to(np.float32(0), len(cloud.points))
        attributes = {name: read_attribute(cloud, name) for name in query.columns}
        columns = {name: zeros if values is None else values for name, values in attributes.items()}
        _counts[key] = int(np.count_nonzero(query.visible_in_region(columns)))
    return _counts[key]


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.id_type_updated("POINTCLOUD"):
        _counts.clear()


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_on_update)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_on_update)
