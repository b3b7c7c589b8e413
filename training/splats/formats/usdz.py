"""A package of USD, https://openusd.org."""

from __future__ import annotations

from ..splat_format import SplatFormat
from ..usd import MAX_DEGREE, load_usd, read_usd, write_usd

FORMAT = SplatFormat(
    ".usdz",
    "USD Package",
    "USD in one package, for Apple's devices; all levels in one file",
    tuple(44.0 + 12 * (degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)),
    max_degree=MAX_DEGREE,
    write_levels=write_usd,
    read_levels=read_usd,
    require=load_usd,
    georeferenced=True,
)
