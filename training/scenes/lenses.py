"""Lenses of COLMAP, and the lens and size of a photo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import LodgsError

_MAX_SIDE = 1 << 31
"""Exclusive limit of an image's width and height."""


class UnknownLens(ValueError):
    """A camera model that COLMAP's list lacks."""


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model; its parameters are focal length(s), cx, cy, then the distortion."""

    name: str
    parameters: int
    focals: int
    perspective: bool = True  # a pinhole if the distortion is zero; a fisheye is never one


# Indexed by COLMAP's model id (colmap/src/colmap/sensor/models.h).
LENSES = dict(
    enumerate(
        [
            Lens("SIMPLE_PINHOLE", 3, 1),
            Lens("PINHOLE", 4, 2),
            Lens("SIMPLE_RADIAL", 4, 1),
            Lens("RADIAL", 5, 1),
            Lens("OPENCV", 8, 2),
            Lens("OPENCV_FISHEYE", 8, 2, perspective=False),
            Lens("FULL_OPENCV", 12, 2),
            Lens("FOV", 5, 2),
            Lens("SIMPLE_RADIAL_FISHEYE", 4, 1, perspective=False),
            Lens("RADIAL_FISHEYE", 5, 1, perspective=False),
            Lens("THIN_PRISM_FISHEYE", 12, 2, perspective=False),
            Lens("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, perspective=False),
            Lens("SIMPLE_DIVISION", 4, 1),
            Lens("DIVISION", 5, 2),
            Lens("SIMPLE_FISHEYE", 3, 1, perspective=False),
            Lens("FISHEYE", 4, 2, perspective=False),
            Lens("EUCM", 6, 2),
            Lens("EQUIRECTANGULAR", 2, 0, perspective=False),
        ]
    )
)
LENS_BY_NAME = {lens.name: lens for lens in LENSES.values()}
MAX_LENS_ID = 256
"""Exclusive limit of ids of lenses that newer versions of COLMAP may add; others are damage."""
_TWO_FOCALS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_DIVISION": "DIVISION",
    "SIMPLE_FISHEYE": "FISHEYE",
}
"""Lens with two focal lengths for each lens with one; further distortion parameters are 0."""
_TANGENTIAL = "OPENCV", "FULL_OPENCV", "THIN_PRISM_FISHEYE"
"""Lenses whose third and fourth distortion parameters are p1 and p2."""


@dataclass(frozen=True)
class Intrinsics:
    """One record of cameras.bin or cameras.txt.

    Attributes:
        width, height: size in pixels of the photos that COLMAP used.
        parameters: lens parameters in COLMAP's order; finite, focal lengths > 0.
    """

    lens: Lens
    width: int
    height: int
    parameters: np.ndarray

    @property
    def distorted(self) -> bool:
        """True unless the lens is a pinhole."""
        distortion = self.parameters[self.lens.focals + 2 :]
        if self.lens.name == "EUCM":  # alpha, beta: a pinhole if alpha = 0, for any beta
            distortion = distortion[:1]
        return not self.lens.perspective or bool(np.any(np.abs(distortion) > 1e-8))  # COLMAP's tolerance

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Pinhole part of the lens: fx, fy, cx, cy."""
        fx, fy = self.parameters[0], self.parameters[self.lens.focals - 1]
        cx, cy = self.parameters[self.lens.focals : self.lens.focals + 2]
        return float(fx), float(fy), float(cx), float(cy)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the lens for photos of another size, scaled along each axis.

        A lens with one focal length becomes one with two if the proportions differ.
        """
        if (width, height) == (self.width, self.height):
            return self
        scale_x, scale_y = width / self.width, height / self.height
        lens, focals = self.lens, self.lens.focals
        center = self.parameters[focals : focals + 2] * (scale_x, scale_y)
        distortion = self.parameters[focals + 2 :]
        if focals == 1 and scale_x != scale_y and lens.name in _TWO_FOCALS:
            lens = LENS_BY_NAME[_TWO_FOCALS[lens.name]]
            distortion = np.pad(distortion, (0, lens.parameters - 4 - len(distortion)))
        scales = (scale_x, scale_y)[: lens.focals]
        focal = self.parameters[:focals] * scales
        return Intrinsics(lens, width, height, np.concatenate([focal, center, distortion]))

    def turned(self, turns: int) -> Intrinsics:
        """Return the lens for photos turned back by 1 to 3 clockwise quarter turns.

        Raises:
            LodgsError: if the distortion cannot be turned.
        """
        if turns == 2:
            return self.turned(1).turned(1)
        lens, (cx, cy) = self.lens, self.pinhole[2:]
        focal = self.parameters[: lens.focals][::-1]
        center = (cy, self.width - cx) if turns == 1 else (self.height - cy, cx)
        distortion = self.parameters[lens.focals + 2 :].copy()
        if lens.name in _TANGENTIAL and distortion.any():
            # (p2, p1) and (sx1, sy1) are vectors in the image.
            sign = 1 if turns == 1 else -1
            p1, p2 = distortion[2:4]
            distortion[2:4] = -sign * p2, sign * p1
            if lens.name == "THIN_PRISM_FISHEYE":
                x, y = distortion[6:8]
                distortion[6:8] = sign * y, -sign * x
        elif lens.name == "RAD_TAN_THIN_PRISM_FISHEYE":
            raise LodgsError(f"it is turned by its EXIF data only, which lens {lens.name} does not allow.")
        return Intrinsics(lens, self.height, self.width, np.concatenate([focal, center, distortion]))


def intrinsics_of(lens: Lens, width: int, height: int, parameters: np.ndarray) -> Intrinsics:
    """Return intrinsics of a lens.

    Raises:
        ValueError: the size, a focal length or a parameter is invalid.
    """
    if len(parameters) != lens.parameters:
        raise ValueError(f"{lens.name} has {lens.parameters} parameters, not {len(parameters)}")
    valid_size = 1 <= width < _MAX_SIDE and 1 <= height < _MAX_SIDE
    if not valid_size or not np.isfinite(parameters).all() or (parameters[: lens.focals] <= 0).any():
        raise ValueError("invalid size, focal length or parameter")
    return Intrinsics(lens, width, height, parameters)


def make_intrinsics(name: str, width: int, height: int, parameters: np.ndarray) -> Intrinsics:
    """Return intrinsics for the name of a COLMAP camera model.

    Raises:
        ValueError: the size, a focal length or a parameter is invalid.
        KeyError: the name is unknown.
    """
    return intrinsics_of(LENS_BY_NAME[name], width, height, parameters)
