"""What levels of detail are worth from far away: fewer splats, the same picture, and no jumps on the way."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..lod.rule import Values
from ..lod.selection import require_rule
from ..rasterize.resident import ResidentBundle
from ..scenes.cameras import Camera
from ..splats.levels import Bundle
from .metrics import psnr
from .views import Evaluation, full_detail_selector

FACTORS = (1, 2, 4, 8)
FRAMES = 120


def pull_back(camera: Camera, factor: float, depth: float) -> Camera:
    """The view from ``factor`` times as far away from what lies at ``depth`` before it."""
    pose = camera.world_to_camera.copy()
    pose[2, 3] += (factor - 1) * depth
    return replace(camera, world_to_camera=pose)


def measure_farther_views(evaluation: Evaluation, bundle: Bundle, values: Values) -> list[dict]:
    """The evaluation's views, pulled back: splats drawn by distance and at full detail, how alike they look.

    Weights at full detail are those that the view has before it is pulled back.

    Returns:
        For each of FACTORS ``factor``, ``drawn`` and ``drawn_full`` (splats in the image), and ``psnr`` of
        the picture by distance against that of full detail, means over views.
    """
    rows, full_detail = [], full_detail_selector(bundle, bundle.levels[-1])
    resident = ResidentBundle(bundle, evaluation.backend)
    for factor in FACTORS:
        found = []
        for camera in evaluation.cameras:
            view = pull_back(camera, factor, evaluation.data.median_depth)
            everything, fixed = full_detail(view if bundle.on_disk else camera)
            full = evaluation.render(everything, view, fixed)
            some = resident.draw(view, values, near=evaluation.data.near)
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


def measure_popping(evaluation: Evaluation, bundle: Bundle, values: Values, camera: Camera) -> dict:
    """How much more neighbouring frames differ on the way out than with all splats in all frames.

    The camera is pulled back from 1 to 8 times its distance in FRAMES equal factors. A jump is the mean
    absolute difference of two neighbouring frames over that of the same two at full detail, where these
    differ at all.

    Returns:
        The largest jump, by what it is of: ``by distance``; where the rule's levels fade, ``faded`` and
        ``hard``, with levels switched on and off.
    """
    shown, resident = (
        full_detail_selector(bundle, bundle.levels[-1]),
        ResidentBundle(bundle, evaluation.backend),
    )
    everything, fixed = shown(camera)
    everything = evaluation.load(everything)
    views = [
        pull_back(camera, factor, evaluation.data.median_depth)
        for factor in np.geomspace(FACTORS[0], FACTORS[-1], FRAMES)
    ]

    def differences(pictures: Iterable[np.ndarray]) -> np.ndarray:
        return np.array([np.abs(b - a).mean() for a, b in pairwise(pictures)])

    def largest(values: Values) -> float:
        drawn = (resident.draw(view, values, near=evaluation.data.near) for view in views)
        pictures = (rendering.image.cpu().numpy() for rendering in drawn)
        moved = still > 0
        return round(float((differences(pictures)[moved] / still[moved]).max(initial=0)), 3)

    def full(view: Camera) -> np.ndarray:
        splats = shown(view)[0] if bundle.on_disk else everything
        return evaluation.draw(splats, view, fixed).numpy()

    still = differences(map(full, views))
    if any(control.name == "fade" for control in require_rule(bundle).controls):
        return {"faded": largest({**values, "fade": 1}), "hard": largest({**values, "fade": 0})}
    return {"by distance": largest(values)}
