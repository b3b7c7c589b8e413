"""Clean-up of a splat scene: hide, show and delete the splats that ``training.editing.cleaning`` finds.

Hidden splats are a boolean attribute of their level's points; one modifier drops them (``crops``). A level
that is trained anew has other points, of which none is hidden: the panel says how many were. Crops act on
whatever comes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import bpy
import numpy as np

from ...training.editing import cleaning
from ...training.errors import LodgsError
from ...training.lod.crop import crop_mask
from ...training.lod.rules.cut import RULE as CUT
from ...training.lod.tree.resident import COLUMNS
from ...training.scenes.cameras import Camera
from ...training.splats.levels import Bundle
from ..attributes import BASE, HIDDEN, SCALE, SELECTION, read_attribute, view_attribute, write_attribute
from . import changes, crops, photographs, selection
from .cameras import view_from
from .placement import axes_of
from .properties import SplatLevel

TESTS = [
    ("LARGE", "Large", "Splats larger than a length: fog, and what stands in the way"),
    ("FAINT", "Faint", "Splats of little opacity"),
    ("FAR", "Far", "Splats far from every camera of the photographs"),
    ("UNSEEN", "Seen by Few", "Splats in the frames of few cameras, whether or not something hides them"),
    ("FLOATERS", "Floaters", "Clusters of few splats with nothing near them"),
    ("SELECTED", "Selected", "Splats that are selected, with the brush, the lasso or in Edit Mode"),
]
"""What can be found, as Blender lists it."""

Test = Callable[[bpy.types.PointCloud], np.ndarray]
"""Which splats of a level it finds, (N,) bool."""

_in_stroke: dict[int, np.ndarray] = {}
"""What a stroke that is not over would have selected of point clouds, by ``session_uid``."""
_counts: dict[int, tuple[tuple, int]] = {}
"""How many splats of a point cloud are left, by ``session_uid``, and what that depends on."""


def large(root: bpy.types.Object, most: float) -> Test:
    """Finds splats whose largest standard deviation is above a length of the world."""
    most /= unit_of(root)
    return lambda cloud: cleaning.find_large(view_of(cloud, SCALE), most)


def faint(least: float) -> Test:
    """Finds splats of less opacity."""
    return lambda cloud: cleaning.find_faint(view_of(cloud, BASE)[:, 3], least)


def far(context: bpy.types.Context, root: bpy.types.Object, most: float) -> Test:
    """Finds splats that are farther than a length of the world from every camera.

    Raises:
        LodgsError: as :func:`cameras`.
    """
    eyes = np.array([camera.center for camera in cameras(context, root)])
    most /= unit_of(root)
    return lambda cloud: cleaning.find_far(view_of(cloud, "position"), eyes, most)


def unseen(context: bpy.types.Context, root: bpy.types.Object, least: int) -> Test:
    """Finds splats in the frames of fewer cameras than that.

    Raises:
        LodgsError: as :func:`cameras`.
    """
    views = cameras(context, root)
    return lambda cloud: cleaning.find_unseen(view_of(cloud, "position"), views, least)


def selected(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Finds splats that are selected, by a stroke or in Edit Mode."""
    found = read_attribute(cloud, SELECTION)
    return np.zeros(len(cloud.points), bool) if found is None else found.astype(bool)


def find(root: bpy.types.Object, test: Test) -> dict[int, np.ndarray]:
    """What a test finds of each level, (N,) bool by its number, but for splats that are hidden already; of a
    tree among the leaves, with the nodes that stand for nothing else."""
    found = {item.number: test(item.object.data) & ~hidden(item.object.data) for item in levels(root)}
    return _with_nodes(root, found)


def find_floaters(
    context: bpy.types.Context, root: bpy.types.Object, gap: float, share: float
) -> dict[int, np.ndarray]:
    """The floaters among what hiding and crops leave: see ``cleaning.find_floaters``.

    Args:
        gap: a length of the world; 0: ``cleaning.default_gap``.
    """
    cropped = crops.as_objects_stand(root, context.evaluated_depsgraph_get())
    means = {item.number: view_of(item.object.data, "position") for item in levels(root)}
    left = {
        item.number: ~hidden(item.object.data) & crop_mask(cropped, means[item.number])
        for item in levels(root)
    }
    stays = {number: mask.copy() for number, mask in left.items()}
    cleaning.exclude_floaters(stays, means, gap / unit_of(root), share, _family(root))
    return _with_nodes(root, {number: left[number] & ~mask for number, mask in stays.items()})


def hide(root: bpy.types.Object, found: Mapping[int, np.ndarray]) -> int:
    """Hides splats, (N,) bool of each level by its number; how many."""
    count = 0
    for item in levels(root):
        cloud, mask = item.object.data, found[item.number]
        if mask.any():
            write_attribute(cloud, HIDDEN, "BOOLEAN", hidden(cloud) | mask)
            cloud.update_tag()
            count += int(mask.sum())
        item.lost = 0
    selection.follow_crops(root)
    return count


def select(root: bpy.types.Object, found: Mapping[int, np.ndarray]) -> int:
    """Selects splats, in place of those that are, as Edit Mode does; how many."""
    with changes.selecting():
        for item in levels(root):
            write_attribute(item.object.data, SELECTION, "BOOLEAN", found[item.number])
            item.object.data.update_tag()
    return sum(int(mask.sum()) for mask in found.values())


def select_also(root: bpy.types.Object, found: Mapping[int, np.ndarray], remove: bool = False) -> int:
    """Selects splats, (N,) of each level by its number and not 0 where it is found, beside those that are, or
    no longer.

    Hidden ones are not; of a tree leaves are, with the nodes that stand for nothing else.

    Returns:
        How many are.
    """
    both = {}
    for item in levels(root):
        both[item.number] = mask = selected(item.object.data)
        mask[found[item.number] > 0] = not remove
        mask &= ~hidden(item.object.data)
    return select(root, _with_nodes(root, both))


def show_selected(root: bpy.types.Object | None, found: Mapping[int, np.ndarray]) -> None:
    """Has viewports show splats as selected while a stroke lasts; without any level those that are."""
    _in_stroke.clear()
    for item in levels(root) if root is not None and found else ():
        _in_stroke[item.object.data.session_uid] = found[item.number]
    changes.others_selected()


def shown_selected(cloud: bpy.types.PointCloud) -> np.ndarray:
    """(N,) bool, which splats viewports show as selected."""
    found = _in_stroke.get(cloud.session_uid)
    return selected(cloud) if found is None or len(found) != len(cloud.points) else found


def count_selected(root: bpy.types.Object) -> dict[int, int]:
    """How many splats of each level are selected, and not hidden, by its number."""
    return {
        item.number: int(np.count_nonzero(selected(item.object.data) & ~hidden(item.object.data)))
        for item in levels(root)
    }


def show_all(root: bpy.types.Object) -> int:
    """Shows hidden splats again; how many."""
    count = 0
    for item in levels(root):
        cloud = item.object.data
        if HIDDEN in cloud.attributes:
            count += int(hidden(cloud).sum())
            cloud.attributes.remove(cloud.attributes[HIDDEN])
            cloud.update_tag()
        item.lost = 0
    selection.follow_crops(root)
    return count


def left(root: bpy.types.Object, bundle: Bundle, depsgraph: bpy.types.Depsgraph) -> Bundle:
    """The levels of a scene without what is hidden and what crops leave out; see ``cleaning.keep_splats``.

    Raises:
        LodgsError: nothing is left.
    """
    cropped, clouds = crops.as_objects_stand(root, depsgraph), {item.number: item for item in levels(root)}
    masks = {
        level.number: crop_mask(cropped, level.splats.means) & ~hidden(clouds[level.number].object.data)
        for level in bundle.levels
    }
    return bundle if all(mask.all() for mask in masks.values()) else cleaning.keep_splats(bundle, masks)


def count_left(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> dict[int, tuple[int, int]]:
    """By the level's number how many splats hiding and crops leave, and how many there are."""
    cropped, found = crops.as_objects_stand(root, depsgraph), {}
    for item in levels(root):
        cloud = item.object.data
        there = changes.version(cloud), len(cloud.points), cropped
        if _counts.get(cloud.session_uid, (None, 0))[0] != there:
            mask = crop_mask(cropped, view_of(cloud, "position")) & ~hidden(cloud)
            _counts[cloud.session_uid] = there, int(np.count_nonzero(mask))
        found[item.number] = _counts[cloud.session_uid][1], len(cloud.points)
    return found


def hidden(cloud: bpy.types.PointCloud) -> np.ndarray:
    """(N,) bool, which splats are hidden."""
    found = read_attribute(cloud, HIDDEN)
    return np.zeros(len(cloud.points), bool) if found is None else found.astype(bool)


def cameras(context: bpy.types.Context, root: bpy.types.Object) -> list[Camera]:
    """The cameras of a scene's photographs, or where it has none those of the Blender scene, in the splats'
    space.

    Raises:
        LodgsError: there are none, or the root is stretched.
    """
    views = photographs.views(root)
    width, height = (context.scene.render.resolution_x, context.scene.render.resolution_y)
    depsgraph = context.evaluated_depsgraph_get()
    found = [
        # where views are hidden, Blender does not know where they stand
        photographs.camera_of(view)
        if view.data.lodgs.width
        else view_from(root, depsgraph, width, height, view)[0]
        for view in views or [obj for obj in context.scene.objects if obj.type == "CAMERA"]
    ]
    if not found:
        raise LodgsError(
            f"'{root.name}' has no cameras.",
            "Import its photographs, or add cameras to the Blender scene.",
        )
    return found


def unit_of(root: bpy.types.Object) -> float:
    """How long a unit of the splats is in the world."""
    return max(axes_of(root).matrix_world.to_scale()) or 1.0


def suggestions(context: bpy.types.Context, root: bpy.types.Object) -> dict[str, float]:
    """Limits to begin with, by name, lengths in the world: such that of the finest level about one splat in a
    hundred is larger, and one in twenty is farther off."""
    cloud, unit = levels(root)[-1].object.data, unit_of(root)
    means, scales = view_of(cloud, "position"), view_of(cloud, SCALE)
    some = slice(None, None, max(len(means) // 100_000, 1))
    found = {
        "size": float(np.quantile(scales[some].max(axis=1), 0.99)) * unit,
        "gap": cleaning.default_gap(means) * unit,
    }
    try:
        eyes = np.array([camera.center for camera in cameras(context, root)], np.float32)
    except LodgsError:
        return found
    away = np.full(len(means[some]), np.inf, np.float32)
    for eye in eyes:
        np.minimum(away, np.linalg.norm(means[some] - eye, axis=1), out=away)
    return found | {"distance": float(np.quantile(away, 0.95)) * unit}


def bounds(root: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), along the world's axes, of a box with some room around nine tenths of the finest level on
    each, or of the points where there is none: flat ground often lies in its outermost layer.

    Raises:
        LodgsError: there are neither.
    """
    objects = [item.object for item in levels(root)] or [root.lodgs.points]
    if objects[-1] is None:
        raise LodgsError(f"'{root.name}' has neither splats nor points.", "Import them, or train.")
    means = view_of(objects[-1].data, "position")
    matrix = np.array(axes_of(root).matrix_world, np.float64)
    placed = means[:: max(len(means) // 100_000, 1)] @ matrix[:3, :3].T + matrix[:3, 3]
    low, high = np.quantile(placed, (0.05, 0.95), axis=0)
    room = 0.05 * np.maximum(high - low, 0.1 * max((high - low).max(), 1e-6))
    return low - room, high + room


def levels(root: bpy.types.Object) -> list[SplatLevel]:
    """The levels that are there, coarse to fine."""
    return [item for item in root.lodgs.levels if item.exists]


def _with_nodes(root: bpy.types.Object, found: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """The same; of a tree what is found of leaves, and the nodes of which then nothing else is left."""
    family = _family(root)
    if family is None:
        return found
    gone = {item.number: found[item.number] | hidden(item.object.data) for item in levels(root)}
    stays = family.with_ancestors({number: ~mask for number, mask in gone.items()})
    return {item.number: ~stays[item.number] & ~hidden(item.object.data) for item in levels(root)}


def _family(root: bpy.types.Object) -> cleaning.TreeRelations | None:
    """Who stands for whom, where the levels are a tree."""
    if root.lodgs.rule != CUT.name:
        return None
    columns, means = {}, {}
    for item in levels(root):
        cloud = item.object.data
        means[item.number] = read_attribute(cloud, "position")
        nothing = np.zeros(len(cloud.points), np.float32)
        found = {name: read_attribute(cloud, name) for name in COLUMNS}
        columns[item.number] = {name: nothing if x is None else x for name, x in found.items()}
    return cleaning.TreeRelations(columns, means)


def view_of(cloud: bpy.types.PointCloud, name: str) -> np.ndarray:
    """An attribute of splats, see ``attributes.view_attribute``.

    Raises:
        LodgsError: the cloud has it no more.
    """
    found = view_attribute(cloud, name)
    if found is None:
        raise LodgsError(f"{cloud.name} carries no splats.", "Undo what took its attributes away.")
    return found
