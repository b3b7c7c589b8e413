"""How splats look beside how they were trained: exposure, white balance, tint, saturation, opacity.

Splats have display-coded (sRGB) colours, in which they are blended, as the photographs are. There a look is a
3x3 matrix on colours: what it makes of each splat's colour, it makes of the blended picture. Linear light
times k is a code times k^(1/2.2), as nearly as a factor can have it. Colours are linear in their harmonics:
the matrix acts on the coefficients of every degree, and nothing of a view has to be known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..lod.crop import Crop
from ..splats.gaussians import SH_C0, SplatRows, Splats
from ..splats.levels import Bundle
from .paint import apply_paint

GAMMA = 2.2
"""Of the power that stands for the sRGB curve."""
DAYLIGHT = 6500.0
"""Temperature in kelvins of the light that stays as it is."""
LUMA = (0.2126, 0.7152, 0.0722)
"""What channels add to lightness (ITU-R BT.709)."""
RANGES = {
    "exposure": (-10.0, 10.0), "temperature": (2500.0, 20_000.0), "tint": (0.0, 1.0),
    "saturation": (0.0, 4.0), "opacity": (0.0, 1.0),
}  # fmt: skip
"""What each part of a look may be."""
_FAINTEST = 1e-6
_RGB_OF_XYZ = np.array(
    ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
)  # IEC 61966-2-1


@dataclass(frozen=True)
class Look:
    """What is made of colours and opacities; the defaults leave both as they are. Looks compare.

    Attributes:
        exposure: in stops: one more is twice the light.
        temperature: in kelvins, of the light that is to look white; above DAYLIGHT colours get warmer.
        tint: display-coded colour that white gets.
        saturation: 0 is grey.
        opacity: factor on the opacities.

    Raises:
        LodgsError: a value is beyond RANGES.
    """

    exposure: float = 0.0
    temperature: float = DAYLIGHT
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    saturation: float = 1.0
    opacity: float = 1.0

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not all(low <= each <= high for each in (value if name == "tint" else [value])):
                shown = " ".join(f"{each:g}" for each in value) if name == "tint" else f"{value:g}"
                raise LodgsError(
                    f"The {name} of a look cannot be {shown}.", f"Choose from {low:g} to {high:g}."
                )

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) float64, on display-coded colours: light first, then saturation, tint last, so that without
        saturation the tint tones."""
        light = 2 ** (self.exposure / GAMMA) * white_balance(self.temperature)
        grey = np.broadcast_to(LUMA, (3, 3))
        saturation = self.saturation * np.eye(3) + (1 - self.saturation) * grey
        return np.asarray(self.tint)[:, None] * saturation * light

    def as_dict(self) -> dict[str, Any]:
        """The same as JSON has it."""
        return asdict(self) | {"tint": list(self.tint)}


NEUTRAL = Look()

Looks = Sequence[tuple[Crop | None, Look]]
"""Looks, one upon the other, and in which box or sphere each counts, or if so said outside of which; None:
everywhere."""


def looks_as_dicts(looks: Looks) -> list[dict[str, Any]]:
    """The same as JSON has it."""
    return [{"crop": crop and crop.as_dict(), "look": look.as_dict()} for crop, look in looks]


def white_balance(temperature: float) -> np.ndarray:
    """(3,) factors on display-coded colours that make grey in a black body's light grey in DAYLIGHT's, as
    light as before."""
    factors = (_black_body(DAYLIGHT) / _black_body(temperature)) ** (1 / GAMMA)
    return factors / np.dot(LUMA, factors)


def _black_body(temperature: float) -> np.ndarray:
    """(3,) linear sRGB of a black body's light, of luminance 1.

    Kim et al., Design of Advanced Color Temperature Control System for HDTV Applications (2002): its
    chromaticity by polynomials, from 2222 K on.
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
    looks: Looks, means: np.ndarray, sh: np.ndarray, opacity_logits: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What looks make of harmonics (N, K, 3) and opacity logits (N,) of splats at means (N, 3).

    Colours that stay above black are what the matrices make of them, from everywhere.
    """
    for crop, look in looks:
        some: Any = slice(None) if crop is None else np.flatnonzero(crop.contains(means) != crop.outside)
        if crop is not None and not len(some):
            continue
        matrix = look.matrix
        mapped = (sh[some].reshape(-1, 3) @ matrix.T.astype(np.float32)).reshape(sh[some].shape)
        mapped[:, 0] += ((matrix.sum(axis=1) - 1) * 0.5 / SH_C0).astype(np.float32)
        logits = _faded(opacity_logits[some], look.opacity)
        if crop is None:
            sh, opacity_logits = mapped, logits
        else:
            sh, opacity_logits = sh.copy(), opacity_logits.copy()
            sh[some], opacity_logits[some] = mapped, logits
    return sh, opacity_logits


def apply_looks(splats: Splats, looks: Looks) -> Splats:
    """Splats as paint and looks have them; places of regions are in the splats' own space."""
    splats = apply_paint(splats)
    sh, opacity_logits = change_colors(looks, splats.means, splats.sh, splats.opacity_logits)
    return replace(splats, sh=sh, opacity_logits=opacity_logits)


@dataclass(frozen=True)
class RowsWithLook:
    """Splats that are read a few at a time, as paint and looks have them."""

    of: SplatRows
    looks: Looks

    def __len__(self) -> int:
        return len(self.of)

    def select(self, some: slice | np.ndarray, /) -> Splats:
        """The splats of a range of rows, or of some rows (M,) ascending."""
        return apply_looks(self.of.select(some), self.looks)


def apply_looks_to_levels(bundle: Bundle, looks: Looks) -> Bundle:
    """A bundle whose levels are as paint and looks have them; those that are in files stay there until they
    are written."""
    levels = [
        replace(level, splats=apply_looks(level.splats, looks))
        if level.on_disk is None
        else replace(level, on_disk=RowsWithLook(level.on_disk, looks))
        for level in bundle.levels
    ]
    return replace(bundle, levels=levels)


def _faded(logits: np.ndarray, factor: float) -> np.ndarray:
    """Logits (N,) of the opacities times a factor: log f - log(1 - f + exp(-l))."""
    if factor == 1:
        return logits
    with np.errstate(over="ignore"):
        against = 1 - factor + np.exp(-logits.astype(np.float64))
        return (np.log(max(factor, _FAINTEST)) - np.log(against)).clip(-80, 80).astype(np.float32)
