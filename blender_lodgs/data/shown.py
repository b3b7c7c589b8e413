"""Which splats a Blender scene shows, and how much of each: what viewports and renders draw.

A splat instance is an object of a splat point cloud (see ``objects``): a level of a splat scene, a copy of
one, any other object that carries such attributes, or an instance of any of these. What is shown of it is
what its modifiers leave, so that distances and fading count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np

from .. import attributes
from . import looks, roots, selection, streams
from .placement import axes_of


@dataclass(frozen=True)
class SplatInstance:
    """A visible object, or instance of one, that holds splats.

    Attributes:
        object: the original, not the evaluated one.
        evaluated: the same as its modifiers leave it; only valid as long as the depsgraph is not evaluated.
        matrix_world: (4, 4) float64, from the splats' space to Blender's world.
        level: number of the level in its splat scene, 1 is the coarsest; 0 for splats that are no level.
        antialias: see ``SplatScene.antialias``.
        source: from where finer splats are to be read than the levels of its scene hold. All of them are
            instances beside it then, and what is read stands for them all, in the place of the finest.
        looks: see ``looks.looks_of``.
    """

    object: bpy.types.Object
    evaluated: bpy.types.Object
    matrix_world: np.ndarray
    level: int
    antialias: bool
    source: streams.Source | None = None
    looks: tuple[looks.PlacedLook, ...] = ()


@dataclass(frozen=True)
class SplatArrays:
    """N splats in their object's space, float32, ready to be drawn: activated, and of unit rotations.

    Attributes:
        means: (N, 3).
        quats: (N, 4) wxyz.
        scales: (N, 3) standard deviations.
        opacities: (N,) in [0, 1].
        sh: (N, K, 3); colour = 0.5 + sum of coefficient * basis. A view of memory in the order (K, N, 3), as
            Blender has it.
        weights: (N,) in [0, 1], factors on the opacities by level of detail; None where all are 1.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    weights: np.ndarray | None

    def __len__(self) -> int:
        return len(self.means)


def splat_instances(
    depsgraph: bpy.types.Depsgraph, viewport: bpy.types.SpaceView3D | None = None
) -> list[SplatInstance]:
    """The visible splat instances, coarse levels first.

    Visibility is the depsgraph's: that of its view layer, and by ``depsgraph.mode`` of renders or viewports.

    Args:
        viewport: leave out what this viewport hides by itself (its local view, its object types).
    """
    if not any(is_splats(cloud) for cloud in bpy.data.pointclouds):
        return []
    levels = {
        item.object: (item.number, root)
        for root in roots.roots(depsgraph.scene)
        for item in root.lodgs.levels
        if item.object is not None
    }
    found, own_looks = [], {}
    for instance in depsgraph.object_instances:  # visible ones only
        obj = instance.object
        if obj.type != "POINTCLOUD" or not is_splats(obj.original.data):
            continue
        shown_by = (instance.parent if instance.is_instance else obj).original
        if viewport is not None and not shown_by.visible_in_viewport_get(viewport):
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        original = obj.original
        evaluated = original.evaluated_get(depsgraph)
        level, root = levels.get(original) or (0, roots.root_of(original))
        antialias = root is not None and root.lodgs.antialias
        together = root, evaluated.matrix_world.copy().freeze()  # levels mostly are, and have one look
        if root is not None and together not in own_looks:
            own_looks[together] = looks.looks_of(root, depsgraph, evaluated.matrix_world.inverted_safe())
        look = own_looks.get(together, ())
        found.append(SplatInstance(original, evaluated, matrix, level, antialias, looks=look))
    found.sort(key=lambda instance: (instance.level, instance.object.name))
    return _with_sources(found, depsgraph)


def without_coarser(instances: list[SplatInstance]) -> list[SplatInstance]:
    """The same, where what is read from files stands for all levels of its scene."""
    return [each for each in instances if each.source is None or each.level == each.source.level]


def choice_of_picture(instance: SplatInstance, depsgraph: bpy.types.Depsgraph) -> selection.LodQuery | None:
    """By what a picture of the scene's camera chooses an instance's splats; None where all are shown.

    That is what modifiers choose by. Where the eye is the viewport's, there is more to be read of a file than
    that has seen: the camera asks for itself.
    """
    choice = selection.choice(instance.evaluated, depsgraph)
    root, camera = roots.root_of(instance.object), depsgraph.scene.camera
    if choice is None or not choice.rule or instance.source is None or root is None or camera is None:
        return choice
    settings = root.lodgs
    if settings.eye != "VIEW" or settings.freeze:
        return choice
    place = camera.evaluated_get(depsgraph).matrix_world.translation
    eye = tuple(axes_of(root).evaluated_get(depsgraph).matrix_world.inverted_safe() @ place)
    return replace(choice, eye=eye, focal_px=root.evaluated_get(depsgraph).lodgs.focal_px)


def _with_sources(found: list[SplatInstance], depsgraph: bpy.types.Depsgraph) -> list[SplatInstance]:
    """The same, with sources where all levels stand together, chosen by nothing but their rule."""
    sources = {root: source for root in roots.roots(depsgraph.scene) if (source := streams.source_of(root))}
    if not sources:
        return found
    of = {item.object: root for root in sources for item in root.lodgs.levels if item.exists}
    together: dict[tuple, set[int]] = {}
    for each in found:
        if each.object in of and selection.only_chosen(each.evaluated, depsgraph):
            together.setdefault((of[each.object], each.matrix_world.tobytes()), set()).add(each.level)
    numbers = {root: {item.number for item in root.lodgs.levels if item.exists} for root in sources}
    return [
        replace(each, source=sources[root])
        if (root := of.get(each.object)) in sources
        and together.get((root, each.matrix_world.tobytes())) == numbers[root]
        else each
        for each in found
    ]


def is_splats(cloud: bpy.types.PointCloud) -> bool:
    """Whether a point cloud carries the attributes of splats."""
    return all(name in cloud.attributes for name in (attributes.BASE, attributes.SCALE, attributes.ROTATION))


def read(cloud: bpy.types.PointCloud) -> SplatArrays:
    """The splats of a point cloud: ``SplatInstance.evaluated.data`` for what is shown, or any object's data.

    Attributes that modifiers have taken away leave no splats. A band of harmonics that has lost a coefficient
    is left out.
    """
    count = len(cloud.points)
    base, scales = (attributes.read_attribute(cloud, name) for name in (attributes.BASE, attributes.SCALE))
    means, quats = (attributes.read_attribute(cloud, name) for name in ("position", attributes.ROTATION))
    if count == 0 or base is None or scales is None or means is None or quats is None:
        nothing = np.zeros((0, 4), np.float32)
        return SplatArrays(
            nothing[:, :3], nothing, nothing[:, :3], nothing[:, 0], np.zeros((0, 1, 3), np.float32), None
        )
    names = attributes.sh_names(cloud)
    sh = np.empty((1 + len(names), count, 3), np.float32)
    sh[0] = base[:, :3]
    for coefficients, name in zip(sh[1:], names, strict=True):
        cloud.attributes[name].data.foreach_get("vector", coefficients.reshape(-1))
    return SplatArrays(
        means, quats, scales, base[:, 3].copy(), sh.transpose(1, 0, 2),
        attributes.read_attribute(cloud, attributes.WEIGHT),
    )  # fmt: skip


def visible_splats(
    depsgraph: bpy.types.Depsgraph, viewport: bpy.types.SpaceView3D | None = None
) -> list[tuple[SplatInstance, SplatArrays]]:
    """The visible splat instances that have splats left, each with them."""
    found = [(instance, read(instance.evaluated.data)) for instance in splat_instances(depsgraph, viewport)]
    return [(instance, splats) for instance, splats in found if len(splats)]
