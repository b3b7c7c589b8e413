"""Clean-up of a splat scene: hide, show, select and delete splats (``training.editing.cleaning``).

Hidden splats are marked in a boolean attribute of their level's points; a modifier drops them (``crops``). A
level that is trained again has new points, none of them hidden; the panel reports how many were hidden
before. Crops also apply to new points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress

import bpy
import numpy as np

from ...training.editing import cleaning
from ...training.editing.clutter import KINDS
from ...training.errors import LodgsError
from ...training.lod.crop import crop_mask
from ...training.lod.query import LodQuery, SplatSelector
from ...training.lod.rule import OPACITY, Relations, resolve_rule
from ...training.scenes.cameras import Camera
from ...training.splats.levels import Bundle
from ..attributes import BASE, HIDDEN, SCALE, SELECTION, read_attribute, view_attribute, write_attribute
from . import changes, crops, photographs, selection
from .cameras import UnsupportedCameraError, view_from
from .objects import root_of
from .placement import axes_of, world_matrix

Test = Callable[[bpy.types.PointCloud], np.ndarray]
"""Function from a level's point cloud to a mask (N,) bool."""


_in_stroke: dict[int, np.ndarray] = {}
"""Selection masks of the current stroke, by ``session_uid`` of the point cloud."""
_marks: dict[int, np.ndarray] = {}
"""Marks of previewed clutter, by ``session_uid`` of the point cloud."""
_counts: dict[int, tuple[tuple, int]] = {}
"""Cache keys and numbers of remaining splats, by ``session_uid`` of the point cloud."""


def size_test(root: bpy.types.Object, max_size: float) -> Test:
    """Return a test for splats whose largest standard deviation exceeds a length in the world."""
    max_size /= unit_length(root)
    return lambda cloud: cleaning.find_large(splat_attribute(cloud, SCALE), max_size)


def opacity_test(min_opacity: float) -> Test:
    """Return a test for splats below an opacity."""
    return lambda cloud: cleaning.find_faint(splat_attribute(cloud, BASE)[:, 3], min_opacity)


def distance_test(context: bpy.types.Context, root: bpy.types.Object, max_distance: float) -> Test:
    """Return a test for splats farther than a length in the world from every camera.

    Raises:
        LodgsError: see :func:`cameras`.
    """
    positions = np.array([camera.center for camera in cameras(context, root)])
    max_distance /= unit_length(root)
    return lambda cloud: cleaning.find_far(splat_attribute(cloud, "position"), positions, max_distance)


def views_test(context: bpy.types.Context, root: bpy.types.Object, min_views: int) -> Test:
    """Return a test for splats in the frames of fewer than ``min_views`` cameras.

    Raises:
        LodgsError: see :func:`cameras`.
    """
    views = cameras(context, root)
    return lambda cloud: cleaning.find_unseen(splat_attribute(cloud, "position"), views, min_views)


def selected_mask(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Return the (N,) bool mask of splats selected by a stroke or in Edit Mode."""
    return _mask(cloud, SELECTION)


def find(root: bpy.types.Object, test: Test) -> dict[int, np.ndarray]:
    """Apply a test to the visible splats of each level.

    Splats that depend on others, as nodes of a tree on leaves, follow them.

    Returns:
        Masks (N,) bool by level number.
    """
    masks = {
        item.number: test(item.object.data) & ~hidden_mask(item.object.data)
        for item in root.lodgs.existing_levels
    }
    return _with_dependents(root, masks)


def find_floaters(
    context: bpy.types.Context, root: bpy.types.Object, gap: float, share: float
) -> dict[int, np.ndarray]:
    """Find floaters among the splats that are neither hidden nor cropped; see ``cleaning.find_floaters``.

    Args:
        gap: length in the world; 0 for ``cleaning.default_gap``.

    Returns:
        Masks (N,) bool by level number.
    """
    cropped = crops.evaluated_crops(root, context.evaluated_depsgraph_get())
    means = {
        item.number: splat_attribute(item.object.data, "position") for item in root.lodgs.existing_levels
    }
    visible = {
        item.number: ~hidden_mask(item.object.data) & crop_mask(cropped, means[item.number])
        for item in root.lodgs.existing_levels
    }
    remaining_masks = {number: mask.copy() for number, mask in visible.items()}
    cleaning.exclude_floaters(remaining_masks, means, _relations(root), gap / unit_length(root), share)
    return _with_dependents(
        root, {number: visible[number] & ~mask for number, mask in remaining_masks.items()}
    )


def hide(root: bpy.types.Object, masks: Mapping[int, np.ndarray]) -> int:
    """Hide splats.

    Args:
        masks: (N,) bool by level number.

    Returns:
        The number of splats that were hidden.
    """
    count = 0
    for item in root.lodgs.existing_levels:
        cloud, mask = item.object.data, masks[item.number]
        if mask.any():
            write_attribute(cloud, HIDDEN, "BOOLEAN", hidden_mask(cloud) | mask)
            cloud.update_tag()
            count += int(mask.sum())
        item.lost = 0
    selection.follow_crops(root)
    return count


def select(root: bpy.types.Object, masks: Mapping[int, np.ndarray]) -> int:
    """Replace the selection, as Edit Mode does.

    Args:
        masks: (N,) bool by level number.

    Returns:
        The number of selected splats.
    """
    with changes.selecting():
        for item in root.lodgs.existing_levels:
            write_attribute(item.object.data, SELECTION, "BOOLEAN", masks[item.number])
            item.object.data.update_tag()
    return sum(int(mask.sum()) for mask in masks.values())


def extend_selection(
    root: bpy.types.Object, strengths: Mapping[int, np.ndarray], remove: bool = False
) -> int:
    """Add splats to the selection, or remove them from it.

    Hidden splats are never selected. Splats that depend on others follow them.

    Args:
        strengths: (N,) by level number; splats with values other than 0 are selected.
        remove: remove these splats from the selection instead.

    Returns:
        The number of selected splats.
    """
    masks = {}
    for item in root.lodgs.existing_levels:
        masks[item.number] = mask = selected_mask(item.object.data)
        mask[strengths[item.number] > 0] = not remove
        mask &= ~hidden_mask(item.object.data)
    return select(root, _with_dependents(root, masks))


def preview_selection(root: bpy.types.Object | None, masks: Mapping[int, np.ndarray]) -> None:
    """Display a selection in the viewports during a stroke; an empty mapping ends the preview."""
    _in_stroke.clear()
    for item in root.lodgs.existing_levels if root is not None and masks else ():
        _in_stroke[item.object.data.session_uid] = masks[item.number]
    changes.report_selected()


def mark_of(kind: str) -> int:
    """Return the mark of a kind of clutter, or of other splats with ""."""
    return 2 + [*KINDS, ""].index(kind)


def show_marks(marks: Mapping[int, np.ndarray]) -> None:
    """Display the marks (N,) uint8 of point clouds, by ``session_uid``, in place of their selection."""
    _marks.clear()
    _marks.update(marks)
    changes.report_selected()


def shows_marks(cloud: bpy.types.PointCloud, marks: np.ndarray) -> bool:
    """Return whether :func:`show_marks` displays this array for a point cloud."""
    return _marks.get(cloud.session_uid) is marks and len(marks) == len(cloud.points)


def displayed_marks(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Return the marks (N,) uint8 that viewports display: 0 none, 1 selected, else :func:`mark_of` a kind."""
    for values in (_in_stroke.get(cloud.session_uid), _marks.get(cloud.session_uid)):
        if values is not None and len(values) == len(cloud.points):
            return values.astype(np.uint8)
    return selected_mask(cloud).astype(np.uint8)


def count_selected(root: bpy.types.Object) -> dict[int, int]:
    """Return the number of selected, visible splats by level number."""
    return {
        item.number: int(np.count_nonzero(selected_mask(item.object.data) & ~hidden_mask(item.object.data)))
        for item in root.lodgs.existing_levels
    }


def show_all(root: bpy.types.Object) -> int:
    """Show hidden splats again.

    Returns:
        The number of splats that were hidden.
    """
    count = 0
    for item in root.lodgs.existing_levels:
        cloud = item.object.data
        if HIDDEN in cloud.attributes:
            count += int(hidden_mask(cloud).sum())
            cloud.attributes.remove(cloud.attributes[HIDDEN])
            cloud.update_tag()
        item.lost = 0
    selection.follow_crops(root)
    return count


def remaining(root: bpy.types.Object, bundle: Bundle, depsgraph: bpy.types.Depsgraph) -> Bundle:
    """Return the levels of a scene without hidden and cropped splats; see ``cleaning.keep_splats``.

    Raises:
        LodgsError: no splat remains.
    """
    cropped = crops.evaluated_crops(root, depsgraph)
    clouds = {item.number: item for item in root.lodgs.existing_levels}
    masks = {
        level.number: crop_mask(cropped, level.splats.means) & ~hidden_mask(clouds[level.number].object.data)
        for level in bundle.levels
    }
    return bundle if all(mask.all() for mask in masks.values()) else cleaning.keep_splats(bundle, masks)


def count_remaining(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> dict[int, tuple[int, int]]:
    """Return the number of remaining splats and of all splats by level number.

    Hidden and cropped splats do not remain.
    """
    cropped, counts = crops.evaluated_crops(root, depsgraph), {}
    for item in root.lodgs.existing_levels:
        cloud = item.object.data
        key = changes.version(cloud), len(cloud.points), cropped
        if _counts.get(cloud.session_uid, (None, 0))[0] != key:
            mask = crop_mask(cropped, splat_attribute(cloud, "position")) & ~hidden_mask(cloud)
            _counts[cloud.session_uid] = key, int(np.count_nonzero(mask))
        counts[item.number] = _counts[cloud.session_uid][1], len(cloud.points)
    return counts


def hidden_mask(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Return the (N,) bool mask of hidden splats."""
    return _mask(cloud, HIDDEN)


def _mask(cloud: bpy.types.PointCloud, name: str) -> np.ndarray:
    """Return an attribute as (N,) bool; False everywhere without the attribute."""
    values = read_attribute(cloud, name)
    return np.zeros(len(cloud.points), bool) if values is None else values.astype(bool)


def visible_opacities(cloud: bpy.types.PointCloud, means: np.ndarray, query: LodQuery | None) -> np.ndarray:
    """Return the opacities (N,) of the splats that a query selects, and 0 for all others."""
    opacities = splat_attribute(cloud, BASE)[:, 3]
    if query is None:
        return opacities
    names = {name for name in query.columns if name in cloud.attributes}
    columns = {name: view_attribute(cloud, name) for name in names - {HIDDEN}}
    columns |= {OPACITY: opacities, HIDDEN: hidden_mask(cloud)}
    rows, weights = SplatSelector(means, columns).select(query)
    visible = np.zeros(len(means), np.float32)
    visible[rows] = weights * opacities[rows]
    return visible


def cameras(context: bpy.types.Context, root: bpy.types.Object) -> list[Camera]:
    """Return the cameras of a scene in the splats' space; those of no splat scene if it has none.

    Raises:
        LodgsError: there are no cameras, or the root is scaled differently along its axes.
    """
    views = photographs.views(root)
    width, height = (context.scene.render.resolution_x, context.scene.render.resolution_y)
    depsgraph = context.evaluated_depsgraph_get()
    result = []
    others = [obj for obj in context.scene.objects if obj.type == "CAMERA" and root_of(obj) in (None, root)]
    for view in views or others:
        if views and view.data.lodgs.width:
            # Blender does not evaluate hidden views; their own pose is always valid.
            result.append(photographs.camera_of(view))
            continue
        with suppress(UnsupportedCameraError):  # such as orthographic cameras
            result.append(view_from(root, depsgraph, width, height, view)[0])
    if not result:
        raise LodgsError(
            f"Cannot find splats by camera: '{root.name}' has no cameras.",
            "Import its photos, or add cameras to the Blender scene.",
        )
    return result


def unit_length(root: bpy.types.Object) -> float:
    """Return the length of one splat unit in the world."""
    return max(world_matrix(axes_of(root)).to_scale()) or 1.0


def bounds(root: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (3,) of a box around most of the scene, along the world's axes.

    The box encloses nine tenths of the finest level along each axis, or of the points if there are no levels,
    with a margin: flat ground often lies in the outermost layer.

    Raises:
        LodgsError: the scene has neither splats nor points.
    """
    objects = [item.object for item in root.lodgs.existing_levels] or [root.lodgs.points]
    if objects[-1] is None or not len(objects[-1].data.points):
        raise LodgsError(
            f"Cannot measure '{root.name}': it has neither splats nor points.",
            "Import or train splats first.",
        )
    means = splat_attribute(objects[-1].data, "position")
    matrix = np.array(world_matrix(axes_of(root)), np.float64)
    positions = means[:: max(len(means) // 100_000, 1)] @ matrix[:3, :3].T + matrix[:3, 3]
    low, high = np.quantile(positions, (0.05, 0.95), axis=0)
    margin = 0.05 * np.maximum(high - low, 0.1 * max((high - low).max(), 1e-6))
    return low - margin, high + margin


def _with_dependents(root: bpy.types.Object, masks: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Add the visible splats that depend on others and do not remain without them."""
    removed = {
        item.number: masks[item.number] | hidden_mask(item.object.data) for item in root.lodgs.existing_levels
    }
    remaining = _relations(root).completed({number: ~mask for number, mask in removed.items()})
    return {
        item.number: ~remaining[item.number] & ~hidden_mask(item.object.data)
        for item in root.lodgs.existing_levels
    }


def _relations(root: bpy.types.Object) -> Relations:
    """Return the relations among the splats of the levels."""
    related, columns = resolve_rule(root.lodgs.rule).relations, {}
    for item in root.lodgs.existing_levels if related.columns else ():
        cloud = item.object.data
        means = dict(zip("xyz", read_attribute(cloud, "position").T, strict=True))
        zeros = np.zeros(len(cloud.points), np.float32)
        values = {
            name: means[name] if name in means else read_attribute(cloud, name) for name in related.columns
        }
        columns[item.number] = {name: zeros if x is None else x for name, x in values.items()}
    return related(columns)


def splat_attribute(cloud: bpy.types.PointCloud, name: str) -> np.ndarray:
    """Return a splat attribute without a copy; see ``attributes.view_attribute``.

    Raises:
        LodgsError: the point cloud no longer has the attribute.
    """
    values = view_attribute(cloud, name)
    if values is None:
        raise LodgsError(
            f"Cannot read '{cloud.name}': it has no splats.", "Undo the step that removed its attributes."
        )
    return values
