"""Tables of A LoD of Gaussians (Windisch et al. 2025)."""

from __future__ import annotations

from itertools import pairwise

from .subject import Subject
from .tables import (
    FPS,
    LPIPS,
    PSNR,
    SPLATS,
    SSIM,
    TIME,
    Column,
    Paper,
    Row,
    Table,
    Training,
    Trend,
    Value,
    increases,
)

_TREE, _BASE, _OCTREE = "A LoD of Gaussians", "3DGS", "OctreeGS"
_PIXELS = (0.5, 1, 2, 4, 8, 16)
_CACHED, _UNCACHED = "Render Time Full", "Render Time w/o Cache"
_LOADED = Column("loaded nodes", "loaded", 0)
_CACHES = (0.1, 0.25, 0.5, 1.0)
"""Sizes of the cache, as shares of all nodes."""


def _label(pixels: float) -> str:
    return f"cut at {pixels:g} px"


def _cut(pixels: float):
    return lambda subject: subject.by_distance(pixels=pixels)


def _cache_label(share: float) -> str:
    return f"cache of {share:.0%}"


def _cached(share: float):
    return lambda subject: subject.streamed(share)


def _halves(value: Value) -> tuple[bool, str]:
    """Interpolate the loss at half of the splats of the finest cut."""
    fine = value(_label(_PIXELS[0]), SPLATS)
    cuts = [(value(_label(p), SPLATS) / fine, value(_label(p), PSNR)) for p in _PIXELS]
    for (first, quality), (second, coarser) in pairwise(cuts):
        if second <= 0.5 <= first:
            part = (first - 0.5) / max(first - second, 1e-9)
            loss = cuts[0][1] - (quality + part * (coarser - quality))
            return loss < 0.5, f"{loss:.2f} dB"
    return False, "no cut has half of the splats"


PAPER = Paper(
    title="A LoD of Gaussians: Unified Training and Rendering for Ultra-Large Scale Reconstruction",
    trainings={_BASE: Training("3dgs"), _OCTREE: Training("octree_neural"), _TREE: Training("tree")},
    tables=(
        Table(
            "Table 1",
            "Cuts of the trained size against Octree-GS",
            "MC-small-city+, where Octree-GS ran out of memory",
            (PSNR, SSIM, LPIPS, SPLATS),
            [
                Row("OctreeGS", _OCTREE, Subject.networks),
                Row("Ours", _TREE, lambda subject: subject.by_distance(), (21.59, 0.711, 0.396, 136_700_000)),
            ],
        ),
        Table(
            "Table 2",
            "Cuts of the trained size against Octree-GS",
            "Small City",
            (PSNR, SSIM, LPIPS),
            [
                Row("OctreeGS", _OCTREE, Subject.networks, (19.20, 0.601, 0.498)),
                Row("Ours", _TREE, lambda subject: subject.by_distance(), (24.61, 0.774, 0.297)),
            ],
            (increases("The tree is better than Octree-GS (5.4 dB).", ("OctreeGS", "Ours"), PSNR),),
        ),
        Table(
            "Table 3",
            "Frames with and without a cache of nodes",
            "MC-smaller-city+",
            (TIME, _LOADED),
            [
                Row(_CACHED, _TREE, _cached(1.0), (48.1,)),
                Row(_UNCACHED, _TREE, lambda subject: subject.streamed(reuse=False), (119.4,)),
            ],
            (increases("The cache makes frames faster (2.5 times).", (_CACHED, _UNCACHED), TIME),),
        ),
        Table(
            "Figure 18",
            "Quality and speed of cuts",
            "five views of each scene",
            (PSNR, SSIM, LPIPS, FPS, SPLATS),
            [
                Row("3DGS", _BASE, lambda subject: subject.level()),
                *(Row(_label(pixels), _TREE, _cut(pixels)) for pixels in _PIXELS),
            ],
            (
                increases("Finer cuts have more quality.", [_label(p) for p in reversed(_PIXELS)], PSNR),
                increases("Frames of coarser cuts are faster.", [_label(p) for p in _PIXELS], FPS),
                Trend("Half of the splats lose little quality.", _halves),
            ),
        ),
        Table(
            "Figure 19",
            "Speed by size of the cache",
            "1,000 frames of MC-small-city+ and Campus",
            (FPS, _LOADED),
            [Row(_cache_label(share), _TREE, _cached(share)) for share in _CACHES],
            (increases("Larger caches make frames faster.", list(map(_cache_label, _CACHES)), FPS),),
        ),
    ),
    missing=(
        "Figures 18 and 19: their values are not published as numbers. With a small cache, pictures of LODGS "
        "also become coarser.",
        "Table 1: the other programs, and memory of graphics cards.",
        "Table 3: other rows; make bench-tree measures cuts by subtrees and by breadth-first search, and "
        "training with and without a cache, of trees with up to 10 million nodes.",
    ),
)
