"""Splats where they are drawn, kept from picture to picture: whatever draws levels by distance draws with it.

A set of splats (``SplatSet``) is put in spatial order once, and looked at in blocks of rows: what is out of
sight, or out of its level's reach, is left out before its splats are looked at one by one, and nothing that
is left out is copied. ``ResidentBundle`` is a bundle's levels as such sets; of a file that has an index of its
blocks it reads what the eye's region needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import pad

from ..editing.look import Looks, changed
from ..errors import LodgsError
from ..lod.blocks import SIZE, spatial_order
from ..lod.on_disk import Sight, open_if_large
from ..lod.partial_read import BLOCKS, read_head_and_tables, read_part
from ..lod.query import Choice, Chooser
from ..lod.rule import OPACITY, Region, Values, every_column, facts_of
from ..lod.selection import known_rule, levels_alone, not_alone, rule_of
from ..scenes.cameras import Camera
from ..splats.bundle import Bundle
from ..splats.dialects import Warn, ignore
from ..splats.gaussians import Splats
from ..splats.ply import Element, all_columns
from . import rasterize, tensor_device
from .gaussians import Gaussians
from .rendering import Rendering
from .transform import transform_gaussians

MANY = 16 * SIZE
"""Fewer splats are not worth being put in order; of equally deep ones the first in order is in front."""


class SplatSet:
    """Splats where a backend draws them.

    Args:
        splats: in the set's own coordinates; of their extras those are kept that rules ask for.
        weights: (N,) on the opacities; None: ones.
        backend: rasterizer.
        ordered: their rows are in spatial order already; then nothing is copied.

    Attributes:
        gaussians: the same, where there are MANY in spatial order, on the backend's device.
    """

    def __init__(
        self,
        splats: Splats,
        weights: np.ndarray | None = None,
        backend: str = "auto",
        ordered: bool = False,
    ) -> None:
        device = tensor_device(backend)
        if not ordered and len(splats) >= MANY:
            order = spatial_order(splats.means)
            splats, weights = splats.select(order), None if weights is None else weights[order]
        self.gaussians = Gaussians.of(splats, device)
        self._weights = None if weights is None else np.asarray(weights, np.float32)
        # opacities as they were trained, by which rules choose whatever looks make of them
        self._columns = {name: splats.extras[name] for name in every_column() if name in splats.extras}
        with np.errstate(over="ignore"):
            self._columns[OPACITY] = 1 / (1 + np.exp(-splats.opacity_logits))
        self._chooser: Chooser | None = None
        self._in_world: tuple[bytes, Gaussians] | None = None
        self._joined: tuple[list[SplatSet], Gaussians] | None = None
        self._looked: tuple[Looks, SplatSet] | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    def select_visible(
        self, choice: Choice | None, camera: Camera | None = None, near: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """The splats that have a weight, (M,) int32 ascending, and their weights (M,) float32.

        Args:
            choice: by what they are weighted, on top of their own weights; None: by these alone.
            camera: in the set's own coordinates; splats that are out of its sight may be left out.
            near: depth at which its drawing begins, in the set's units.
        """
        if self._chooser is None:
            self._chooser = self._make_chooser()
        rows, weights = self._chooser.chosen(choice, camera, near)
        if self._weights is None:
            return rows, weights
        weights = weights * self._weights[rows]
        some = weights > 0
        return (rows, weights) if some.all() else (rows[some], weights[some])

    def transformed(self, matrix: np.ndarray) -> Gaussians:
        """The splats where a transform (4, 4) puts them, any affine one; kept while it is the same.

        Their harmonics stay the set's.
        """
        key = matrix.tobytes()
        if self._in_world is None or self._in_world[0] != key:
            self._in_world = key, transform_gaussians(self.gaussians, matrix)
        return self._in_world[1]

    def with_looks(self, looks: Looks) -> SplatSet:
        """The set as looks have it, with everything else shared; kept while they are the same."""
        if not looks:
            self._looked = None
            return self
        if self._looked is None or self._looked[0] != looks:
            own, other = self.gaussians, copy(self)
            sh, logits = changed(looks, *(x.cpu().numpy() for x in (own.means, own.sh, own.opacity_logits)))
            sh, logits = (torch.from_numpy(x).to(own.means.device) for x in (sh, logits))
            other.gaussians = replace(own, sh=sh, opacity_logits=logits)
            other._in_world = other._joined = other._looked = None
            self._looked = looks, other
        return self._looked[1]

    def concatenated(self, others: Sequence[SplatSet]) -> Gaussians:
        """These splats and those of other sets as one, kept as long as these are the others.

        All of them are parts of it then, so that nothing is there twice.
        """
        others = list(others)
        if not others:
            return self.gaussians
        if self._joined is None or self._joined[0] != others:
            sets = [self, *others]
            most = max(one.gaussians.sh.shape[1] for one in sets)
            whole = Gaussians.concatenated([
                replace(one.gaussians, sh=pad(one.gaussians.sh, (0, 0, 0, most - one.gaussians.sh.shape[1])))
                for one in sets
            ])  # fmt: skip
            if self in others:  # drawn twice at one place
                return whole
            begin = 0
            for one in sets:
                end = begin + len(one)
                one.gaussians, begin = whole.select(slice(begin, end)), end
                one._chooser = one._in_world = None  # which hold what these tensors took the place of
            self._joined = others, whole
        return self._joined[1]

    def _make_chooser(self) -> Chooser:
        own = self.gaussians
        return Chooser(own.means.cpu().numpy(), self._columns, own.log_scales.cpu().numpy())


class WeightedSet(NamedTuple):
    """A set of splats, and by what they are weighted; None: by nothing but their own weights."""

    splats: SplatSet
    choice: Choice | None


def combine_visible(
    sets: Sequence[WeightedSet], camera: Camera, near: float
) -> tuple[Gaussians, torch.Tensor, torch.Tensor | None]:
    """Of sets that stand together all splats, N, which of them to look at, and weights: for ``rasterize``.

    Args:
        camera, near: in the sets' coordinates.

    Returns:
        The splats; rows (M,) int32; weights (N,), which count in these rows only, or None: all are 1.
    """
    gaussians = sets[0].splats.concatenated([one.splats for one in sets[1:]])
    device = gaussians.means.device
    chosen = [splats.chosen(choice, camera, near) for splats, choice in sets]
    begins = np.cumsum([0, *(len(one.splats) for one in sets)], dtype=np.int32)
    rows = np.concatenate([some + begin for begin, (some, _) in zip(begins, chosen, strict=False)])
    found = np.concatenate([weights for _, weights in chosen])
    rows_there = torch.from_numpy(rows).to(device)
    if (found == 1).all():
        return gaussians, rows_there, None
    weights = np.zeros(len(gaussians), np.float32)
    weights[rows] = found
    return gaussians, rows_there, torch.from_numpy(weights).to(device)


def draw(
    sets: Sequence[WeightedSet], camera: Camera, *, near: float = 0.01, backend: str = "auto", **options: Any
) -> Rendering:
    """What a camera sees of sets that stand together. Nothing is kept for gradients.

    Args:
        options: as for :func:`training.rasterize.rasterize`.
    """
    with torch.no_grad():
        gaussians, rows, weights = combine_visible(sets, camera, near)
        return rasterize(gaussians, camera, near=near, rows=rows, weights=weights, backend=backend, **options)


class ResidentBundle:
    """A bundle's levels, for one picture after another.

    Args:
        source: a bundle, all of whose splats are kept ready, but for levels that are elsewhere: of these each
            camera has read what it may see (``lod.on_disk``). Or the file of one. Of that is read what is asked
            for: where it has a table of blocks (``lod.partial_read``), and the rule tells for a region which
            splats may be shown in it, these alone, which stay while the eye is there.
        backend: rasterizer.
        warn: as for ``read_bundle``.
        most: see ``open_if_large``, for a file without such regions.

    Attributes:
        bundle: what is known of it; without splats where it is a file.
        loaded: how many splats are held ready.
        bytes_read: of the file, so far.

    Raises:
        LodgsError: as ``read_bundle``, or the bundle contradicts its rule.
    """

    def __init__(
        self,
        source: Bundle | str | Path,
        backend: str = "auto",
        warn: Warn = ignore,
        most: int = 0,
    ) -> None:
        self._path = None if isinstance(source, Bundle) else Path(source)
        self.bundle = source if isinstance(source, Bundle) else read_head_and_tables(source)
        self._backend, self._warn = backend, warn
        self.loaded, self.bytes_read = 0, 0
        self._sets: dict[int, SplatSet] = {}
        self._holds: tuple[Region | None, frozenset[int]] | None = None
        self._rule = known_rule(self.bundle)
        if self._path is not None:
            self.bundle = open_if_large(self._path, most) or self.bundle
        self._sights: dict[int, Sight] = {}
        self._row_bytes = 0
        self._facts: dict[int, tuple[tuple[str, float], ...]] = {}
        self._tables = tuple(
            (name, tuple((column, rows.dtype.str, rows.tobytes()) for column, rows in table.items()))
            for name, table in self.bundle.tables.items()
            if self._rule is not None and name in self._rule.tables
        )

    def select_by_rule(self, camera: Camera, values: Values) -> dict[int, WeightedSet]:
        """The levels by number, weighted as the rule says for a camera's eye.

        Args:
            values: of the rule's controls, see ``lod.selection.settings``.

        Raises:
            LodgsError: the levels are not made for distances, the rule is not known here, or facts are
                missing; or as ``read_bundle``.
        """
        rule = rule_of(self.bundle)
        x, y, z = camera.center.tolist()
        choices = {
            number: Choice(rule.name, (x, y, z), camera.focal, facts, tuple(values.items()), self._tables)
            for number, facts in self._all_facts().items()
        }
        if self.bundle.on_disk:
            return {
                n: WeightedSet(self._in_sight(n, camera, choice), choice) for n, choice in choices.items()
            }
        self._hold(next(iter(choices.values())).region(), frozenset(choices))
        return {number: WeightedSet(self._sets[number], choice) for number, choice in choices.items()}

    def select_level(self, number: int, camera: Camera) -> dict[int, WeightedSet]:
        """All that a camera sees of a level: the level, and where levels add up the coarser ones before it.

        Raises:
            LodgsError: there is no such level, or it is no scene by itself; or as ``read_bundle``.
        """
        known = [level.number for level in self.bundle.levels]
        if number not in known:
            raise LodgsError(
                f"There is no level {number}.", f"Choose from {known[0]} (coarsest) to {known[-1]}."
            )
        if number not in [level.number for level in levels_alone(self.bundle)]:
            raise LodgsError(*not_alone(number, known[-1]))
        numbers = [level.number for level in self.bundle.drawn_levels(number)]
        if self.bundle.on_disk:
            return {number: WeightedSet(self._in_sight(number, camera, None), None) for number in numbers}
        self._hold(None, frozenset(numbers))
        return {number: WeightedSet(self._sets[number], None) for number in numbers}

    def draw(self, camera: Camera, values: Values, *, near: float = 0.01, **options: Any) -> Rendering:
        """What a camera is shown by the rule; arguments as of :meth:`select_by_rule` and :func:`draw`."""
        return self._draw(self.select_by_rule(camera, values), camera, near, options)

    def draw_level(self, number: int, camera: Camera, *, near: float = 0.01, **options: Any) -> Rendering:
        """What a camera sees at a level; arguments as of :meth:`select_level` and :func:`draw`."""
        return self._draw(self.select_level(number, camera), camera, near, options)

    def _draw(self, shown: dict[int, WeightedSet], camera: Camera, near: float, options: dict) -> Rendering:
        options = {"antialias": self.bundle.antialias, "backend": self._backend} | options
        return draw(list(shown.values()), camera, near=near, **options)

    def _all_facts(self) -> dict[int, tuple[tuple[str, float], ...]]:
        """What the rule knows of each level, by number."""
        if not self._facts:
            rule, numbered = (
                rule_of(self.bundle),
                [(level.number, level.facts) for level in self.bundle.levels],
            )
            for number, _ in numbered:
                found = facts_of(rule, self.bundle.facts, numbered, number)
                self._facts[number] = tuple(found.items())
        return self._facts

    def _in_sight(self, number: int, camera: Camera, choice: Choice | None) -> SplatSet:
        """The splats of a level that a camera may see, where they are drawn."""
        if number not in self._sights:
            (level,) = (level for level in self.bundle.levels if level.number == number)
            self._sights[number] = Sight(level.rows, self._rule, self._path or "", self._warn)
        sight = self._sights[number]
        missing = sight.missing(camera, choice)
        if missing is not None:
            self._sets.pop(number, None)  # so that both are never in memory
            splats = sight.read(missing)
            self._sets[number] = SplatSet(splats, None, self._backend, ordered=True)
            self._row_bytes = Element.of("", all_columns(splats)).dtype.itemsize
        self.loaded = sum(map(len, self._sets.values()))
        self.bytes_read = self._row_bytes * sum(each.count for each in self._sights.values())
        return self._sets[number]

    def _hold(self, region: Region | None, numbers: frozenset[int]) -> None:
        """Has these levels ready, or at least what a region shows of them."""
        if self._path is None or BLOCKS not in self.bundle.tables:
            region = None
        if self._holds is not None and self._holds[0] == region and numbers <= self._holds[1]:
            return
        if self._path is None:
            bundle, numbers = self.bundle, frozenset(level.number for level in self.bundle.levels)
        else:
            self._holds, self._sets = None, {}  # so that both are never in memory
            bundle, size = read_part(self._path, numbers, region, self._warn)
            self.bytes_read += size
        ordered = BLOCKS in bundle.tables
        self._sets = {
            level.number: SplatSet(level.splats, None, self._backend, ordered)
            for level in bundle.levels
            if level.number in numbers
        }
        self.loaded = sum(map(len, self._sets.values()))
        self._holds = region, numbers
