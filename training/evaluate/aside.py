"""How a scene looks a step aside of its photographs, where no photograph says what should be seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from ..scenes.cameras import Camera
from ..splats.gaussians import Splats
from .views import Evaluation

NEIGHBOURS = (1, 2, 4)
"""Which of a camera's nearest other cameras a place lies halfway to."""
VEIL = 0.1
"""What is nearer than this share of the scene's median depth hangs before the scene."""
OPAQUE = 0.5
"""Opacity from which a splat hides what is behind it."""
OVERSIZED = 0.5
"""Share of the scene's median depth that no opaque splat among the cameras should reach."""
MOST_PLACES = 120


def halfway(cameras: Sequence[Camera]) -> list[Camera]:
    """Views from halfway between each camera and its 1st, 2nd and 4th nearest, looking as the camera does."""
    centers = np.array([camera.center for camera in cameras])
    found = []
    _, order = KDTree(centers).query(centers, k=[1 + nearest for nearest in NEIGHBOURS])
    for camera, others in zip(cameras, order, strict=True):
        for other in others[others < len(cameras)]:  # those that do not exist are numbered beyond
            pose = camera.world_to_camera.copy()
            pose[:3, 3] = -pose[:3, :3] @ (camera.center + centers[other]) / 2
            found.append(replace(camera, world_to_camera=pose, image=None))
    return found


def veil(evaluation: Evaluation, splats: Splats, weights: np.ndarray | None = None) -> dict[str, float]:
    """Share of the pixels that something hangs before, seen from places halfway between training cameras.

    A pixel is veiled where its median depth, at which half of its light is stopped, is less than ``VEIL`` of
    the scene's median depth.

    Returns:
        ``mean`` and ``max`` over the places: all of :func:`halfway`, or ``MOST_PLACES`` evenly chosen.
    """
    data = evaluation.data
    places = halfway(data.train)
    places = places[:: -(-len(places) // MOST_PLACES)]
    shares = []
    for place in places:
        depth = evaluation.render(splats, place, weights, outputs=("median_depth",)).median_depth
        assert depth is not None
        shares.append(float(((depth > 0) & (depth < VEIL * data.median_depth)).float().mean()))
    return {"mean": round(float(np.mean(shares)), 5), "max": round(float(np.max(shares)), 5)}


def oversized(evaluation: Evaluation, splats: Splats) -> int:
    """How many opaque splats among the cameras have a standard deviation over half the median depth.

    Among the cameras is no farther from their mean than the scene's extent.
    """
    data = evaluation.data
    among = np.linalg.norm(splats.means - data.mean_camera, axis=1) <= data.extent
    opaque = splats.opacity_logits >= np.log(OPAQUE / (1 - OPAQUE))
    large = splats.log_scales.max(axis=1) > np.log(OVERSIZED * data.median_depth)
    return int((among & opaque & large).sum())
