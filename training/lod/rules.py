"""The rules of the papers, as formulas on arrays (numpy or torch: only shared operators are used).

Levels are listed from coarse to fine; level 1 is the first entry. Distances, near and far are in the
scene's own units (COLMAP's), focal lengths in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

import numpy as np

FADE = 0.5
"""Over how many levels of what is wanted a level of an octree fades in."""


def flod_s_min(s_min_1: float, rho: float, levels: int) -> list[float]:
    """FLoD's 3D scale constraint of each level (FLoD, Eq. 3): s_min_1 * rho**(1 - l), and 0 at the last.

    Args:
        s_min_1: constraint of level 1, in scene units (the paper's lambda).
        rho: factor by which it shrinks from level to level.
        levels: number of levels; with one level there is no constraint, which is plain 3DGS.
    """
    return [s_min_1 * rho ** (1 - level) for level in range(1, levels)] + [0.0]


def flod_bands(
    s_min: Sequence[float], focal_px: float, gamma: float, start: int, end: int
) -> list[tuple[float, float]]:
    """The distance band [near, far) in which each level is drawn (FLoD, Eq. 7 and 8).

    d_proj(l) = s_min(l) / gamma * focal_px is where level l's smallest detail covers gamma pixels. Level l
    serves d_proj(l) <= d < d_proj(l - 1); the finest level in use starts at 0, the coarsest has no end.

    Args:
        s_min: scale constraint of every level, coarse to fine.
        focal_px: focal length of the viewing camera in pixels.
        gamma: screen size threshold in pixels.
        start, end: the coarsest and the finest level in use, 1-based, inclusive.

    Returns:
        One (near, far) for each level; (inf, inf) for levels outside [start, end].

    Raises:
        ValueError: if not 1 <= start <= end <= len(s_min), or gamma is not positive.
    """
    if not 1 <= start <= end <= len(s_min):
        raise ValueError(f"levels {start} to {end} are not a range within 1 to {len(s_min)}")
    if gamma <= 0:
        raise ValueError(f"gamma must be positive, not {gamma}")

    def d_proj(level: int) -> float:
        return s_min[level - 1] / gamma * focal_px

    bands = []
    for level in range(1, len(s_min) + 1):
        if not start <= level <= end:
            bands.append((inf, inf))
            continue
        near = 0.0 if level == end else d_proj(level)
        far = inf if level == start else d_proj(level - 1)
        bands.append((near, far))
    return bands


def band_mask(distances, near: float, far: float):
    """Where near <= distance < far, as booleans (N,): the splats whose weight is 1."""
    return (distances >= near) & (distances < far)


def octree_wanted(distances, bias, d_max: float, levels: int):
    """The level that is wanted at a distance, 1 to ``levels``, not rounded (Octree-GS, Eq. 5 with the bias).

    Args:
        distances: (N,) from the eye, times the focal length that d_max belongs to over the eye's own.
        bias: (N,) each splat's bias, in levels, to which a global offset may be added.
        d_max: the distance from which on level 1 alone is wanted where the bias is 0.
    """
    return (_log2(d_max / distances.clip(1e-20)) + bias).clip(0, levels - 1) + 1


def octree_weights(wanted, level):
    """Weights (N,) of splats of a level: 1 below the wanted level, part of it near that, 0 above.

    Levels add up, and level 1 is always there. Octree-GS, Sec. 4.1: piecewise linear in the wanted level. The
    paper rounds it in training, which is where this is at least one half; a level fades in over FADE levels
    around that place (1 in the paper: then up to half a level more is drawn than training knew).

    Args:
        wanted: (N,) of :func:`octree_wanted`.
        level: (N,) or a number, 1 is the coarsest.
    """
    return ((wanted - level + 0.5) / FADE + 0.5).clip(0, 1)


def _log2(values):
    return values.log2() if hasattr(values, "log2") else np.log2(values)
