"""Selection and depth order of the splats that a viewport draws.

This module uses numpy only and runs in a worker thread. Drawing needs the splats, which stay on the graphics
card while they are drawn (``resident``), and a list of the drawn ones from back to front with their weights:
the arrangement. It is computed from the pool of all splats.
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
from . import motion
from .records import MEANS, OPACITIES, SCALES

SAMPLE_STEP = 16
"""One splat of this many is sampled to estimate a selection's size."""
MIN_SAMPLE = 10_000
"""Smallest sample; smaller sets are counted exactly."""
ESTIMATE_LIMIT = 1.05
"""Fraction of the budget at which estimates end and exact counts start: a sample may be off by 5 %."""
FINER_LIMIT = 0.9
"""Maximum fraction of the budget that a finer query may need to return. A slight motion changes no detail."""

WIDTH = 8192
"""Width in texels of the textures with one texel per item."""


_serials = itertools.count()


class PagedSplats(Protocol):
    """Splats that are read from disk page by page, see ``streaming.Stream``."""

    copied_updates: int
    records: np.ndarray
    columns: dict[str, np.ndarray]

    def take(self) -> np.ndarray: ...


@dataclass
class Pool:
    """N splats of any number of objects, concatenated.

    Attributes:
        means: (N, 3) float32 in the space of their objects.
        areas: (N,) float32, sums of squared standard deviations.
        opacities: (N,) float32 in [0, 1].
        columns: (N,) float32 by name, rule columns; zeros for objects without one.
        paged: first splat and source of each set that is read from disk.
        serial: version of the contents; unique across pools, changed by :meth:`apply_updates`.
        changed: splats (M,) int32 replaced since the owner of the store cleared this list.
    """

    means: np.ndarray
    areas: np.ndarray
    opacities: np.ndarray
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    paged: Sequence[tuple[int, PagedSplats]] = ()
    serial: int = field(default_factory=lambda: next(_serials))
    changed: list[np.ndarray] = field(default_factory=list)
    _applied: dict[int, int] = field(default_factory=dict)
    _selectors: dict[tuple[int, int], SplatSelector] = field(default_factory=dict, compare=False)
    _drawn: list[DrawnSplats] = field(default_factory=list, compare=False)

    def selector(self, placement: Placement) -> SplatSelector:
        """Return the cached selector of a placement's splats."""
        key = placement.first, placement.count
        if key not in self._selectors:
            rows = slice(placement.first, placement.first + placement.count)
            self._selectors[key] = self._new_selector(rows)
        return self._selectors[key]

    def _new_selector(self, rows: slice | np.ndarray) -> SplatSelector:
        columns = {name: column[rows] for name, column in self.columns.items()}
        return SplatSelector(self.means[rows], columns | {OPACITY: self.opacities[rows]})

    def estimate_count(self, placement: Placement) -> int:
        """Estimate the number of selected splats of a placement; large sets are sampled."""
        size = placement.count // SAMPLE_STEP
        if placement.query is None or not placement.query.resolved_rule.independent or size < MIN_SAMPLE:
            return len(_select(self, placement)[0])
        key = placement.first, -size
        if key not in self._selectors:
            rows = placement.first + np.random.default_rng(0).integers(0, placement.count, size)
            self._selectors[key] = self._new_selector(rows)
        return len(self._selectors[key].select(placement.query)[0]) * SAMPLE_STEP

    def drawn_splats(self, request: Request) -> DrawnSplats:
        """Return the splats that a request draws, unsorted; the last result is cached."""
        if not self._drawn or self._drawn[0].selection_key != request.selection_key:
            self._drawn[:] = [_select_drawn(self, request)]
        return self._drawn[0]

    def apply_updates(self) -> None:
        """Copy newly read pages of paged splats. Nobody may read the pool meanwhile."""
        for first, paged in self.paged:
            previous = paged.copied_updates
            rows = paged.take()
            if self._applied.get(first) != previous:  # another pool took pages, or this pool is new
                rows = np.arange(len(paged.records), dtype=np.int32)
            if self._applied.get(first) == paged.copied_updates:
                continue
            self._applied[first] = paged.copied_updates
            records = paged.records[rows]
            targets = rows + np.int32(first)
            self.means[targets] = records[:, MEANS]
            self.opacities[targets] = records[:, OPACITIES]
            self.areas[targets] = np.einsum("ij,ij->i", records[:, SCALES], records[:, SCALES])
            for name, column in paged.columns.items():  # sizes change for resident nodes too
                self.columns[name][first : first + len(column)] = column
            self._selectors = {key: value for key, value in self._selectors.items() if key[0] != first}
            self._drawn.clear()
            self.changed.append(targets)
            self.serial = next(_serials)


@dataclass(frozen=True)
class DrawnSplats:
    """M drawn splats, unsorted.

    Attributes:
        selection_key: see :attr:`Request.selection_key`.
        table: (M, 4) float32, the rows of :attr:`Arrangement.instances`.
        splats: (M,) int32, their pool rows.
        means: means of each placement's drawn splats, in its local space.
        excluded: number of splats excluded by the budget.
        coarsened: see :class:`Arrangement`.
    """

    selection_key: tuple
    table: np.ndarray
    splats: np.ndarray
    means: list[np.ndarray]
    excluded: int
    coarsened: Counter[int]


@dataclass(frozen=True)
class Placement:
    """A visible splat set: splats ``first`` to ``first + count`` of the pool with a transform.

    Attributes:
        matrix: ``matrix_world``, (4, 4) float64 as bytes, so that placements compare.
        level: 1 is the coarsest; 0 for splats that are no level.
        query: selects and weights the splats; None means all with weight 1.
        scene: number of the splat scene.
        colors: meaning of the colours, see ``SplatScene.colors``.
        antialias: see ``SplatScene.antialias``.
        arrived: number of updates of paged splats.
        looks: changes of colours and opacities; they change neither selection nor order.
    """

    first: int
    count: int
    matrix: bytes
    level: int
    query: LodQuery | None
    scene: int
    colors: str
    antialias: bool = False
    arrived: int = 0
    looks: Looks = field(default=(), compare=False)

    @property
    def world(self) -> np.ndarray:
        """``matrix_world``, (4, 4) float64."""
        return np.frombuffer(self.matrix).reshape(4, 4)


@dataclass(frozen=True)
class Request:
    """Input of an arrangement besides the pool; requests compare.

    Attributes:
        placements: coarse levels first.
        backward: direction opposite to the view direction, in the world.
        budget: maximum number of splats.
        position: position of the view in the world, from which splats beyond the budget are ranked; None if
            all splats fit.
        coarsened: that of the view's last arrangement, if its detail should remain after a slight motion.
        motion: maximum number of splats while the view moves, and its position; None if it draws all.
        moving: sort only the splats that a moving view draws.
    """

    placements: tuple[Placement, ...]
    backward: tuple[float, float, float]
    budget: int
    position: tuple[float, float, float] | None = None
    coarsened: Counter[int] = field(default_factory=Counter, compare=False)
    motion: tuple[int, tuple[float, float, float]] | None = None
    moving: bool = False

    @property
    def selection_key(self) -> tuple:
        """The values that determine the selected splats, independent of their order."""
        if self.position is not None:
            return self.budget, self.position, *self.placements
        return self.budget, *(replace(placement, matrix=b"") for placement in self.placements)


@dataclass(frozen=True)
class Arrangement:
    """The splats to draw for a request.

    Attributes:
        request: the answered request.
        instances: (M, 4) float32, from back to front: pool row, weight, placement number, and the level or
            band that determines the colour (0: own colour). Those of ``motion`` if the request is for a
            moving view.
        splats: (M,) int32, pool rows of all drawn splats, unsorted.
        motion: (K, 4) float32, the instances while the view moves, see ``motion.simplify``; None for all.
        excluded: number of splats excluded by the budget.
        serial: the pool's; later versions have other splats in some rows.
        coarsened: number of coarser queries that the budget demanded, by scene.
    """

    request: Request
    instances: np.ndarray
    splats: np.ndarray
    excluded: int
    serial: int
    coarsened: Counter[int] = field(default_factory=Counter)
    motion: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of drawn splats."""
        return len(self.splats)


def arrange(pool: Pool, request: Request, update: bool = False) -> Arrangement:
    """Select the splats of a request and sort them from back to front.

    The selection is repeated only for other queries or another budget. If only the view turns or objects
    move, the splats are only sorted again.

    Args:
        update: copy newly read pages first, see ``Pool.apply_updates``.
    """
    if update:
        pool.apply_updates()
    drawn = pool.drawn_splats(request)
    depths = np.empty(len(drawn.table), np.float32)
    backward = np.append(request.backward, 0.0)
    begin = 0
    for placement, means in zip(request.placements, drawn.means, strict=True):
        axis = (backward @ placement.world).astype(np.float32)  # grows towards the camera
        np.add(means @ axis[:3], axis[3], out=depths[begin : begin + len(means)])
        begin += len(means)
    simplified = None
    if request.motion is not None and request.motion[0] < len(drawn.table):
        visibility = _visibility_in_motion(pool, request, drawn)
        kept, simplified = motion.simplify(drawn.table, visibility, request.motion[0])
        simplified = simplified[stable_argsort(depths[kept])]
    if simplified is not None and request.moving:
        instances = simplified
    else:
        instances = drawn.table[stable_argsort(depths)]
    return Arrangement(
        request, instances, drawn.splats, drawn.excluded, pool.serial, drawn.coarsened, simplified
    )


def _visibility_in_motion(pool: Pool, request: Request, drawn: DrawnSplats) -> np.ndarray:
    """Return the visibility of drawn splats (M,) from the position of a moving view."""
    assert request.motion is not None
    parts, begin = [], 0
    for placement, means in zip(request.placements, drawn.means, strict=True):
        part = slice(begin, begin + len(means))
        begin += len(means)
        offsets = _offsets(placement, means, request.motion[1])
        visibility = _visibility(pool, placement, drawn.splats[part], drawn.table[part, 1], offsets)
        motion.dim_beside(visibility, offsets, request.backward)
        parts.append(visibility)
    return np.concatenate(parts)


def _offsets(placement: Placement, means: np.ndarray, position: tuple[float, float, float]) -> np.ndarray:
    """Return the offsets (M, 3) in the world from a position there to means (M, 3) of a placement."""
    world = placement.world
    offsets = means @ world[:3, :3].T.astype(np.float32)
    offsets += (world[:3, 3] - position).astype(np.float32)
    return offsets


def _visibility(
    pool: Pool, placement: Placement, rows: np.ndarray, weight: np.ndarray, offsets: np.ndarray | None
) -> np.ndarray:
    """Return the opacity times area of splats (M,) of a placement, in the image or in the world.

    Args:
        rows: (M,) in the pool.
        weight: (M,) factors of the opacities.
        offsets: (M, 3) from the view; None for areas in the world.
    """
    areas = pool.areas[rows] * np.float32(abs(np.linalg.det(placement.world[:3, :3])) ** (2 / 3))
    visibility = pool.opacities[rows] * weight * areas
    if offsets is not None:
        visibility /= np.maximum(np.einsum("ij,ij->i", offsets, offsets), areas)
    return visibility


def stable_argsort(values: np.ndarray) -> np.ndarray:
    """Return the stable ascending order (N,) of float32 values (N,), twice as fast as ``argsort``.

    Maps the bits to sortable integers and radix-sorts 16 bits at a time.
    """
    bits = (values + np.float32(0)).view(np.int32)  # -0 becomes 0
    bits = np.where(bits < 0, ~bits, bits | np.int32(-(1 << 31))).view(np.uint32)
    order = np.argsort(bits.astype(np.uint16), kind="stable")
    return order[np.argsort((bits >> np.uint32(16)).astype(np.uint16)[order], kind="stable")]


def _select_drawn(pool: Pool, request: Request) -> DrawnSplats:
    """Select the splats that a request draws."""
    coarsened = request.coarsened.copy()
    selections, excluded = select_within_budget(
        pool, request.placements, request.budget, request.position, coarsened
    )
    table = np.empty((sum(len(index) for index, _ in selections), 4), np.float32)
    means: list[np.ndarray] = []
    begin = 0
    for number, (placement, (index, weight)) in enumerate(zip(request.placements, selections, strict=True)):
        selected_means = pool.means[placement.first : placement.first + placement.count][index]
        rows = table[begin : begin + len(index)]
        rows[:, 0], rows[:, 1], rows[:, 2] = index + placement.first, weight, number
        rows[:, 3] = _color_levels(pool, placement, index, selected_means)
        means.append(selected_means)
        begin += len(index)
    splats = table[:, 0].astype(np.int32)
    return DrawnSplats(request.selection_key, table, splats, means, excluded, coarsened)


def select_within_budget(
    pool: Pool,
    placements: Sequence[Placement],
    budget: int,
    position: tuple[float, float, float] | None = None,
    coarsened: Counter[int] | None = None,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
    """Select the splats of placements within a budget.

    If there are too many, the scene that draws the most splats takes the next coarser query of its rule,
    repeatedly. If no rule can get coarser, the least visible splats are excluded; for levels that add up,
    those of the finest level first.

    Args:
        position: see :class:`Request`; None ranks splats by their size in the world.
        coarsened: number of coarser queries by scene of the last arrangement; replaced by the new ones.

    Returns:
        Index and weights of each placement's splats, and the number of excluded splats.
    """

    def count(placement: Placement) -> int:
        return len(_select(pool, placement)[0])

    placements = list(placements)
    full_count = sum(map(count, placements))
    previous, steps = coarsened or Counter(), Counter()
    if full_count > (FINER_LIMIT if previous else 1) * budget:
        steps += _coarsen(placements, pool.estimate_count, ESTIMATE_LIMIT * budget, previous)
        steps += _coarsen(placements, count, budget, previous - steps)
    if coarsened is not None:
        coarsened.clear()
        coarsened.update(steps)
    selections = [_select(pool, placement) for placement in placements]
    total = sum(len(index) for index, _ in selections)
    while total > budget:
        sets_per_scene = Counter(
            placement.scene
            for placement, (index, _) in zip(placements, selections, strict=True)
            if len(index)
        )
        adding = [
            i for i, placement in enumerate(placements)
            if len(selections[i][0]) and sets_per_scene[placement.scene] > 1
        ]  # fmt: skip
        numbers = [max(adding, key=lambda i: placements[i].level)] if adding else range(len(placements))
        candidates = sum(len(selections[i][0]) for i in numbers)
        _thin(pool, placements, selections, numbers, max(candidates - (total - budget), 0), position)
        total = sum(len(index) for index, _ in selections)
    return selections, full_count - sum(len(index) for index, _ in selections)


def _coarsen(
    placements: list[Placement], count: Callable[[Placement], int], budget: float, previous: Counter[int]
) -> Counter[int]:
    """Replace queries by coarser ones in place until the counts fit into the budget, if possible.

    Scenes that were coarser before (``previous``) stay so unless ``FINER_LIMIT`` of the budget suffices.

    Returns:
        Number of coarser queries by scene.
    """
    counts = [count(placement) for placement in placements]
    scenes = {placement.scene for placement in placements if placement.query is not None}
    steps: Counter[int] = Counter()
    while True:
        total = sum(counts)
        finer = {scene for scene in scenes if steps[scene] < previous[scene] and total > FINER_LIMIT * budget}
        candidates = scenes if total > budget else finer
        if not candidates:
            return steps
        scene_counts = dict.fromkeys(candidates, 0)
        for placement, splats in zip(placements, counts, strict=True):
            if placement.scene in scene_counts:
                scene_counts[placement.scene] += splats
        scene = max(scene_counts, key=lambda number: scene_counts[number])
        levels = sorted({placement.level for placement in placements if placement.scene == scene})
        steps[scene] += 1
        for i, placement in enumerate(placements):
            if placement.scene == scene and placement.query is not None:
                coarser = placement.query.coarser(levels)
                if coarser is None:
                    scenes.discard(scene)
                    break
                placements[i] = replace(placement, query=coarser)
                counts[i] = count(placements[i])


def _select(pool: Pool, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """Return index and weights of a placement's splats with a weight above 0."""
    if placement.query is None:
        return np.arange(placement.count, dtype=np.int32), np.ones(placement.count, np.float32)
    return pool.selector(placement).select(placement.query)


def _thin(
    pool: Pool,
    placements: Sequence[Placement],
    selections: list[tuple[np.ndarray, np.ndarray]],
    numbers: Sequence[int],
    keep: int,
    position: tuple[float, float, float] | None,
) -> None:
    """Keep the most visible splats (opacity times area in the image) of some placements.

    The direction of the view does not count, so that a turned view is complete.

    Args:
        selections: index and weights of each placement's splats; replaced by those of the kept splats.
        numbers: indices of the placements to thin.
        keep: number of splats that remain.
        position: see :func:`select_within_budget`.
    """
    visibility = []
    for i in numbers:
        index, weight = selections[i]
        rows = index + placements[i].first
        offsets = None if position is None else _offsets(placements[i], pool.means[rows], position)
        visibility.append(_visibility(pool, placements[i], rows, weight, offsets))
    values = np.concatenate(visibility)
    stays = np.zeros(len(values), bool)
    if keep:
        stays[np.argpartition(values, len(values) - keep)[len(values) - keep :]] = True
    begin = 0
    for i, part in zip(numbers, visibility, strict=True):
        mask = stays[begin : begin + len(part)]
        selections[i] = (selections[i][0][mask], selections[i][1][mask])
        begin += len(part)


def _color_levels(
    pool: Pool, placement: Placement, index: np.ndarray, means: np.ndarray
) -> np.ndarray | float:
    """Return the level that determines the colour of a placement's splats (M,) with these means (M, 3)."""
    query = placement.query
    if query is not None and query.rule:
        if placement.colors == "LEVELS":
            rows = index + placement.first
            names = query.resolved_rule.columns
            return query.splat_level(
                {name: pool.columns[name][rows] for name in names if name in pool.columns}
            )
        if placement.colors == "BANDS":
            return query.target_level(means)
        if placement.colors == "CHUNKS":
            return query.part_numbers(means)
    return placement.level if placement.colors in ("LEVELS", "BANDS") else 0
