"""How a scene looks a step aside of its photographs, where no photograph says what should be seen."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from ..optimize.support import halfway
from ..optimize.training_data import TrainingData
from ..scenes.cameras import pick_evenly
from .views import Evaluation, SplatSelector

VEIL_DEPTH = 0.1
"""What is nearer than this share of the scene's median depth hangs before the scene."""
OPAQUE_OPACITY = 0.5
"""Opacity from which a splat, or what hangs before a pixel, hides what is behind it."""
OVERSIZED_SCALE = 0.5
"""Share of the scene's median depth that no opaque splat among the cameras should reach."""
MAX_POSITIONS = 120


def measure_veil(evaluation: Evaluation, shown_to: SplatSelector) -> dict[str, float]:
    """Share of the pixels that something hangs before, seen from places halfway between training cameras.

    A pixel is veiled where its median depth, at which half of its light is stopped, is less than ``VEIL`` of
    the scene's median depth.

    Args:
        shown_to: what a camera is shown.

    Returns:
        ``mean`` and ``max`` over the places, from 0 to 1: all of :func:`halfway`, or ``MOST_PLACES`` evenly
        chosen.
    """
    shares = []
    for place in pick_evenly(halfway(evaluation.data.train), MAX_POSITIONS):
        splats, weights = shown_to(place)
        before = place.view_space(splats.means)[:, 2] < VEIL_DEPTH * evaluation.data.median_depth
        # only what hangs before is drawn: the depth at which half of the light is stopped is among it, or not
        near = evaluation.render(splats.select(before), place, None if weights is None else weights[before])
        shares.append(float((near.alpha >= OPAQUE_OPACITY).float().mean()))
    return {"mean": round(float(np.mean(shares)), 5), "max": round(float(np.max(shares)), 5)}


def count_oversized(data: TrainingData, shown_to: SplatSelector) -> int:
    """How many opaque splats among the cameras have a standard deviation over half the median depth.

    Among the cameras is no farther from their mean than the scene's extent; opaque is, with its weight, what
    the training camera nearest to that mean is shown so.
    """
    splats, weights = shown_to(
        min(data.train, key=lambda camera: np.linalg.norm(camera.center - data.mean_camera))
    )
    among = np.linalg.norm(splats.means - data.mean_camera, axis=1) <= data.extent
    opaque = expit(splats.opacity_logits) * (1 if weights is None else weights) >= OPAQUE_OPACITY
    large = splats.log_scales.max(axis=1) > np.log(OVERSIZED_SCALE * data.median_depth)
    return int((among & opaque & large).sum())
