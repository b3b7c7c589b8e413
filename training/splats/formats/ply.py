"""PLY with the columns of 3D Gaussian Splatting (Kerbl et al. 2023)."""

from __future__ import annotations

from pathlib import Path

from ..dialects import comments_from_meta
from ..gaussians import SplatRows
from ..ply import write_ply
from ..splat_format import SplatFormat, higher_coefficients


def write(path: Path, splats: SplatRows, meta: dict) -> None:
    """Write a PLY with the meta as comments.

    Raises:
        LodgsError: the file cannot be written.
    """
    write_ply(path, splats, comments_from_meta(meta))


FORMAT = SplatFormat(
    ".ply",
    "PLY",
    "Original format for any viewer, without loss",
    tuple(4.0 * (17 + higher_coefficients(degree)) for degree in range(5)),
    max_degree=4,
    write=write,
    georeferenced=True,
)
