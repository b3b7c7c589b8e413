"""What levels of detail are worth from far away: fewer splats, the same picture, and no jumps on the way."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..lod.selection import Detail, complete, select
from ..scenes.cameras import Camera
from ..splats.bundle import Bundle
from .metrics import psnr
from .protocol import Evaluation

FACTORS = (1, 2, 4, 8)
FRAMES = 120


def pulled_back(camera: Camera, factor: float, depth: float) -> Camera:
    """The view from ``factor`` times as far away from what lies at ``depth`` before it."""
    pose = camera.world_to_camera.copy()
    pose[2, 3] += (factor - 1) * depth
    return replace(camera, world_to_camera=pose)


def farther(evaluation: Evaluation, bundle: Bundle, detail: Detail) -> list[dict]:
    """Held-out views, pulled back: splats drawn by distance and at full detail, and how alike they look.

    Returns:
        For each of FACTORS ``factor``, ``drawn`` and ``drawn_full`` (splats in the image), and ``psnr`` of
        the picture by distance against that of full detail, means over views.
    """
    everything, rows = complete(bundle, bundle.levels[-1]), []
    for factor in FACTORS:
        found = []
        for camera in evaluation.cameras:
            view = pulled_back(camera, factor, evaluation.data.median_depth)
            full = evaluation.render(everything, view)
            chosen, weights = select(bundle, view.center, min(view.fx, view.fy), detail)
            some = evaluation.render(chosen, view, weights)
            counts = [int((rendering.radii > 0).sum()) for rendering in (some, full)]
            found.append((*counts, psnr(some.image.cpu(), full.image.cpu())))
        drawn, drawn_full, alike = np.mean(found, axis=0)
        rows.append(
            {
                "factor": factor,
                "drawn": round(float(drawn)),
                "drawn_full": round(float(drawn_full)),
                "psnr": round(float(alike), 2),
            }
        )
    return rows


def jumps(evaluation: Evaluation, bundle: Bundle, detail: Detail, camera: Camera) -> dict:
    """How much more neighbouring frames differ on the way out than with all splats in all frames.

    The camera is pulled back from 1 to 8 times its distance in FRAMES equal factors. A jump is the mean
    absolute difference of two neighbouring frames over that of the same two at full detail.

    Returns:
        ``faded`` and ``hard``: the largest jump with levels fading, and with levels switched on and off.
    """
    everything = complete(bundle, bundle.levels[-1])
    views = [
        pulled_back(camera, factor, evaluation.data.median_depth)
        for factor in np.geomspace(FACTORS[0], FACTORS[-1], FRAMES)
    ]

    def differences(pictures: list[np.ndarray]) -> np.ndarray:
        return np.array([np.abs(b - a).mean() for a, b in pairwise(pictures)])

    def by_distance(view: Camera, fade: bool) -> np.ndarray:
        chosen, weights = select(bundle, view.center, min(view.fx, view.fy), replace(detail, fade=fade))
        return evaluation.draw(chosen, view, weights).numpy()

    still = differences([evaluation.draw(everything, view).numpy() for view in views])
    return {
        name: round(float((differences([by_distance(view, fade) for view in views]) / still).max()), 3)
        for name, fade in (("faded", True), ("hard", False))
    }
