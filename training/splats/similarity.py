"""Similarity transforms of splats: rotation, uniform scale and translation. numpy only."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import LodgsError
from . import sh as spherical_harmonics
from .gaussians import SplatRows, Splats
from .ply import NORMALS, Columns

AxisNames = tuple[str, str, str]
"""Names of the columns of x, y and z."""
_DIRECTIONS = 200
"""Number of directions that determine the rotation of harmonics; degree 4 needs at least 9."""


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # too large or small numbers are refused
def is_similarity(matrix: np.ndarray) -> bool:
    """Return True if a transform (4, 4) is a rotation, one scale for all axes, and a translation."""
    linear = matrix[:3, :3]
    square = linear.T @ linear
    scale = np.trace(square) / 3
    return np.linalg.det(linear) > 0 and bool(np.abs(square / scale - np.eye(3)).max() < 1e-5)


@dataclass(frozen=True)
class Similarity:
    """The transform x' = scale · rotation x + translation.

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
        """Decompose a matrix (4, 4).

        Raises:
            LodgsError: the matrix stretches, shears or mirrors, or is not an affine transform.
        """
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or (matrix[3] != (0, 0, 0, 1)).any():
            raise LodgsError(
                "Cannot transform splats: the matrix is not an affine transform.",
                "Give 4 rows of 4 numbers, the last of them 0 0 0 1.",
            )
        if not matrix[:3, :3].any() or not is_similarity(matrix):
            raise LodgsError(
                "Cannot transform splats: the transform stretches, shears or mirrors them.",
                "Use one scale above 0 for all axes.",
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
        """Rotate about x, then y, then z, as Blender's XYZ Euler angles do.

        Raises:
            LodgsError: the scale is not above 0, or a value is not a finite number.
        """
        if not np.isfinite([*degrees, *translation]).all():
            raise LodgsError(
                "Cannot transform splats: an angle or a translation is not a finite number.",
                "Use finite numbers.",
            )
        matrix = np.eye(4)
        for axis, angle in enumerate(np.radians(np.asarray(degrees, np.float64))):
            turn = np.eye(4)
            i, j = ((1, 2), (2, 0), (0, 1))[axis]
            turn[[i, j], [i, j]] = np.cos(angle)
            turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
            matrix = turn @ matrix
        if not 0 < scale < np.inf:
            raise LodgsError(f"Cannot scale splats by {scale:g}.", "Use a scale above 0.")
        matrix[:3, :3] *= scale
        matrix[:3, 3] = translation
        return cls.from_matrix(matrix)

    def compose(self, first: Similarity) -> Similarity:
        """Return the transform that applies ``first``, then this one."""
        return Similarity.from_matrix(self.matrix @ first.matrix)

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) float64."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    @cached_property
    def quat(self) -> np.ndarray:
        """Rotation as a quaternion, (4,) float64, wxyz, from the numerically best of its four formulas."""
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

    @np.errstate(over="ignore", invalid="ignore")  # positions that are not finite stay so
    def transform_axes(self, axes: Iterable[np.ndarray], translate: bool = True) -> list[np.ndarray]:
        """Transform coordinates axis by axis; equal inputs give bit-identical outputs.

        Args:
            axes: x, y and z, (N,) each.
            translate: False for directions, which are only rotated.

        Returns:
            x, y and z, (N,) float32 each.
        """
        x, y, z = (axis.astype(np.float64) for axis in axes)
        scale, shift = (self.scale, self.translation) if translate else (1.0, np.zeros(3))
        rows = (scale * self.rotation).tolist()
        return [
            (a * x + b * y + c * z + t).astype(np.float32)
            for (a, b, c), t in zip(rows, shift.tolist(), strict=True)
        ]

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) to (N, 3) float64."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def transform_columns(
        self, columns: Columns, lengths: Collection[str], positions: Sequence[AxisNames]
    ) -> Columns:
        """Scale the columns of lengths, transform those of positions, and keep all others.

        Args:
            columns: columns (N,) by name.
            lengths: names of columns of lengths.
            positions: names of the x, y and z columns of each kind of position.
        """
        transformed = dict(columns)
        for name in lengths:
            if name in transformed:
                with np.errstate(over="ignore", invalid="ignore"):  # huge values stand for infinity
                    scaled = transformed[name] * np.float64(self.scale)
                    transformed[name] = scaled.astype(transformed[name].dtype)
        for names in positions:
            if all(name in transformed for name in names):
                axes = self.transform_axes(transformed[name] for name in names)
                transformed |= {
                    name: axis.astype(transformed[name].dtype) for name, axis in zip(names, axes, strict=True)
                }
        return transformed

    @cached_property
    def _bands(self) -> list[np.ndarray]:
        """Matrices that rotate the coefficients of degree 1 to 4: (3, 3), (5, 5), (7, 7), (9, 9) float64.

        A rotated colour satisfies c'·Y(R d) = c·Y(d) in every direction d. Rotated harmonics of one degree
        are linear combinations of that degree, so enough directions determine the matrix exactly.
        """
        # evenly on the sphere, along a spiral
        height = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
        angle = np.arange(_DIRECTIONS) * np.pi * (3 - np.sqrt(5))
        ring = np.sqrt(1 - height**2)
        directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height])
        max_degree = spherical_harmonics.MAX_DEGREE
        original, rotated = np.empty((2, spherical_harmonics.coefficient_count(max_degree), _DIRECTIONS))
        for values, (x, y, z) in ((original, directions), (rotated, self.rotation @ directions)):
            spherical_harmonics.basis(x, y, z, max_degree, values)
        bands = [slice(degree**2, (degree + 1) ** 2) for degree in range(1, max_degree + 1)]
        return [np.linalg.lstsq(rotated[band].T, original[band].T, rcond=None)[0] for band in bands]

    def rotate_harmonics(self, sh: np.ndarray) -> np.ndarray:
        """Rotate spherical-harmonics coefficients (N, (degree + 1)², 3) float32."""
        rotated = sh.copy()
        for degree in range(1, spherical_harmonics.degree_from_count(sh.shape[1]) + 1):
            band = slice(degree**2, (degree + 1) ** 2)
            rotated[:, band] = np.matmul(self._bands[degree - 1], sh[:, band])
        return rotated

    def transform_splats(
        self, splats: Splats, lengths: Collection[str] = (), positions: Sequence[AxisNames] = ()
    ) -> Splats:
        """Transform means, rotations, scales, harmonics and normals into new arrays.

        Args:
            lengths: names of extra columns of lengths.
            positions: names of extra x, y and z columns of positions.
        """
        extras = self.transform_columns(splats.extras, lengths, positions)
        if all(name in extras for name in NORMALS):
            normals = self.transform_axes((extras[name] for name in NORMALS), translate=False)
            extras |= dict(zip(NORMALS, normals, strict=True))
        rotates = not np.array_equal(self.rotation, np.eye(3))
        return replace(
            splats,
            means=np.stack(self.transform_axes(splats.means.T), axis=1),
            quats=self._rotate_quats(splats.quats) if rotates else splats.quats.copy(),
            log_scales=splats.log_scales + np.float32(np.log(self.scale)),
            sh=self.rotate_harmonics(splats.sh) if rotates else splats.sh.copy(),
            extras=extras,
        )

    def _rotate_quats(self, quats: np.ndarray) -> np.ndarray:
        """Rotate quaternions (N, 4) wxyz; their lengths stay the same."""
        w, x, y, z = self.quat.tolist()
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
        return (quats @ left.T).astype(np.float32)


@dataclass(frozen=True)
class TransformedRows:
    """Splats that are transformed batch by batch while they are read.

    Attributes:
        rows: source of the splats.
        transform: transform of a batch.
        columns: extra columns (N,) that replace the transformed ones.
    """

    rows: SplatRows
    transform: Callable[[Splats], Splats]
    columns: Columns

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,)."""
        splats = self.transform(self.rows.select(index))
        splats.extras |= {name: column[index] for name, column in self.columns.items()}
        return splats
