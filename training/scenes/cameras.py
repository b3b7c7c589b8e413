"""Pinhole cameras in OpenCV axes (x right, y down, z forward). numpy only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Camera:
    """One undistorted view.

    Attributes:
        name: image name relative to the scene's image folder, with forward slashes.
        width, height: image size in pixels.
        fx, fy, cx, cy: intrinsics in pixels; pixel centres lie at +0.5, as in COLMAP.
        world_to_camera: (4, 4) float64, rigid, OpenCV axes, COLMAP world.
        image: path of the photograph, or None where there is none.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    image: Path | None = None

    @property
    def center(self) -> np.ndarray:
        """The eye in world coordinates, (3,) float64."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another pixel grid; intrinsics scale with it."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height,
            fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy,
        )  # fmt: skip
