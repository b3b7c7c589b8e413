"""Tables of Octree-GS (Ren et al. 2024)."""

from __future__ import annotations

from .subject import Subject
from .tables import PSNR, SPLATS, SSIM, Paper, Row, Table, Training, Trend, Value, ascending

_BIAS, _NEXT, _PROGRESSIVE = {"bias_rate": 0.0}, {"grow_next": False}, {"coarse_share": 0.0}
_ABLATIONS = {
    "M1": ({**_NEXT, **_BIAS, **_PROGRESSIVE}, (28.78, 0.866, 316_000)),
    "M2": ({**_NEXT, **_PROGRESSIVE}, (29.25, 0.880, 446_000)),
    "M3": (_PROGRESSIVE, (29.46, 0.882, 488_000)),
    "M4": ({**_BIAS, "init_level": 2}, (28.30, 0.856, 232_000)),
    "M5": ({"init_level": 2}, (28.44, 0.860, 237_000)),
    "M6": ({**_BIAS, "init_level": 4}, (29.29, 0.879, 466_000)),
    "M7": ({"init_level": 4}, (29.50, 0.883, 473_000)),
}
"""Changes and published values of the ablations: M1 is the octree alone, M2 adds the level bias, M3 growth
into the next level; M4 to M7 train progressively from level 2 or 4, without and with the bias."""


def _baked_and_networks(subject: Subject) -> dict[str, float]:
    """Measure the images of the networks, with the number of splats that are baked for a view."""
    return {"splats": subject.by_distance()["splats"], **subject.networks()}


def _bias_helps(value: Value) -> tuple[bool, str]:
    gains = [value(biased, PSNR) - value(plain, PSNR) for plain, biased in
             (("M1", "M2"), ("M4", "M5"), ("M6", "M7"))]  # fmt: skip
    return all(gain > 0 for gain in gains), ", ".join(f"{gain:+.2f}" for gain in gains) + " dB"


def _later_start_is_smaller(value: Value) -> tuple[bool, str]:
    share = value("M5", SPLATS) / value("M7", SPLATS)
    return share < 1 and value("M7", PSNR) > value("M5", PSNR), f"{share:.0%} of the splats"


PAPER = Paper(
    title="Octree-GS: Towards Consistent Real-time Rendering with LOD-Structured 3D Gaussians",
    trainings={
        "3D-GS": Training("3dgs"),
        "Octree-GS": Training("octree_neural"),
        "Scaffold-GS": Training("octree_neural", {"levels": 1}),
        **{name: Training("octree_neural", changes) for name, (changes, _) in _ABLATIONS.items()},
    },
    tables=(
        Table(
            "Table 1", "Quality and splats for a view", "Mip-NeRF360", (PSNR, SSIM, SPLATS),
            (
                Row("3D-GS", "3D-GS", lambda subject: subject.level(), (27.52, 0.812, 824_000)),
                Row("Scaffold-GS", "Scaffold-GS", _baked_and_networks, (27.71, 0.813, 719_000)),
                Row("Ours", "Octree-GS", _baked_and_networks, (27.73, 0.815, 686_000)),
            ),
            (
                ascending("Octree-GS is better than 3D-GS (0.21 dB).", ("3D-GS", "Ours"), PSNR),
                ascending("It draws fewer splats than Scaffold-GS (5 %).", ("Ours", "Scaffold-GS"), SPLATS),
            ),
        ),
        Table(
            "Table 5", "Ablations", "Block_Small of MatrixCity", (PSNR, SSIM, SPLATS),
            [Row(name, name, _baked_and_networks, published)
             for name, (_, published) in _ABLATIONS.items()],
            (
                Trend("The level bias improves M1, M4 and M6 (0.47, 0.14 and 0.21 dB).", _bias_helps),
                Trend("Training from level 2 has 50 % of the splats and less quality than from level 4.",
                      _later_start_is_smaller),
                ascending("Growth into the next level improves quality (0.21 dB).", ("M2", "M3"), PSNR),
            ),
        ),
    ),
    missing=(
        "LPIPS is not measured. Splats are those of the baked levels; the networks draw part of them.",
        "Tables 2 and 4: results are not split by altitude or image size. Table 3: lodgs evaluate --far "
        "counts splats from 2, 4 and 8 times the distance.",
    ),
)  # fmt: skip
