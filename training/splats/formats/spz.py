"""Niantic's SPZ, https://github.com/nianticlabs/spz."""

from __future__ import annotations

from ..splat_format import SplatFormat
from ..spz import MAX_WRITTEN_DEGREE, read_spz, write_spz

FORMAT = SplatFormat(
    ".spz",
    "SPZ",
    "Niantic's format for phones, Blender and the web, a tenth of a PLY's size",
    (17.0, 18.0, 18.0, 18.0),
    max_degree=MAX_WRITTEN_DEGREE,
    antialiased=True,
    write=write_spz,
    read=read_spz,
)
