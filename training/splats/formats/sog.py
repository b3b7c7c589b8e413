"""PlayCanvas' SOG, https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/."""

from __future__ import annotations

from ..sog import MAX_DEGREE, MAX_PALETTE, load_packages, read_sog, write_sog
from ..splat_format import SplatFormat

FORMAT = SplatFormat(
    ".sog",
    "SOG",
    "PlayCanvas' web format, the smallest for large scenes",
    (13.0, 14.6, 14.6, 14.6),
    max_degree=MAX_DEGREE,
    palette_size=MAX_PALETTE,
    write=write_sog,
    read=read_sog,
    require=load_packages,
)
