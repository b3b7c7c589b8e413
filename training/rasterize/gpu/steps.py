"""Inputs of training steps in device memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rendering import RasterSettings
from .device import Buffer
from .recording import Recording

LOSSES = 2
"""Index of the first loss in the report (common.wgsl)."""


@dataclass
class Step:
    """Inputs of a step, to repeat it, and its loss.

    Attributes:
        photo: (H, W), photo on the device.
        lens: see ``lens_of``.
        training: (TRAINING_NUMBERS,), see ``ProjectedScene.train``.
        loss: None until it is read from the device.
    """

    settings: RasterSettings
    photo: Buffer
    lens: np.ndarray
    ssim_weight: float
    weights: np.ndarray | None
    training: np.ndarray
    loss: float | None = None

    @property
    def key(self) -> tuple:
        """Properties that decide which dispatches make the step."""
        return (*self.photo.shape, self.settings.degree, self.ssim_weight)


@dataclass
class Inputs:
    """Numbers and buffers of recorded dispatches that change between steps."""

    photo: Buffer
    lens: np.ndarray
    background: np.ndarray
    training: np.ndarray
    slot: np.ndarray
    drawn: Buffer
    recording: Recording | None = None

    def set(self, step: Step, index: int) -> None:
        """Set the numbers of a step, whose losses have the given index in the report."""
        self.lens[:] = step.lens
        self.background[:] = step.settings.background
        self.training[:] = step.training
        self.slot[:] = LOSSES + 2 * index
