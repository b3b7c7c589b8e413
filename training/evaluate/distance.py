"""Effects of levels of detail at a distance: fewer splats, image quality and popping."""

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
from .views import Evaluation, full_detail_source

FACTORS = (1, 2, 4, 8)
"""Multiples of the distance at which views are compared."""
FRAMES = 120
"""Number of frames of the camera move that shows popping."""


def pull_back(camera: Camera, factor: float, depth: float) -> Camera:
    """Move a camera back until a point at ``depth`` in front of it is ``factor`` times as far away."""
    pose = camera.world_to_camera.copy()
    pose[2, 3] += (factor - 1) * depth
    return replace(camera, world_to_camera=pose)


def measure_farther_views(evaluation: Evaluation, bundle: Bundle, values: Values) -> list[dict]:
    """Compare levels selected by distance with full detail, on views that are pulled back.

    Full detail keeps the weights of the original camera.

    Args:
        values: values of the rule's controls.

    Returns:
        A dict for each factor in FACTORS: ``factor``, ``drawn`` (splats in the image with levels selected by
        distance), ``drawn_full`` (splats in the image at full detail) and ``psnr`` between these images.
        The numbers are means over the views.
    """
    rows = []
    source = full_detail_source(bundle, bundle.levels[-1])
    resident = ResidentBundle(bundle, evaluation.backend)
    for factor in FACTORS:
        samples = []
        for camera in evaluation.cameras:
            view = pull_back(camera, factor, evaluation.data.median_depth)
            splats, weights = source(view if bundle.on_disk else camera)
            full = evaluation.render(splats, view, weights)
            selected = resident.draw(view, values, near=evaluation.data.near)
            counts = [int((rendering.radii > 0).sum()) for rendering in (selected, full)]
            samples.append((*counts, psnr(selected.image.cpu(), full.image.cpu())))
        drawn, drawn_full, quality = np.mean(samples, axis=0)
        rows.append(
            {
                "factor": factor,
                "drawn": round(float(drawn)),
                "drawn_full": round(float(drawn_full)),
                "psnr": round(float(quality), 2),
            }
        )
    return rows


def measure_popping(evaluation: Evaluation, bundle: Bundle, values: Values, camera: Camera) -> dict:
    """Measure the largest jump between frames while the camera moves back, relative to full detail.

    The camera moves back from 1 to 8 times its distance in FRAMES equal factors. A jump is the mean absolute
    difference of two consecutive frames, divided by the same difference at full detail. Pairs of frames that
    are equal at full detail do not count.

    Args:
        values: values of the rule's controls.

    Returns:
        The largest jump as ``by distance``. If the rule can fade levels: the largest jump with fading as
        ``faded``, and without fading as ``hard``.
    """
    source = full_detail_source(bundle, bundle.levels[-1])
    resident = ResidentBundle(bundle, evaluation.backend)
    full_splats, weights = source(camera)
    full_splats = evaluation.load(full_splats)
    views = [
        pull_back(camera, factor, evaluation.data.median_depth)
        for factor in np.geomspace(FACTORS[0], FACTORS[-1], FRAMES)
    ]

    def differences(images: Iterable[np.ndarray]) -> np.ndarray:
        return np.array([np.abs(second - first).mean() for first, second in pairwise(images)])

    def largest_jump(values: Values) -> float:
        renderings = (resident.draw(view, values, near=evaluation.data.near) for view in views)
        images = (rendering.image.cpu().numpy() for rendering in renderings)
        moved = full_differences > 0
        jumps = differences(images)[moved] / full_differences[moved]
        return round(float(jumps.max(initial=0)), 3)

    def draw_full(view: Camera) -> np.ndarray:
        splats = source(view)[0] if bundle.on_disk else full_splats
        return evaluation.draw(splats, view, weights).numpy()

    full_differences = differences(map(draw_full, views))
    if any(control.name == "fade" for control in require_rule(bundle).controls):
        return {"faded": largest_jump({**values, "fade": 1}), "hard": largest_jump({**values, "fade": 0})}
    return {"by distance": largest_jump(values)}
