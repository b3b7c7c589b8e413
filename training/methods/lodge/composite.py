"""Render several levels together, and measure each splat's contribution to images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...lod.blocks import BlockIndex
from ...lod.rule import collect_facts
from ...lod.rules.chunks import RULE
from ...rasterize import Gaussians, contributions
from ...rasterize.filter3d import apply_filter3d
from ...scenes.cameras import Camera

Rows = Mapping[int, np.ndarray]
"""Selected rows (M,) int32 of levels by number, finest first."""


def smooth(gaussians: Gaussians, std: float) -> Gaussians:
    """Apply LODGE's filter of a standard deviation in scene units (Eq. 3)."""
    scales, opacities = apply_filter3d(gaussians.log_scales, gaussians.opacity_logits, std)
    return replace(gaussians, log_scales=scales, opacity_logits=opacities)


@dataclass(frozen=True)
class IndexedLevel:
    """Splats of a level in blocks, which limits work to the blocks in view.

    Attributes:
        gaussians: splats in spatial order, detached from gradients.
        means: their positions, (N, 3) float32.
        blocks: their blocks.
    """

    gaussians: Gaussians
    means: np.ndarray
    blocks: BlockIndex

    @classmethod
    def of(cls, gaussians: Gaussians, blocks: BlockIndex | None = None) -> IndexedLevel:
        """Create a level, computing ``blocks`` if they are not given."""
        gaussians = gaussians.detach()
        means = gaussians.means.cpu().numpy()
        return cls(gaussians, means, blocks or BlockIndex.of(means, gaussians.log_scales.cpu().numpy()))

    def __len__(self) -> int:
        return len(self.gaussians)

    def in_view(self, camera: Camera, near: float) -> np.ndarray:
        """Return the rows (M,) int32 that may be in a camera's image."""
        return self.blocks.rows(self.blocks.in_view(camera, near))


def visible_rows(
    levels: Mapping[int, IndexedLevel],
    d_l: Mapping[int, float],
    camera: Camera,
    near: float,
    distance_scale: float = 1.0,
) -> Rows:
    """Return the rows of each level that the rule draws for a camera (Eq. 2), by distance from the camera.

    Args:
        levels: levels by number.
        d_l: distance from which each level is drawn, in scene units, by number.
        near: near clipping depth.
        distance_scale: control of the rule.
    """
    views = {number: level.blocks.in_view(camera, near) for number, level in levels.items()}
    return rows_at_distances(levels, d_l, camera.center, views, distance_scale)


def rows_at_distances(
    levels: Mapping[int, IndexedLevel],
    d_l: Mapping[int, float],
    position: np.ndarray,
    blocks: Mapping[int, np.ndarray] | None = None,
    distance_scale: float = 1.0,
) -> Rows:
    """Return the rows that the rule draws for a camera position (3,), in all blocks or in those marked True,
    (B,).
    """
    facts = [(number, {"d_l": d_l[number]}) for number in sorted(levels)]
    values = RULE.defaults(sorted(levels)) | {"distance_scale": distance_scale, "chunks": 0}
    position, selected = np.asarray(position, np.float32), {}
    for number, level in levels.items():
        of_level = collect_facts(RULE, {}, facts, number)
        level_rows = level.blocks.in_band(position, *RULE.distance_band(1.0, of_level, values))[0]
        rows = level.blocks.rows(level_rows if blocks is None else level_rows & blocks[number])
        selected[number] = rows[RULE.weights(level.means[rows], position, 1.0, {}, of_level, values) > 0]
    return selected


def gather_rows(levels: Mapping[int, IndexedLevel], rows: Rows) -> Gaussians:
    """Concatenate these rows of levels, in the order of ``rows``."""
    return Gaussians.concatenated(
        [
            levels[number].gaussians.select(torch.from_numpy(level_rows).long())
            for number, level_rows in rows.items()
        ]
    )


class LevelStack:
    """All splats of several levels in one set, whose rows can be rendered without copies.

    Args:
        antialias: see ``rasterize``.

    Attributes:
        gaussians: splats, level after level.
        slices: slice of each level by number.
    """

    def __init__(self, levels: Mapping[int, IndexedLevel], antialias: bool = False) -> None:
        self.antialias = antialias
        self.gaussians = Gaussians.concatenated([level.gaussians for level in levels.values()])
        ends = np.cumsum([len(level) for level in levels.values()])
        self.slices = {
            number: slice(int(end) - len(level), int(end))
            for (number, level), end in zip(levels.items(), ends, strict=True)
        }

    def rows(self, rows: Rows) -> torch.Tensor:
        """Convert rows of levels to rows of the set, (M,) int32."""
        selected = [level_rows + np.int32(self.slices[number].start) for number, level_rows in rows.items()]
        return torch.from_numpy(np.concatenate(selected)).to(self.gaussians.means.device)

    def importance(self, views: Iterable[tuple[Camera, Rows]], near: float, backend: str) -> torch.Tensor:
        """Return each splat's maximum share (N,) of a pixel in images of the given rows."""
        largest = torch.zeros(len(self.gaussians))
        for camera, rows in views:
            measured = contributions(
                self.gaussians,
                [camera],
                near=near,
                antialias=self.antialias,
                rows=self.rows(rows),
                backend=backend,
            )
            largest = torch.maximum(largest, measured.largest.to(largest))
        return largest


def seen_from_distance(
    level: IndexedLevel, cameras: Sequence[Camera], near: float, distance: float, views: int
) -> np.ndarray:
    """Return which splats are in the images of at least ``views`` cameras at this distance or farther, (N,)
    bool.
    """
    counts = np.zeros(len(level), np.int32)
    for camera in cameras:
        _, max_distances = level.blocks.distances(camera.center)
        rows = level.blocks.rows(level.blocks.in_view(camera, near) & (max_distances >= distance))
        means = level.means[rows]
        far = np.linalg.norm(means - camera.center, axis=1) >= distance
        counts[rows[far & camera.sees(means, near)]] += 1
    return counts >= views
