"""Effects of levels of detail at a distance: fewer splats, image quality and popping."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
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


class FlyOut:
    """A camera move from a view back to FACTORS[-1] times its distance, in FRAMES equal factors.

    Attributes:
        factors: distance of each frame relative to the first, (FRAMES,).
        moved: whether the image at full detail changes between two frames, (FRAMES - 1,).
    """

    def __init__(self, evaluation: Evaluation, bundle: Bundle, camera: Camera) -> None:
        self.factors = np.geomspace(FACTORS[0], FACTORS[-1], FRAMES)
        depth = evaluation.data.median_depth
        self._views = [pull_back(camera, factor, depth) for factor in self.factors]
        self._near = evaluation.data.near
        self._resident = ResidentBundle(bundle, evaluation.backend)
        source = full_detail_source(bundle, bundle.levels[-1])
        splats, weights = source(camera)
        loaded = evaluation.load(splats)

        def draw_full(view: Camera) -> np.ndarray:
            splats = source(view)[0] if bundle.on_disk else loaded
            return evaluation.draw(splats, view, weights).numpy()

        self._full_differences = _differences(map(draw_full, self._views))
        self.moved = self._full_differences > 0

    def frames(self, values: Values) -> Iterator[np.ndarray]:
        """Draw the frames (H, W, 3) with levels by distance.

        Args:
            values: values of the rule's controls.
        """
        for view in self._views:
            yield self._resident.draw(view, values, near=self._near).image.cpu().numpy()

    def jumps(self, frames: Iterable[np.ndarray]) -> np.ndarray:
        """Return the change between consecutive frames relative to full detail, (FRAMES - 1,).

        A change is the mean absolute difference. It is 0 where full detail does not change.
        """
        changes = _differences(frames)
        return np.divide(changes, self._full_differences, out=np.zeros_like(changes), where=self.moved)


def _differences(images: Iterable[np.ndarray]) -> np.ndarray:
    """Return the mean absolute difference between consecutive images."""
    return np.array([np.abs(second - first).mean() for first, second in pairwise(images)])


def measure_popping(evaluation: Evaluation, bundle: Bundle, values: Values, camera: Camera) -> dict:
    """Measure the largest jump between frames while the camera moves back, see :class:`FlyOut`.

    Args:
        values: values of the rule's controls.

    Returns:
        The largest jump as ``by distance``. If the rule can fade levels: the largest jump with fading as
        ``faded``, and without fading as ``hard``.
    """
    fly_out = FlyOut(evaluation, bundle, camera)

    def largest_jump(values: Values) -> float:
        return round(float(fly_out.jumps(fly_out.frames(values)).max(initial=0)), 3)

    if any(control.name == "fade" for control in require_rule(bundle).controls):
        return {"faded": largest_jump({**values, "fade": 1}), "hard": largest_jump({**values, "fade": 0})}
    return {"by distance": largest_jump(values)}
