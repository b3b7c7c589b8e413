"""Tables of CLoD-GS (Cheng et al. 2025)."""

from __future__ import annotations

from .subject import Subject
from .tables import LPIPS, PSNR, SPLATS, SSIM, Paper, Row, Table, Training, Trend, Value, increases

_PLAIN, _FULL, _THREE, _TEN = "3DGS", "CLoD-GS", "CLoD-GS to scale 3", "CLoD-GS to scale 10"
_NO_WEIGHT, _NO_LOSS = "without w_s", "without L_reg"
_SCALES = (1, 2, 3, 4, 5)
_DATA = "BungeeNeRF"


def _scale(s_v: float):
    return lambda subject: subject.by_distance(s_v=s_v)


def _finest(subject: Subject) -> dict[str, float]:
    return subject.level()


def _smaller_and_better(value: Value) -> tuple[bool, str]:
    gain = value("CLoD-GS", PSNR) - value("3DGS", PSNR)
    share = 1 - value("CLoD-GS", SPLATS) / value("3DGS", SPLATS)
    return gain > 0 and share > 0, f"{gain:+.2f} dB with {share:.0%} fewer splats"


def _graceful(value: Value) -> tuple[bool, str]:
    gain = value("to 5, s_v = 5", PSNR) - value("to 3, s_v = 5", PSNR)
    loss = value("to 3, s_v = 1", PSNR) - value("to 5, s_v = 1", PSNR)
    return gain > 0 and loss < 0.3, f"{gain:+.2f} dB at s_v = 5, {-loss:+.2f} dB at s_v = 1"


def _fades(value: Value) -> tuple[bool, str]:
    share = value("to 5, s_v = 5", SPLATS) / value("to 5, s_v = 1", SPLATS)
    loss = value("to 5, s_v = 1", PSNR) - value("to 5, s_v = 5", PSNR)
    return share < 0.6, f"{share:.0%} of the splats, {loss:.2f} dB less"


def _curve(name: str, training: str) -> list[Row]:
    return [Row(f"{name}, s_v = {s_v}", training, _scale(s_v)) for s_v in _SCALES]


PAPER = Paper(
    title="CLoD-GS: Continuous Level-of-Detail via 3D Gaussian Splatting",
    trainings={
        _PLAIN: Training("3dgs"),
        _FULL: Training("clod"),
        _THREE: Training("clod", {"s_v_most": 3.0}),
        _TEN: Training("clod", {"s_v_most": 10.0}),
        _NO_WEIGHT: Training("clod", {"scale_weight": False}),
        _NO_LOSS: Training("clod", {"count_weight": 0.0}),
    },
    tables=(
        Table(
            "Table 1", "Full detail against 3DGS", _DATA, (PSNR, SSIM, LPIPS, SPLATS),
            (
                Row("3DGS", _PLAIN, _finest, (27.91, 0.917, 0.096, 6_733_000)),
                Row("CLoD-GS", _FULL, _scale(1), (28.05, 0.919, 0.095, 4_185_000)),
            ),
            (Trend("More quality than 3DGS (0.14 dB) with 38 % fewer splats.", _smaller_and_better),),
        ),
        Table(
            "Figure 3", "Quality against splats, for the range of scales in training", _DATA,
            (PSNR, SSIM, LPIPS, SPLATS),
            [*_curve("to 3", _THREE), *_curve("to 5", _FULL), *_curve("to 10", _TEN)],
            (
                Trend("A larger range of scales improves low detail and keeps full detail.", _graceful),
                increases("Splats fall with the scale.",
                          [f"to 5, s_v = {s_v}" for s_v in reversed(_SCALES)], SPLATS),
                Trend("Scale 5 draws under 60 % of the splats.", _fades),
            ),
        ),
        Table(
            "Table 2", "Ablations of the training, at scale 5", _DATA,
            (PSNR, SSIM, LPIPS, SPLATS),
            (
                Row("Full model", _FULL, _scale(5), (27.59, 0.902, 0.123)),
                Row("w/o weight", _NO_WEIGHT, _scale(5), (27.39, 0.894, 0.127)),
                Row("w/o loss", _NO_LOSS, _scale(5), (27.56, 0.902, 0.123)),
            ),
            (
                increases("The weight w_s improves quality (0.2 dB).", ("w/o weight", "Full model"), PSNR),
                increases("L_reg does not lower quality (0.03 dB).", ("w/o loss", "Full model"), PSNR),
            ),
        ),
    ),
    missing=(
        "Table 2, without weight and loss: the paper does not define it, because w_s is a factor of L_reg.",
        "Table 1: Fast Rendering and MaskGaussian are not part of LODGS.",
        "Figure 3: its values are not published as numbers.",
    ),
)  # fmt: skip
