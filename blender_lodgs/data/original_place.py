"""Original coordinates in Blender's world, which a georeferenced splat scene defines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from ...training.splats.origin import NO_ORIGIN
from .metadata import origin_of
from .placement import axes_of, placement_of
from .roots import roots

UNSCALED = 1e-5
"""Maximum difference of a scale from 1 that counts as rounding of Blender's float32 matrices."""


@dataclass(frozen=True)
class OriginalPlace:
    """Map from Blender's world to original coordinates.

    Attributes:
        origin: (3,) float64 local origin.
        to_world: (4, 4) float64 rigid transform from coordinates relative to the origin to Blender's world.
    """

    origin: np.ndarray
    to_world: np.ndarray

    def local_camera(self, camera: Camera) -> Camera:
        """Return a camera of Blender's world relative to the origin."""
        return camera.in_object_space(self.to_world)[0] if self.origin.any() else camera

    def place(self, root: bpy.types.Object) -> None:
        """Move a new georeferenced scene to its place in Blender's world; leave other scenes unchanged."""
        origin = origin_of(root)
        if origin.any() and self.origin.any():
            offset = np.eye(4)
            offset[:3, 3] = origin - self.origin
            axes_of(root).matrix_basis = Matrix((self.to_world @ offset).tolist())


def original_place(
    scene: bpy.types.Scene, warn: Callable[[str], object] = lambda message: None
) -> OriginalPlace:
    """Return the original place of a Blender scene, from its first georeferenced splat scene without scale.

    Without such a scene, Blender's coordinates are the original ones.

    Args:
        warn: function called with a sentence if the georeferenced scenes are scaled.
    """
    georeferenced = [root for root in roots(scene) if origin_of(root).any()]
    for root in georeferenced:
        try:
            placement = placement_of(root)
        except LodgsError:  # stretched
            continue
        if abs(placement.scale - 1) < UNSCALED:
            return OriginalPlace(origin_of(root), placement.matrix)
    if georeferenced:
        warn(
            f"The views have Blender's coordinates, not the original ones, because '{georeferenced[0].name}' "
            "is scaled. Set its scale to 1 and capture to another folder."
        )
    return OriginalPlace(NO_ORIGIN, np.eye(4))
