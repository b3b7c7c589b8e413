"""Which splat scene is seen at a pixel of a viewport."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...training.editing.brush import Projection
from ..attributes import BASE, SCALE, WEIGHT, read_attribute
from .objects import root_of
from .shown import SplatInstance, splat_instances

DIM = 0.5
"""Share of the light that the picked splats and those before them let through at most: fog is not picked."""
FAINTEST = 1 / 255
"""Splats of less opacity at the pixel do not count."""


def scene_at(
    depsgraph: bpy.types.Depsgraph,
    viewport: bpy.types.SpaceView3D | None,
    view: Matrix,
    projection: Matrix,
    size: tuple[int, int],
    at: tuple[float, float],
    before: float = np.inf,
) -> bpy.types.Object | None:
    """The root of the splats that are seen at a pixel, or their object where they are in no scene.

    Splats count as round there, of their mean width; which one comes first is told by their means.

    Args:
        viewport: see ``shown.splat_instances``.
        view, projection: from the world to the camera's space, and on to clip space.
        size: the viewport's (W, H) in pixels.
        at: the pixel, x from the left and y from below.
        before: depth in the world of what hides the splats behind it there.

    Returns:
        None where no splats are, or not enough of them to hide half of what is behind.
    """
    instances = splat_instances(depsgraph, viewport)
    found = [_at_pixel(each, np.array(view), np.array(projection), size, at) for each in instances]
    if not found:
        return None
    depths, alphas = (np.concatenate(each) for each in zip(*found, strict=True))
    owners = np.repeat(np.arange(len(found)), [len(each) for each, _ in found])
    order = np.argsort(depths)
    order = order[depths[order] < before]
    hidden = np.cumprod(1 - alphas[order]) <= DIM
    if not hidden.any():
        return None
    obj = instances[owners[order[hidden.argmax()]]].object
    return root_of(obj) or obj


def _at_pixel(
    instance: SplatInstance,
    view: np.ndarray,
    projection: np.ndarray,
    size: tuple[int, int],
    at: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Depths (M,) in the world and opacities (M,) of the splats of an instance that cover a pixel."""
    cloud = instance.evaluated.data
    means, scales, base = (read_attribute(cloud, name) for name in ("position", SCALE, BASE))
    if means is None or scales is None or base is None or not len(means):
        return np.zeros(0), np.zeros(0)
    placed = Projection.of(view @ instance.matrix_world, projection, size).place(means)
    away = np.square(placed.x - at[0]) + np.square(placed.y - at[1])
    with np.errstate(divide="ignore"):
        sigma = scales.mean(1) / placed.pixel
    alphas = base[:, 3] * np.exp(-away / 2 / (sigma**2 + 0.3))  # 3DGS's dilation
    weights = read_attribute(cloud, WEIGHT)
    alphas = np.minimum(alphas if weights is None else alphas * weights, 0.99)
    covers = alphas > FAINTEST
    unit = np.cbrt(abs(np.linalg.det(instance.matrix_world[:3, :3])))  # what is compared stands in the world
    return placed.depth[covers] * unit, alphas[covers]
