"""Splats on the graphics card: only drawn splats are uploaded, when they are first needed.

The values for selection of all splats are in memory (the pool). Full records are read in batches from
Blender's attributes or from streamed files (``streaming``), for drawn splats that are not uploaded yet. The
store on the card is slightly larger than the drawn set; a new splat replaces the least recently drawn one.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf

import bpy
import gpu
import numpy as np

from ...training.editing.paint import COLUMNS as PAINT_COLUMNS
from ...training.editing.paint import mix_paint
from ...training.lod.rule import all_rule_columns
from .. import attributes
from ..data import changes, cleaning, painting
from .arrangement import WIDTH, Pool
from .records import (
    MEANS,
    OPACITIES,
    QUATS,
    SCALES,
    coefficients_of,
    empty_records,
    record_texels,
    resize_records,
)
from .shaders import MAX_TEXTURES
from .splats import copy_records
from .streaming import Stream

UPLOAD_BATCH = 1 << 13
"""Number of splats per upload."""
MIN_SLOTS = 1 << 16
"""Size of the smallest store."""
TEXTURE_BYTES = 1 << 29
"""Size of a texture from which a store has several: some drivers take long to create a large one."""
SPARE_FACTOR = 1.25
"""Size of a new store relative to the number of drawn splats."""
SHRINK_FACTOR = 2.0
"""Size relative to a new store at which a store is replaced by a smaller one."""

bytes_uploaded = 0
"""Number of uploaded bytes since Blender started."""


Cloud = bpy.types.PointCloud | Stream
"""Source of splats: a point cloud or a streamed file."""


@dataclass
class Resident:
    """Splats of several point clouds, concatenated.

    Attributes:
        pool: values for selection.
        starts, counts: first splat and number of splats of each cloud.
        higher: largest number of SH coefficients beyond the first, of whole degrees up to 4.
        store: splats on the graphics card; None before the first drawing.
        marks: (N,) uint8, see ``cleaning.displayed_marks``; None if no splat is marked.
        checksums: checksum by cloud number and attribute name; a stream has its ``id`` and an empty name.
        painted: version and paint (N, 4) of each cloud at the last :meth:`update_paint`, by cloud number.
    """

    pool: Pool
    starts: list[int]
    counts: list[int]
    higher: int
    store: Store | None = None
    marks: np.ndarray | None = None
    checksums: dict[tuple[int, str], int] = field(default_factory=dict)
    painted: dict[int, tuple[changes.Version, np.ndarray | None]] = field(default_factory=dict)
    _selection: changes.Version | None = None

    @property
    def total(self) -> int:
        return len(self.pool.means)

    def reserve(self, lists: Sequence[np.ndarray]) -> Store:
        """Return the store and keep these lists of splats (M,) in it; others may be replaced.

        If the store is too small or far too large, a new, empty one is returned.
        """
        used = np.zeros(self.total, bool)
        for indices in lists:
            used[indices] = True
        orphans = 0 if self.store is None else len(self.store.orphans)
        needed = int(np.count_nonzero(used)) + orphans
        slots = min(max(round(SPARE_FACTOR * needed), MIN_SLOTS), self.total + orphans)
        if self.store is None or not needed <= len(self.store.owners) <= SHRINK_FACTOR * slots:
            self.store = Store(self.total, slots, self.higher)
        self.store.keep(used)
        return self.store

    def update_marks(self, clouds: Sequence[Cloud | None]) -> None:
        """Update the marks if the displayed selection or clutter has changed."""
        version = changes.selection_version()
        if self._selection == version:
            return
        self._selection = version
        marks = np.zeros(self.total, np.uint8)
        for start, count, cloud in zip(self.starts, self.counts, clouds, strict=True):
            if isinstance(cloud, bpy.types.PointCloud) and len(cloud.points) == count:
                marks[start : start + count] = cleaning.displayed_marks(cloud)
        self.marks = marks if marks.any() else None

    def update_paint(self, clouds: Sequence[Cloud | None]) -> None:
        """Upload paint that has changed since the last call."""
        for number, cloud in enumerate(clouds):
            if not isinstance(cloud, bpy.types.PointCloud) or len(cloud.points) != self.counts[number]:
                continue
            previous_version, previous = self.painted.get(number, (None, None))
            version = changes.paint_version(cloud)
            if previous_version == version:
                continue
            paint = painting.displayed_paint(cloud)
            self.painted[number] = version, paint
            if previous_version is None or self.store is None:
                continue
            no_paint = np.zeros((1, 4), np.float32)
            changed = (no_paint if previous is None else previous) != (no_paint if paint is None else paint)
            rows = np.flatnonzero(np.broadcast_to(changed.any(axis=1), self.counts[number]))
            uploaded = rows[self.store.slots[self.starts[number] + rows] >= 0]
            for begin in range(0, len(uploaded), UPLOAD_BATCH):
                batch = uploaded[begin : begin + UPLOAD_BATCH]
                self.store.overwrite(
                    self.starts[number] + batch, read_records(cloud, batch, self.store.higher)
                )

    def count_in_first_cloud(self, indices: np.ndarray) -> int:
        """Return the number of splats (M,), ascending, that are in the same cloud as the first one."""
        number = self._cloud(indices)
        return int(np.searchsorted(indices, self.starts[number] + self.counts[number]))

    def read(self, clouds: Sequence[Cloud | None], indices: np.ndarray) -> np.ndarray | None:
        """Read the records of splats (M,), ascending, of one cloud, see :func:`read_records`.

        Returns:
            None if the cloud was removed or resized.
        """
        number = self._cloud(indices)
        cloud = clouds[number]
        if cloud is None or splat_count(cloud) != self.counts[number] or self.store is None:
            return None
        rows = indices - self.starts[number]
        if isinstance(cloud, Stream):
            return resize_records(cloud.records[rows], self.store.higher)
        return read_records(cloud, rows, self.store.higher)

    def _cloud(self, indices: np.ndarray) -> int:
        return int(np.searchsorted(self.starts, indices[0], side="right")) - 1


class Store:
    """Textures with slots for a part of N splats; a slot is a run of texels with one record.

    Attributes:
        slots: (N,) int32 slot of each splat; -1 if it is not uploaded.
        owners: (slots,) int32 splat in each slot; -1 if it is empty.
        higher: number of stored SH coefficients beyond the first.
        orphans: (M,) slots whose splats were replaced in the pool but may still be drawn.
        texture_slots: number of slots per texture.
        textures: WIDTH texels wide. Each is created on first use, so that no redraw waits for all of them.
    """

    def __init__(self, total: int, count: int, higher: int) -> None:
        max_texels = gpu.capabilities.max_texture_size_get() * WIDTH
        slots = max(-(-count // MAX_TEXTURES), TEXTURE_BYTES // (16 * record_texels(higher)))
        self.texture_slots = max(min(slots, count), 1)
        while higher and record_texels(higher) * self.texture_slots > max_texels:  # reduce the SH degree
            higher = {24: 15, 15: 8, 8: 3}.get(higher, 0)
        self.slots = np.full(total, -1, np.int32)
        self.owners = np.full(count, -1, np.int32)
        self.higher = higher
        self.orphans = np.zeros(0, np.int32)
        self._last_used = np.zeros(count, np.int32)
        self._time = 0
        self._filled = 0
        self.textures: list[gpu.types.GPUTexture | None] = [None] * -(-count // self.texture_slots)
        self._framebuffers: list[gpu.types.GPUFrameBuffer | None] = [None] * len(self.textures)

    def keep(self, used: np.ndarray) -> None:
        """Keep the splats of a mask (N,) bool in their slots; others may be replaced."""
        self._time += 1
        kept_slots = self.owners >= 0
        kept_slots[kept_slots] = used[self.owners[kept_slots]]
        self._last_used[kept_slots] = self._last_used[self.orphans] = self._time

    def invalidate(self, indices: np.ndarray) -> None:
        """Invalidate splats (M,) that the pool has replaced; their old records stay until :meth:`release`."""
        slots = self.slots[indices]
        slots = slots[slots >= 0]
        self.slots[indices] = self.owners[slots] = -1
        self.orphans = np.concatenate([self.orphans, slots])

    def release(self) -> None:
        """Release the records of replaced splats, which no viewport draws any more."""
        self.orphans = self.orphans[:0]

    def missing(self, indices: np.ndarray) -> np.ndarray:
        """Return the splats that are not uploaded, ascending and without the duplicates of (M,) indices."""
        mask = np.zeros(len(self.slots), bool)
        mask[indices] = True
        mask &= self.slots < 0
        return np.flatnonzero(mask).astype(np.int32)

    def insert(self, indices: np.ndarray, records: np.ndarray) -> None:
        """Upload splats (M,) to free slots and keep them like those of :meth:`keep`.

        Args:
            records: (M, 4 * texels) float32.
        """
        slots = self._free_slots(len(indices))
        replaced = self.owners[slots]
        replaced = replaced[replaced >= 0]
        self.slots[replaced] = -1
        self.owners[slots] = indices
        self.slots[indices] = slots
        self._last_used[slots] = self._time
        self._write(slots, records)

    def overwrite(self, indices: np.ndarray, records: np.ndarray) -> None:
        """Replace the records of uploaded splats (M,) by (M, 4 * texels) float32."""
        slots = self.slots[indices]
        order = np.argsort(slots)
        self._write(slots[order], records[order])

    def _write(self, slots: np.ndarray, records: np.ndarray) -> None:
        """Upload records to slots (M,), ascending."""
        global bytes_uploaded
        size = self.texture_slots
        for number in range(slots[0] // size, slots[-1] // size + 1):
            begin, end = np.searchsorted(slots, (number * size, (number + 1) * size))
            if begin < end:
                local = slots[begin:end] - np.int32(number * size)
                copy_records(*self._texture(number), local, records[begin:end])
        bytes_uploaded += records.nbytes

    def _texture(self, number: int) -> tuple[gpu.types.GPUFrameBuffer, gpu.types.GPUTexture]:
        """Return a texture with its framebuffer; create them on first use."""
        texture, frame = self.textures[number], self._framebuffers[number]
        if texture is None or frame is None:
            height = max(-(-record_texels(self.higher) * self.texture_slots // WIDTH), 1)
            texture = self.textures[number] = gpu.types.GPUTexture((WIDTH, height), format="RGBA32F")
            frame = self._framebuffers[number] = gpu.types.GPUFrameBuffer(color_slots=texture)
        return frame, texture

    def _free_slots(self, count: int) -> np.ndarray:
        """Return slots (M,), ascending: empty ones first, then the least recently drawn."""
        if self._filled + count <= len(self.owners):
            self._filled += count
            return np.arange(self._filled - count, self._filled, dtype=np.int32)
        self._filled = len(self.owners)
        return np.sort(np.argpartition(self._last_used, count - 1)[:count]).astype(np.int32)


def splat_count(cloud: Cloud) -> int:
    """Return the number of splats of a cloud, or of slots of a stream."""
    return len(cloud.records) if isinstance(cloud, Stream) else len(cloud.points)


def higher_count(cloud: Cloud) -> int:
    """Return the number of SH coefficients beyond the first, of whole degrees up to 4."""
    if isinstance(cloud, Stream):
        return cloud.higher
    return len(attributes.sh_names(cloud))


class PoolReader:
    """Reader of a pool, one attribute of one point cloud at a time, so that no redraw waits for all of them.

    Checksums come first: an undo makes Blender report unchanged points as changed. If all are unchanged, the
    reader returns the previous splats. Streamed splats are copied later, by ``Pool.apply_updates``.

    Args:
        previous: splats that were read before from the same clouds in the same order, if any.
    """

    def __init__(self, clouds: Sequence[Cloud], previous: Resident | None = None) -> None:
        counts = [splat_count(cloud) for cloud in clouds]
        starts = [sum(counts[:i]) for i in range(len(counts))]
        higher = max(map(higher_count, clouds), default=0)
        if previous is not None and (counts, higher) != (previous.counts, previous.higher):
            previous = None
        self._previous = previous
        self._checksums = {(i, ""): id(cloud) for i, cloud in enumerate(clouds) if isinstance(cloud, Stream)}
        self._layout = starts, counts, higher
        self._resident: Resident | None = None
        names = ("position", attributes.SCALE, attributes.BASE, *all_rule_columns())
        self._attributes = [
            (number, name)
            for number, cloud in enumerate(clouds)
            for name in names
            if counts[number] and not isinstance(cloud, Stream)
        ]
        self._unchecked = [
            *self._attributes,
            *(
                (number, name)
                for number in dict(self._attributes)
                for name in (
                    attributes.ROTATION,
                    attributes.WEIGHT,
                    *attributes.sh_names(clouds[number]),
                    *PAINT_COLUMNS,
                )
            ),
        ]

    def advance(self, clouds: Sequence[Cloud], until: float = inf) -> Resident | None:
        """Read at least one attribute, and further ones until a time (``time.monotonic``).

        Args:
            clouds: the clouds of the constructor; Blender may have moved them in memory.

        Returns:
            None if attributes remain.
        """
        while self._unchecked:
            number, name = self._unchecked.pop(0)
            self._checksums[number, name] = _checksum(clouds[number], name)
            if self._unchecked and time.monotonic() >= until:
                return None
        if self._previous is not None and self._checksums == self._previous.checksums:
            return self._previous
        if self._resident is None:
            self._resident = self._allocate(clouds)
        pool, starts, counts = self._resident.pool, self._resident.starts, self._resident.counts
        while self._attributes:
            number, name = self._attributes.pop(0)
            rows = slice(starts[number], starts[number] + counts[number])
            _read_attribute(pool, rows, clouds[number], name)
            if self._attributes and time.monotonic() >= until:
                return None
        return self._resident

    def _allocate(self, clouds: Sequence[Cloud]) -> Resident:
        """Return splats without values."""
        starts, counts, higher = self._layout
        total = sum(counts)
        means = np.zeros((total, 3), np.float32)
        areas = np.zeros(total, np.float32)
        opacities = np.zeros(total, np.float32)
        columns = {name: np.zeros(total, np.float32) for name in all_rule_columns()}
        paged = [
            (start, cloud) for start, cloud in zip(starts, clouds, strict=True) if isinstance(cloud, Stream)
        ]
        pool = Pool(means, areas, opacities, columns, paged)
        return Resident(pool, starts, counts, higher, checksums=self._checksums)


def _checksum(cloud: bpy.types.PointCloud, name: str) -> int:
    """Return the checksum of a cloud's attribute; -1 if it is missing."""
    values = attributes.view_attribute(cloud, name)
    return -1 if values is None else zlib.crc32(values)


def _read_attribute(pool: Pool, rows: slice, cloud: bpy.types.PointCloud, name: str) -> None:
    """Copy an attribute of a cloud to its rows of a pool."""
    values = attributes.view_attribute(cloud, name)
    if values is None:
        return
    if name == "position":
        pool.means[rows] = values
    elif name == attributes.SCALE:
        pool.areas[rows] = np.einsum("ij,ij->i", values, values)
    elif name == attributes.BASE:
        pool.opacities[rows] = values[:, 3]
        if (weights := attributes.view_attribute(cloud, attributes.WEIGHT)) is not None:
            pool.opacities[rows] *= weights
    else:
        pool.columns[name][rows] = values


def read_records(cloud: bpy.types.PointCloud, rows: np.ndarray, higher: int) -> np.ndarray:
    """Return the records (M, 4 * texels) float32 of splats (M,) of a cloud, see ``records``.

    Opacities are multiplied by the weights that modifiers have set.
    """
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1:
        rows = slice(rows[0], rows[-1] + 1)  # type: ignore[assignment]  # a view, not a copy
    base = attributes.view_attribute(cloud, attributes.BASE)[rows]
    records = empty_records(len(base), higher)
    records[:, MEANS] = attributes.view_attribute(cloud, "position")[rows]
    records[:, OPACITIES] = base[:, 3]
    records[:, QUATS] = attributes.view_attribute(cloud, attributes.ROTATION)[rows]
    records[:, SCALES] = attributes.view_attribute(cloud, attributes.SCALE)[rows]
    coefficients = coefficients_of(records, higher)
    coefficients[:, 0] = base[:, :3]
    for k, name in enumerate(attributes.sh_names(cloud)[:higher], 1):
        coefficients[:, k] = attributes.view_attribute(cloud, name)[rows]
    if (weights := attributes.view_attribute(cloud, attributes.WEIGHT)) is not None:
        records[:, OPACITIES] *= weights[rows]
    if (paint := painting.displayed_paint(cloud, rows)) is not None:
        coefficients[:] = mix_paint(coefficients, paint)
    return records
