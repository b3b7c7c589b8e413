"""Flaws that appear between the training cameras, where no photo shows the right result.

A veil is a fog of splats in front of the camera.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from ..optimize.support import midpoint_views
from ..optimize.training_data import TrainingData
from ..scenes.cameras import pick_evenly
from .views import Evaluation, SplatSource

VEIL_DEPTH = 0.1
"""Limit depth of a veil, as a fraction of the scene's median depth."""
OPAQUE_OPACITY = 0.5
"""Minimum opacity of an opaque splat, and minimum alpha of a veiled pixel."""
OVERSIZED_SCALE = 0.5
"""Minimum standard deviation of an oversized splat, as a fraction of the scene's median depth."""
MAX_POSITIONS = 120
"""Maximum number of camera positions where the veil is measured."""


def measure_veil(evaluation: Evaluation, source: SplatSource) -> dict[str, float]:
    """Measure the share of veiled pixels at positions halfway between training cameras.

    A pixel is veiled if splats nearer than ``VEIL_DEPTH`` times the scene's median depth stop at least half
    of its light.

    Args:
        source: returns the splats of a camera.

    Returns:
        ``mean`` and ``max`` over the positions, from 0 to 1. The positions are those of
        :func:`.midpoint_views`, or ``MAX_POSITIONS`` evenly chosen ones.
    """
    shares = []
    for camera in pick_evenly(midpoint_views(evaluation.data.train), MAX_POSITIONS):
        splats, weights = source(camera)
        near = camera.view_space(splats.means)[:, 2] < VEIL_DEPTH * evaluation.data.median_depth
        # only near splats determine whether half of the light is stopped in front of the limit
        veil = evaluation.render(splats.select(near), camera, None if weights is None else weights[near])
        shares.append(float((veil.alpha >= OPAQUE_OPACITY).float().mean()))
    return {"mean": round(float(np.mean(shares)), 5), "max": round(float(np.max(shares)), 5)}


def count_oversized(data: TrainingData, source: SplatSource) -> int:
    """Count the oversized opaque splats near the cameras.

    A splat is oversized if its largest standard deviation exceeds ``OVERSIZED_SCALE`` times the median
    depth. It is near the cameras if its distance from the mean camera position is at most the scene's extent.
    Opacities include the weights for the training camera nearest to the mean camera position.
    """
    central = min(data.train, key=lambda camera: np.linalg.norm(camera.center - data.mean_camera))
    splats, weights = source(central)
    near_cameras = np.linalg.norm(splats.means - data.mean_camera, axis=1) <= data.extent
    opaque = expit(splats.opacity_logits) * (1 if weights is None else weights) >= OPAQUE_OPACITY
    large = splats.log_scales.max(axis=1) > np.log(OVERSIZED_SCALE * data.median_depth)
    return int((near_cameras & opaque & large).sum())
