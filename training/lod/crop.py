"""Boxes and spheres that splats are kept in, or cut out of: one test, by places, for every level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..documents import quote
from ..errors import LodgsError

SHAPES = ("BOX", "SPHERE")
FACE_SQUARED = (1 + 1e-5) ** 2
"""The square of how far a crop reaches in its own space: what lies on its face is in it, however numbers were
rounded on the way there."""
_NOWHERE = ((0.0, 0.0, 0.0, 2.0),) * 3
"""The way into a crop that is flat: every place is outside."""


@dataclass(frozen=True)
class Crop:
    """A box or a sphere somewhere in the splats' own space. Crops compare, and travel as JSON.

    Attributes:
        shape: "BOX", from -1 to 1 on each axis of its own space, or "SPHERE", of radius 1 there.
        to_own: the rows of the (3, 4) transform from the splats' space to the crop's own.
        outside: whether what lies in it is cut out; otherwise it is what stays.
    """

    shape: str
    to_own: tuple[tuple[float, ...], ...]
    outside: bool = False

    @classmethod
    def at(cls, shape: str, matrix: np.ndarray, outside: bool = False) -> Crop:
        """A crop where (4, 4) ``matrix`` puts the box from -1 to 1, or the sphere of radius 1."""
        matrix = np.asarray(matrix, np.float64)
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
            return cls(shape, _NOWHERE, outside)
        rows = np.linalg.inv(matrix)[:3]
        return cls(shape, tuple(map(tuple, rows.tolist())), outside)

    @classmethod
    def box(cls, one: Sequence[float], other: Sequence[float], outside: bool = False) -> Crop:
        """A box between two opposite corners (3,), along the axes.

        Raises:
            LodgsError: there is nothing between them, or no end.
        """
        low, high = np.minimum(one, other), np.maximum(one, other)
        if not np.isfinite([low, high]).all():
            raise LodgsError(f"The box from {one} to {other} has no end.", "Give two opposite corners.")
        if not (high > low).all():
            raise LodgsError(f"The box from {one} to {other} is flat.", "Give two opposite corners.")
        matrix = np.diag([*(high - low) / 2, 1])
        matrix[:3, 3] = (low + high) / 2
        return cls.at("BOX", matrix, outside)

    @classmethod
    def sphere(cls, centre: Sequence[float], radius: float, outside: bool = False) -> Crop:
        """A sphere around a centre (3,).

        Raises:
            LodgsError: it has no radius, or no end.
        """
        if not np.isfinite([*centre, radius]).all():
            raise LodgsError(
                f"The sphere of radius {radius:g} around {centre} has no end.", "Give four finite numbers."
            )
        if not radius > 0:
            raise LodgsError(f"A sphere of radius {radius:g} holds nothing.", "Give a radius above 0.")
        matrix = np.diag([radius, radius, radius, 1.0])
        matrix[:3, 3] = centre
        return cls.at("SPHERE", matrix, outside)

    def holds(self, means: np.ndarray) -> np.ndarray:
        """(N,) bool, which means (N, 3) lie in it."""
        x, y, z = means.T
        squares = None
        for a, b, c, d in np.array(self.to_own, np.float32):
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
        """A crop in words: ``box X Y Z X Y Z`` (two opposite corners), ``sphere X Y Z R``, or either with the
        12 numbers of ``to_own``, row by row, for what is turned or stretched.

        Raises:
            LodgsError: it is none, or holds nothing.
        """
        name, *told = text.split()
        try:
            numbers = [float(each) for each in told]
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
            f"{quote(text)} is no box and no sphere.",
            "Give box X Y Z X Y Z (two opposite corners), or sphere X Y Z RADIUS.",
        )

    def as_text(self) -> str:
        """What ``from_text`` makes the same of, whatever lies in it stays or goes."""
        return " ".join([self.shape.lower(), *(repr(value) for row in self.to_own for value in row)])

    def as_dict(self) -> dict:
        """The same as JSON has it."""
        return {"shape": self.shape, "to_own": [list(row) for row in self.to_own], "outside": self.outside}


def crop_mask(crops: Sequence[Crop], means: np.ndarray) -> np.ndarray:
    """(N,) bool, which splats at means (N, 3) some crops leave.

    Those in any of the crops that keep what lies in them, or all where there is none such, but for those in
    any that is cut out.
    """
    inside = [crop for crop in crops if not crop.outside]
    found = np.full(len(means), not inside)
    for crop in inside:
        found |= crop.holds(means)
    for crop in crops:
        if crop.outside:
            found &= ~crop.holds(means)
    return found


def is_crop_text(text: str) -> bool:
    """Whether a text is meant to be one that :meth:`Crop.from_text` reads, and no path."""
    return text.split(" ", 1)[0].upper() in SHAPES
