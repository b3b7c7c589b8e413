"""Tables of FLoD (Seo et al. 2025)."""

from __future__ import annotations

from .subject import Subject
from .tables import (
    FPS,
    LPIPS,
    MEMORY,
    PSNR,
    SIZE,
    SPLATS,
    SSIM,
    Paper,
    Row,
    Table,
    Training,
    Trend,
    Value,
    increases,
    loses_little,
)

_ALL, _OVERLAP, _TOGETHER = "FLoD", "FLoD without overlap pruning", "FLoD without level-by-level training"
_SCAFFOLD, _OCTREE, _SINGLE = "FLoD-Scaffold", "Octree-GS", "Scaffold-GS"
_PLAIN, _MIP = "3DGS", "Mip-Splatting"

_TRAININGS = {
    _ALL: Training("flod"),
    _OVERLAP: Training("flod", {"overlap_interval": 0}),
    _TOGETHER: Training("flod", {"densify_until": [1.0] * 5}),
    _SCAFFOLD: Training("flod_scaffold"),
    _SINGLE: Training("octree_neural", {"levels": 1}),
    _OCTREE: Training("octree_neural"),
    _PLAIN: Training("3dgs"),
    _MIP: Training("3dgs", {"antialias": True}),
}

_MIP_NERF = "Mip-NeRF360"
_LEVELS = range(1, 6)


_SCAFFOLD_LEVELS = {1: (20.1, 0.5), 2: (22.1, 0.5), 3: (24.7, 0.6), 4: (26.6, 0.8), 5: (27.4, 1.0)}
"""Published PSNR and memory of FLoD-Scaffold's levels."""


def _level(number: int):
    return lambda subject: subject.level(number)


def _level_with_memory(number: int):
    return lambda subject: subject.level_with_memory(number)


def _range(first: int, last: int):
    return lambda subject: subject.by_distance(first=first, last=last)


def _range_beats_level(value: Value) -> tuple[bool, str]:
    gain = value("5-4-3", PSNR) - value("4", PSNR)
    return gain > 0, f"{gain:+.2f} dB"


def _prunes_coarse_levels(value: Value) -> tuple[bool, str]:
    shares = [1 - value(f"{n}, with", SPLATS) / value(f"{n}, without", SPLATS) for n in _LEVELS]
    text = ", ".join(f"{share:.0%}" for share in shares)
    return shares[0] > 0 and shares[0] == max(shares), text


def _training_helps(value: Value) -> tuple[bool, str]:
    gains = [value(f"{n}, with", PSNR) - value(f"{n}, without", PSNR) for n in _LEVELS]
    return all(gain > 0 for gain in gains), ", ".join(f"{gain:+.2f}" for gain in gains) + " dB"


def _compresses(value: Value) -> tuple[bool, str]:
    ratio = value("FLoD-3DGS+LightGS", SIZE) / value("FLoD-3DGS", SIZE)
    loss = value("FLoD-3DGS", PSNR) - value("FLoD-3DGS+LightGS", PSNR)
    return ratio <= 0.1 and loss <= 0.7, f"{1 - ratio:.1%} smaller, {loss:.2f} dB"


def _per_view_is_better(value: Value) -> tuple[bool, str]:
    gain = value("per view", PSNR) - value("predetermined", PSNR)
    return gain > 0, f"{gain:+.2f} dB"


def _pairs(training: str, published: dict[int, tuple[tuple, tuple]]) -> list[Row]:
    """Return rows of each level without and with a part of the method."""
    rows = []
    for number, (without, with_part) in published.items():
        rows.append(Row(f"{number}, without", training, _level(number), without))
        rows.append(Row(f"{number}, with", _ALL, _level(number), with_part))
    return rows


def _finest(subject: Subject) -> dict[str, float]:
    return subject.level()


PAPER = Paper(
    title="FLoD: Integrating Flexible Level of Detail into 3D Gaussian Splatting",
    trainings=_TRAININGS,
    tables=(
        Table(
            "Table 1", "Finest level against other methods", _MIP_NERF, (PSNR, SSIM, LPIPS),
            (
                Row("3DGS", _PLAIN, _finest, (27.36, 0.812, 0.217)),
                Row("Mip-Splatting", _MIP, _finest, (27.59, 0.831, 0.181)),
                Row("FLoD-3DGS", _ALL, _finest, (27.75, 0.815, 0.224)),
            ),
            (increases("FLoD-3DGS is better than 3DGS (0.39 dB).", ("3DGS", "FLoD-3DGS"), PSNR),),
        ),
        Table(
            "Table 2", "Quality, speed and splats of levels and ranges", _MIP_NERF,
            (PSNR, SSIM, LPIPS, FPS, SPLATS),
            (
                Row("5", _ALL, _level(5), (27.75, 0.815, 0.224, 103, 2_189_000)),
                Row("5-4-3", _ALL, _range(3, 5), (27.33, 0.801, 0.245, 124, 1_210_000)),
                Row("4", _ALL, _level(4), (26.67, 0.764, 0.292, 150, 1_049_000)),
                Row("4-3-2", _ALL, _range(2, 4), (26.48, 0.759, 0.298, 160, 856_000)),
                Row("3", _ALL, _level(3), (24.11, 0.634, 0.440, 202, 443_000)),
                Row("3-2-1", _ALL, _range(1, 3), (24.07, 0.632, 0.442, 208, 414_000)),
            ),
            (
                loses_little("5-4-3 loses 0.42 dB at 55 % of the splats.", "5", "5-4-3", 0.6, 0.65),
                increases("Quality falls from row to row.", ("3-2-1", "3", "4-3-2", "4", "5-4-3", "5"), PSNR),
                increases("Splats fall, too.", ("3-2-1", "3", "4-3-2", "4", "5-4-3", "5"), SPLATS),
                Trend("5-4-3 is better than level 4 (0.66 dB).", _range_beats_level),
            ),
        ),
        Table(
            "Table 3", "Levels of FLoD-Scaffold", _MIP_NERF, (PSNR, MEMORY),
            (
                *(Row(f"FLoD-Scaffold, level {n}", _SCAFFOLD, _level_with_memory(n), values)
                  for n, values in _SCAFFOLD_LEVELS.items()),
                Row("Scaffold-GS", _SINGLE, Subject.networks, (27.4, 1.3)),
                Row("Octree-Scaffold", _OCTREE, Subject.networks, (27.2, 1.0)),
            ),
            (increases("Quality rises by level.", [f"FLoD-Scaffold, level {n}" for n in _LEVELS], PSNR),),
        ),
        Table(
            "Table 4", "Selection for each view, and once", "Small City", (PSNR, FPS, SPLATS),
            (
                Row("per view", _ALL, _range(3, 5), (25.49, 221, 601_000)),
                Row("predetermined", _ALL, lambda s: s.predetermined(first=3, last=5), (24.69, 286, 589_000)),
                Row("max level", _ALL, _finest, (26.37, 181, 1_308_000)),
            ),
            (Trend("Selection for each view is better than once (0.8 dB).", _per_view_is_better),),
        ),
        Table(
            "Table 5", "Levels without and with level-by-level training", "DL3DV-10K",
            (PSNR, SSIM, LPIPS),
            _pairs(_TOGETHER, {
                5: ((31.20, 0.930, 0.158), (31.97, 0.936, 0.105)),
                4: ((29.05, 0.896, 0.161), (30.73, 0.917, 0.133)),
                3: ((27.05, 0.850, 0.224), (28.29, 0.869, 0.200)),
                2: ((23.41, 0.734, 0.376), (24.01, 0.750, 0.355)),
                1: ((20.41, 0.637, 0.485), (20.81, 0.646, 0.475)),
            }),
            (Trend("Level-by-level training improves levels 1 to 5.", _training_helps),),
        ),
        Table(
            "Table 6", "Levels without and with overlap pruning", _MIP_NERF, (SPLATS,),
            _pairs(_OVERLAP, {
                1: ((38_000,), (10_000,)), 2: ((49_000,), (31_000,)), 3: ((439_000,), (390_000,)),
                4: ((1_001_000,), (970_000,)), 5: ((2_058_000,), (2_048_000,)),
            }),
            (Trend("Overlap pruning removes most from level 1 (74 %).",
                   _prunes_coarse_levels),),
        ),
        Table(
            "Table 9", "Level 5 with compression", _MIP_NERF, (FPS, SIZE, PSNR, SSIM, LPIPS),
            (
                Row("FLoD-3DGS", _ALL, Subject.sized_level, (103, 518, 27.8, 0.815, 0.224)),
                Row("FLoD-3DGS+LightGS", _ALL, Subject.compressed, (144, 31.7, 27.1, 0.799, 0.250)),
            ),
            (Trend("Compression makes the level at least 90 % smaller at 0.7 dB or less.", _compresses),),
        ),
    ),
    missing=(
        "Table 1: Hierarchical-3DGS and Octree-3DGS are not trained. Table 3: memory of the networks. "
        "Table 4: memory.",
        "Mip-Splatting has its 2D filter only. Scaffold-GS is neural Octree-GS with one level.",
        "Table 7: it needs a laptop with a graphics card. Table 8: its methods are not part of LODGS.",
    ),
)  # fmt: skip
