"""Effects of levels of detail at a distance: fewer splats, image quality and popping."""

from __future__ import annotations

import time
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
    """Move a camera back until a point at ``depth`` in front of it is ``factor`` times as far away.

    Args:
        depth: depth in scene units.
    """
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
        distance), ``drawn_full`` (splats in the image at full detail), ``psnr`` between these images, and
        ``frame_s`` (seconds of the image by distance). The numbers are means over the views, seconds the
        median.
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
            started = time.perf_counter()
            selected = resident.draw(view, values, near=evaluation.data.near)
            seconds = time.perf_counter() - started
            counts = [int((rendering.radii > 0).sum()) for rendering in (selected, full)]
            samples.append((*counts, psnr(selected.image.cpu(), full.image.cpu()), seconds))
        drawn, drawn_full, quality, _ = np.mean(samples, axis=0)
        frame_s = np.median([seconds for *_, seconds in samples])
        rows.append(
            {
                "factor": factor,
                "drawn": round(float(drawn)),
                "drawn_full": round(float(drawn_full)),
                "psnr": round(float(quality), 2),
                "frame_s": round(float(frame_s), 5),
            }
        )
    return rows


def fly_out(camera: Camera, depth: float, step: int = 1) -> list[Camera]:
    """Return the views of a camera move back to FACTORS[-1] times the distance, in FRAMES equal factors.

    Args:
        depth: distance in front of the camera, in scene units, that the factors multiply.
        step: number of frames from one returned view to the next.
    """
    factors = np.geomspace(FACTORS[0], FACTORS[-1], FRAMES)[::step]
    return [pull_back(camera, factor, depth) for factor in factors]


def measure_popping(
    evaluation: Evaluation, bundle: Bundle, values: Values, camera: Camera
) -> dict[str, list[float]]:
    """Measure the jumps between frames while the camera moves back (:func:`fly_out`).

    A jump is the mean absolute difference between consecutive frames, relative to full detail. It is 0 where
    full detail does not change.

    Args:
        values: values of the rule's controls.

    Returns:
        The FRAMES - 1 jumps as ``by distance``. If the rule can fade levels: those with fading as ``faded``,
        and without fading as ``hard``.
    """
    views = fly_out(camera, evaluation.data.median_depth)
    resident = ResidentBundle(bundle, evaluation.backend)
    source = full_detail_source(bundle, bundle.levels[-1])
    splats, weights = source(camera)
    loaded = evaluation.load(splats)

    def draw_full(view: Camera) -> np.ndarray:
        splats = source(view)[0] if bundle.on_disk else loaded
        return evaluation.draw(splats, view, weights).numpy()

    full = _differences(map(draw_full, views))

    def jumps(values: Values) -> list[float]:
        frames = (resident.draw(view, values, near=evaluation.data.near).image for view in views)
        changes = _differences(frame.cpu().numpy() for frame in frames)
        relative = np.divide(changes, full, out=np.zeros_like(changes), where=full > 0)
        return [round(float(jump), 3) for jump in relative]

    if any(control.name == "fade" for control in require_rule(bundle).controls):
        return {"faded": jumps({**values, "fade": 1}), "hard": jumps({**values, "fade": 0})}
    return {"by distance": jumps(values)}


def _differences(images: Iterable[np.ndarray]) -> np.ndarray:
    """Return the mean absolute differences (F - 1,) between F consecutive images (H, W, 3)."""
    return np.array([np.abs(second - first).mean() for first, second in pairwise(images)])
