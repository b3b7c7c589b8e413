"""Niantic's SPZ, https://github.com/nianticlabs/spz."""

from __future__ import annotations

from ..splat_format import SplatFormat

FORMAT = SplatFormat(
    ".spz",
    "SPZ",
    "Niantic's format for phones, Cesium and glTF, a twelfth of a PLY's size",
    (17.0, 18.0, 18.0, 18.0),
    max_degree=3,
    antialiased=True,
)
