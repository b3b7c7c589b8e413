"""Picking of splat scenes in a viewport."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...training.editing.brush import Projection
from ..attributes import BASE, SCALE, WEIGHT, read_attribute
from ..nodes import display
from .cleaning import visible_opacities
from .objects import root_of
from .shown import SplatInstance, rule_query, splat_instances

MAX_TRANSMITTANCE = 0.5
"""Maximum transmittance at the picked splat; fog is not picked."""
MIN_ALPHA = 1 / 255
"""Minimum opacity of a splat at the pixel."""


def scene_at(
    depsgraph: bpy.types.Depsgraph,
    viewport: bpy.types.SpaceView3D | None,
    view: Matrix,
    projection: Matrix,
    size: tuple[int, int],
    at: tuple[float, float],
    max_depth: float = np.inf,
) -> bpy.types.Object | None:
    """Return the root of the splats at a pixel, or their object if they are in no scene.

    Splats are treated as round, with their mean width, and sorted by their means.

    Args:
        viewport: see ``shown.splat_instances``.
        view: matrix from the world to the camera's space.
        projection: matrix from the camera's space to clip space.
        size: size (W, H) of the viewport in pixels.
        at: pixel, x from the left and y from below.
        max_depth: depth in the world beyond which splats are occluded at the pixel.

    Returns:
        None if the splats at the pixel hide less than half of the background.
    """
    instances = splat_instances(depsgraph, viewport)
    samples = [
        _at_pixel(item, depsgraph, np.array(view), np.array(projection), size, at) for item in instances
    ]
    if not samples:
        return None
    depths, alphas = (np.concatenate(values) for values in zip(*samples, strict=True))
    owners = np.repeat(np.arange(len(samples)), [len(values) for values, _ in samples])
    order = np.argsort(depths)
    order = order[depths[order] < max_depth]
    hidden = np.cumprod(1 - alphas[order]) <= MAX_TRANSMITTANCE
    if not hidden.any():
        return None
    obj = instances[owners[order[hidden.argmax()]]].object
    return root_of(obj) or obj


def _at_pixel(
    instance: SplatInstance,
    depsgraph: bpy.types.Depsgraph,
    view: np.ndarray,
    projection: np.ndarray,
    size: tuple[int, int],
    at: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return depths (M,) in the world and opacities (M,) of an instance's splats that cover a pixel."""
    cloud = instance.evaluated.data
    reduced = display.is_reduced(cloud)
    if reduced:
        cloud = instance.object.data
    means, scales, base = (read_attribute(cloud, name) for name in ("position", SCALE, BASE))
    if means is None or scales is None or base is None or not len(means):
        return np.zeros(0), np.zeros(0)
    opacities, weights = base[:, 3], read_attribute(cloud, WEIGHT)
    if reduced:
        opacities = visible_opacities(cloud, means, rule_query(instance, depsgraph))
    elif weights is not None:
        opacities = opacities * weights
    projected = Projection.of(view @ instance.matrix_world, projection, size).place(means)
    squared_distances = np.square(projected.x - at[0]) + np.square(projected.y - at[1])
    with np.errstate(divide="ignore"):
        sigma = scales.mean(1) / projected.pixel
    alphas = opacities * np.exp(-squared_distances / 2 / (sigma**2 + 0.3))  # 3DGS's dilation
    alphas = np.minimum(alphas, 0.99)
    visible = alphas > MIN_ALPHA
    scale = np.cbrt(abs(np.linalg.det(instance.matrix_world[:3, :3])))  # instances are compared in the world
    return projected.depth[visible] * scale, alphas[visible]
