"""``.splat`` of antimatter15: 32 bytes per splat without a header, https://github.com/antimatter15/splat."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ...documents import open_file
from ...errors import LodgsError
from ...files import atomic_write
from ..batches import batch_slices
from ..gaussians import SH_C0, SplatRows, Splats
from ..mapped_rows import release_pages, require_size
from ..splat_format import SplatFormat

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, splats: SplatRows, meta: dict) -> None:
    """Write a ``.splat``: mean and scales, then 8 bits each of colour, opacity and a quaternion wxyz.

    The format has no place for the meta.

    Raises:
        LodgsError: the file cannot be written.
    """
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        for batch in map(splats.select, batch_slices(len(splats))):
            rows = np.empty(len(batch), _ROW)
            rows["mean"], rows["scale"] = batch.means, np.exp(batch.log_scales)
            opacity = 1 / (1 + np.exp(-batch.opacity_logits.astype(np.float64)))
            color = np.column_stack([0.5 + SH_C0 * batch.sh[:, 0], opacity])
            rows["rgba"] = (255 * color).round().clip(0, 255)
            lengths = np.linalg.norm(batch.quats, axis=1, keepdims=True)
            unit = batch.quats / np.where(lengths > 0, lengths, 1)
            rows["quat"] = (128 + 128 * unit).round().clip(0, 255)
            file.write(rows.data)


class SplatFile:
    """Rows of a ``.splat``, mapped into memory. Opacities of 0 and 255 become nearby ones with finite logits.

    Raises:
        LodgsError: the file cannot be read, or its last row is incomplete.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            if not size or size % _ROW.itemsize:
                problem = f"{size:,} bytes are not a multiple of {_ROW.itemsize}" if size else "it is empty"
                raise LodgsError(f"Cannot read {path}: {problem}.", "Export it again.")
            self._rows = np.memmap(file, _ROW, "r")

    def __len__(self) -> int:
        return len(self._rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,).

        Raises:
            LodgsError: another program has truncated the file.
        """
        require_size(self._rows, self._path)
        rows = np.array(self._rows[index])
        release_pages(self._rows)
        rgba = rows["rgba"].astype(np.float32) / 255
        opacity = rgba[:, 3].clip(0.25 / 255, 1 - 0.25 / 255)
        with np.errstate(divide="ignore", invalid="ignore"):  # dropped later, because they cannot be drawn
            log_scales = np.log(rows["scale"])
        return Splats(
            rows["mean"].copy(), rows["quat"].astype(np.float32) / 128 - 1, log_scales,
            np.log(opacity / (1 - opacity)), (rgba[:, None, :3] - 0.5) / np.float32(SH_C0),
        )  # fmt: skip


FORMAT = SplatFormat(
    ".splat",
    "Splat",
    "Small, for older web viewers. Colours do not depend on the view direction",
    (32.0,),
    max_degree=0,
    write=write_splat,
    read=lambda path: (SplatFile(path), {}),
)
