"""What strokes over a viewport hit of a splat scene: of every level, as ``training.editing.brush`` tells it."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.editing.brush import OcclusionDepth, Projection, hit_strength, middle_scale
from ...training.lod.crop import crop_mask
from ...training.lod.query import SplatSelector
from ...training.lod.rule import HIDDEN, OPACITY
from .. import attributes
from ..data import cleaning, crops, shown
from ..data.placement import axes_of
from . import views


class Picture:
    """A splat scene in a viewport, as long as neither changes.

    Args:
        view, projection: (4, 4) from the world to the camera's space, and on to clip space.
        size: of the region in pixels.
        viewport: see ``shown.splat_instances``.

    Raises:
        LodgsError: a level has lost its splats' attributes.
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
        instances = {each.object: each for each in shown.splat_instances(depsgraph, viewport)}
        cropped = crops.as_objects_stand(root, depsgraph)
        # levels that are not shown are not evaluated
        world = np.array(axes_of(root).evaluated_get(depsgraph).matrix_world, np.float64)
        projected = Projection.of(view @ world, projection, size)
        self._levels, parts = {}, []
        for item in cleaning.levels(root):
            obj, cloud = item.object, item.object.data
            means, scales = (cleaning.view_of(cloud, name) for name in ("position", attributes.SCALE))
            placed = projected.place(means)
            there = crop_mask(cropped, means) & ~cleaning.hidden(cloud)
            self._levels[item.number] = placed, 2 * scales.max(axis=1, initial=0), there, middle_scale(scales)
            if (instance := instances.get(obj)) is not None:
                choice = views.choice_of_view(instance, depsgraph)
                parts.append((placed, scales, _drawn(cloud, means, choice)))
        self._front = OcclusionDepth(parts)

    def hits(
        self, covered: np.ndarray, through: bool = False, footprints: bool = False
    ) -> dict[int, np.ndarray]:
        """How strongly a stroke hits each level, (N,) by its number: see ``brush.hit_strength``.

        Args:
            covered: (H, W) the stroke, of the region's pixels (``brush.brush_coverage``, ``brush.lasso_coverage``).
            through: hit what is hidden by other splats as well.
            footprints: hit each splat as far as its footprint is covered, instead of by its mean.
        """
        front = None if through else self._front
        return {
            number: hit_strength(covered, placed, reach, front, sigma if footprints else None) * there
            for number, (placed, reach, there, sigma) in self._levels.items()
        }


def _drawn(cloud: bpy.types.PointCloud, means: np.ndarray, choice) -> np.ndarray:
    """(N,) opacities of the splats that a choice shows; of others 0."""
    opacities = cleaning.view_of(cloud, attributes.BASE)[:, 3]
    if choice is None:
        return opacities
    names = {name for name in choice.columns if name in cloud.attributes}
    columns = {name: attributes.view_attribute(cloud, name) for name in names - {HIDDEN}}
    columns |= {OPACITY: opacities, HIDDEN: cleaning.hidden(cloud)}
    rows, weights = SplatSelector(means, columns).select(choice)
    drawn = np.zeros(len(means), np.float32)
    drawn[rows] = weights * opacities[rows]
    return drawn
