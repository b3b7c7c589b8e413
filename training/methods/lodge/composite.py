"""Levels as a camera sees them together, and what each splat gives to a picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch

from ...lod.rule import facts_of
from ...lod.rules.chunks import RULE
from ...rasterize import Gaussians, contributions
from ...rasterize.filter3d import smoothed
from ...scenes.cameras import Camera


def filtered(gaussians: Gaussians, std: float) -> Gaussians:
    """Splats with LODGE's filter of that standard deviation, in scene units (Eq. 3)."""
    scales, opacities = smoothed(gaussians.log_scales, gaussians.opacity_logits, std)
    return replace(gaussians, log_scales=scales, opacity_logits=opacities)


def composite(
    levels: Mapping[int, Gaussians], d_l: Mapping[int, float], camera: Camera, distance_scale: float = 1.0
) -> tuple[Gaussians, torch.Tensor]:
    """What a camera sees of levels by the rule (Eq. 2), and weights.

    Args:
        levels: splats by number; the last has all its rows in the result, at its end, the others those
            that are shown.
        d_l: the distance from which on each of them is shown, in scene units, by number.
        distance_scale: the rule's control.

    Returns:
        N splats and their weights (N,).
    """
    facts = [(number, {"d_l": d_l[number]}) for number in sorted(levels)]
    values = RULE.defaults(sorted(levels)) | {"distance_scale": distance_scale}
    eye = np.asarray(camera.center, np.float32)
    *_, last = levels
    shown, weights = [], []
    for number, gaussians in levels.items():
        means = gaussians.means.detach().cpu().numpy()
        found = RULE.weights(means, eye, camera.focal, {}, facts_of(RULE, {}, facts, number), values)
        weight = torch.from_numpy(found).to(gaussians.means.device)
        if number != last:
            gaussians, weight = gaussians.select(weight > 0), weight[weight > 0]
        shown.append(gaussians)
        weights.append(weight)
    return Gaussians.concatenated(shown), torch.cat(weights)


def importance(
    pictures: Iterable[tuple[Camera, Gaussians, torch.Tensor | None]],
    count: int,
    near: float,
    backend: str,
    antialias: bool = False,
) -> torch.Tensor:
    """The largest share (count,) of a pixel that each of the last ``count`` splats of pictures has."""
    largest = torch.zeros(count)
    for camera, gaussians, weights in pictures:
        found = contributions(
            gaussians, [camera], weights=weights, near=near, antialias=antialias, backend=backend
        )
        largest = torch.maximum(largest.to(found.largest), found.largest[-count:])
    return largest
