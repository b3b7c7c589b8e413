"""Levels as a camera sees them together, and what each splat gives to a picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...lod.blocks import Blocks
from ...lod.rule import collect_facts
from ...lod.rules.chunks import RULE
from ...rasterize import Gaussians, contributions
from ...rasterize.filter3d import apply_filter3d
from ...scenes.cameras import Camera

Rows = Mapping[int, np.ndarray]
"""Of levels by number, finest first, the rows (M,) int32 that are meant."""


def filtered(gaussians: Gaussians, std: float) -> Gaussians:
    """Splats with LODGE's filter of that standard deviation, in scene units (Eq. 3)."""
    scales, opacities = apply_filter3d(gaussians.log_scales, gaussians.opacity_logits, std)
    return replace(gaussians, log_scales=scales, opacity_logits=opacities)


@dataclass(frozen=True)
class IndexedLevel:
    """A level's splats in blocks: work goes to those alone that a camera may see.

    Attributes:
        gaussians: in spatial order; not differentiated.
        means: theirs, (N, 3) float32.
        blocks: theirs.
    """

    gaussians: Gaussians
    means: np.ndarray
    blocks: Blocks

    @classmethod
    def of(cls, gaussians: Gaussians, blocks: Blocks | None = None) -> IndexedLevel:
        """A level; ``blocks`` where they are known."""
        gaussians = gaussians.detach()
        means = gaussians.means.cpu().numpy()
        return cls(gaussians, means, blocks or Blocks.of(means, gaussians.log_scales.cpu().numpy()))

    def __len__(self) -> int:
        return len(self.gaussians)

    def in_view(self, camera: Camera, near: float) -> np.ndarray:
        """The rows (M,) int32 that may be in a camera's image."""
        return self.blocks.rows(self.blocks.in_view(camera, near))


def rows_seen(
    levels: Mapping[int, IndexedLevel],
    d_l: Mapping[int, float],
    camera: Camera,
    near: float,
    distance_scale: float = 1.0,
) -> Rows:
    """What a camera sees of levels by the rule (Eq. 2), from its own eye.

    Args:
        levels: by number.
        d_l: the distance from which on each of them is shown, in scene units, by number.
        near: depth at which drawing begins.
        distance_scale: the rule's control.
    """
    views = {number: level.blocks.in_view(camera, near) for number, level in levels.items()}
    return rows_at_distances(levels, d_l, camera.center, views, distance_scale)


def rows_at_distances(
    levels: Mapping[int, IndexedLevel],
    d_l: Mapping[int, float],
    eye: np.ndarray,
    blocks: Mapping[int, np.ndarray] | None = None,
    distance_scale: float = 1.0,
) -> Rows:
    """The rows of levels that the rule shows an eye (3,), of all blocks or of those that are True, (B,)."""
    facts = [(number, {"d_l": d_l[number]}) for number in sorted(levels)]
    values = RULE.defaults(sorted(levels)) | {"distance_scale": distance_scale, "chunks": 0}
    eye, found = np.asarray(eye, np.float32), {}
    for number, level in levels.items():
        of_level = collect_facts(RULE, {}, facts, number)
        some = level.blocks.in_band(eye, *RULE.distance_band(1.0, of_level, values))[0]
        rows = level.blocks.rows(some if blocks is None else some & blocks[number])
        found[number] = rows[RULE.weights(level.means[rows], eye, 1.0, {}, of_level, values) > 0]
    return found


def together(levels: Mapping[int, IndexedLevel], rows: Rows) -> Gaussians:
    """These rows of levels as one set, in the order of ``rows``."""
    return Gaussians.concatenated(
        [levels[number].gaussians.select(torch.from_numpy(some).long()) for number, some in rows.items()]
    )


class Stack:
    """All splats of some levels in one set, of which rows are drawn without copies.

    Args:
        antialias: how they are drawn, as of ``rasterize``.

    Attributes:
        gaussians: level after level.
        part: where each level's rows are, by number.
    """

    def __init__(self, levels: Mapping[int, IndexedLevel], antialias: bool = False) -> None:
        self.antialias = antialias
        self.gaussians = Gaussians.concatenated([level.gaussians for level in levels.values()])
        ends = np.cumsum([len(level) for level in levels.values()])
        self.part = {
            number: slice(int(end) - len(level), int(end))
            for (number, level), end in zip(levels.items(), ends, strict=True)
        }

    def rows(self, rows: Rows) -> torch.Tensor:
        """Rows of levels as rows of all, (M,) int32."""
        found = [some + np.int32(self.part[number].start) for number, some in rows.items()]
        return torch.from_numpy(np.concatenate(found)).to(self.gaussians.means.device)

    def importance(self, pictures: Iterable[tuple[Camera, Rows]], near: float, backend: str) -> torch.Tensor:
        """The largest share (N,) of a pixel that each splat has in pictures of rows."""
        largest = torch.zeros(len(self.gaussians))
        for camera, rows in pictures:
            some = self.rows(rows)
            found = contributions(
                self.gaussians, [camera], near=near, antialias=self.antialias, rows=some, backend=backend
            )
            largest = torch.maximum(largest, found.largest.to(largest))
        return largest


def seen_from_afar(
    level: IndexedLevel, cameras: Sequence[Camera], near: float, distance: float, views: int
) -> np.ndarray:
    """(N,) bool, which splats so many cameras have in their images from that distance or farther."""
    counts = np.zeros(len(level), np.int32)
    for camera in cameras:
        _, most = level.blocks.distances(camera.center)
        rows = level.blocks.rows(level.blocks.in_view(camera, near) & (most >= distance))
        means = level.means[rows]
        far = np.linalg.norm(means - camera.center, axis=1) >= distance
        counts[rows[far & camera.sees(means, near)]] += 1
    return counts >= views
