"""Splats that stand elsewhere: turned, scaled alike along all axes, and moved. numpy only."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import LodgsError
from . import sh as harmonics
from .gaussians import SplatRows, Splats
from .ply import NORMALS, Columns

AxisNames = tuple[str, str, str]
"""Names of the columns of x, y and z."""
_DIRECTIONS = 200
"""Directions on which harmonics are compared: several times as many as the 9 of degree 4."""


def is_similarity(matrix: np.ndarray) -> bool:
    """Whether a transform (4, 4) is a rotation, one scale for all axes, and a translation."""
    linear = matrix[:3, :3]
    square = linear.T @ linear
    scale = np.trace(square) / 3
    return np.linalg.det(linear) > 0 and bool(np.abs(square / scale - np.eye(3)).max() < 1e-5)


@dataclass(frozen=True)
class Similarity:
    """Where splats stand: x' = scale · rotation x + translation.

    Attributes:
        rotation: (3, 3) float64.
        scale: above 0.
        translation: (3,) float64.
    """

    rotation: np.ndarray
    scale: float
    translation: np.ndarray

    @classmethod
    def from_matrix(cls, matrix: np.ndarray) -> Similarity:
        """The placement that a matrix (4, 4) is.

        Raises:
            LodgsError: it stretches, shears or mirrors, or is no matrix of that kind.
        """
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or (matrix[3] != (0, 0, 0, 1)).any():
            raise LodgsError("This is no transform.", "Give 4 rows of 4 numbers, the last of them 0 0 0 1.")
        if not matrix[:3, :3].any() or not is_similarity(matrix):
            raise LodgsError(
                "The transform stretches, shears or mirrors the splats, which no file of splats can hold.",
                "Give it one scale for all axes, above 0.",
            )
        left, _, right = np.linalg.svd(matrix[:3, :3])
        scale = float(np.sqrt(np.square(matrix[:3, :3]).sum() / 3))
        return cls(left @ right, scale, matrix[:3, 3])

    @classmethod
    def from_angles(
        cls,
        degrees: Sequence[float] = (0, 0, 0),
        scale: float = 1.0,
        translation: Sequence[float] = (0, 0, 0),
    ) -> Similarity:
        """Of angles about x, then y, then z, as Blender's XYZ Euler angles are.

        Raises:
            LodgsError: the scale is not above 0, or something is no number.
        """
        found = np.eye(4)
        for axis, angle in enumerate(np.radians(np.asarray(degrees, np.float64))):
            turn, (i, j) = np.eye(4), ((1, 2), (2, 0), (0, 1))[axis]
            turn[[i, j], [i, j]] = np.cos(angle)
            turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
            found = turn @ found
        if not 0 < scale < np.inf:
            raise LodgsError(f"A scale of {scale:g} is not possible.", "Give a number above 0.")
        found[:3, :3] *= scale
        found[:3, 3] = translation
        return cls.from_matrix(found)

    def compose(self, first: Similarity) -> Similarity:
        """This placement of what another one has placed before."""
        return Similarity.from_matrix(self.matrix @ first.matrix)

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) float64."""
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = self.scale * self.rotation, self.translation
        return found

    @cached_property
    def quat(self) -> np.ndarray:
        """(4,) float64, wxyz, of the rotation: the largest of its four forms, which loses no digits."""
        r = self.rotation
        squares = np.array([
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ])  # fmt: skip
        squares += np.triu(squares, 1).T + np.eye(4)  # 4 q qᵀ
        row = squares[np.argmax(np.diag(squares))]
        return row / np.linalg.norm(row)

    def transform_axes(self, places: Iterable[np.ndarray], shift: bool = True) -> list[np.ndarray]:
        """Where places are then, axis by axis, (N,) float32 each: equal places to the bit at equal ones.

        Args:
            places: x, y and z, (N,) each.
            shift: False for directions, which are turned alone.
        """
        x, y, z = (axis.astype(np.float64) for axis in places)
        unit, moved = (self.scale, self.translation) if shift else (1.0, np.zeros(3))
        rows = (unit * self.rotation).tolist()
        return [
            (a * x + b * y + c * z + t).astype(np.float32)
            for (a, b, c), t in zip(rows, moved.tolist(), strict=True)
        ]

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Where places (N, 3) are then, (N, 3) float64."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def transform_columns(
        self, columns: Columns, lengths: Collection[str], places: Sequence[AxisNames]
    ) -> Columns:
        """Columns by name of which some are lengths, and some the axes of places; others stay as they are."""
        found = dict(columns)
        for name in lengths:
            if name in found:
                with np.errstate(over="ignore"):  # of what stands for no end
                    found[name] = (found[name] * np.float64(self.scale)).astype(found[name].dtype)
        for place in places:
            if all(name in found for name in place):
                axes = self.transform_axes(found[name] for name in place)
                found |= {n: axis.astype(found[n].dtype) for n, axis in zip(place, axes, strict=True)}
        return found

    @cached_property
    def _bands(self) -> list[np.ndarray]:
        """What turns the coefficients of each degree from 1 on: (3, 3), (5, 5), (7, 7), (9, 9) float64.

        A turned colour is c'·Y(R d) = c·Y(d) in every direction d: harmonics of one degree are those of the
        same degree in turned directions, so the matrix is exact where enough directions are compared.
        """
        # evenly on the sphere, along a spiral
        height = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
        turn, ring = np.arange(_DIRECTIONS) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - height**2)
        directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), height])
        before, after = np.empty((2, harmonics.coefficient_count(harmonics.MAX_DEGREE), _DIRECTIONS))
        for values, (x, y, z) in ((before, directions), (after, self.rotation @ directions)):
            harmonics.basis(x, y, z, harmonics.MAX_DEGREE, values)
        bands = [slice(degree**2, (degree + 1) ** 2) for degree in range(1, harmonics.MAX_DEGREE + 1)]
        return [np.linalg.lstsq(after[band].T, before[band].T, rcond=None)[0] for band in bands]

    def rotate_harmonics(self, sh: np.ndarray) -> np.ndarray:
        """Coefficients (N, (degree + 1)², 3) float32 as they are seen from turned directions."""
        turned = sh.copy()
        for degree in range(1, harmonics.degree_from_count(sh.shape[1]) + 1):
            band = slice(degree**2, (degree + 1) ** 2)
            turned[:, band] = np.matmul(self._bands[degree - 1], sh[:, band])
        return turned

    def transform_splats(
        self, splats: Splats, lengths: Collection[str] = (), places: Sequence[AxisNames] = ()
    ) -> Splats:
        """Splats that look the same where they stand then, as new arrays.

        Means, rotations, scales, harmonics and normals go along; so do further columns that are said to.

        Args:
            lengths: names of further columns that are lengths.
            places: of further columns that are places.
        """
        extras = self.transform_columns(splats.extras, lengths, places)
        if all(name in extras for name in NORMALS):
            normals = self.transform_axes((extras[name] for name in NORMALS), shift=False)
            extras |= dict(zip(NORMALS, normals, strict=True))
        turned = not np.array_equal(self.rotation, np.eye(3))
        return replace(
            splats,
            means=np.stack(self.transform_axes(splats.means.T), axis=1),
            quats=self._turned(splats.quats) if turned else splats.quats.copy(),
            log_scales=splats.log_scales + np.float32(np.log(self.scale)),
            sh=self.rotate_harmonics(splats.sh) if turned else splats.sh.copy(),
            extras=extras,
        )

    def _turned(self, quats: np.ndarray) -> np.ndarray:
        """Quaternions (N, 4) wxyz, turned; as long as they were."""
        w, x, y, z = self.quat.tolist()
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
        return (quats @ left.T).astype(np.float32)


@dataclass(frozen=True)
class TransformedRows:
    """Splats in a file as they are where they stand then, a few rows at a time.

    Attributes:
        rows: the splats as they are.
        placed: what is made of some of them.
        remade: further columns (N,) in place of theirs.
    """

    rows: SplatRows
    placed: Callable[[Splats], Splats]
    remade: Columns

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, some: slice | np.ndarray, /) -> Splats:
        """The splats of a range of rows, or of some rows (M,) ascending."""
        splats = self.placed(self.rows.select(some))
        splats.extras |= {name: column[some] for name, column in self.remade.items()}
        return splats
