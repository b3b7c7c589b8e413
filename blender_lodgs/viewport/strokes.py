"""Hit tests of brush and lasso strokes in a viewport, for all levels of a splat scene."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.editing.brush import OcclusionDepth, Projection, hit_strength, middle_scale
from ...training.lod.crop import crop_mask
from .. import attributes
from ..data import cleaning, crops, shown
from ..data.placement import axes_of
from . import view_camera


class StrokeTarget:
    """A splat scene projected into a viewport, valid until either of them changes.

    Args:
        view, projection: (4, 4) from the world to camera space, and from there to clip space.
        size: width and height of the region in pixels.
        viewport: see ``shown.splat_instances``.

    Raises:
        LodgsError: attributes of a level's splats are missing.
    """

    def __init__(
        self,
        root: bpy.types.Object,
        depsgraph: bpy.types.Depsgraph,
        view: np.ndarray,
        projection: np.ndarray,
        size: tuple[int, int],
        viewport: bpy.types.SpaceView3D | None = None,
    ) -> None:
        self.size = size
        instances = {instance.object: instance for instance in shown.splat_instances(depsgraph, viewport)}
        crop_list = crops.evaluated_crops(root, depsgraph)
        # hidden levels are not evaluated: use the axes of the scene
        world = np.array(axes_of(root).evaluated_get(depsgraph).matrix_world, np.float64)
        world_projection = Projection.of(view @ world, projection, size)
        self._levels, occluders = {}, []
        for item in root.lodgs.existing_levels:
            obj, cloud = item.object, item.object.data
            means, scales = (cleaning.splat_attribute(cloud, name) for name in ("position", attributes.SCALE))
            projected = world_projection.place(means)
            editable = crop_mask(crop_list, means) & ~cleaning.hidden_mask(cloud)
            reach = 2 * scales.max(axis=1, initial=0)
            self._levels[item.number] = projected, reach, editable, middle_scale(scales)
            if (instance := instances.get(obj)) is not None:
                query = view_camera.view_query(instance, depsgraph)
                occluders.append((projected, scales, cleaning.visible_opacities(cloud, means, query)))
        self._front = OcclusionDepth(occluders)

    def hits(
        self, covered: np.ndarray, through: bool = False, footprints: bool = False
    ) -> dict[int, np.ndarray]:
        """Return the hit strengths (N,) of a stroke by level number, see ``brush.hit_strength``.

        Args:
            covered: (H, W) stroke in the region's pixels, see ``brush.brush_coverage``.
            through: also hit splats behind others.
            footprints: hit splats by the covered part of their footprint instead of by their mean.
        """
        front = None if through else self._front
        return {
            number: hit_strength(covered, projected, reach, front, sigma if footprints else None) * editable
            for number, (projected, reach, editable, sigma) in self._levels.items()
        }
