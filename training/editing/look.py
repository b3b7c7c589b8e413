"""Looks of splats: exposure, white balance, tint, saturation and opacity.

Splats have display-coded (sRGB) colours and are blended in them, like photos. There, a look is a 3x3 matrix
on colours, and applying it to each splat equals applying it to the blended image. Linear light times k is
approximated by a display value times k^(1/2.2). Colours are linear in their harmonics, so that the matrix
applies to the coefficients of every degree, independent of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ..lod.crop import Crop, CropUnion
from ..settings import check_value, setting, settings_of
from ..splats.gaussians import SH_C0, SplatRows, Splats
from ..splats.levels import Bundle
from .paint import apply_paint

GAMMA = 2.2
"""Exponent that approximates the sRGB curve."""
DAYLIGHT = 6500.0
"""Temperature in kelvins that changes nothing."""
LUMA = (0.2126, 0.7152, 0.0722)
"""Luma coefficients of the channels (ITU-R BT.709)."""
_MIN_FACTOR = 1e-6
_RGB_OF_XYZ = np.array(
    ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
)  # IEC 61966-2-1


@dataclass(frozen=True)
class Look:
    """A change of colours and opacities; the defaults change nothing. Hashable.

    Raises:
        LodgsError: a value is out of its bounds.
    """

    exposure: float = setting(
        0.0, "Brightness in stops. Each stop doubles the light.", low=-10, high=10, soft=(-4, 4)
    )
    temperature: float = setting(
        DAYLIGHT,
        "White balance: colour temperature of the light that appears white. Values below "
        f"{DAYLIGHT:.0f} K make colours colder, above it warmer.",
        low=2500, high=20_000, soft=(None, 12_000), unit="K",
    )  # fmt: skip
    tint: tuple[float, float, float] = setting(
        (1.0, 1.0, 1.0), "Display colour that multiplies all splat colours, 0 to 1.", high=1
    )
    saturation: float = setting(
        1.0, "Saturation of the splats. 0 is grey, 1 is as trained.", high=4, soft=(None, 2)
    )
    opacity: float = setting(1.0, "Factor for the opacity of every splat, 0 to 1.", high=1)

    def __post_init__(self) -> None:
        for name, f in LOOK_SETTINGS.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                check_value(f, number)

    @property
    def matrix(self) -> np.ndarray:
        """Matrix (3, 3) float64 on display-coded colours: light, then saturation, then tint.

        With saturation 0, the tint therefore tones the image.
        """
        light = 2 ** (self.exposure / GAMMA) * white_balance(self.temperature)
        gray = np.broadcast_to(LUMA, (3, 3))
        saturation = self.saturation * np.eye(3) + (1 - self.saturation) * gray
        return np.asarray(self.tint)[:, None] * saturation * light

    def as_dict(self) -> dict[str, Any]:
        """Return the look as a JSON-serialisable dict."""
        return asdict(self) | {"tint": list(self.tint)}


LOOK_SETTINGS = settings_of(Look)
"""The settings of a look, by name."""
NEUTRAL = Look()

Looks = Sequence[tuple[Crop | None, Look]]
"""Looks in the order of application, each with a crop that limits it; None means all splats."""
LimitedLooks = Sequence[tuple[Crop | CropUnion | None, Look]]
"""Looks as above, each limited by one crop or by several."""


def looks_as_dicts(looks: Looks) -> list[dict[str, Any]]:
    """Return looks as JSON-serialisable dicts."""
    return [{"crop": crop and crop.as_dict(), "look": look.as_dict()} for crop, look in looks]


def white_balance(temperature: float) -> np.ndarray:
    """Return factors (3,) on display-coded colours that turn a black body's light into DAYLIGHT.

    Factors preserve luma.
    """
    factors = (_black_body(DAYLIGHT) / _black_body(temperature)) ** (1 / GAMMA)
    return factors / np.dot(LUMA, factors)


def _black_body(temperature: float) -> np.ndarray:
    """Return linear sRGB (3,) of a black body's light, with luminance 1.

    Chromaticity polynomials of Kim et al., Design of Advanced Color Temperature Control System for HDTV
    Applications (2002), valid from 2222 K on.
    """
    t = 1000 / temperature
    if temperature <= 4000:
        x = np.polyval((-0.2661239, -0.2343589, 0.8776956, 0.179910), t)
        y = np.polyval((-0.9549476, -1.37418593, 2.09137015, -0.16748867), x)
    else:
        x = np.polyval((-3.0258469, 2.1070379, 0.2226347, 0.240390), t)
        y = np.polyval((3.0817580, -5.87338670, 3.75112997, -0.37001483), x)
    return _RGB_OF_XYZ @ (x / y, 1.0, (1 - x - y) / y)


def change_colors(
    looks: LimitedLooks, means: np.ndarray, sh: np.ndarray, opacity_logits: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Apply looks to harmonics (N, K, 3) and opacity logits (N,) of splats at means (N, 3).

    Exact for colours above black, where they are not clamped.
    """
    for crop, look in looks:
        rows: Any = slice(None) if crop is None else np.flatnonzero(crop.contains(means) != crop.outside)
        if crop is not None and not len(rows):
            continue
        matrix = look.matrix
        mapped = (sh[rows].reshape(-1, 3) @ matrix.T.astype(np.float32)).reshape(sh[rows].shape)
        mapped[:, 0] += ((matrix.sum(axis=1) - 1) * 0.5 / SH_C0).astype(np.float32)
        logits = _scale_opacity(opacity_logits[rows], look.opacity)
        if crop is None:
            sh, opacity_logits = mapped, logits
        else:
            sh, opacity_logits = sh.copy(), opacity_logits.copy()
            sh[rows], opacity_logits[rows] = mapped, logits
    return sh, opacity_logits


def apply_looks(splats: Splats, looks: LimitedLooks) -> Splats:
    """Return splats with paint and looks applied; crops are in the splats' space."""
    splats = apply_paint(splats)
    sh, opacity_logits = change_colors(looks, splats.means, splats.sh, splats.opacity_logits)
    return replace(splats, sh=sh, opacity_logits=opacity_logits)


@dataclass(frozen=True)
class RowsWithLook:
    """Splats on disk with paint and looks applied when they are read."""

    rows: SplatRows
    looks: LimitedLooks

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Read a range of rows, or some rows (M,) ascending."""
        return apply_looks(self.rows.select(index), self.looks)


def apply_looks_to_levels(bundle: Bundle, looks: LimitedLooks) -> Bundle:
    """Return a bundle with paint and looks applied; levels on disk stay there until they are written."""
    levels = [
        replace(level, splats=apply_looks(level.splats, looks))
        if level.on_disk is None
        else replace(level, on_disk=RowsWithLook(level.on_disk, looks))
        for level in bundle.levels
    ]
    return replace(bundle, levels=levels)


def _scale_opacity(logits: np.ndarray, factor: float) -> np.ndarray:
    """Return logits (N,) of the scaled opacities: log f - log(1 - f + exp(-l))."""
    if factor == 1:
        return logits
    with np.errstate(over="ignore"):
        transparency = 1 - factor + np.exp(-logits.astype(np.float64))
        return (np.log(max(factor, _MIN_FACTOR)) - np.log(transparency)).clip(-80, 80).astype(np.float32)
