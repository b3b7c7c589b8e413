"""Splats in files that are read in batches of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .batches import BATCH_ROWS, batch_slices
from .coding import CodedRows
from .dialects import Warn, drop_undrawable, dropped_message, ignore, to_3dgs
from .gaussians import Splats
from .mapped_rows import release_pages, require_size
from .origin import NO_ORIGIN
from .ply import read_elements, splats_from_rows

_ROW = "row"
"""Extra column with each splat's row in the file."""


@dataclass(frozen=True)
class FileRows:
    """A level's splats in a file.

    Attributes:
        vertices: the 3DGS columns of each splat, structured.
        extras: the extra columns, structured, or None.
        path: path of the file.
        origin: (3,) local origin that is subtracted from the positions of a file of another program.
    """

    vertices: np.ndarray | CodedRows
    extras: np.ndarray | None
    path: str | Path
    origin: np.ndarray = field(default_factory=lambda: NO_ORIGIN)

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def row_size(self) -> int:
        """Number of bytes of a splat in the file."""
        vertices = self.vertices.codes if isinstance(self.vertices, CodedRows) else self.vertices
        return vertices.dtype.itemsize + (0 if self.extras is None else self.extras.dtype.itemsize)

    def columns(self, index: slice | np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Read the existing ones of the named columns, (M,) each, and nothing else.

        Raises:
            LodgsError: another program has truncated the file.
        """
        columns = {}
        for rows in (self.vertices, self.extras):
            if rows is None:
                continue
            require_size(rows, self.path)
            available = [name for name in names if name in (rows.dtype.names or ())]
            if isinstance(rows, CodedRows):
                decoded = np.asarray(rows[index])
                columns |= {name: decoded[name] for name in available}
            else:
                columns |= {name: np.array(rows[name][index]) for name in available}
            release_pages(rows)
        return columns

    def select(self, index: slice | np.ndarray) -> Splats:
        """Read splats, drawable or not, and keep nothing of the file in memory.

        Raises:
            LodgsError: another program has truncated the file, or see ``splats_from_rows``.
        """
        require_size(self.vertices, self.path)
        if self.extras is not None:
            require_size(self.extras, self.path)
        splats = splats_from_rows(self.vertices[index], self.path, self.origin)
        if self.extras is not None:
            extras = self.extras[index]
            splats.extras |= {column: np.array(extras[column]) for column in extras.dtype.names or ()}
        release_pages(self.vertices)
        if self.extras is not None:
            release_pages(self.extras)
        return splats


class DrawableRows:
    """The drawable splats of a file, converted to the meaning of the 3DGS columns.

    The constructor reads all splats once to find them.

    Args:
        warn: as for `read_ply`.
    """

    def __init__(self, rows: FileRows, warn: Warn = ignore) -> None:
        self._rows = rows
        self._drawable = None
        parts = []
        for batch in batch_slices(len(rows), BATCH_ROWS):
            splats = self._convert(batch, ignore if batch.start else warn)
            splats.extras = {_ROW: batch.start + np.arange(len(splats))}
            parts.append(drop_undrawable(splats, rows.path).extras[_ROW])
        missing = len(rows) - sum(map(len, parts))
        if missing:
            self._drawable = np.concatenate(parts)
            warn(dropped_message(missing, rows.path))

    def __len__(self) -> int:
        return len(self._rows) if self._drawable is None else len(self._drawable)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,)."""
        rows = index if self._drawable is None else self._drawable[index]
        return drop_undrawable(self._convert(rows), self._rows.path)

    def _convert(self, index: slice | np.ndarray, warn: Warn = ignore) -> Splats:
        splats = self._rows.select(index)
        return splats if self._rows.extras is not None else to_3dgs(splats, self._rows.path, warn)


def open_ply(path: str | Path) -> FileRows:
    """Open a plain PLY to read its splats in batches, without conversion.

    Raises:
        LodgsError: see ``read_elements``.
    """
    return FileRows(read_elements(path)[0]["vertex"], None, path)
