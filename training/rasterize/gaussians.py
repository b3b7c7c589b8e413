"""Gaussian splats as torch tensors: the one value that every rasterizer takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from ..splats.gaussians import Splats


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in the parametrisation that 3DGS files use (:class:`training.splats.gaussians.Splats`).

    All tensors are of one type and on one device; ``vars(gaussians)`` has them by name.

    Attributes:
        means: (N, 3) in the world.
        quats: (N, 4) rotations wxyz, of any length but zero.
        log_scales: (N, 3), natural logarithm of the standard deviation along each axis, in world units.
        opacity_logits: (N,); opacity = sigmoid(logit).
        sh: (N, (d+1)², 3) spherical-harmonics coefficients, the colour is 0.5 + Σ c·Y, at least 0. Or (N, 3)
            colours, the same from everywhere, at least 0 as well.

    Raises:
        ValueError: for tensors whose shapes do not belong together.
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
        """Plain arrays as float32 tensors on a device; on the CPU they may share the arrays' memory."""
        columns = (np.ascontiguousarray(getattr(splats, f.name), np.float32) for f in fields(cls))
        return cls(*(torch.from_numpy(column).to(device) for column in columns))

    @classmethod
    def concatenated(cls, sets: Sequence[Gaussians]) -> Gaussians:
        """All of several sets whose ``sh`` have one shape, in order."""
        return cls(*map(torch.cat, zip(*(vars(one).values() for one in sets), strict=True)))

    def __len__(self) -> int:
        return len(self.means)

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Gaussians:
        """These with every tensor changed by a function."""
        return Gaussians(*(function(tensor) for tensor in vars(self).values()))

    def select(self, index) -> Gaussians:
        """Those at ``index``: a slice, a boolean mask (N,) or integers (M,)."""
        return self.map(lambda tensor: tensor[index])

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """These on another device, of another type, or both."""
        return self.map(lambda tensor: tensor.to(device=device, dtype=dtype))

    def detach(self) -> Gaussians:
        """The same values without their gradients' graph."""
        return self.map(torch.Tensor.detach)
