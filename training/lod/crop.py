"""Crops: boxes and spheres that keep, or remove, the splats whose means are inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..documents import quote
from ..errors import LodgsError

SHAPES = ("BOX", "SPHERE")
FACE_SQUARED = (1 + 1e-5) ** 2
"""Squared half size of a crop in its local space, with a margin that keeps points on faces inside."""
_MAX_LENGTH = 1e30
"""Largest number of a box or a sphere; single precision holds its inverse, too."""
_NOWHERE = ((0.0, 0.0, 0.0, 2.0),) * 3
"""``to_local`` of a flat crop, which has no inside."""


@dataclass(frozen=True)
class Crop:
    """A box or a sphere in the splats' space. Hashable and JSON-serialisable.

    Attributes:
        shape: "BOX", from -1 to 1 on each axis of its local space, or "SPHERE", of radius 1 there.
        to_local: rows of the (3, 4) transform from the splats' space to the crop's local space.
        outside: keep the outside instead of the inside.
    """

    shape: str
    to_local: tuple[tuple[float, ...], ...]
    outside: bool = False

    @classmethod
    def from_matrix(cls, shape: str, matrix: np.ndarray, outside: bool = False) -> Crop:
        """Return the crop with the (4, 4) transform from its local space to the splats' space."""
        matrix = np.asarray(matrix, np.float64)
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
            return cls(shape, _NOWHERE, outside)
        rows = np.linalg.inv(matrix)[:3]
        return cls(shape, tuple(map(tuple, rows.tolist())), outside)

    @classmethod
    def box(cls, corner: Sequence[float], opposite: Sequence[float], outside: bool = False) -> Crop:
        """Return an axis-aligned box between two opposite corners (3,).

        Raises:
            LodgsError: the box is flat or infinite.
        """
        low, high = np.minimum(corner, opposite), np.maximum(corner, opposite)
        if not (np.abs([low, high]) <= _MAX_LENGTH).all():
            raise LodgsError(
                f"Cannot use the box from {corner} to {opposite}: it is infinite.", "Use finite corners."
            )
        if not (high > low).all():
            raise LodgsError(
                f"Cannot use the box from {corner} to {opposite}: it is flat.", "Use two opposite corners."
            )
        matrix = np.diag([*(high - low) / 2, 1])
        matrix[:3, 3] = (low + high) / 2
        return cls.from_matrix("BOX", matrix, outside)

    @classmethod
    def sphere(cls, center: Sequence[float], radius: float, outside: bool = False) -> Crop:
        """Return a sphere around a centre (3,).

        Raises:
            LodgsError: the sphere is empty or infinite.
        """
        if not (np.abs([*center, radius]) <= _MAX_LENGTH).all():
            raise LodgsError(
                f"Cannot use the sphere of radius {radius:g} around {center}: it is infinite.",
                "Use finite numbers.",
            )
        if not radius > 0:
            raise LodgsError(
                f"Cannot use a sphere of radius {radius:g}: it is empty.", "Use a radius above 0."
            )
        matrix = np.diag([radius, radius, radius, 1.0])
        matrix[:3, 3] = center
        return cls.from_matrix("SPHERE", matrix, outside)

    def contains(self, means: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of means (N, 3) inside the crop."""
        x, y, z = means.T
        squares = None
        for a, b, c, d in np.array(self.to_local, np.float32):
            axis = x * a
            axis += y * b
            axis += z * c
            axis += d
            np.multiply(axis, axis, out=axis)
            if squares is None:
                squares = axis
            elif self.shape == "SPHERE":
                squares += axis
            else:
                np.maximum(squares, axis, out=squares)
        assert squares is not None
        return squares <= np.float32(FACE_SQUARED)

    @classmethod
    def from_text(cls, text: str) -> Crop:
        """Parse a crop.

        Valid are ``box X Y Z X Y Z`` (two opposite corners), ``sphere X Y Z R``, or either name with the 12
        numbers of ``to_local``, row by row.

        Raises:
            LodgsError: invalid text, or an empty crop.
        """
        name, *words = text.split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if np.isfinite(numbers).all():
            match name.upper(), len(numbers):
                case "BOX", 6:
                    return cls.box(numbers[:3], numbers[3:])
                case "SPHERE", 4:
                    return cls.sphere(numbers[:3], numbers[3])
                case "BOX" | "SPHERE", 12:
                    rows = (tuple(numbers[at : at + 4]) for at in (0, 4, 8))
                    return cls(name.upper(), tuple(rows))
        raise LodgsError(
            f"Cannot read the region {quote(text)}: it is neither a box nor a sphere.",
            "Use box X Y Z X Y Z (two opposite corners), or sphere X Y Z RADIUS.",
        )

    def as_text(self) -> str:
        """Return a text for :meth:`from_text`, which does not store ``outside``."""
        return " ".join([self.shape.lower(), *(repr(value) for row in self.to_local for value in row)])

    def as_dict(self) -> dict:
        """Return the crop as a JSON-serialisable dict."""
        return {
            "shape": self.shape,
            "to_local": [list(row) for row in self.to_local],
            "outside": self.outside,
        }


def crop_mask(crops: Sequence[Crop], means: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the splats at means (N, 3) that crops keep.

    Crops keep splats inside any crop that keeps its inside (all splats if there is no such crop), except
    those inside any crop that keeps its outside.
    """
    inside = [crop for crop in crops if not crop.outside]
    mask = np.full(len(means), not inside)
    for crop in inside:
        mask |= crop.contains(means)
    for crop in crops:
        if crop.outside:
            mask &= ~crop.contains(means)
    return mask


@dataclass(frozen=True)
class CropUnion:
    """The inside of any of several crops, as the limit of one look."""

    crops: tuple[Crop, ...]
    outside = False

    def contains(self, means: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of means (N, 3) inside a crop."""
        return np.logical_or.reduce([crop.contains(means) for crop in self.crops])


def is_crop_text(text: str) -> bool:
    """Return whether a text is meant for :meth:`Crop.from_text`, and is not a path."""
    return text.split(" ", 1)[0].upper() in SHAPES
