"""Gaussian splats as torch tensors, the input of every rasterizer backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from ..splats.gaussians import Splats


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, parametrised as in 3DGS files (:class:`training.splats.gaussians.Splats`).

    All tensors have the same type and device. ``vars(gaussians)`` lists them by name.

    Attributes:
        means: (N, 3) in world coordinates.
        quats: (N, 4) rotations wxyz, of any non-zero length.
        log_scales: (N, 3), natural logarithm of the standard deviation along each axis, in world units.
        opacity_logits: (N,); opacity = sigmoid(logit).
        sh: (N, (d+1)², 3) spherical-harmonics coefficients of the colour max(0, 0.5 + Σ c·Y). Or (N, 3)
            view-independent colours, also clamped at 0.

    Raises:
        ValueError: shapes do not match.
    """

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self) -> None:
        count = len(self.means)
        shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": ()}
        for name, row in shapes.items():
            shape = tuple(getattr(self, name).shape)
            if shape != (count, *row):
                raise ValueError(f"{name} must have shape {(count, *row)}, not {shape}")
        shape = tuple(self.sh.shape)
        if len(shape) not in (2, 3) or shape[0] != count or shape[-1] != 3:
            raise ValueError(f"sh must be ({count}, coefficients, 3) or ({count}, 3), not {shape}")

    @classmethod
    def of(cls, splats: Splats, device: torch.device | str = "cpu") -> Gaussians:
        """Convert arrays to float32 tensors on a device; on the CPU they may share the arrays' memory."""
        columns = (np.ascontiguousarray(getattr(splats, f.name), np.float32) for f in fields(cls))
        return cls(*(torch.from_numpy(column).to(device) for column in columns))

    @classmethod
    def concatenated(cls, sets: Sequence[Gaussians]) -> Gaussians:
        """Concatenate several sets whose ``sh`` have the same shape."""
        return cls(*map(torch.cat, zip(*(vars(gaussians).values() for gaussians in sets), strict=True)))

    def __len__(self) -> int:
        return len(self.means)

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Gaussians:
        """Apply a function to every tensor."""
        return Gaussians(*(function(tensor) for tensor in vars(self).values()))

    def select(self, index: Any) -> Gaussians:
        """Select splats by a slice, a boolean mask (N,) or integers (M,)."""
        return self.map(lambda tensor: tensor[index])

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """Convert all tensors to another device or type."""
        return self.map(lambda tensor: tensor.to(device=device, dtype=dtype))

    def detach(self) -> Gaussians:
        """Detach all tensors from the autograd graph."""
        return self.map(torch.Tensor.detach)
