"""Splats on the graphics card: those that viewports draw, brought there when they are first needed.

Of all splats memory holds what choosing needs (the pool). The rest is read a piece at a time from Blender's
attributes, or from what has come from a file (``streaming``), for splats that are drawn and not there yet. On
the card they lie in a store somewhat larger than what is drawn: who comes takes the place of whoever has not
been drawn for the longest time.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf

import bpy
import gpu
import numpy as np

from ...training.editing.paint import mix_paint
from ...training.lod.rule import all_rule_columns
from .. import attributes
from ..data import changes, cleaning, painting
from . import splats
from .arranging import WIDTH, Pool
from .streaming import Stream, record_texels

PIECE = 1 << 13
"""Splats that are brought to the graphics card at a time."""
LEAST, SPARE, WASTE = 1 << 16, 1.25, 2.0
"""The smallest store, in splats; how much more than is drawn a new one holds; and from how much more on it
gives way to a smaller one."""

bytes_uploaded = 0
"""What was brought to the graphics card since Blender started, in bytes."""


Cloud = bpy.types.PointCloud | Stream
"""What has splats: Blender's, or a file of which what the eye needs is here."""


@dataclass
class Resident:
    """The splats of some point clouds, one cloud after the other.

    Attributes:
        pool: see there.
        starts, counts: where each cloud's splats begin, and how many they are.
        higher: how many coefficients beyond the first they have at most, of whole degrees up to 4.
        store: those on the graphics card; none as long as nothing was drawn.
        selected: (N,) bool, see :meth:`see_selection`; None where none is.
        painted: the paint (N, 4) of each cloud, by its place among them, that was seen last; see
            :meth:`see_paint`.
    """

    pool: Pool
    starts: list[int]
    counts: list[int]
    higher: int
    store: Store | None = None
    selected: np.ndarray | None = None
    painted: dict[int, tuple[changes.Version, np.ndarray | None]] = field(default_factory=dict)
    _selection: changes.Version | None = None

    @property
    def total(self) -> int:
        return len(self.pool.means)

    def hold(self, lists: Sequence[np.ndarray]) -> Store:
        """The store, in which from now on lists of splats (M,) keep their places, and others may lose theirs.

        It is anew and empty where it has no room for all of them, or far too much.
        """
        held = np.zeros(self.total, bool)
        for each in lists:
            held[each] = True
        orphans = 0 if self.store is None else len(self.store.orphans)
        wanted = int(np.count_nonzero(held)) + orphans
        room = min(max(round(SPARE * wanted), LEAST), self.total + orphans)
        if self.store is None or not wanted <= len(self.store.owners) <= WASTE * room:
            self.store = Store(self.total, room, self.higher)
        self.store.hold(held)
        return self.store

    def see_selection(self, clouds: Sequence[Cloud | None]) -> None:
        """Takes over which splats are selected, where others are since it was asked last."""
        if self._selection == (now := changes.selection()):
            return
        self._selection, found = now, np.zeros(self.total, bool)
        for start, count, cloud in zip(self.starts, self.counts, clouds, strict=True):
            if isinstance(cloud, bpy.types.PointCloud) and len(cloud.points) == count:
                found[start : start + count] = cleaning.shown_selected(cloud)
        self.selected = found if found.any() else None

    def see_paint(self, clouds: Sequence[Cloud | None]) -> None:
        """Brings what has been painted since it was asked last to where it is on the graphics card."""
        for number, cloud in enumerate(clouds):
            if not isinstance(cloud, bpy.types.PointCloud) or len(cloud.points) != self.counts[number]:
                continue
            version, before = self.painted.get(number, (None, None))
            if version == (now := changes.paint(cloud)):
                continue
            paint = painting.shown_paint(cloud)
            self.painted[number] = now, paint
            if version is None or self.store is None:
                continue
            nothing = np.zeros((1, 4), np.float32)
            others = (nothing if before is None else before) != (nothing if paint is None else paint)
            rows = np.flatnonzero(np.broadcast_to(others.any(axis=1), self.counts[number]))
            there = rows[self.store.places[self.starts[number] + rows] >= 0]
            for begin in range(0, len(there), PIECE):
                some = there[begin : begin + PIECE]
                self.store.renew(self.starts[number] + some, read_records(cloud, some, self.store.higher))

    def of_one_cloud(self, wanted: np.ndarray) -> int:
        """How many of some splats (M,), ascending, are of the first one's cloud."""
        number = self._cloud(wanted)
        return int(np.searchsorted(wanted, self.starts[number] + self.counts[number]))

    def read(self, clouds: Sequence[Cloud | None], wanted: np.ndarray) -> np.ndarray | None:
        """The records of splats (M,), ascending, of one cloud: see :func:`read_records`.

        Returns:
            None where the cloud is not what it was.
        """
        number = self._cloud(wanted)
        cloud = clouds[number]
        if cloud is None or count_of(cloud) != self.counts[number] or self.store is None:
            return None
        rows, texels = wanted - self.starts[number], record_texels(self.store.higher)
        if isinstance(cloud, Stream):
            return _as_wide(cloud.records[rows], texels)
        return read_records(cloud, rows, self.store.higher)

    def _cloud(self, wanted: np.ndarray) -> int:
        return int(np.searchsorted(self.starts, wanted[0], side="right")) - 1


class Store:
    """Textures with room for some of N splats, each a record of texels in a row.

    Attributes:
        places: (N,) int32 where each splat is; -1 where it is not there.
        owners: (room,) int32 which splat is at each place; -1 where none is.
        higher: how many coefficients beyond the first it has of each splat.
        orphans: (M,) places whose splats are no more, but may still be drawn.
        part: how many places each texture has.
        textures: WIDTH texels wide; each is made when it is first needed, so that no redraw waits for all.
    """

    def __init__(self, total: int, room: int, higher: int) -> None:
        most = gpu.capabilities.max_texture_size_get() * WIDTH
        self.part = max(-(-room // splats.PARTS), 1)
        while higher and record_texels(higher) * self.part > most:  # rather fewer harmonics than no splats
            higher = {24: 15, 15: 8, 8: 3}.get(higher, 0)
        self.places, self.owners = np.full(total, -1, np.int32), np.full(room, -1, np.int32)
        self.higher, self.orphans = higher, np.zeros(0, np.int32)
        self._drawn, self._now, self._filled = np.zeros(room, np.int32), 0, 0
        self.textures: list[gpu.types.GPUTexture | None] = [None] * -(-room // self.part)
        self._frames: list[gpu.types.GPUFrameBuffer | None] = [None] * len(self.textures)

    def hold(self, held: np.ndarray) -> None:
        """From now on these splats, (N,) bool, keep their places, and others may lose theirs."""
        self._now += 1
        there = self.owners >= 0
        there[there] = held[self.owners[there]]
        self._drawn[there] = self._drawn[self.orphans] = self._now

    def forget(self, splats_: np.ndarray) -> None:
        """Splats (M,) are others from now on. What there was of them stays until :meth:`release`."""
        places = self.places[splats_]
        places = places[places >= 0]
        self.places[splats_] = self.owners[places] = -1
        self.orphans = np.concatenate([self.orphans, places])

    def release(self) -> None:
        """Nobody draws any more what splats were before they were others."""
        self.orphans = self.orphans[:0]

    def missing(self, wanted: np.ndarray) -> np.ndarray:
        """Those of the wanted splats (M,) that are not there, ascending; copies want the same ones."""
        absent = np.zeros(len(self.places), bool)
        absent[wanted] = True
        absent &= self.places < 0
        return np.flatnonzero(absent).astype(np.int32)

    def put(self, splats_: np.ndarray, records: np.ndarray) -> None:
        """Gives splats (M,) places, which stay theirs as of those that are held.

        Args:
            records: (M, 4 * texels) float32.
        """
        places = self._free(len(splats_))
        gone = self.owners[places]
        gone = gone[gone >= 0]
        self.places[gone] = -1
        self.owners[places], self.places[splats_], self._drawn[places] = splats_, places, self._now
        self._write(places, records)

    def renew(self, splats_: np.ndarray, records: np.ndarray) -> None:
        """Gives splats (M,) that are there other records, (M, 4 * texels) float32."""
        places = self.places[splats_]
        order = np.argsort(places)
        self._write(places[order], records[order])

    def _write(self, places: np.ndarray, records: np.ndarray) -> None:
        """Brings records to places (M,), ascending."""
        global bytes_uploaded
        for number in range(places[0] // self.part, places[-1] // self.part + 1):
            begin, end = np.searchsorted(places, (number * self.part, (number + 1) * self.part))
            if begin < end:
                here = places[begin:end] - np.int32(number * self.part)
                splats.copy_records(*self._texture(number), here, records[begin:end])
        bytes_uploaded += records.nbytes

    def _texture(self, number: int) -> tuple[gpu.types.GPUFrameBuffer, gpu.types.GPUTexture]:
        """One of the textures, made where there is none yet."""
        texture, frame = self.textures[number], self._frames[number]
        if texture is None or frame is None:
            height = max(-(-record_texels(self.higher) * self.part // WIDTH), 1)
            texture = self.textures[number] = gpu.types.GPUTexture((WIDTH, height), format="RGBA32F")
            frame = self._frames[number] = gpu.types.GPUFrameBuffer(color_slots=texture)
        return frame, texture

    def _free(self, count: int) -> np.ndarray:
        """Places (M,), ascending: what was never used, then what was drawn longest ago."""
        if self._filled + count <= len(self.owners):
            self._filled += count
            return np.arange(self._filled - count, self._filled, dtype=np.int32)
        self._filled = len(self.owners)
        return np.sort(np.argpartition(self._drawn, count - 1)[:count]).astype(np.int32)


def count_of(cloud: Cloud) -> int:
    """How many splats there are, or room for them."""
    return len(cloud.records) if isinstance(cloud, Stream) else len(cloud.points)


def higher_of(cloud: Cloud) -> int:
    """How many coefficients beyond the first a cloud has, of whole degrees up to 4."""
    if isinstance(cloud, Stream):
        return cloud.higher
    return len(attributes.sh_names(cloud))


class Reading:
    """What choosing needs of the splats of point clouds, one cloud after the other, while it is being read:
    an attribute at a time, so that no redraw waits for all.

    What has come from files is taken over when something is arranged (``Pool.take_over``).
    """

    def __init__(self, clouds: Sequence[Cloud]) -> None:
        counts = [count_of(cloud) for cloud in clouds]
        starts = [sum(counts[:i]) for i in range(len(counts))]
        total = sum(counts)
        means, areas = np.zeros((total, 3), np.float32), np.zeros(total, np.float32)
        opacities = np.zeros(total, np.float32)
        columns = {name: np.zeros(total, np.float32) for name in all_rule_columns()}
        paged = [
            (start, each) for start, each in zip(starts, clouds, strict=True) if isinstance(each, Stream)
        ]
        pool = Pool(means, areas, opacities, columns, paged)
        self._resident = Resident(pool, starts, counts, max(map(higher_of, clouds), default=0))
        names = ("position", attributes.SCALE, attributes.BASE, *columns)
        self._left = [
            (number, name)
            for number, cloud in enumerate(clouds)
            for name in names
            if counts[number] and not isinstance(cloud, Stream)
        ]

    def go_on(self, clouds: Sequence[Cloud], until: float = inf) -> Resident | None:
        """Reads on, at least one attribute; None where there is more at a time (``time.monotonic``).

        Args:
            clouds: the same splats as at first. Blender may have moved them, so they are given anew.
        """
        pool, starts, counts = self._resident.pool, self._resident.starts, self._resident.counts
        while self._left:
            number, name = self._left.pop(0)
            part = slice(starts[number], starts[number] + counts[number])
            _read_attribute(pool, part, clouds[number], name)
            if self._left and time.monotonic() >= until:
                return None
        return self._resident


def _read_attribute(pool: Pool, part: slice, cloud: bpy.types.PointCloud, name: str) -> None:
    """Brings what an attribute of a cloud says of its splats into their part of a pool."""
    values = attributes.view_attribute(cloud, name)
    if values is None:
        return
    if name == "position":
        pool.means[part] = values
    elif name == attributes.SCALE:
        pool.areas[part] = np.einsum("ij,ij->i", values, values)
    elif name == attributes.BASE:
        pool.opacities[part] = values[:, 3]
        if (weights := attributes.view_attribute(cloud, attributes.WEIGHT)) is not None:
            pool.opacities[part] *= weights
    else:
        pool.columns[name][part] = values


def read_pool(clouds: Sequence[Cloud]) -> Resident:
    """All of :class:`Reading` at once."""
    found = Reading(clouds).go_on(clouds)
    assert found is not None
    return found


def read_records(cloud: bpy.types.PointCloud, rows: np.ndarray, higher: int) -> np.ndarray:
    """What the shader needs of splats (M,) of a cloud, (M, 4 * texels) float32.

    Mean, opacity, quaternion wxyz, standard deviations, and coefficients of the harmonics, three floats each.
    Weights that modifiers have given splats are factors on their opacities.
    """
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1:
        rows = slice(rows[0], rows[-1] + 1)  # type: ignore[assignment]  # a view, not a copy
    base = attributes.view_attribute(cloud, attributes.BASE)[rows]
    records = np.zeros((len(base), 4 * record_texels(higher)), np.float32)
    records[:, 0:3] = attributes.view_attribute(cloud, "position")[rows]
    records[:, 3] = base[:, 3]
    records[:, 4:8] = attributes.view_attribute(cloud, attributes.ROTATION)[rows]
    records[:, 8:11] = attributes.view_attribute(cloud, attributes.SCALE)[rows]
    records[:, 11:14] = base[:, :3]
    for k, name in enumerate(attributes.sh_names(cloud)[:higher]):
        place = 14 + 3 * k
        records[:, place : place + 3] = attributes.view_attribute(cloud, name)[rows]
    if (weights := attributes.view_attribute(cloud, attributes.WEIGHT)) is not None:
        records[:, 3] *= weights[rows]
    if (paint := painting.shown_paint(cloud, rows)) is not None:
        colors = records[:, 11 : 14 + 3 * higher].reshape(len(records), -1, 3)  # a view
        colors[:] = mix_paint(colors, paint)
    return records


def _as_wide(records: np.ndarray, texels: int) -> np.ndarray:
    """Records (M, any) with as many numbers as the store has, (M, 4 * texels): with fewer harmonics."""
    found = np.zeros((len(records), 4 * texels), np.float32)
    width = min(records.shape[1], 4 * texels)
    found[:, :width] = records[:, :width]
    return found
