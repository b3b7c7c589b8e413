"""Splats resident in device memory, from which level-of-detail renderers draw image after image.

A :class:`SplatSet` is sorted spatially once and culled in blocks of rows: invisible blocks and blocks beyond
their level's distance range are skipped before single splats are tested, and culled splats are never copied.
A :class:`ResidentBundle` holds a bundle's levels as such sets. From a file with a block index it reads only
the splats that the camera's region needs.
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

from ..editing.look import Looks, change_colors
from ..errors import LodgsError
from ..lod.blocks import BLOCKS, SIZE
from ..lod.on_disk import CulledReader, open_if_large, read_header_and_tables, read_part
from ..lod.query import LodQuery, SplatSelector
from ..lod.rule import OPACITY, Region, Values, all_rule_columns, collect_facts
from ..lod.selection import check_rule, require_rule, standalone_error, standalone_levels
from ..scenes.cameras import Camera
from ..splats.dialects import Warn, ignore
from ..splats.gaussians import Splats
from ..splats.levels import Bundle
from ..splats.morton import spatial_order
from ..splats.ply import Element, all_columns
from . import rasterize, tensor_device
from .gaussians import Gaussians
from .rendering import Rendering
from .transform import transform_gaussians

SORT_THRESHOLD = 16 * SIZE
"""Smaller sets are not sorted spatially. Among splats of equal depth, the first in order is in front."""


class SplatSet:
    """Splats on a backend's device.

    Args:
        splats: splats in the set's coordinates. Of their extra columns, only those that rules use are kept.
        weights: (N,) factors of the opacities; None means 1.
        backend: rasterizer backend.
        ordered: the rows are already in spatial order, so they need no copy.

    Attributes:
        gaussians: the splats on the backend's device, in spatial order if they reach SORT_THRESHOLD.
    """

    def __init__(
        self,
        splats: Splats,
        weights: np.ndarray | None = None,
        backend: str = "auto",
        ordered: bool = False,
    ) -> None:
        device = tensor_device(backend)
        if not ordered and len(splats) >= SORT_THRESHOLD:
            order = spatial_order(splats.means)
            splats = splats.select(order)
            weights = None if weights is None else weights[order]
        self.gaussians = Gaussians.of(splats, device)
        self._weights = None if weights is None else np.asarray(weights, np.float32)
        # rules select by the trained opacities, which looks may change
        self._columns = {name: splats.extras[name] for name in all_rule_columns() if name in splats.extras}
        self._columns[OPACITY] = splats.opacities
        self._selector: SplatSelector | None = None
        self._transformed: tuple[bytes, Gaussians] | None = None
        self._concatenated: tuple[list[SplatSet], Gaussians] | None = None
        self._with_looks: tuple[Looks, SplatSet] | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    def select_visible(
        self, query: LodQuery | None, camera: Camera | None = None, near: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Select the splats with positive weight.

        Args:
            query: rule and arguments that weight the splats in addition to their own weights; None applies no
                rule.
            camera: camera in the set's coordinates; splats outside its image may be skipped.
            near: near depth of the camera, in the set's units.

        Returns:
            Row indices (M,) int32, ascending, and weights (M,) float32.
        """
        if self._selector is None:
            self._selector = self._make_selector()
        rows, weights = self._selector.select(query, camera, near)
        if self._weights is None:
            return rows, weights
        weights = weights * self._weights[rows]
        positive = weights > 0
        return (rows, weights) if positive.all() else (rows[positive], weights[positive])

    def transformed(self, matrix: np.ndarray) -> Gaussians:
        """Apply an affine transform (4, 4) to the splats; the last result is cached.

        Their harmonics are not rotated.
        """
        key = matrix.tobytes()
        if self._transformed is None or self._transformed[0] != key:
            self._transformed = key, transform_gaussians(self.gaussians, matrix)
        return self._transformed[1]

    def with_looks(self, looks: Looks) -> SplatSet:
        """Return the set with looks applied, sharing all other data; the last result is cached."""
        if not looks:
            self._with_looks = None
            return self
        if self._with_looks is None or self._with_looks[0] != looks:
            own = self.gaussians
            copied = copy(self)
            sh, logits = change_colors(
                looks, *(x.cpu().numpy() for x in (own.means, own.sh, own.opacity_logits))
            )
            sh, logits = (torch.from_numpy(x).to(own.means.device) for x in (sh, logits))
            copied.gaussians = replace(own, sh=sh, opacity_logits=logits)
            copied._transformed = copied._concatenated = copied._with_looks = None
            self._with_looks = looks, copied
        return self._with_looks[1]

    def concatenated(self, following: Sequence[SplatSet]) -> Gaussians:
        """Concatenate the splats of this set and the following sets; the last result is cached.

        All sets then become views of the result, so no splat is stored twice.
        """
        following = list(following)
        if not following:
            return self.gaussians
        if self._concatenated is None or self._concatenated[0] != following:
            sets = [self, *following]
            terms = max(splat_set.gaussians.sh.shape[1] for splat_set in sets)
            combined = Gaussians.concatenated(
                [_pad_harmonics(splat_set.gaussians, terms) for splat_set in sets]
            )
            if self in following:  # a set that is drawn twice cannot be a view of both copies
                return combined
            begin = 0
            for splat_set in sets:
                end = begin + len(splat_set)
                splat_set.gaussians = combined.select(slice(begin, end))
                splat_set._selector = splat_set._transformed = None  # they reference the replaced tensors
                begin = end
            self._concatenated = following, combined
        return self._concatenated[1]

    def _make_selector(self) -> SplatSelector:
        own = self.gaussians
        return SplatSelector(own.means.cpu().numpy(), self._columns, own.log_scales.cpu().numpy())


def _pad_harmonics(gaussians: Gaussians, terms: int) -> Gaussians:
    sh = gaussians.sh
    return replace(gaussians, sh=pad(sh, (0, 0, 0, terms - sh.shape[1])))


class WeightedSet(NamedTuple):
    """A set of splats and the query that weights them; None applies no rule."""

    splats: SplatSet
    query: LodQuery | None


def combine_visible(
    sets: Sequence[WeightedSet], camera: Camera, near: float
) -> tuple[Gaussians, torch.Tensor, torch.Tensor | None]:
    """Concatenate sets in the same coordinates and select their visible splats, for ``rasterize``.

    Args:
        camera, near: camera and near depth in the sets' coordinates.

    Returns:
        All N splats; rows (M,) int32 to consider; weights (N,), valid in these rows only, or None if all are
        1.
    """
    gaussians = sets[0].splats.concatenated([weighted.splats for weighted in sets[1:]])
    device = gaussians.means.device
    selections = [splats.select_visible(query, camera, near) for splats, query in sets]
    begins = np.cumsum([0, *(len(weighted.splats) for weighted in sets)], dtype=np.int32)
    rows = np.concatenate([index + begin for begin, (index, _) in zip(begins, selections, strict=False)])
    row_weights = np.concatenate([weights for _, weights in selections])
    device_rows = torch.from_numpy(rows).to(device)
    if (row_weights == 1).all():
        return gaussians, device_rows, None
    weights = np.zeros(len(gaussians), np.float32)
    weights[rows] = row_weights
    return gaussians, device_rows, torch.from_numpy(weights).to(device)


def draw(
    sets: Sequence[WeightedSet], camera: Camera, *, near: float = 0.01, backend: str = "auto", **options: Any
) -> Rendering:
    """Render sets in the same coordinates, without gradients.

    Args:
        options: see :func:`training.rasterize.rasterize`.
    """
    with torch.no_grad():
        gaussians, rows, weights = combine_visible(sets, camera, near)
        return rasterize(gaussians, camera, near=near, rows=rows, weights=weights, backend=backend, **options)


class ResidentBundle:
    """A bundle's levels, ready to render images.

    Levels in memory become resident as a whole. Of levels on disk, only the splats that a camera may see are
    read (``lod.on_disk``). A file is read on demand: if it has a block table (``lod.blocks``) and its
    rule defines regions, only the splats of the camera's region are resident.

    Args:
        source: a bundle, or a bundle's file.
        backend: rasterizer backend.
        warn: see ``read_bundle``.
        max_in_memory: maximum number of splats to read at once from a file without regions; 0 means the
            default of ``open_if_large``.

    Attributes:
        bundle: the bundle; without splats if the source is a file.
        loaded: number of resident splats.
        bytes_read: bytes read from the file so far.

    Raises:
        LodgsError: see ``read_bundle``, or the bundle contradicts its rule.
    """

    def __init__(
        self,
        source: Bundle | str | Path,
        backend: str = "auto",
        warn: Warn = ignore,
        max_in_memory: int = 0,
    ) -> None:
        self._path = None if isinstance(source, Bundle) else Path(source)
        self.bundle = source if isinstance(source, Bundle) else read_header_and_tables(source)
        self._backend = backend
        self._warn = warn
        self.loaded = 0
        self.bytes_read = 0
        self._sets: dict[int, SplatSet] = {}
        self._resident: tuple[Region | None, frozenset[int]] | None = None
        self._rule = check_rule(self.bundle)
        if self._path is not None:
            self.bundle = open_if_large(self._path, max_in_memory) or self.bundle
        self._readers: dict[int, CulledReader] = {}
        self._row_bytes = 0
        self._facts: dict[int, tuple[tuple[str, float], ...]] = {}
        self._tables = tuple(
            (name, tuple((column, rows.dtype.str, rows.tobytes()) for column, rows in table.items()))
            for name, table in self.bundle.tables.items()
            if self._rule is not None and name in self._rule.tables
        )

    def select_by_rule(self, camera: Camera, values: Values) -> dict[int, WeightedSet]:
        """Return the levels by number, weighted by the bundle's rule for a camera.

        Args:
            values: values of the rule's controls, see ``lod.selection.resolve_controls``.

        Raises:
            LodgsError: the bundle has no rule, an unknown rule, or lacks facts; or see ``read_bundle``.
        """
        rule = require_rule(self.bundle)
        x, y, z = camera.center.tolist()
        queries = {
            number: LodQuery(rule.name, (x, y, z), camera.focal, facts, tuple(values.items()), self._tables)
            for number, facts in self._all_facts().items()
        }
        if self.bundle.on_disk:
            return {
                number: WeightedSet(self._read_visible(number, camera, query), query)
                for number, query in queries.items()
            }
        self._load(next(iter(queries.values())).region(), frozenset(queries))
        return {number: WeightedSet(self._sets[number], query) for number, query in queries.items()}

    def select_level(self, number: int, camera: Camera) -> dict[int, WeightedSet]:
        """Return one level, with all coarser ones if levels are cumulative.

        Raises:
            LodgsError: the level does not exist or is not a complete scene; or see ``read_bundle``.
        """
        available = [level.number for level in self.bundle.levels]
        if number not in available:
            raise LodgsError(
                f"Cannot draw level {number}: the bundle has no such level.",
                f"Choose a level from {available[0]} (coarsest) to {available[-1]}.",
            )
        if number not in [level.number for level in standalone_levels(self.bundle)]:
            raise LodgsError(*standalone_error(number, available[-1]))
        numbers = [level.number for level in self.bundle.drawn_levels(number)]
        if self.bundle.on_disk:
            return {number: WeightedSet(self._read_visible(number, camera, None), None) for number in numbers}
        self._load(None, frozenset(numbers))
        return {number: WeightedSet(self._sets[number], None) for number in numbers}

    def draw(self, camera: Camera, values: Values, *, near: float = 0.01, **options: Any) -> Rendering:
        """Render the levels as the rule selects them; see :meth:`select_by_rule` and :func:`draw`."""
        return self._draw(self.select_by_rule(camera, values), camera, near, options)

    def draw_level(self, number: int, camera: Camera, *, near: float = 0.01, **options: Any) -> Rendering:
        """Render one level; see :meth:`select_level` and :func:`draw`."""
        return self._draw(self.select_level(number, camera), camera, near, options)

    def _draw(
        self, sets: dict[int, WeightedSet], camera: Camera, near: float, options: dict[str, Any]
    ) -> Rendering:
        defaults: dict[str, Any] = {"antialias": self.bundle.antialias, "backend": self._backend}
        return draw(list(sets.values()), camera, near=near, **(defaults | options))

    def _all_facts(self) -> dict[int, tuple[tuple[str, float], ...]]:
        """Return the rule's facts of every level, by number."""
        if not self._facts:
            rule = require_rule(self.bundle)
            numbered = [(level.number, level.facts) for level in self.bundle.levels]
            for number, _ in numbered:
                facts = collect_facts(rule, self.bundle.facts, numbered, number)
                self._facts[number] = tuple(facts.items())
        return self._facts

    def _read_visible(self, number: int, camera: Camera, query: LodQuery | None) -> SplatSet:
        """Read the splats of a level that a camera may see."""
        if number not in self._readers:
            (level,) = (level for level in self.bundle.levels if level.number == number)
            self._readers[number] = CulledReader(level.rows, self._rule, self._path or "", self._warn)
        reader = self._readers[number]
        missing = reader.missing(camera, query)
        if missing is not None:
            self._sets.pop(number, None)  # free it before reading the replacement
            splats = reader.read(missing)
            self._sets[number] = SplatSet(splats, None, self._backend, ordered=True)
            self._row_bytes = Element.from_columns("", all_columns(splats)).dtype.itemsize
        self.loaded = sum(map(len, self._sets.values()))
        self.bytes_read = self._row_bytes * sum(reader.splats_read for reader in self._readers.values())
        return self._sets[number]

    def _load(self, region: Region | None, numbers: frozenset[int]) -> None:
        """Make levels resident; if their file supports it, only the splats of a region."""
        if self._path is None or BLOCKS not in self.bundle.tables:
            region = None
        if self._resident is not None and self._resident[0] == region and numbers <= self._resident[1]:
            return
        if self._path is None:
            bundle = self.bundle
            numbers = frozenset(level.number for level in bundle.levels)
        else:
            self._resident = None
            self._sets = {}  # free them before reading the replacements
            bundle, size = read_part(self._path, numbers, region, self._warn)
            self.bytes_read += size
        ordered = BLOCKS in bundle.tables
        self._sets = {
            level.number: SplatSet(level.splats, None, self._backend, ordered)
            for level in bundle.levels
            if level.number in numbers
        }
        self.loaded = sum(map(len, self._sets.values()))
        self._resident = region, numbers
