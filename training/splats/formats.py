"""Splat files of other programs: smaller files, and levels that browsers stream.

LODGS itself reads and writes PLY and ``.splat``, which is a documented row of 32 bytes without a header. SPZ,
SOG, compressed PLY and streamed levels change with the versions of their programs, so PlayCanvas'
splat-transform (MIT, from npm) reads and writes them. The existing Python packages (gaussforge, gsply) do not
run in Blender, because they are compiled for one version of Python each.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..documents import open_file, read_json
from ..errors import LodgsError
from ..files import atomic_write
from .dialects import comments_from_meta
from .gaussians import SH_C0, SplatRows, Splats
from .level_folder import write_folder
from .levels import MAX_READ_LEVELS, Bundle
from .ply import BATCH_ROWS, write_ply

PROGRAM = "splat-transform"
INSTALL_HINT = (
    "Install Node.js 22 or newer (nodejs.org), then run in a terminal: npm install --global "
    "@playcanvas/splat-transform. Then restart this program."
)
# npm's program folders that a desktop's PATH lacks: those of Homebrew and of the installer.
_FOLDERS = ("/opt/homebrew/bin", "/usr/local/bin")
_POLL_SECONDS = 0.05
"""Interval between checks of the running program."""
_CPU_ROUNDS = 3
"""Rounds of clustering harmonics on the CPU, instead of 10. Time is proportional to rounds; on a trained
scene (3,000 splats of degree 3) the colour error after 3 rounds was 0.3 % larger than after 10."""
STREAMED_FILE = "lod-meta.json"
"""Main file of streamed levels, in a folder of their own."""


class SplatFormat(NamedTuple):
    """A file format for the splats of one level.

    Attributes:
        suffix: end of the file name.
        label: name in menus.
        about: tooltip in menus.
        splat_bytes: bytes per splat for each SH degree from 0 on. For formats that compress by content, these
            are averages of trained scenes (``docs/reference/formats.md``).
        max_degree: highest SH degree that the format stores.
        palette_size: maximum number of coefficient sets, a power of two, if splats share sets of SH
            coefficients; else 0.
        antialiased: True if the format stores that splats need Mip-Splatting's 2D filter.
    """

    suffix: str
    label: str
    about: str
    splat_bytes: tuple[float, ...]
    max_degree: int
    palette_size: int = 0
    antialiased: bool = False

    def size(self, count: int, degree: int) -> float:
        """Estimate the file size of splats in bytes."""
        degree = min(degree, len(self.splat_bytes) - 1)
        palette = min(1 << count.bit_length() - 1, self.palette_size) if count else 0
        return count * self.splat_bytes[degree] + 0.88 * palette * _higher_coefficients(degree)


def _higher_coefficients(degree: int) -> int:
    """Return the number of SH coefficients of three channels beyond the base colour."""
    return 3 * ((degree + 1) ** 2 - 1)


PLY = SplatFormat(
    ".ply", "PLY", "Original format for any viewer, without loss",
    tuple(4.0 * (17 + _higher_coefficients(degree)) for degree in range(5)), 4,
)  # fmt: skip
SPLAT = SplatFormat(
    ".splat", "Splat", "Small, for older web viewers. Colours do not depend on the view direction",
    (32.0,), 0,
)  # fmt: skip
FORMATS = (
    PLY,
    SplatFormat(
        ".compressed.ply", "Compressed PLY", "Format of SuperSplat and PlayCanvas, a quarter of a PLY's size",
        tuple(16.3 + _higher_coefficients(degree) for degree in range(4)), 3,
    ),
    SplatFormat(
        ".spz", "SPZ", "Niantic's format for phones, Cesium and glTF, a twelfth of a PLY's size",
        (17.0, 18.0, 18.0, 18.0), 3, antialiased=True,
    ),
    SplatFormat(
        ".sog", "SOG", "PlayCanvas' web format, the smallest. Slow without a graphics card",
        (13.0, 14.6, 14.6, 14.6), 3, 1 << 16,
    ),
    SPLAT,
)  # fmt: skip
READABLE = (".ply", ".spz", ".sog", ".splat", ".ksplat", STREAMED_FILE)
"""Ends of the names of readable files; :data:`STREAMED_FILE` is a complete name."""


def find_format(path: Path) -> SplatFormat:
    """Return the export format for a file name.

    Raises:
        LodgsError: no format has the name's suffix.
    """
    matches = [kind for kind in FORMATS if path.name.lower().endswith(kind.suffix)]
    if not matches:
        suffixes = ", ".join(kind.suffix for kind in FORMATS)
        raise LodgsError(f"Cannot write {path.name}: unsupported export format.", f"Use one of {suffixes}.")
    return max(matches, key=lambda kind: len(kind.suffix))


def write_splats(path: Path, splats: SplatRows, meta: dict) -> Iterator[str]:
    """Write splats in the format of the file name, and yield while splat-transform runs.

    A generator that is closed early leaves no files behind.

    Args:
        meta: meta of the splats' bundle.

    Yields:
        The program's last line of output.

    Raises:
        LodgsError: the file cannot be written, the format does not support the splats, or splat-transform is
            missing or fails.
    """
    kind = find_format(path)
    if kind is PLY:
        write_ply(path, splats, comments_from_meta(meta))
        return
    if kind is SPLAT:
        write_splat(path, splats)
        return
    degree = splats.select(slice(0, 0)).sh_degree
    if degree > kind.max_degree:
        raise LodgsError(
            f"Cannot write SH degree {degree} as {kind.label}: it supports degree 0 to {kind.max_degree}.",
            "Write a PLY instead.",
        )
    find_splat_transform()  # reports a missing program before files are written
    with tempfile.TemporaryDirectory(prefix="lodgs-") as folder:
        plain = Path(folder, "splats.ply")
        converted = Path(folder, f"converted{kind.suffix}")
        write_ply(plain, splats, comments_from_meta(meta))
        yield from splat_transform_steps([str(plain), str(converted)])
        with atomic_write(path) as temporary:
            shutil.move(converted, temporary)


def write_streamed_levels(folder: Path, bundle: Bundle) -> Iterator[str]:
    """Write levels that browsers stream by distance: ``lod-meta.json`` and its files.

    Levels without splats, which crops can leave, are omitted because splat-transform refuses them. An earlier
    export in the folder is replaced after all files are written. Yields as :func:`write_splats`.

    Raises:
        LodgsError: as :func:`write_splats`; or the folder has other files, or no level has splats.
    """
    levels = [
        level for level in bundle.levels if any(len(part.rows) for part in bundle.drawn_levels(level.number))
    ]
    if not levels:
        raise LodgsError("Cannot export levels: they contain no splats.", "Make some splats visible.")
    bundle = replace(bundle, levels=levels)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / STREAMED_FILE).exists():
        raise LodgsError(f"Cannot export to {folder}: it contains other files.", "Choose an empty folder.")
    find_splat_transform()  # reports a missing program before files are written
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(f"Cannot create {folder}: {error.strerror}.", "Choose another folder.") from error
    with tempfile.TemporaryDirectory(prefix=".lodgs-", dir=folder.parent) as temporary:
        plain = Path(temporary, "levels")
        converted = Path(temporary, "converted")
        write_folder(plain, bundle)
        arguments = level_arguments(plain, len(bundle.levels))
        yield from splat_transform_steps([*arguments, str(converted / STREAMED_FILE)])
        if folder.exists():
            folder.rename(Path(temporary, "previous"))
        converted.rename(folder)


def level_arguments(folder: Path, count: int) -> list[str]:
    """Return splat-transform's arguments for the levels of a folder, ``lod0.ply`` the finest."""
    return [word for lod in range(count) for word in (str(folder / f"lod{lod}.ply"), "-l", str(lod))]


@contextmanager
def open_as_ply(path: Path) -> Iterator[Path]:
    """Yield a PLY with the splats of a file, or a folder of PLYs with streamed levels.

    A PLY or a folder is yielded unchanged. Other files are converted to a temporary one of the same name.

    Raises:
        LodgsError: the file cannot be read, or splat-transform is missing or fails.
    """
    if path.is_dir() and (path / STREAMED_FILE).is_file():
        path = path / STREAMED_FILE
    if path.is_dir() or is_plain_ply(path):
        yield path
        return
    name = path.name.lower()
    open_file(path).close()  # reports an unreadable file
    stem = path.resolve().parent.name if name == STREAMED_FILE else path.stem.removesuffix(".compressed")
    with tempfile.TemporaryDirectory(prefix="lodgs-") as folder:
        converted = Path(folder, f"{stem or 'splats'}.ply")
        if name == STREAMED_FILE:
            converted = converted.with_suffix("")
            for lod in range(_count_lods(path)):
                run_splat_transform(["-L", str(lod), str(path), str(converted / f"lod{lod}.ply")])
        elif name.endswith(SPLAT.suffix):
            write_ply(converted, read_splat(path))
        else:
            run_splat_transform([str(path), str(converted)])
        yield converted


def run_splat_transform(arguments: Sequence[str]) -> None:
    """Run splat-transform to the end; raises as :func:`splat_transform_steps`."""
    for _ in splat_transform_steps(arguments):
        pass


def splat_transform_steps(arguments: Sequence[str]) -> Iterator[str]:
    """Run splat-transform, and yield its last line of output while it runs.

    A run that fails on the graphics card is repeated on the CPU. Closing the generator ends the program.

    Args:
        arguments: arguments of the program, the last of them the file to write.

    Raises:
        LodgsError: the program is missing or fails.
    """
    command = find_splat_transform()
    output = ""
    environment = os.environ | {"PATH": _search_path()}
    for device in ((), ("-g", "cpu", "-i", str(_CPU_ROUNDS))):
        with tempfile.TemporaryDirectory(prefix="lodgs-") as folder:
            log = Path(folder, "log")
            with open(log, "wb") as stream:
                process = subprocess.Popen(
                    [command, "-w", "--no-tty", *device, *arguments],
                    stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, env=environment,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )  # fmt: skip
            try:
                while process.poll() is None:
                    yield _last_line(log)
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(_POLL_SECONDS)
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()
            if process.returncode == 0 and Path(arguments[-1]).exists():
                return
            output = log.read_text("utf-8", "replace")
    errors = [line.split("Error:")[-1] for line in output.splitlines() if "Error:" in line]
    failure = f"exit code {process.returncode}: {(errors or [output[-200:]])[-1].strip()}"
    raise LodgsError(
        f"Cannot convert splats: {PROGRAM} failed ({failure if process.returncode else 'no output'}).",
        "Check that its version is 3 or newer, and the version of Node.js 22 or newer.",
    )


def find_splat_transform() -> str:
    """Return the path of splat-transform.

    Raises:
        LodgsError: it is not installed.
    """
    path = shutil.which(PROGRAM, path=_search_path())
    if path is None:
        raise LodgsError(f"Cannot convert splats: {PROGRAM} is not installed.", INSTALL_HINT)
    return path


def _search_path() -> str:
    folders = [os.environ.get("PATH", "")]
    return os.pathsep.join(folders if sys.platform == "win32" else [*folders, *_FOLDERS])


def _last_line(log: Path) -> str:
    """Return the last line of a log without progress symbols."""
    lines = (line.strip(" ·▸") for line in reversed(log.read_text("utf-8", "replace").splitlines()))
    return next(filter(None, lines), "")


def is_plain_ply(path: Path) -> bool:
    """Return True if a file needs no conversion: an uncompressed PLY, or an unknown format.

    Raises:
        LodgsError: the file cannot be read.
    """
    name = path.name.lower()
    if not name.endswith(PLY.suffix):
        return not name.endswith(READABLE)
    with open_file(path) as file:
        return b"packed_position" not in file.read(4096)


def _count_lods(path: Path) -> int:
    count = read_json(path).get("lodLevels")
    if type(count) is not int or not 1 <= count <= MAX_READ_LEVELS:
        raise LodgsError(f"Cannot read {path}: it does not describe streamed levels.", "Choose another file.")
    return count


# .splat of antimatter15: https://github.com/antimatter15/splat, 32 bytes a splat, no header.
_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, splats: SplatRows) -> None:
    """Write a ``.splat``: mean and scales, then 8 bits each of colour, opacity and a quaternion wxyz.

    Raises:
        LodgsError: the file cannot be written.
    """
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        for begin in range(0, len(splats), BATCH_ROWS):
            batch = splats.select(slice(begin, begin + BATCH_ROWS))
            rows = np.empty(len(batch), _ROW)
            rows["mean"], rows["scale"] = batch.means, np.exp(batch.log_scales)
            opacity = 1 / (1 + np.exp(-batch.opacity_logits.astype(np.float64)))
            colour = np.column_stack([0.5 + SH_C0 * batch.sh[:, 0], opacity])
            rows["rgba"] = (255 * colour).round().clip(0, 255)
            lengths = np.linalg.norm(batch.quats, axis=1, keepdims=True)
            unit = batch.quats / np.where(lengths > 0, lengths, 1)
            rows["quat"] = (128 + 128 * unit).round().clip(0, 255)
            file.write(rows.data)


def read_splat(path: Path) -> Splats:
    """Read a ``.splat``. Opacities of 0 and 255 become nearby ones with finite logits.

    Raises:
        LodgsError: the file cannot be read, or its last row is incomplete.
    """
    with open_file(path) as file:
        data = file.read()
    if not data or len(data) % _ROW.itemsize:
        raise LodgsError(
            f"Cannot read {path}: {len(data):,} bytes are not a multiple of {_ROW.itemsize}.",
            "Export it again.",
        )
    rows = np.frombuffer(data, _ROW)
    rgba = rows["rgba"].astype(np.float32) / 255
    opacity = rgba[:, 3].clip(0.25 / 255, 1 - 0.25 / 255)
    with np.errstate(divide="ignore", invalid="ignore"):  # dropped later, because they cannot be drawn
        log_scales = np.log(rows["scale"])
    return Splats(
        rows["mean"].copy(), rows["quat"].astype(np.float32) / 128 - 1, log_scales,
        np.log(opacity / (1 - opacity)), (rgba[:, None, :3] - 0.5) / np.float32(SH_C0),
    )  # fmt: skip
