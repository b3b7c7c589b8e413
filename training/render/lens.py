"""Lenses of rendered images: projections, and the aperture of a thin lens. numpy only."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from ..scenes.cameras import Camera

PERSPECTIVE, ORTHOGRAPHIC, EQUIRECTANGULAR = "perspective", "orthographic", "equirectangular"
PROJECTIONS = PERSPECTIVE, ORTHOGRAPHIC, EQUIRECTANGULAR
MAX_SAMPLES = 4096
"""Maximum number of samples of an image."""
MAX_ANGLE = 7.0
"""Maximum longitude or latitude of a panorama's edges in radians, more than one turn."""
GOLDEN, PLASTIC = 0.6180339887498949, 0.7548776662466927
"""Inverse golden ratio and plastic number: multiples of them spread evenly modulo 1, independently."""


@dataclass(frozen=True)
class LensProjection:
    """Mapping of directions to pixels, in addition to the values of a :class:`Camera`.

    Attributes:
        kind: one of PROJECTIONS.
        distance: for ORTHOGRAPHIC, the depth at which the pinhole camera shows the same scale.
        longitude: for EQUIRECTANGULAR, angles at the left and the right edge of the image, radians.
        latitude: for EQUIRECTANGULAR, angles at the lower and the upper edge.
    """

    kind: str = PERSPECTIVE
    distance: float = 1.0
    longitude: tuple[float, float] = (-np.pi, np.pi)
    latitude: tuple[float, float] = (-np.pi / 2, np.pi / 2)

    def as_dict(self) -> dict:
        """Return the attributes as JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class Aperture:
    """Opening of a thin lens, as in Cycles.

    Attributes:
        radius: radius in world units.
        focus: depth of the plane in focus.
        blades: number of corners; fewer than 3 mean a circle.
        rotation: rotation of the corners in radians, counterclockwise in the image.
        ratio: horizontal squeeze. 1 for none, 2 for an anamorphic lens.
    """

    radius: float
    focus: float
    blades: int = 0
    rotation: float = 0.0
    ratio: float = 1.0

    def as_dict(self) -> dict:
        """Return the attributes as JSON values."""
        return asdict(self)

    def points(self, count: int) -> np.ndarray:
        """Return evenly spread points (count, 2) of the opening, world units, x right and y down.

        The points of a circle are Vogel's spiral.
        """
        sectors = self.blades if self.blades >= 3 else 1  # each gets the same points
        numbers = np.arange(count)
        turns = numbers // sectors
        outward, second = np.sqrt((turns + 0.5) / (turns[-1] + 1)), (0.5 + GOLDEN * turns) % 1
        if sectors == 1:
            angle = 2 * np.pi * second
            unit = outward * np.cos(angle), outward * np.sin(angle)
        else:
            sector, half = numbers % sectors, np.pi / sectors
            along, across = outward * np.cos(half), outward * (2 * second - 1) * np.sin(half)
            angle = self.rotation + (2 * sector + 1) * half
            unit = (
                along * np.cos(angle) - across * np.sin(angle),
                along * np.sin(angle) + across * np.cos(angle),
            )
        return self.radius * np.stack([unit[0] / self.ratio, -unit[1]], axis=1)

    def camera_at(self, point: np.ndarray, camera: Camera, projection: LensProjection) -> Camera:
        """Return the camera that looks through a point (2,) of the opening.

        The plane in focus stays at the same pixels. The pose of an orthographic camera gets sheared.
        """
        pose = camera.world_to_camera.copy()
        pose[:2, 3] -= point
        if projection.kind == ORTHOGRAPHIC:
            pose[:2] += np.outer(point / self.focus, pose[2])
            return replace(camera, world_to_camera=pose)
        x, y = point / self.focus
        return replace(
            camera, world_to_camera=pose, cx=camera.cx + camera.fx * x, cy=camera.cy + camera.fy * y
        )


SHARP = LensProjection()
"""LensProjection of a pinhole camera."""
