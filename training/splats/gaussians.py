"""3D Gaussian splats as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Protocol

import numpy as np

SH_C0 = 0.28209479177387814
"""Spherical harmonic of degree 0, sqrt(1 / 4π): a base colour is 0.5 + SH_C0 · sh[:, 0]."""


class SplatRows(Protocol):
    """Splats that are loaded in batches of rows from memory (``Splats``), a file or another source."""

    def __len__(self) -> int: ...

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,)."""
        ...


@dataclass
class Splats:
    """N Gaussians in the parametrisation that 3DGS files use.

    Attributes:
        means: (N, 3) float32, world coordinates.
        quats: (N, 4) float32, wxyz, normalised or not.
        log_scales: (N, 3) float32, natural logarithm of the standard deviation along each axis.
        opacity_logits: (N,) float32; opacity = sigmoid(logit).
        sh: (N, (degree + 1)**2, 3) float32; colour = 0.5 + sum of coefficient * basis, degree 0 to 4.
        extras: additional per-splat columns by name, each (N,) of a PLY type (8- to 32-bit integers, float32,
            float64); they survive every read, edit and write.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    extras: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def opacities(self) -> np.ndarray:
        """Opacities (N,) float32 in [0, 1]."""
        with np.errstate(over="ignore"):
            return 1 / (1 + np.exp(-self.opacity_logits))

    def select(self, index: slice | np.ndarray | list[int]) -> Splats:
        """Return the splats at ``index``: a slice, a boolean mask (N,) or an integer array."""
        columns = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "extras"}
        return Splats(**columns, extras={name: column[index] for name, column in self.extras.items()})

    def padded(self, degree: int) -> Splats:
        """Return the splats with zeros for missing coefficients up to a degree of at least their own."""
        missing = (degree + 1) ** 2 - self.sh.shape[1]
        return replace(self, sh=np.pad(self.sh, ((0, 0), (0, missing), (0, 0)))) if missing else self

    @classmethod
    def concatenated(cls, sets: list[Splats]) -> Splats:
        """Join sets of one SH degree in order. Only extras that all sets have are kept."""
        columns = {
            f.name: np.concatenate([getattr(s, f.name) for s in sets])
            for f in fields(cls)
            if f.name != "extras"
        }
        shared = [name for name in sets[0].extras if all(name in s.extras for s in sets)]
        return cls(
            **columns, extras={name: np.concatenate([s.extras[name] for s in sets]) for name in shared}
        )


def equalize_degrees(sets: Sequence[Splats]) -> list[Splats]:
    """Return the sets with the highest SH degree of them all."""
    degree = max(splats.sh_degree for splats in sets)
    return [splats.padded(degree) for splats in sets]


def splat_area(log_scales: np.ndarray) -> np.ndarray:
    """Return s1 s2 + s1 s3 + s2 s3, (N,) float64, about proportional to an ellipsoid's mean shadow."""
    a, b, c = np.exp(np.minimum(log_scales, 60).T.astype(np.float64))
    return a * b + a * c + b * c
