"""Visible splat instances of a Blender scene, for viewports and renders.

A splat instance is an object of a splat point cloud (see ``objects``): a level of a splat scene, a copy of
one, any other object with these attributes, or an instance of any of them. Its modifiers are applied,
including level-of-detail weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np

from .. import attributes
from . import looks, roots, selection, streams
from .placement import axes_of, require_finite

MIN_SCALE = 1e-9
"""Scale of an instance below which nothing of it is visible."""
MIN_THICKNESS = 1e-5
"""Minimum ratio of the smallest to the largest scale of an instance; the renderer refuses flat ones."""


@dataclass(frozen=True)
class SplatInstance:
    """A visible object with splats, or an instance of one.

    Attributes:
        object: original object.
        evaluated: evaluated object; valid until the depsgraph is evaluated again.
        matrix_world: (4, 4) float64, from the splats' space to Blender's world.
        level: number of the level in its splat scene, 1 is the coarsest; 0 for splats that are not a level.
        antialias: see ``SplatScene.antialias``.
        source: file with finer splats of the scene. All levels of the scene are then instances with this
            source, and streamed splats replace them at the finest one.
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
    """N activated splats in their object's space, float32.

    Attributes:
        means: (N, 3).
        quats: (N, 4) wxyz, normalised.
        scales: (N, 3) standard deviations.
        opacities: (N,) in [0, 1].
        sh: (N, K, 3); colour = 0.5 + sum of coefficient * basis. A view of memory in the order (K, N, 3), as
            in Blender.
        weights: (N,) in [0, 1], level-of-detail factors of the opacities; None if all are 1.
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
    """Return the visible splat instances, coarse levels first.

    Visibility is that of the depsgraph's view layer, for renders or viewports according to
    ``depsgraph.mode``.

    Args:
        viewport: exclude objects that this viewport hides by local view or object type, and those whose
            transform is not finite.

    Raises:
        LodgsError: without a viewport, if the transform of an object is not finite.
    """
    if not any(is_splats(cloud) for cloud in bpy.data.pointclouds):
        return []
    levels = {
        item.object: (item.number, root)
        for root in roots.roots(depsgraph.scene)
        for item in root.lodgs.existing_levels
    }
    instances, own_looks = [], {}
    for instance in depsgraph.object_instances:  # visible ones only
        obj = instance.object
        if obj.type != "POINTCLOUD" or not is_splats(obj.original.data):
            continue
        shown_by = (instance.parent if instance.is_instance else obj).original
        if viewport is not None and not shown_by.visible_in_viewport_get(viewport):
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        if viewport is None:
            require_finite(obj.original, matrix)
        matrix = _drawable(matrix)
        if matrix is None:
            continue
        original = obj.original
        evaluated = original.evaluated_get(depsgraph)
        level, root = levels.get(original) or _instanced_level(original)
        antialias = root is not None and root.lodgs.antialias
        look_key = root, evaluated.matrix_world.copy().freeze()  # levels mostly share one look
        if root is not None and look_key not in own_looks:
            own_looks[look_key] = looks.looks_of(root, depsgraph, evaluated.matrix_world.inverted_safe())
        look = own_looks.get(look_key, ())
        instances.append(SplatInstance(original, evaluated, matrix, level, antialias, looks=look))
    instances.sort(key=lambda instance: (instance.level, instance.object.name))
    return _with_sources(instances, depsgraph)


def _instanced_level(obj: bpy.types.Object) -> tuple[int, bpy.types.Object | None]:
    """Return the level number and the root of splats outside the scenes of :func:`roots.roots`.

    The number is 0 for splats that are not a level, and the root None for splats in no splat scene.
    """
    root = roots.root_of(obj)
    items = root.lodgs.levels if root is not None else ()
    return next((item.number for item in items if item.object == obj), 0), root


def _drawable(matrix: np.ndarray) -> np.ndarray | None:
    """Return the matrix (4, 4) of an instance, slightly thickened if it is flat.

    None for an instance that is scaled to a point, as objects often are at the start of an animation.
    """
    if not np.isfinite(matrix).all():
        return None
    u, scales, vh = np.linalg.svd(matrix[:3, :3])
    if scales[0] < MIN_SCALE:
        return None
    thinnest = MIN_THICKNESS * scales[0]
    if scales[2] < thinnest:
        matrix[:3, :3] = u * np.maximum(scales, thinnest) @ vh
    return matrix


def drop_streamed_levels(instances: list[SplatInstance]) -> list[SplatInstance]:
    """Return the instances without coarser levels of streamed scenes, which streamed splats replace."""
    return [
        instance
        for instance in instances
        if instance.source is None or instance.level == instance.source.level
    ]


def rule_query(instance: SplatInstance, depsgraph: bpy.types.Depsgraph) -> selection.LodQuery | None:
    """Return the rule arguments of an instance at its own distance from the camera; None if all are shown."""
    query = selection.evaluated_query(instance.evaluated, depsgraph)
    return query and at_instance(query, instance)


def camera_query(instance: SplatInstance, depsgraph: bpy.types.Depsgraph) -> selection.LodQuery | None:
    """Return the rule arguments of an instance for an image of the scene camera; None if all are shown.

    These are the arguments of :func:`rule_query`, except for streamed scenes with the viewport as camera:
    finer splats are then selected for the scene camera itself.
    """
    query = selection.evaluated_query(instance.evaluated, depsgraph)
    root, camera = roots.root_of(instance.object), depsgraph.scene.camera
    if query is None or not query.rule or instance.source is None or root is None or camera is None:
        return query and at_instance(query, instance)
    settings = root.evaluated_get(depsgraph).lodgs
    if settings.follows_viewport:
        location = camera.evaluated_get(depsgraph).matrix_world.translation
        position = tuple(axes_of(root).evaluated_get(depsgraph).matrix_world.inverted_safe() @ location)
        query = replace(query, position=position, focal_px=settings.focal_px)
    return at_instance(query, instance)


def at_instance(query: selection.LodQuery, instance: SplatInstance) -> selection.LodQuery:
    """Move the camera of a query from the space of the original object to the space of an instance of it.

    A camera that is fixed to the splats, such as the mean of the training cameras, stays there.
    """
    root = roots.root_of(instance.evaluated)  # with animated settings
    own = np.array(instance.evaluated.matrix_world, np.float64)
    is_fixed = root is not None and not root.lodgs.freeze and root.lodgs.camera_choice == "TRAINING"
    if not query.rule or is_fixed or np.array_equal(own, instance.matrix_world):
        return query
    x, y, z = np.linalg.solve(instance.matrix_world, own @ (*query.position, 1.0))[:3].tolist()
    return replace(query, position=(x, y, z))


def _with_sources(instances: list[SplatInstance], depsgraph: bpy.types.Depsgraph) -> list[SplatInstance]:
    """Add sources to instances whose levels share one transform and have no modifiers of artists."""
    sources = {
        root: source
        for root in roots.roots(depsgraph.scene)
        if (source := streams.source_of(root, depsgraph))
    }
    if not sources:
        return instances
    root_of_level = {item.object: root for root in sources for item in root.lodgs.existing_levels}
    placed_levels: dict[tuple, set[int]] = {}
    for instance in instances:
        if instance.object in root_of_level and selection.only_lodgs_modifiers(instance.evaluated, depsgraph):
            placed_levels.setdefault(
                (root_of_level[instance.object], instance.matrix_world.tobytes()), set()
            ).add(instance.level)
    numbers = {root: {item.number for item in root.lodgs.existing_levels} for root in sources}
    return [
        replace(instance, source=sources[root])
        if (root := root_of_level.get(instance.object)) in sources
        and placed_levels.get((root, instance.matrix_world.tobytes())) == numbers[root]
        else instance
        for instance in instances
    ]


def is_splats(cloud: bpy.types.PointCloud) -> bool:
    """Return True if a point cloud has the attributes of splats."""
    return all(name in cloud.attributes for name in (attributes.BASE, attributes.SCALE, attributes.ROTATION))


def read(cloud: bpy.types.PointCloud) -> SplatArrays:
    """Return the splats of a point cloud.

    The result is empty if modifiers removed an attribute. A band of harmonics without all coefficients is
    dropped.

    Args:
        cloud: ``SplatInstance.evaluated.data`` for visible splats, or the data of any object.
    """
    count = len(cloud.points)
    base, scales = (attributes.read_attribute(cloud, name) for name in (attributes.BASE, attributes.SCALE))
    means, quats = (attributes.read_attribute(cloud, name) for name in ("position", attributes.ROTATION))
    if count == 0 or base is None or scales is None or means is None or quats is None:
        empty = np.zeros((0, 4), np.float32)
        return SplatArrays(
            empty[:, :3], empty, empty[:, :3], empty[:, 0], np.zeros((0, 1, 3), np.float32), None
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
    """Return the visible splat instances that are not empty, with their splats."""
    pairs = [(instance, read(instance.evaluated.data)) for instance in splat_instances(depsgraph, viewport)]
    return [(instance, splats) for instance, splats in pairs if len(splats)]
