"""PlayCanvas' compressed PLY. A file whose name lacks ``.compressed`` is recognised by its contents."""

from __future__ import annotations

from ..compressed_ply import MAX_DEGREE, read_compressed_ply, write_compressed_ply
from ..splat_format import SplatFormat, higher_coefficients

FORMAT = SplatFormat(
    ".compressed.ply",
    "Compressed PLY",
    "Format of SuperSplat and PlayCanvas, a quarter of a PLY's size",
    tuple(16.3 + higher_coefficients(degree) for degree in range(MAX_DEGREE + 1)),
    max_degree=MAX_DEGREE,
    write=write_compressed_ply,
    read=read_compressed_ply,
    georeferenced=True,
)
