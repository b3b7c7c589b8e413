"""What Blender and the renderer hand each other beside lines of JSON: arrays in files. numpy only.

A set of splats is one file of float32, column after column: means, quats, log-scales, opacity logits,
weights, further columns by which a rule chooses, coefficients. A frame is one file of float32, plane after
plane, rows from the top. Who writes a file finishes it before the line that names it is sent, and never
changes it afterwards; both sides read by mapping it into memory. All lie in one folder, which bears a mark:
without it the renderer removes nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..splats.gaussians import Splats

PROTOCOL = 2
"""Version of what is said; both sides come from one installation, so any other one is refused."""

MARK = ".lodgs-renderer"
"""The file that says that a folder is the renderer's, and goes when it ends."""

_WIDTHS = (3, 4, 3, 1, 1)
_TERMS = {1, 4, 9, 16, 25}


def claim_folder(folder: Path) -> None:
    """Makes a folder for arrays, or takes one that is empty or claimed already, and marks it.

    Raises:
        LodgsError: there is something else in it, or it cannot be made.
    """
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if (folder / MARK).is_file():
            return
        if any(folder.iterdir()):
            raise LodgsError(
                f"{folder} is not empty: the renderer would remove what lies in it.",
                "Name a folder that does not exist yet.",
            )
        (folder / MARK).write_text("This folder is removed when LODGS's renderer ends.\n", encoding="utf-8")
    except OSError as error:
        raise LodgsError(
            f"{folder} cannot be made: {error.strerror}.", "Name a folder that does not exist yet."
        ) from error


def release_folder(folder: Path) -> None:
    """Removes a claimed folder with the files in it; folders in it stay, and any folder without the mark."""
    with suppress(OSError):
        if (folder / MARK).is_file():
            for path in sorted(folder.iterdir(), key=lambda path: path.name == MARK):  # the mark at last
                with suppress(OSError):
                    path.unlink()
            folder.rmdir()


def pack_set(splats: Splats, weights: np.ndarray | None) -> list[np.ndarray]:
    """The columns of a set in the order of its file, float32, extras included; weights of None are ones."""
    ones = np.ones(len(splats), np.float32) if weights is None else weights
    columns = (
        splats.means, splats.quats, splats.log_scales, splats.opacity_logits, ones,
        *splats.extras.values(), splats.sh,
    )  # fmt: skip
    return [np.ascontiguousarray(column, np.float32).reshape(-1) for column in columns]


def digest(columns: list[np.ndarray]) -> tuple[tuple[int, int], ...]:
    """What tells whether columns are those of before without keeping them: each one's length and CRC."""
    return tuple((len(column), zlib.crc32(column.data)) for column in columns)


def write_set(path: Path, columns: list[np.ndarray]) -> None:
    """Writes what :func:`packed` returned."""
    with open(path, "wb") as file:
        for column in columns:
            file.write(column.data)


def read_set(path: Path, count: int, columns: Sequence[str] = ()) -> tuple[Splats, np.ndarray]:
    """A set's splats and weights.

    Args:
        columns: the names of its further columns, in their order; they become extras.

    Raises:
        LodgsError: the file is not there, or not one of ``count`` splats.
    """
    try:
        if not path.is_file():
            raise LodgsError(f"There is no set of splats {path.name}.")
        mapped = _mapped(path)
    except (OSError, ValueError) as error:
        raise LodgsError(f"The set of splats {path.name} cannot be read: {error}.") from error
    widths = (*_WIDTHS, *[1] * len(columns))
    rest, odd = divmod(mapped.size - count * sum(widths), 3 * max(count, 1))
    if odd or (count and rest not in _TERMS) or (not count and mapped.size):
        raise LodgsError(f"The set of splats {path.name} does not hold {count} splats.")
    values = np.array(mapped)
    parts, begin = [], 0
    for width in widths:
        parts.append(values[begin : begin + count * width].reshape(count, width))
        begin += count * width
    means, quats, log_scales, logits, weights, *further = parts
    sh = values[begin:].reshape(count, rest if count else 1, 3)
    extras = {name: column[:, 0] for name, column in zip(columns, further, strict=True)}
    return Splats(means, quats, log_scales, logits[:, 0], sh, extras), weights[:, 0]


def write_planes(path: Path, planes: Sequence[np.ndarray]) -> None:
    """Writes a frame, planes (H, W)."""
    with open(path, "wb") as file:
        for plane in planes:
            file.write(np.ascontiguousarray(plane, np.float32).data)


def read_planes(path: Path, planes: int, height: int, width: int) -> np.ndarray:
    """A frame, (planes, H, W) float32; ValueError where the file is not one of this size."""
    return np.array(_mapped(path)).reshape(planes, height, width)


def _mapped(path: Path) -> np.ndarray:
    """A file's numbers, as they lie in the system's cache."""
    return np.memmap(path, np.float32, "r") if path.stat().st_size else np.empty(0, np.float32)
