"""Which splats a viewport draws, and in which order: numpy only, for a thread beside Blender's own.

Drawing needs two things: the splats themselves, which stay on the graphics card until they change (the pool),
and a list of which of them are drawn, from back to front, each with its weight (the arrangement). Only the
list depends on where the eye is and in which direction the view looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..selection import BandRule, Rule

WIDTH = 8192
"""Texels in a row of every texture that holds one texel for each of many splats."""


@dataclass(frozen=True)
class Pool:
    """N splats of any number of objects, one after the other.

    Attributes:
        means: (N, 4) float32 in their objects' space, the fourth number is 1.
        scales: (N, 4) float32 standard deviations; the fourth number is unused.
        opacities: (N,) float32 in [0, 1].
        bias: (N,) float32 in levels (Octree-GS).
    """

    means: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    bias: np.ndarray


@dataclass(frozen=True)
class Placement:
    """A visible splat set: splats ``first`` to ``first + count`` of the pool, somewhere in the world.

    Attributes:
        matrix: the set's ``matrix_world``, (4, 4) float64 as bytes, so that placements compare.
        level: 1 is the coarsest; 0 for splats that are no level.
        rule: what weights its splats; None: all 1.
        scene: of which splat scene it is a level, a number; sets of different scenes never make room.
        replaces: whether a level stands in the coarser one's place, rather than adding to it.
        tell: what its colours tell, see ``SplatScene.tell``.
    """

    first: int
    count: int
    matrix: bytes
    level: int
    rule: Rule | None
    scene: int
    replaces: bool
    tell: str

    @property
    def world(self) -> np.ndarray:
        """``matrix_world``, (4, 4) float64."""
        return np.frombuffer(self.matrix).reshape(4, 4)


@dataclass(frozen=True)
class Request:
    """All that an arrangement depends on besides the pool; requests compare.

    Attributes:
        placements: coarse levels first.
        backward: the direction against which the view looks, in the world.
        budget: most splats to draw.
    """

    placements: tuple[Placement, ...]
    backward: tuple[float, float, float]
    budget: int


@dataclass(frozen=True)
class Arrangement:
    """What is drawn.

    Attributes:
        request: what it answers.
        instances: (rows * WIDTH, 4) float32; the first ``count`` are, from back to front: a splat's place in
            the pool, its weight, its placement's number, and the level or band whose colour it gets (0: its
            own).
        count: how many are drawn.
        left_out: how many were left out, to stay within the budget.
    """

    request: Request
    instances: np.ndarray
    count: int
    left_out: int


def arrange(pool: Pool, request: Request) -> Arrangement:
    """The splats to draw for a request, from back to front."""
    chosen, left_out = within_budget(pool, request.placements, request.budget)
    depths, told = [], []
    backward = np.append(request.backward, 0.0)
    for placement, (index, _) in zip(request.placements, chosen, strict=True):
        means = pool.means[placement.first : placement.first + placement.count]
        depth = means @ (backward @ placement.world).astype(np.float32)  # grows towards the eye
        depths.append(depth if len(index) == len(depth) else depth[index])
        told.append(_told(placement, means, index))
    depth = np.concatenate(depths) if depths else np.zeros(0, np.float32)
    order = np.argsort(depth)

    count = len(order)
    instances = np.zeros((max(1, -(-count // WIDTH)) * WIDTH, 4), np.float32)
    if count:
        columns = (
            [
                index + placement.first
                for placement, (index, _) in zip(request.placements, chosen, strict=True)
            ],
            [weight for _, weight in chosen],
            [np.full(len(index), number) for number, (index, _) in enumerate(chosen)],
            told,
        )
        for column, values in enumerate(columns):
            instances[:count, column] = np.concatenate(values)[order]
    return Arrangement(request, instances, count, left_out)


def within_budget(
    pool: Pool, placements: Sequence[Placement], budget: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
    """Each placement's splats that are drawn, as their places in it and their weights; and how many are not.

    Where there are more than the budget, the finest levels go first. A level that replaces coarser ones goes
    as a whole, and the next coarser one takes its place; of levels that add up, and of what is the last of
    its scene, the most visible splats stay.
    """
    chosen = [_choose(pool, placement) for placement in placements]
    wanted = sum(len(index) for index, _ in chosen)
    placements = list(placements)

    def excess() -> int:
        return sum(len(index) for index, _ in chosen) - budget

    while excess() > 0:
        some = [i for i, (index, _) in enumerate(chosen) if len(index)]
        scenes: dict[int, int] = {}
        for i in some:
            scenes[placements[i].scene] = scenes.get(placements[i].scene, 0) + 1
        several = [i for i in some if scenes[placements[i].scene] > 1]
        if not several:
            _thin(pool, placements, chosen, some, budget)
            break
        finest = max(several, key=lambda i: placements[i].level)
        if not placements[finest].replaces and len(chosen[finest][0]) > excess():
            _thin(pool, placements, chosen, [finest], len(chosen[finest][0]) - excess())
            break
        chosen[finest] = (chosen[finest][0][:0], chosen[finest][1][:0])
        rule = placements[finest].rule
        if placements[finest].replaces and isinstance(rule, BandRule):
            coarser = max(
                (i for i in several if placements[i].scene == placements[finest].scene and i != finest),
                key=lambda i: placements[i].level,
            )
            behind = placements[coarser].rule
            if isinstance(behind, BandRule):
                placements[coarser] = replace(placements[coarser], rule=replace(behind, near=rule.near))
                chosen[coarser] = _choose(pool, placements[coarser])
    return chosen, max(0, wanted - sum(len(index) for index, _ in chosen))


def _choose(pool: Pool, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """The splats of a placement whose weight is not 0, and their weights."""
    part = slice(placement.first, placement.first + placement.count)
    if placement.rule is None:
        return np.arange(placement.count, dtype=np.int32), np.ones(placement.count, np.float32)
    weights = placement.rule.weights(pool.means[part, :3], pool.bias[part])
    index = np.flatnonzero(weights)
    return index, weights[index].astype(np.float32)


def _thin(pool: Pool, placements, chosen, which: list[int], keep: int) -> None:
    """Leaves the ``keep`` most visible splats of those placements: opacity times area."""
    visible = []
    for i in which:
        index, weight = chosen[i]
        place = index + placements[i].first
        scales = pool.scales[place, :3]
        visible.append(pool.opacities[place] * weight * np.einsum("ij,ij->i", scales, scales))
    everything = np.concatenate(visible)
    stays = np.zeros(len(everything), bool)
    stays[np.argpartition(everything, len(everything) - keep)[len(everything) - keep :]] = True
    start = 0
    for i, part in zip(which, visible, strict=True):
        mine = stays[start : start + len(part)]
        chosen[i] = (chosen[i][0][mine], chosen[i][1][mine])
        start += len(part)


def _told(placement: Placement, means: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Which level's colour each splat gets."""
    if placement.tell == "BANDS" and placement.rule is not None:
        return placement.rule.bands(means[index, :3], placement.level).astype(np.float32)
    return np.full(len(index), placement.level if placement.tell != "OWN" else 0, np.float32)
