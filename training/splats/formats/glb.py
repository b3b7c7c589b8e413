"""Binary glTF with KHR_gaussian_splatting."""

from __future__ import annotations

from ..gltf import MAX_DEGREE, write_glb
from ..gltf_reader import read_glb
from ..splat_format import SplatFormat

FORMAT = SplatFormat(
    ".glb",
    "glTF",
    "glTF for Babylon.js and three.js; all levels in one file",
    tuple(48.0 + 12 * (degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)),
    max_degree=MAX_DEGREE,
    write_levels=write_glb,
    read_levels=read_glb,
    georeferenced=True,
)
