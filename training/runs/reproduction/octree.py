"""Tables of Octree-GS (Ren et al. 2024)."""

from __future__ import annotations

from .subject import Subject
from .tables import LPIPS, PSNR, SPLATS, SSIM, Column, Paper, Row, Table, Training, Trend, Value, increases

_BIAS, _NEXT, _PROGRESSIVE = {"bias_rate": 0.0}, {"grow_next": False}, {"coarse_share": 0.0}
_ABLATIONS = {
    "M1": ({**_NEXT, **_BIAS, **_PROGRESSIVE}, (28.78, 0.866, 0.205, 316_000)),
    "M2": ({**_NEXT, **_PROGRESSIVE}, (29.25, 0.880, 0.180, 446_000)),
    "M3": (_PROGRESSIVE, (29.46, 0.882, 0.178, 488_000)),
    "M4": ({**_BIAS, "init_level": 2}, (28.30, 0.856, 0.221, 232_000)),
    "M5": ({"init_level": 2}, (28.44, 0.860, 0.221, 237_000)),
    "M6": ({**_BIAS, "init_level": 4}, (29.29, 0.879, 0.183, 466_000)),
    "M7": ({"init_level": 4}, (29.50, 0.883, 0.177, 473_000)),
}
"""Changes and published values of the ablations: M1 is the octree alone, M2 adds the level bias, M3 growth
into the next level; M4 to M7 train progressively from level 2 or 4, without and with the bias."""


_SIZES = [Column(f"PSNR at {size}", f"psnr_{factor}")
          for factor, size in ((1, "full size"), (2, "1/2"), (4, "1/4"), (8, "1/8"))]  # fmt: skip


def _each_size(value: Value) -> tuple[bool, str]:
    gains = [value("Ours", column) - value("3D-GS", column) for column in _SIZES]
    return all(gain > 0 for gain in gains), ", ".join(f"{gain:+.2f}" for gain in gains) + " dB"


def _bias_helps(value: Value) -> tuple[bool, str]:
    gains = [value(biased, PSNR) - value(plain, PSNR) for plain, biased in
             (("M1", "M2"), ("M4", "M5"), ("M6", "M7"))]  # fmt: skip
    return all(gain > 0 for gain in gains), ", ".join(f"{gain:+.2f}" for gain in gains) + " dB"


def _later_start_is_smaller(value: Value) -> tuple[bool, str]:
    share = value("M5", SPLATS) / value("M7", SPLATS)
    return share <= 0.75 and value("M7", PSNR) > value("M5", PSNR), f"{share:.0%} of the splats"


PAPER = Paper(
    title="Octree-GS: Towards Consistent Real-time Rendering with LOD-Structured 3D Gaussians",
    trainings={
        "3D-GS": Training("3dgs"),
        "Mip-Splatting": Training("3dgs", {"antialias": True}),
        "Octree-GS": Training("octree_neural"),
        "Scaffold-GS": Training("octree_neural", {"levels": 1}),
        **{name: Training("octree_neural", changes) for name, (changes, _) in _ABLATIONS.items()},
    },
    tables=(
        Table(
            "Table 1", "Quality and splats for a view", "Mip-NeRF360", (PSNR, SSIM, LPIPS, SPLATS),
            (
                Row("3D-GS", "3D-GS", lambda subject: subject.level(), (27.52, 0.812, 0.221, 824_000)),
                Row("Scaffold-GS", "Scaffold-GS", Subject.networks, (27.71, 0.813, 0.221, 719_000)),
                Row("Ours", "Octree-GS", Subject.networks, (27.73, 0.815, 0.217, 686_000)),
            ),
            (
                increases("Octree-GS is better than 3D-GS (0.21 dB).", ("3D-GS", "Ours"), PSNR),
                increases("It draws fewer splats than Scaffold-GS (5 %).", ("Ours", "Scaffold-GS"), SPLATS),
            ),
        ),
        Table(
            "Table 3", "Quality and splats for a view of a town", "Block_Small of MatrixCity",
            (PSNR, SSIM, LPIPS, SPLATS),
            (
                Row("Mip-Splatting", "Mip-Splatting", lambda subject: subject.level(),
                    (27.14, 0.829, 0.240, 860_000)),
                Row("Scaffold-GS", "Scaffold-GS", Subject.networks, (29.00, 0.868, 0.210, 357_000)),
                Row("Ours", "Octree-GS", Subject.networks, (29.50, 0.883, 0.177, 473_000)),
            ),
            (
                increases("Octree-GS is better than Scaffold-GS (0.5 dB).", ("Scaffold-GS", "Ours"), PSNR),
                increases("Octree-GS is better than Mip-Splatting (2.4 dB).", ("Mip-Splatting", "Ours"),
                          PSNR),
            ),
        ),
        Table(
            "Table 4", "Quality by image size", "multi-resolution Mip-NeRF360", _SIZES,
            (
                Row("3D-GS", "3D-GS", Subject.by_size, (26.16, 27.33, 28.55, 27.85)),
                Row("Scaffold-GS", "Scaffold-GS", Subject.by_size, (26.81, 28.09, 29.52, 28.98)),
                Row("Mip-Splatting", "Mip-Splatting", Subject.by_size, (27.43, 28.56, 30.00, 31.05)),
                Row("Ours", "Octree-GS", Subject.by_size, (27.59, 28.70, 30.05, 31.05)),
            ),
            (Trend("Octree-GS is better than 3D-GS at each size (1.4, 1.4, 1.5 and 3.2 dB).", _each_size),),
        ),
        Table(
            "Table 5", "Ablations", "Block_Small of MatrixCity", (PSNR, SSIM, LPIPS, SPLATS),
            [Row(name, name, Subject.networks, published)
             for name, (_, published) in _ABLATIONS.items()],
            (
                Trend("The level bias improves M1, M4 and M6 (0.47, 0.14 and 0.21 dB).", _bias_helps),
                Trend("Training from level 2 has 50 % of the splats and less quality than from level 4.",
                      _later_start_is_smaller),
                increases("Growth into the next level improves quality (0.21 dB).", ("M2", "M3"), PSNR),
            ),
        ),
    ),
    missing=(
        "Mip-Splatting has its 2D filter only. Scaffold-GS is neural Octree-GS with one level.",
        "Table 2: results are not split by altitude; lodgs evaluate --far counts splats from 2, 4 and 8 "
        "times the distance. Table 3: speed on camera paths.",
        "Table 4: training on several image sizes. Ours trains at one, and PSNR of baked levels is measured.",
    ),
)  # fmt: skip
