"""``.ksplat`` of mkkellogg's GaussianSplats3D (MIT), https://github.com/mkkellogg/GaussianSplats3D.

A header, headers of sections, and sections. A section has buckets of neighbouring splats, of which the last
ones are not full. From compression 1 on, positions are whole numbers relative to the center of their bucket.
"""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import IO

import numpy as np

from ..documents import open_file
from ..errors import LodgsError
from .gaussians import SH_C0, Splats
from .mapped_rows import release_pages, require_size

_HEADER = np.dtype({
    "names": ["version", "max_sections", "sections", "count", "compression", "sh_range"],
    "formats": [("u1", 2), "<u4", "<u4", "<u4", "<u2", ("<f4", 2)],
    "offsets": [0, 4, 8, 16, 20, 36],
    "itemsize": 4096,
})  # fmt: skip
_SECTION = np.dtype({
    "names": ["count", "capacity", "bucket_size", "buckets", "block", "bucket_bytes", "range", "full",
              "partial", "degree"],
    "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
    "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
    "itemsize": 1024,
})  # fmt: skip
_TYPES = ("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1")
"""Types of positions, of scales and rotations, and of SH coefficients for each compression."""
_SH_RANGE = 1.5
"""Magnitude of the largest SH coefficient at compression 2, if the header has no range."""
_RANGE = 32767
"""Largest distance from the center of a bucket, if the section has none."""
_MIN_SCALE = 2.0**-24
"""Smallest scale above 0 in half precision."""
_MAX_DEGREE = 3


class KsplatRows:
    """Splats of a ``.ksplat``, mapped into memory.

    Raises:
        LodgsError: the file cannot be read or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with open_file(path) as file:
            try:
                self._read(file, os.fstat(file.fileno()).st_size)
            except (ValueError, OverflowError) as error:
                raise LodgsError(f"Cannot read {path}: {error}.", "Export it again.") from error

    def _read(self, file: IO[bytes], size: int) -> None:
        """Read the headers, and map the sections.

        Raises:
            ValueError: the file is damaged.
        """
        if size < _HEADER.itemsize:
            raise ValueError("it is too short for a header")
        header = np.frombuffer(file.read(_HEADER.itemsize), _HEADER)[0]
        if tuple(header["version"]) < (0, 1) or header["version"][0] or header["compression"] >= len(_TYPES):
            version = ".".join(map(str, header["version"]))
            raise ValueError(f"version {version}, compression {header['compression']} is unknown")
        ends = header["sh_range"]
        self._sh_range = tuple(map(float, ends)) if ends.any() else (-_SH_RANGE, _SH_RANGE)
        count = int(header["max_sections"])
        begin = _HEADER.itemsize + count * _SECTION.itemsize
        if begin > size:
            raise ValueError(f"it is too short for {count:,} sections")
        heads = np.frombuffer(file.read(count * _SECTION.itemsize), _SECTION)
        self._sections = []
        for head in heads:
            section = _Section(file, head, int(header["compression"]), begin, size)
            self._sections.append(section)
            begin = section.end
        counts = [len(section.rows) for section in self._sections]
        self._begins = np.cumsum([0, *counts])
        self._degree = max((section.degree for section in self._sections), default=0)
        if self._begins[-1] != header["count"] or not header["count"]:
            raise ValueError(f"its sections have {self._begins[-1]:,} of {header['count']:,} splats")

    def __len__(self) -> int:
        return int(self._begins[-1])

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,).

        Raises:
            LodgsError: another program has truncated the file.
        """
        for section in self._sections:
            require_size(section.rows, self._path)
        rows = np.arange(len(self))[index]
        cuts = np.searchsorted(rows, self._begins)
        parts = [
            section.decode(rows[first:last] - begin, self._degree, self._sh_range)
            for section, begin, (first, last) in zip(
                self._sections, self._begins, pairwise(cuts), strict=False
            )
        ]
        return Splats.concatenated(parts)


class _Section:
    """Splats of one section.

    Args:
        begin: position of the section in the file.
        size: size of the file.

    Attributes:
        rows: the rows (N,) of the splats, structured.
        degree: SH degree.
        end: position of the end in the file.

    Raises:
        ValueError: the section exceeds the file, or contradicts itself.
    """

    def __init__(self, file: IO[bytes], head: np.void, compression: int, begin: int, size: int) -> None:
        count, capacity, buckets, full, partial, degree = (
            int(head[name]) for name in ("count", "capacity", "buckets", "full", "partial", "degree")
        )
        if degree > _MAX_DEGREE or count > capacity or full + partial > buckets:
            raise ValueError("the header of a section contradicts itself")
        self.degree, self._packed = degree, compression > 0
        position, half, harmonic = _TYPES[compression]
        row = np.dtype([
            ("mean", position, 3), ("scale", half, 3), ("quat", half, 4), ("rgba", "u1", 4),
            ("sh", harmonic, 3 * ((degree + 1) ** 2 - 1)),
        ])  # fmt: skip
        centers = begin + 4 * partial
        splats = centers + buckets * int(head["bucket_bytes"])
        self.end = splats + capacity * row.itemsize
        if self.end > size:
            raise ValueError(f"it is too short for {capacity:,} splats in a section")
        self.rows = np.memmap(file, row, "r", splats, count) if count else np.empty(0, row)
        if self._packed:
            if buckets and head["bucket_bytes"] != 12:
                raise ValueError(f"its buckets have {head['bucket_bytes']} bytes")
            file.seek(begin)
            lengths = np.frombuffer(file.read(4 * partial), "<u4")
            sizes = np.concatenate([np.full(full, head["bucket_size"], np.int64), lengths])
            self._ends = np.cumsum(sizes)
            if count > sizes.sum():
                raise ValueError(f"its buckets have fewer than {count:,} splats")
            self._centers = np.frombuffer(file.read(12 * buckets), "<f4").reshape(-1, 3)
            self._range = int(head["range"]) or _RANGE
            self._step = float(head["block"]) / 2 / self._range

    @np.errstate(over="ignore", invalid="ignore")  # such splats are dropped later
    def decode(self, index: np.ndarray, degree: int, sh_range: tuple[float, float]) -> Splats:
        """Return the splats of ascending rows (M,), with SH of a degree of at least the section's."""
        rows = np.array(self.rows[index])
        release_pages(self.rows)
        means = rows["mean"].astype(np.float32)
        if self._packed:
            center = self._centers[np.searchsorted(self._ends, index, side="right")]
            means = (center + (rows["mean"].astype(np.float64) - self._range) * self._step).astype(np.float32)
        rgba = rows["rgba"].astype(np.float32) / 255
        opacity = rgba[:, 3].clip(0.25 / 255, 1 - 0.25 / 255)
        sh = np.zeros((len(rows), (degree + 1) ** 2, 3), np.float32)
        sh[:, 0] = (rgba[:, :3] - 0.5) / np.float32(SH_C0)
        values = rows["sh"].astype(np.float32)
        if rows["sh"].dtype == np.uint8:
            low, high = sh_range
            values = np.float32(low) + values / 255 * np.float32(high - low)
        for order in range(1, self.degree + 1):  # of each degree all values of red, then green, then blue
            first, last = order**2, (order + 1) ** 2
            part = values[:, 3 * (first - 1) : 3 * (last - 1)].reshape(len(rows), 3, last - first)
            sh[:, first:last] = part.transpose(0, 2, 1)
        scales = np.maximum(rows["scale"].astype(np.float32), _MIN_SCALE)
        return Splats(
            means, rows["quat"].astype(np.float32), np.log(scales), np.log(opacity / (1 - opacity)), sh
        )
