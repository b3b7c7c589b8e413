"""Levels in the form that formats of other programs share: complete levels, selected by distance."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..documents import parse_json
from ..errors import LodgsError
from .batches import batch_slices
from .bundle_header import (
    INCONSISTENCIES,
    bundle_line,
    inconsistency_error,
    json_default,
    level_line,
    parse_bundle,
)
from .dialects import MAX_COORDINATE
from .gaussians import SplatRows, Splats
from .levels import Bundle, Level
from .origin import FAR_SPLATS, NO_ORIGIN, ORIGIN_SAMPLE, choose_origin
from .similarity import Similarity

DISTANCE_RULE, DISTANCE = "chunks", "d_l"
"""Rule of levels that other programs select by distance, and the fact with a level's distance."""
DEFAULT_FOCAL = 1000.0
"""Focal length in pixels for which distances are computed if the scene has no views."""
_Part = TypeVar("_Part")
_NEAR_SHARE = 0.9
"""Fraction of the finest splats inside the radius of a scene; the others are sky and floaters."""


@dataclass(frozen=True)
class ConcatenatedRows:
    """Several sets of splats, in memory or on disk, as one."""

    sets: Sequence[SplatRows]

    @classmethod
    def of_level(cls, bundle: Bundle, number: int) -> ConcatenatedRows:
        """Return all splats that are drawn at a level."""
        return cls([level.rows for level in bundle.drawn_levels(number)])

    def __len__(self) -> int:
        return sum(map(len, self.sets))

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Read a range of all rows, or ascending rows (M,)."""
        if not isinstance(index, slice):
            ends = np.cumsum([len(rows) for rows in self.sets])
            pieces = np.split(index, np.searchsorted(index, ends[:-1]))
            begins = ends - [len(rows) for rows in self.sets]
            return Splats.concatenated(
                [
                    rows.select(piece - begin)
                    for rows, piece, begin in zip(self.sets, pieces, begins, strict=True)
                ]
            )
        begin, end, _ = index.indices(len(self))
        parts, first = [], 0
        for rows in self.sets:
            parts.append(rows.select(slice(max(begin - first, 0), max(min(end - first, len(rows)), 0))))
            first += len(rows)
        return Splats.concatenated(parts)


@dataclass(frozen=True)
class PortableView:
    """A camera for other programs.

    Attributes:
        camera_to_world: (4, 4) float64, OpenCV axes.
        near: depth of the near plane.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: np.ndarray
    near: float


@dataclass(frozen=True)
class PortableLevels:
    """Levels for other programs.

    Attributes:
        bundle: levels that are complete scenes and not cumulative.
        distances: camera distances from which on each level replaces the finer ones, coarse to fine, the last
            of them 0; empty without selection by distance.
        focal: focal length in pixels that the distances are for.
        fade: ratio of the end to the begin of the distances over which two levels fade into each other.
        views: cameras of the scene.
        origin: (3,) float64, added to positions by the transform of the scene.
    """

    bundle: Bundle
    distances: tuple[float, ...] = ()
    focal: float = DEFAULT_FOCAL
    fade: float = 1.0
    views: Sequence[PortableView] = ()
    origin: np.ndarray = field(default_factory=lambda: NO_ORIGIN)

    @property
    def fine_to_coarse(self) -> list[Level]:
        """Levels in the order of most formats."""
        return self.bundle.levels[::-1]

    @property
    def placement(self) -> np.ndarray:
        """Transform (4, 4) float64 of the splats to a scene with z up at its place."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.bundle.up_rotation
        matrix[:3, 3] = self.bundle.up_rotation @ self.origin
        return matrix

    def sphere(self) -> tuple[np.ndarray, float]:
        """Return centre (3,) and radius of most of the finest level's splats, in its coordinates."""
        rows = self.bundle.levels[-1].rows
        if not len(rows):
            return np.zeros(3), 1.0
        means = rows.select(np.arange(0, len(rows), max(1, len(rows) // ORIGIN_SAMPLE))).means
        center = np.median(means.astype(np.float64), axis=0)
        return center, float(np.quantile(np.linalg.norm(means - center, axis=1), _NEAR_SHARE))

    def describe(self) -> str:
        """Return everything except splats, tables and views as JSON, for :func:`parse_description`."""
        levels = [level_line(lod, level) for lod, level in enumerate(self.fine_to_coarse)]
        description = {"bundle": bundle_line(self.bundle), "levels": levels, "meta": self.bundle.meta}
        return json.dumps(
            {**description, "placement": self.placement.ravel()}, default=json_default, allow_nan=False
        )


def parse_description(text: object, path: Path) -> tuple[Bundle, np.ndarray]:
    """Return the bundle of :meth:`PortableLevels.describe`, without splats, and its placement (4, 4).

    A place on Earth that does not fit into the header of a bundle is left out.

    Raises:
        LodgsError: the text is invalid.
    """
    try:
        if not isinstance(text, str):
            raise TypeError("it is not a text")
        values = parse_json(text, f"The description in {path}")
        placement = np.array(values["placement"], np.float64).reshape(4, 4)
        bundle = parse_bundle(values["bundle"], values["levels"], values["meta"], path)
    except INCONSISTENCIES as error:
        raise inconsistency_error(path, error) from error
    if bundle.georeference is not None and not bundle.georeference.is_storable:
        del bundle.meta["georeference"]
    return bundle, placement


def join_levels(groups: Sequence[Sequence[_Part]], outside: Sequence[_Part]) -> list[list[_Part]]:
    """Return the parts of each level of a scene whose objects have levels of their own, fine to coarse.

    Args:
        groups: levels of each object, fine to coarse. Objects with fewer levels than others keep their
            coarsest one.
        outside: parts of all levels.
    """
    count = max(map(len, groups), default=1)
    return [[*outside, *(group[min(i, len(group) - 1)] for group in groups)] for i in range(count)]


def portable_batches(rows: SplatRows) -> Iterator[tuple[int, Splats]]:
    """Yield the first row and the splats of each batch, with unit quaternions and without extra columns."""
    for batch in batch_slices(len(rows)):
        splats = rows.select(batch)
        lengths = np.linalg.norm(splats.quats, axis=1, keepdims=True)
        identity = np.array([1, 0, 0, 0], np.float32)
        quats = np.where(lengths > 0, splats.quats / np.where(lengths > 0, lengths, 1), identity)
        yield batch.start, Splats(splats.means, quats, splats.log_scales, splats.opacity_logits, splats.sh)


def splats_from_activated(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, alphas: np.ndarray, sh: np.ndarray
) -> Splats:
    """Return splats from scales and opacities as they are drawn.

    Opacities of 0 and 1 become nearby ones with finite logits. Invalid values remain invalid.

    Args:
        means, scales: (N, 3) each.
        quats: (N, 4), wxyz.
        alphas: opacities (N,) in [0, 1].
        sh: (N, K, 3) float32.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        alphas = alphas.astype(np.float64).clip(1e-7, 1 - 1e-7)
        logits = np.log(alphas / (1 - alphas)).astype(np.float32)
        log_scales = np.log(scales.astype(np.float32))
    return Splats(means.astype(np.float32), quats.astype(np.float32), log_scales, logits, sh)


def place_splats(splats: Splats, matrix: np.ndarray, path: Path) -> tuple[Splats, np.ndarray]:
    """Return splats that are transformed except for the translation, and the translation (3,) float64.

    Raises:
        LodgsError: the transform stretches, shears or mirrors, or has too large numbers.
    """
    if not (np.abs(matrix) <= MAX_COORDINATE).all():
        raise LodgsError(
            f"Cannot read {path}: a transform has numbers above {MAX_COORDINATE:g}.",
            "Move the splats closer to 0, and export them again.",
        )
    try:
        transform = Similarity.from_matrix(matrix)
    except LodgsError as error:
        raise LodgsError(f"Cannot read {path}: {error.what}", error.remedy) from error
    shift = transform.translation
    if np.array_equal(matrix[:3, :3], np.eye(3)):
        return splats, shift
    return replace(transform, translation=np.zeros(3)).transform_splats(splats), shift


def upright_meta(placed: Sequence[tuple[Splats, np.ndarray]], up: str) -> tuple[dict, list[Splats]]:
    """Return meta for placed splats with an axis up, "Y" or "Z", and them relative to a local origin."""
    rotation = np.eye(3) if up == "Z" else np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    meta: dict = {"up_rotation": rotation.tolist()}
    sample = [s.means[:: max(1, len(s) // ORIGIN_SAMPLE)].astype(np.float64) + t for s, t in placed]
    origin = choose_origin(np.concatenate(sample), far=FAR_SPLATS)
    if origin.any():
        meta["origin"] = origin.tolist()
    return meta, [
        replace(s, means=(s.means.astype(np.float64) + (t - origin)).astype(np.float32)) for s, t in placed
    ]
