"""Which splats a viewport draws, and in which order: numpy only, for a thread beside Blender's own.

Drawing needs two things: the splats themselves, which stay on the graphics card as long as they are drawn
(``resident``), and a list of which are drawn, from back to front, each with its weight (the arrangement). It
is made from what the pool says of all splats.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from ...training.editing.look import Looks
from ...training.lod.query import LodQuery, SplatSelector
from ...training.lod.rule import OPACITY

SAMPLE, LEAST_SAMPLE = 16, 10_000
"""Of so many splats one is asked where a budget looks for a choice, and how many are asked at least."""
ROUGHLY = 1.05
"""Share of the budget at which asking a few ends, and all are asked: a sample may be wrong by that."""

WIDTH = 8192
"""Texels in a row of every texture that holds one texel for each of many splats."""


_serials = itertools.count()


class Paged(Protocol):
    """Splats that change by and by: see ``streaming.Stream``."""

    taken: int
    records: np.ndarray
    columns: dict[str, np.ndarray]

    def take(self) -> np.ndarray: ...


@dataclass
class Pool:
    """N splats of any number of objects, one after the other.

    Attributes:
        means: (N, 3) float32 in their objects' space.
        areas: (N,) float32, the sum of their squared standard deviations.
        opacities: (N,) float32 in [0, 1].
        columns: (N,) float32 by name: what rules need to know of splats; zeros where an object lacks one.
        paged: from where on splats are others by and by, and which.
        serial: another one after :meth:`take_over` has changed some, and in every pool.
        changed: (M,) int32 each, at which places others are since then: for who keeps what they are.
    """

    means: np.ndarray
    areas: np.ndarray
    opacities: np.ndarray
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    paged: Sequence[tuple[int, Paged]] = ()
    serial: int = field(default_factory=lambda: next(_serials))
    changed: list[np.ndarray] = field(default_factory=list)
    _seen: dict[int, int] = field(default_factory=dict)
    _choosers: dict[tuple[int, int], SplatSelector] = field(default_factory=dict, compare=False)
    _drawn: list[Drawn] = field(default_factory=list, compare=False)

    def chooser(self, placement: Placement) -> SplatSelector:
        """What chooses from a placement's splats."""
        key = placement.first, placement.count
        if key not in self._choosers:
            part = slice(placement.first, placement.first + placement.count)
            columns = {name: column[part] for name, column in self.columns.items()}
            columns[OPACITY] = self.opacities[part]
            self._choosers[key] = SplatSelector(self.means[part], columns)
        return self._choosers[key]

    def about(self, placement: Placement) -> int:
        """About how many splats of a placement have a weight: of many splats a few are asked."""
        few = placement.count // SAMPLE
        if placement.choice is None or not placement.choice.resolved_rule.independent or few < LEAST_SAMPLE:
            return len(_choose(self, placement)[0])
        key = placement.first, -few
        if key not in self._choosers:
            rows = placement.first + np.random.default_rng(0).integers(0, placement.count, few)
            columns = {name: column[rows] for name, column in self.columns.items()}
            columns[OPACITY] = self.opacities[rows]
            self._choosers[key] = SplatSelector(self.means[rows, :3], columns)
        return len(self._choosers[key].select(placement.choice)[0]) * SAMPLE

    def drawn(self, request: Request) -> Drawn:
        """What a request draws, in no order; the last one is kept."""
        if not self._drawn or self._drawn[0].choices != request.choices:
            self._drawn[:] = [_drawn(self, request)]
        return self._drawn[0]

    def take_over(self) -> None:
        """Takes over what has come of paged splats, which nobody must be reading."""
        for first, paged in self.paged:
            before, some = paged.taken, paged.take()
            if self._seen.get(first) != before:  # another pool took something, or this is a new one
                some = np.arange(len(paged.records), dtype=np.int32)
            if self._seen.get(first) == paged.taken:
                continue
            self._seen[first] = paged.taken
            records, here = paged.records[some], some + np.int32(first)
            self.means[here], self.opacities[here] = records[:, 0:3], records[:, 3]
            self.areas[here] = np.einsum("ij,ij->i", records[:, 8:11], records[:, 8:11])
            for name, column in paged.columns.items():  # sizes of all: who stands for others changes
                self.columns[name][first : first + len(column)] = column
            self._choosers = {key: each for key, each in self._choosers.items() if key[0] != first}
            self._drawn.clear()
            self.changed.append(here)
            self.serial = next(_serials)


@dataclass(frozen=True)
class Drawn:
    """The M splats that are drawn.

    Attributes:
        choices: see there.
        table: (M, 4) float32, the rows of :attr:`Arrangement.instances`.
        means: of each placement's splats among them, in its own space.
        left_out: how many were left out, to stay within the budget.
    """

    choices: tuple
    table: np.ndarray
    means: list[np.ndarray]
    left_out: int


@dataclass(frozen=True)
class Placement:
    """A visible splat set: splats ``first`` to ``first + count`` of the pool, somewhere in the world.

    Attributes:
        matrix: the set's ``matrix_world``, (4, 4) float64 as bytes, so that placements compare.
        level: 1 is the coarsest; 0 for splats that are no level.
        choice: what weights its splats; None: all 1.
        scene: of which splat scene it is a level, a number.
        tell: what its colours tell, see ``SplatScene.tell``.
        antialias: see ``SplatScene.antialias``.
        arrived: of paged splats, how much has come.
        looks: what is made of their colours and opacities where they are drawn: no other splats, nor another
            order.
    """

    first: int
    count: int
    matrix: bytes
    level: int
    choice: LodQuery | None
    scene: int
    tell: str
    antialias: bool = False
    arrived: int = 0
    looks: Looks = field(default=(), compare=False)

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

    @property
    def choices(self) -> tuple:
        """All that says which splats are drawn, in whatever order."""
        return self.budget, *(replace(placement, matrix=b"") for placement in self.placements)


@dataclass(frozen=True)
class Arrangement:
    """What is drawn.

    Attributes:
        request: what it answers.
        instances: (M, 4) float32, from back to front: a splat's place in the pool, its weight, its
            placement's number, and the level or band whose colour it gets (0: its own).
        splats: (M,) int32, the same places in the pool.
        left_out: how many were left out, to stay within the budget.
        serial: the pool's: in a later one some places are other splats'.
    """

    request: Request
    instances: np.ndarray
    splats: np.ndarray
    left_out: int
    serial: int

    @property
    def count(self) -> int:
        """How many are drawn."""
        return len(self.splats)


def arrange(pool: Pool, request: Request, take_over: bool = False) -> Arrangement:
    """The splats to draw for a request, from back to front.

    What is drawn is found anew where the choices or the budget have changed; while only the view turns, or
    objects move, it is put in another order alone.

    Args:
        take_over: first what has come of paged splats, see ``Pool.take_over``.
    """
    if take_over:
        pool.take_over()
    drawn, count = pool.drawn(request), 0
    depths = np.empty(len(drawn.table), np.float32)
    backward = np.append(request.backward, 0.0)
    for placement, means in zip(request.placements, drawn.means, strict=True):
        toward = (backward @ placement.world).astype(np.float32)  # grows towards the eye
        np.add(means @ toward[:3], toward[3], out=depths[count : count + len(means)])
        count += len(means)
    instances = drawn.table[ascending(depths)]
    places = instances[:, 0].astype(np.int32)
    return Arrangement(request, instances, places, drawn.left_out, pool.serial)


def ascending(values: np.ndarray) -> np.ndarray:
    """The order (N,) of float32 numbers (N,), equal ones as they come: ``argsort``, twice as fast.

    Their bits in the order of whole numbers, sixteen at a time, which numpy counts instead of compares.
    """
    bits = (values + np.float32(0)).view(np.int32)  # no zero below zero
    bits = np.where(bits < 0, ~bits, bits | np.int32(-(1 << 31))).view(np.uint32)
    order = np.argsort(bits.astype(np.uint16), kind="stable")
    return order[np.argsort((bits >> np.uint32(16)).astype(np.uint16)[order], kind="stable")]


def _drawn(pool: Pool, request: Request) -> Drawn:
    chosen, left_out = within_budget(pool, request.placements, request.budget)
    table = np.empty((sum(len(index) for index, _ in chosen), 4), np.float32)
    means, begin = [], 0
    for number, (placement, (index, weight)) in enumerate(zip(request.placements, chosen, strict=True)):
        own = pool.means[placement.first : placement.first + placement.count][index]
        rows = table[begin : begin + len(index)]
        rows[:, 0], rows[:, 1], rows[:, 2] = index + placement.first, weight, number
        rows[:, 3] = _color_levels(pool, placement, index, own)
        means.append(own)
        begin += len(index)
    return Drawn(request.choices, table, means, left_out)


def within_budget(
    pool: Pool, placements: Sequence[Placement], budget: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
    """Each placement's splats that are drawn, as their places in it and their weights; and how many are not.

    Where there are more than the budget, the scene that draws the most takes the next coarser choice of its
    rule, again and again. Where no rule can give way any more, the least visible splats go: of levels that
    add up first those of the finest.
    """

    def count(placement: Placement) -> int:
        return len(_choose(pool, placement)[0])

    placements = list(placements)
    wanted = sum(map(count, placements))
    if wanted > budget:
        _give_way(placements, pool.about, ROUGHLY * budget)
        _give_way(placements, count, budget)
    chosen = [_choose(pool, placement) for placement in placements]
    total = sum(len(index) for index, _ in chosen)
    while total > budget:
        of_scene = Counter(p.scene for p, (index, _) in zip(placements, chosen, strict=True) if len(index))
        adding = [
            i for i, placement in enumerate(placements)
            if len(chosen[i][0]) and of_scene[placement.scene] > 1
        ]  # fmt: skip
        which = [max(adding, key=lambda i: placements[i].level)] if adding else range(len(placements))
        here = sum(len(chosen[i][0]) for i in which)
        _thin(pool, placements, chosen, which, max(here - (total - budget), 0))
        total = sum(len(index) for index, _ in chosen)
    return chosen, wanted - sum(len(index) for index, _ in chosen)


def _give_way(placements: list[Placement], count: Callable[[Placement], int], budget: float) -> None:
    """Has scenes take coarser choices, in place, until no more than the budget are counted, if they can."""
    counts = [count(placement) for placement in placements]
    givers = {placement.scene for placement in placements if placement.choice is not None}
    while sum(counts) > budget and givers:
        drawn = dict.fromkeys(givers, 0)
        for placement, here in zip(placements, counts, strict=True):
            if placement.scene in drawn:
                drawn[placement.scene] += here
        scene = max(drawn, key=lambda each: drawn[each])
        levels = sorted({placement.level for placement in placements if placement.scene == scene})
        for i, placement in enumerate(placements):
            if placement.scene == scene and placement.choice is not None:
                coarser = placement.choice.coarser(levels)
                if coarser is None:
                    givers.discard(scene)
                    break
                placements[i] = replace(placement, choice=coarser)
                counts[i] = count(placements[i])


def _choose(pool: Pool, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """The splats of a placement that have a weight, and their weights."""
    if placement.choice is None:
        return np.arange(placement.count, dtype=np.int32), np.ones(placement.count, np.float32)
    return pool.chooser(placement).select(placement.choice)


def _thin(pool: Pool, placements, chosen, which: Sequence[int], keep: int) -> None:
    """Leaves the ``keep`` most visible splats of those placements: opacity times area."""
    visible = []
    for i in which:
        index, weight = chosen[i]
        place = index + placements[i].first
        visible.append(pool.opacities[place] * weight * pool.areas[place])
    everything = np.concatenate(visible)
    stays = np.zeros(len(everything), bool)
    if keep:
        stays[np.argpartition(everything, len(everything) - keep)[len(everything) - keep :]] = True
    start = 0
    for i, part in zip(which, visible, strict=True):
        mine = stays[start : start + len(part)]
        chosen[i] = (chosen[i][0][mine], chosen[i][1][mine])
        start += len(part)


def _color_levels(
    pool: Pool, placement: Placement, index: np.ndarray, means: np.ndarray
) -> np.ndarray | float:
    """Which level's colour a placement's splats (M,) at means (M, 3) get."""
    choice = placement.choice
    if choice is not None and choice.rule:
        if placement.tell == "LEVELS":
            own, place = choice.resolved_rule.columns, index + placement.first
            return choice.splat_level({n: pool.columns[n][place] for n in own if n in pool.columns})
        if placement.tell == "BANDS":
            return choice.target_level(means)
        if placement.tell == "CHUNKS":
            return choice.part_numbers(means)
    return placement.level if placement.tell in ("LEVELS", "BANDS") else 0
