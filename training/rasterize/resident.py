"""A bundle's levels where they are drawn: what a camera is shown of them, and no more work than that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..lod.blocks import Blocks, spatial_order
from ..lod.rule import Region, Rule, Values, facts_of
from ..lod.selection import columns_of, rule_of
from ..scenes.cameras import Camera
from ..splats.bundle import Bundle
from ..splats.gaussians import Splats
from . import device_of, rasterize
from .gaussians import Gaussians
from .rendering import Rendering


@dataclass(frozen=True)
class _Level:
    """A level's place among all splats that are loaded.

    Attributes:
        number: of the level.
        begin: its first row.
        means: (N, 3); columns: what its rule needs, (N,) by name; blocks: of its rows.
    """

    number: int
    begin: int
    means: np.ndarray
    columns: Mapping[str, np.ndarray]
    blocks: Blocks


class Resident:
    """Levels that are drawn again and again.

    Splats are put in spatial order once, and then looked at in blocks: what is out of sight, or at another
    level's distance, is left out before its splats are looked at one by one. Where the rule tells for a
    region which splats may be shown in it, only these are loaded, and they stay while the eye is there.

    Args:
        bundle: its levels are not copied beyond being put in order.
        backend: rasterizer.

    Attributes:
        loaded: how many splats are held ready for drawing.

    Raises:
        LodgsError: its levels are not made for distances, the rule is not known here, or facts are missing.
    """

    def __init__(self, bundle: Bundle, backend: str = "auto") -> None:
        self._rule: Rule = rule_of(bundle)
        self._cumulative, self._tables = bundle.cumulative, bundle.tables
        self._antialias = bundle.antialias
        numbered = [(level.number, level.facts) for level in bundle.levels]
        self._facts = {n: facts_of(self._rule, bundle.facts, numbered, n) for n, _ in numbered}
        self._splats = {
            level.number: level.splats.select(spatial_order(level.splats.means)) for level in bundle.levels
        }
        self._backend, self._device = backend, device_of(backend)
        self._region: Region | None = None
        self._load(self._splats)

    def draw(self, camera: Camera, values: Values, *, near: float = 0.01, **options: Any) -> Rendering:
        """What a camera is shown by the rule.

        Args:
            values: of the rule's controls, see ``lod.selection.settings``.
            near: depth at which drawing begins, in scene units.
            options: as for :func:`training.rasterize.rasterize`. Rows are those of the splats loaded.
        """
        eye = camera.center.astype(np.float32)  # as weights take it: on a border between regions it counts
        self._enter(self._rule.region(eye, values, self._tables))
        rows, weights = [], []
        for level in self._levels:
            some, found = self._shown(level, camera, near, values)
            rows.append(some + level.begin)
            weights.append(found)
        return self._rasterize(camera, near, rows, weights, options)

    def draw_level(self, number: int, camera: Camera, *, near: float = 0.01, **options: Any) -> Rendering:
        """What a camera sees at a level alone; where levels add up, with all coarser ones."""
        self._enter(None)
        rows = [
            level.blocks.rows(level.blocks.in_view(camera, near)) + level.begin
            for level in self._levels
            if level.number == number or (self._cumulative and level.number < number)
        ]
        return self._rasterize(camera, near, rows, None, options)

    def _shown(
        self, level: _Level, camera: Camera, near: float, values: Values
    ) -> tuple[np.ndarray, np.ndarray]:
        """The rows (M,) of a level that may be in view and have a weight, and their weights."""
        facts, rule, blocks = self._facts[level.number], self._rule, level.blocks
        what = camera.center.astype(np.float32), camera.focal
        seen = blocks.in_view(camera, near)
        if not rule.apart:
            rows = blocks.rows(seen)
            weights = rule.weights(level.means, *what, level.columns, facts, values, self._tables)[rows]
        else:
            if self._region is None:
                seen &= blocks.between(camera.center, *rule.band(camera.focal, facts, values))
            rows = blocks.rows(seen)
            columns = {name: column[rows] for name, column in level.columns.items()}
            weights = rule.weights(level.means[rows], *what, columns, facts, values, self._tables)
        some = np.flatnonzero(weights)
        return rows[some], weights[some]

    def _rasterize(
        self,
        camera: Camera,
        near: float,
        rows: Sequence[np.ndarray],
        weights: Sequence[np.ndarray] | None,
        options: Mapping[str, Any],
    ) -> Rendering:
        index = torch.from_numpy(np.concatenate(rows)).to(self._device)
        if weights is not None:
            self._weights[index.long()] = torch.from_numpy(np.concatenate(weights)).to(self._weights)
        with torch.no_grad():
            return rasterize(
                self._gaussians, camera, near=near, rows=index,
                weights=None if weights is None else self._weights,
                antialias=self._antialias, backend=self._backend, **options,
            )  # fmt: skip

    def _enter(self, region: Region | None) -> None:
        """Loads what a region needs, unless it is there already."""
        if region == self._region:
            return
        self._region = region
        if region is None:
            self._load(self._splats)
            return
        columns = {number: columns_of(self._rule, splats) for number, splats in self._splats.items()}
        self._load(
            {
                number: splats.select(np.flatnonzero(self._rule.loaded(columns[number], region)))
                for number, splats in self._splats.items()
            }
        )

    def _load(self, splats: Mapping[int, Splats]) -> None:
        self._levels, begin = [], 0
        for number, one in splats.items():
            blocks = Blocks.of(one.means, one.log_scales)
            self._levels.append(_Level(number, begin, one.means, columns_of(self._rule, one), blocks))
            begin += len(one)
        self.loaded = begin
        self._gaussians = Gaussians.of(Splats.concatenated(list(splats.values())), self._device)
        self._weights = torch.ones(begin, device=self._device)
