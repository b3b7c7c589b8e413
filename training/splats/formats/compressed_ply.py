"""PlayCanvas' compressed PLY. A file whose name lacks ``.compressed`` is recognised by its contents."""

from __future__ import annotations

from ..splat_format import SplatFormat, higher_coefficients

FORMAT = SplatFormat(
    ".compressed.ply",
    "Compressed PLY",
    "Format of SuperSplat and PlayCanvas, a quarter of a PLY's size",
    tuple(16.3 + higher_coefficients(degree) for degree in range(4)),
    max_degree=3,
)
