"""Clutter around the subject of a scene: its kinds with their colours, and limits that suit the scene.

The ``lodgs edit`` command and the Clean Up panel share these declarations. numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from ..scenes.ground import ground_plane, points_near_cameras
from ..scenes.overview import FAR, LARGE, NEAR, central_ball
from ..splats.batches import read_batches
from ..splats.levels import Bundle
from ..splats.portable_levels import ConcatenatedRows

HALO_OPACITY, HALO_SIZE = 0.1, 0.05
"""Suggested opacity below which a splat is a halo, and its minimum size as a fraction of the subject's
radius."""
DEPTH = 0.05
"""Suggested minimum depth of splats below the ground, as a fraction of the subject's radius."""


class Kind(NamedTuple):
    """Splats that a test matches: their name in the singular, and their colour in previews, as sRGB."""

    noun: str
    tint: str
    color: tuple[float, float, float]


KINDS = {
    "drop_floaters": Kind("floater", "orange", (1.0, 0.45, 0.0)),
    "max_size": Kind("large splat", "yellow", (1.0, 0.95, 0.1)),
    "halo_opacity": Kind("halo", "pink", (1.0, 0.5, 0.75)),
    "min_opacity": Kind("faint splat", "cyan", (0.0, 0.9, 1.0)),
    "max_reach": Kind("distant splat", "violet", (0.55, 0.25, 1.0)),
    "max_distance": Kind("far splat", "magenta", (1.0, 0.1, 0.9)),
    "min_views": Kind("rarely seen splat", "green", (0.2, 1.0, 0.2)),
    "min_depth": Kind("buried splat", "red", (1.0, 0.05, 0.1)),
    "crops": Kind("cropped splat", "blue", (0.15, 0.35, 1.0)),
}
"""Kinds by test, see ``cleaning.Cleaning``. A splat of several kinds has the colour of the first."""


@dataclass(frozen=True)
class SceneSubject:
    """The subject of a scene.

    Attributes:
        center, radius: ball around it, see ``overview.central_ball``. The radius is infinite if most splats
            are at one place, so that none of them is clutter.
        ground: unit normal (3,) and a point (3,) of the ground below it; None without a ground.
    """

    center: np.ndarray
    radius: float
    ground: tuple[np.ndarray, np.ndarray] | None = None

    def distances(self, means: np.ndarray) -> np.ndarray:
        """Return the distances (N,) of means (N, 3) from the center."""
        return np.linalg.norm(means - self.center, axis=1)

    def near(self, means: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of means (N, 3) near the subject. A distant background is large and sparse."""
        return self.distances(means) < NEAR * self.radius

    def find_halos(
        self, means: np.ndarray, scales: np.ndarray, opacities: np.ndarray, limit: float
    ) -> np.ndarray:
        """Return a mask (N,) of splats near the subject that are fainter than a limit and larger than most.

        Args:
            scales: (N, 3) standard deviations.
            opacities: (N,).
        """
        large = scales.max(axis=1, initial=0) > HALO_SIZE * self.radius
        return large & (opacities < limit) & self.near(means)

    def find_below(self, means: np.ndarray, depth: float) -> np.ndarray:
        """Return a mask (N,) of means (N, 3) deeper than a length below the ground; none without a ground."""
        if self.ground is None:
            return np.zeros(len(means), bool)
        normal, middle = self.ground
        return (means - middle) @ normal < -depth

    def limits(self) -> dict[str, float]:
        """Return suggested limits of the tests for clutter by name, see ``cleaning.Cleaning``."""
        return {
            "max_size": LARGE * self.radius, "max_reach": FAR * self.radius, "halo_opacity": HALO_OPACITY,
            "min_depth": DEPTH * self.radius,
        }  # fmt: skip


def find_subject(means: np.ndarray, up: np.ndarray, ground_points: np.ndarray) -> SceneSubject:
    """Return the subject of splats.

    Args:
        means: (N, 3) of the finest level.
        up: (3,) direction.
        ground_points: (P, 3) points for the detection of the ground.
    """
    means = means[np.isfinite(means).all(axis=1)]
    center, radius = central_ball(means, inf) if len(means) else (np.zeros(3), inf)
    ground = ground_plane(ground_points, up)
    return SceneSubject(center, radius, None if ground is None else ground[:2])


def subject_of(bundle: Bundle) -> SceneSubject:
    """Return the subject of a bundle, whose finest level is read once, with coarser ones if levels add up."""
    rows = ConcatenatedRows.of_level(bundle, bundle.levels[-1].number)
    batches = [(splats.means, splats.opacity_logits > 0) for splats in read_batches(rows)]
    means = np.concatenate([part for part, _ in batches])
    opaque = means[np.concatenate([part for _, part in batches])]
    return find_subject(means, bundle.up_rotation[2], near_cameras(opaque, bundle))


def near_cameras(points: np.ndarray, bundle: Bundle) -> np.ndarray:
    """Return the points (P, 3) near the cameras of a bundle, for ground detection; all without cameras."""
    center, depth = bundle.meta.get("camera_center"), bundle.meta.get("median_depth", 0)
    if center is None or not isinstance(depth, int | float):
        return points
    return points_near_cameras(points, np.asarray(center), depth)
