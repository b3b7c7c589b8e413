"""PlayCanvas' SOG, https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/."""

from __future__ import annotations

from ..splat_format import SplatFormat

FORMAT = SplatFormat(
    ".sog",
    "SOG",
    "PlayCanvas' web format, the smallest. Slow without a graphics card",
    (13.0, 14.6, 14.6, 14.6),
    max_degree=3,
    palette_size=1 << 16,
)
