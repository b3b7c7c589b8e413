"""Array files that Blender and the renderer exchange, in addition to lines of JSON. numpy only.

A set of splats is one file of float32, column after column: means, quats, log-scales, opacity logits,
weights, extra columns for rules, coefficients. A frame is one file of float32, plane after plane, rows from
the top. The writer completes a file before it sends the line that names it, and never changes it
afterwards. Both sides read files by mapping them into memory. All are in one folder with a marker file;
without the marker, the renderer removes nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import name_errors
from ..splats.gaussians import Splats

PROTOCOL = 5
"""Version of the protocol. Both sides come from one installation, so other versions are refused."""

MARK = ".lodgs-renderer"
"""Marker file of a folder that belongs to a renderer and is removed with it."""

_WIDTHS = (3, 4, 3, 1, 1)
_TERMS = {1, 4, 9, 16, 25}


def claim_folder(folder: Path) -> None:
    """Create a folder for arrays, or use an empty or already claimed one, and mark it.

    Raises:
        LodgsError: the folder has other contents, or cannot be created.
    """
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if (folder / MARK).is_file():
            return
        if any(folder.iterdir()):
            raise LodgsError(
                f"Cannot use {folder} for the renderer: it is not empty, and its contents would be removed.",
                "Choose a folder that does not exist yet.",
            )
        (folder / MARK).write_text("This folder is removed when LODGS's renderer ends.\n", encoding="utf-8")
    except OSError as error:
        raise LodgsError(
            f"Cannot create {folder}: {error.strerror}.", "Choose a folder that does not exist yet."
        ) from error


def release_folder(folder: Path) -> None:
    """Remove a claimed folder and its files. Subfolders, and folders without the marker, stay."""
    with suppress(OSError):
        if (folder / MARK).is_file():
            for path in sorted(folder.iterdir(), key=lambda path: path.name == MARK):  # the marker last
                with suppress(OSError):
                    path.unlink()
            folder.rmdir()


def pack_set(splats: Splats, weights: np.ndarray | None) -> list[np.ndarray]:
    """Return the columns of a set in file order, float32, with extras; ``weights`` None means ones."""
    weights = np.ones(len(splats), np.float32) if weights is None else weights
    columns = (
        splats.means, splats.quats, splats.log_scales, splats.opacity_logits, weights,
        *splats.extras.values(), splats.sh,
    )  # fmt: skip
    return [np.ascontiguousarray(column, np.float32).reshape(-1) for column in columns]


def digest(columns: list[np.ndarray]) -> tuple[tuple[int, int], ...]:
    """Return the length and CRC of each column, to detect changes."""
    return tuple((len(column), zlib.crc32(column.data)) for column in columns)


def write_set(path: Path, columns: list[np.ndarray]) -> None:
    """Write the columns of :func:`pack_set`."""
    with name_errors(path), open(path, "wb") as file:
        for column in columns:
            file.write(column.data)


def read_set(path: Path, count: int, columns: Sequence[str] = ()) -> tuple[Splats, np.ndarray]:
    """Read a set's splats and weights.

    Args:
        columns: names of the extra columns in file order.

    Raises:
        LodgsError: the file does not exist, or does not contain ``count`` splats.
    """
    try:
        if not path.is_file():
            raise LodgsError(f"Cannot read the set of splats {path.name}: it does not exist.")
        mapped = _map_file(path)
    except (OSError, ValueError) as error:
        raise LodgsError(f"Cannot read the set of splats {path.name}: {error}.") from error
    widths = (*_WIDTHS, *[1] * len(columns))
    terms, remainder = divmod(mapped.size - count * sum(widths), 3 * max(count, 1))
    if remainder or (count and terms not in _TERMS) or (not count and mapped.size):
        raise LodgsError(f"Cannot read the set of splats {path.name}: it does not contain {count} splats.")
    values = np.array(mapped)
    parts = []
    begin = 0
    for width in widths:
        parts.append(values[begin : begin + count * width].reshape(count, width))
        begin += count * width
    means, quats, log_scales, logits, weights, *extra_columns = parts
    sh = values[begin:].reshape(count, terms if count else 1, 3)
    extras = {name: column[:, 0] for name, column in zip(columns, extra_columns, strict=True)}
    return Splats(means, quats, log_scales, logits[:, 0], sh, extras), weights[:, 0]


def write_planes(path: Path, planes: Sequence[np.ndarray]) -> None:
    """Write a frame, planes (H, W)."""
    with open(path, "wb") as file:
        for plane in planes:
            file.write(np.ascontiguousarray(plane, np.float32).data)


def read_planes(path: Path, planes: int, height: int, width: int) -> np.ndarray:
    """Read a frame, (planes, H, W) float32.

    Raises:
        ValueError: the file has another size.
    """
    return np.array(_map_file(path)).reshape(planes, height, width)


def _map_file(path: Path) -> np.ndarray:
    """Map the float32 numbers of a file into memory."""
    return np.memmap(path, np.float32, "r") if path.stat().st_size else np.empty(0, np.float32)
