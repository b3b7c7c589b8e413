"""Splats in the files of other programs: smaller ones, and those that browsers load piece by piece.

PLY is ours, and so is ``.splat``, a documented row of 32 bytes without a header. SPZ, SOG, compressed PLY and
streamed levels change with their makers' versions: PlayCanvas' program splat-transform (MIT, from npm) reads
and writes them, and where it is missing a sentence says how to get it. No package for Python does so in
Blender: those that there are (gaussforge, gsply) are compiled for one version of Python each.
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
INSTALL = (
    "Install Node.js 22 or newer (nodejs.org), and in a terminal: npm install --global "
    "@playcanvas/splat-transform. Then start this program again."
)
# Where npm puts programs that a desktop's PATH lacks: Homebrew's and the installer's folders.
_FOLDERS = ("/opt/homebrew/bin", "/usr/local/bin")
_LOOK = 0.05
"""Seconds between two looks at a program at work."""
_ROUNDS = 3
"""Of clustering harmonics, where the processor does it (10 otherwise): a round takes as long as another, and
of 3,000 splats of degree 3 of a trained scene the colours were 0.3 % farther off after 3 than after 10."""
STREAMED = "lod-meta.json"
"""The file that streamed levels begin with, in a folder of their own."""


class Format(NamedTuple):
    """One kind of file for the splats of one level.

    Attributes:
        suffix: of such files.
        label, about: for people.
        bytes_of: of one splat, for each degree of spherical harmonics from 0 on. For the kinds that compress
            by content, what splats of trained scenes took (``docs/formats.md``).
        degree: the highest degree of spherical harmonics that it holds.
        shared: where splats share coefficients of spherical harmonics: how many sets of them there are at
            most, else a power of two.
        antialiased: whether it says that splats are drawn with Mip-Splatting's filter, to programs for it.
    """

    suffix: str
    label: str
    about: str
    bytes_of: tuple[float, ...]
    degree: int
    shared: int = 0
    antialiased: bool = False

    def size(self, count: int, degree: int) -> float:
        """About how many bytes so many splats take."""
        degree = min(degree, len(self.bytes_of) - 1)
        kept = min(1 << count.bit_length() - 1, self.shared) if count else 0
        return count * self.bytes_of[degree] + 0.88 * kept * _rest(degree)


def _rest(degree: int) -> int:
    """How many coefficients of spherical harmonics a degree has beyond the base colour."""
    return 3 * ((degree + 1) ** 2 - 1)


PLY = Format(
    ".ply", "PLY", "The original kind, for any viewer: nothing is lost",
    tuple(4.0 * (17 + _rest(degree)) for degree in range(5)), 4,
)  # fmt: skip
SPLAT = Format(
    ".splat", "Splat", "Small, for older viewers on the web: colours that do not change with the direction",
    (32.0,), 0,
)  # fmt: skip
FORMATS = (
    PLY,
    Format(
        ".compressed.ply", "Compressed PLY", "SuperSplat's and PlayCanvas' kind: a quarter of a PLY",
        tuple(16.3 + _rest(degree) for degree in range(4)), 3,
    ),
    Format(
        ".spz", "SPZ", "Niantic's kind, for phones, Cesium and glTF: a twelfth of a PLY",
        (17.0, 18.0, 18.0, 18.0), 3, antialiased=True,
    ),
    Format(
        ".sog", "SOG", "PlayCanvas' kind for the web, the smallest. Takes minutes without a graphics card",
        (13.0, 14.6, 14.6, 14.6), 3, 1 << 16,
    ),
    SPLAT,
)  # fmt: skip
READABLE = (".ply", ".spz", ".sog", ".splat", ".ksplat", STREAMED)
"""How the names of files end that are opened; those of :data:`STREAMED` are its whole name."""


def format_of(path: Path) -> Format:
    """The kind that a file's name asks for.

    Raises:
        LodgsError: it asks for none that is written.
    """
    found = [kind for kind in FORMATS if path.name.lower().endswith(kind.suffix)]
    if not found:
        endings = ", ".join(kind.suffix for kind in FORMATS)
        raise LodgsError(
            f"{path.name} is no kind of file that is written.", f"Choose an ending of {endings}."
        )
    return max(found, key=lambda kind: len(kind.suffix))


def write_splats(path: Path, splats: SplatRows, meta: dict) -> Iterator[str]:
    """Writes splats as the kind of file that the name asks for, and yields while another program is at it.

    Closed early, it leaves nothing behind.

    Args:
        meta: of the bundle that they are from.

    Yields:
        What the program says that it is doing.

    Raises:
        LodgsError: the file cannot be written, does not hold such splats, or the program is missing or fails.
    """
    kind = format_of(path)
    if kind is PLY:
        write_ply(path, splats, comments_from_meta(meta))
        return
    if kind is SPLAT:
        write_splat(path, splats)
        return
    degree = splats.select(slice(0, 0)).sh_degree
    if degree > kind.degree:
        raise LodgsError(
            f"{kind.label} holds spherical harmonics up to degree {kind.degree}, and these are of {degree}.",
            "Write them as PLY.",
        )
    program()  # before anything is written
    with tempfile.TemporaryDirectory(prefix="lodgs-") as folder:
        plain, made = Path(folder, "splats.ply"), Path(folder, f"made{kind.suffix}")
        write_ply(plain, splats, comments_from_meta(meta))
        yield from transformed([str(plain), str(made)])
        with atomic_write(path) as temporary:
            shutil.move(made, temporary)


def write_streamed(folder: Path, bundle: Bundle) -> Iterator[str]:
    """Writes levels as browsers load them by distance: ``lod-meta.json`` and the files that it names.

    Levels that show no splats, as crops may leave coarse ones, are left out: splat-transform takes none. What
    an earlier export has left there is replaced once all is made. Yields as :func:`write_splats`.

    Raises:
        LodgsError: as :func:`write_splats`; the folder holds something else, or no level has a splat.
    """
    there = folder / STREAMED
    shown = [
        level for level in bundle.levels if any(len(each.rows) for each in bundle.drawn_levels(level.number))
    ]
    if not shown:
        raise LodgsError("There are no splats to write.", "Show some of them.")
    bundle = replace(bundle, levels=shown)
    if folder.is_dir() and any(folder.iterdir()) and not there.exists():
        raise LodgsError(f"{folder} holds other files.", "Choose an empty folder, or a new one.")
    program()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(f"{folder} cannot be made: {error.strerror}.", "Choose another folder.") from error
    with tempfile.TemporaryDirectory(prefix=".lodgs-", dir=folder.parent) as beside:
        levels, made = Path(beside, "levels"), Path(beside, "made")
        write_folder(levels, bundle)
        yield from transformed([*lods_of(levels, len(bundle.levels)), str(made / STREAMED)])
        if folder.exists():
            folder.rename(Path(beside, "before"))
        made.rename(folder)


def lods_of(folder: Path, count: int) -> list[str]:
    """What tells splat-transform of the levels of a folder, ``lod0.ply`` the finest."""
    return [word for lod in range(count) for word in (str(folder / f"lod{lod}.ply"), "-l", str(lod))]


@contextmanager
def as_ply(path: Path) -> Iterator[Path]:
    """What a file holds as a PLY, or streamed levels as a folder of them: the file itself where it is a PLY
    or a folder, else one that is gone afterwards, of the same name.

    Raises:
        LodgsError: the file cannot be read, or the program for it is missing or fails.
    """
    if path.is_dir() and (path / STREAMED).is_file():
        path = path / STREAMED
    if path.is_dir() or is_ply(path):
        yield path
        return
    name = path.name.lower()
    open_file(path).close()  # says why it cannot be read
    stem = path.resolve().parent.name if name == STREAMED else path.stem.removesuffix(".compressed")
    with tempfile.TemporaryDirectory(prefix="lodgs-") as folder:
        made = Path(folder, f"{stem or 'splats'}.ply")
        if name == STREAMED:
            made = made.with_suffix("")
            for lod in range(_count_of_lods(path)):
                run(["-L", str(lod), str(path), str(made / f"lod{lod}.ply")])
        elif name.endswith(SPLAT.suffix):
            write_ply(made, read_splat(path))
        else:
            run([str(path), str(made)])
        yield made


def run(arguments: Sequence[str]) -> None:
    """Has splat-transform write a file, and waits for it; raises as :func:`transformed`."""
    for _ in transformed(arguments):
        pass


def transformed(arguments: Sequence[str]) -> Iterator[str]:
    """Has splat-transform write a file, its last argument, and yields what it says last while it is at it.

    What wants a graphics card is done on the processor where that fails. Closed early, the program ends.

    Raises:
        LodgsError: the program is missing, or fails.
    """
    command, said = program(), ""
    environment = os.environ | {"PATH": _path()}
    for device in ((), ("-g", "cpu", "-i", str(_ROUNDS))):
        with tempfile.TemporaryDirectory(prefix="lodgs-") as folder:
            log = Path(folder, "log")
            with open(log, "wb") as told:
                process = subprocess.Popen(
                    [command, "-w", "--no-tty", *device, *arguments],
                    stdin=subprocess.DEVNULL, stdout=told, stderr=told, env=environment,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )  # fmt: skip
            try:
                while process.poll() is None:
                    yield _last_line(log)
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(_LOOK)
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()
            if process.returncode == 0 and Path(arguments[-1]).exists():
                return
            said = log.read_text("utf-8", "replace")
    errors = [line.split("Error:")[-1] for line in said.splitlines() if "Error:" in line]
    how = f"ended with {process.returncode}: {(errors or [said[-200:]])[-1].strip()}"
    raise LodgsError(
        f"{PROGRAM} {how if process.returncode else 'wrote no file'}.",
        "Look whether its version is 3 or newer, and Node.js' 22 or newer.",
    )


def program() -> str:
    """Where splat-transform is.

    Raises:
        LodgsError: it is not installed.
    """
    found = shutil.which(PROGRAM, path=_path())
    if found is None:
        raise LodgsError(f"This takes the program {PROGRAM}, which is not installed.", INSTALL)
    return found


def _path() -> str:
    places = [os.environ.get("PATH", "")]
    return os.pathsep.join(places if sys.platform == "win32" else [*places, *_FOLDERS])


def _last_line(log: Path) -> str:
    """What a program has said last, without its marks."""
    lines = (line.strip(" ·▸") for line in reversed(log.read_text("utf-8", "replace").splitlines()))
    return next(filter(None, lines), "")


def is_ply(path: Path) -> bool:
    """Whether a file is read as it is: a PLY that is not compressed, or nothing that is known here.

    Raises:
        LodgsError: it cannot be read.
    """
    name = path.name.lower()
    if not name.endswith(PLY.suffix):
        return not name.endswith(READABLE)
    with open_file(path) as file:
        return b"packed_position" not in file.read(4096)


def _count_of_lods(path: Path) -> int:
    levels = read_json(path).get("lodLevels")
    if type(levels) is not int or not 1 <= levels <= MAX_READ_LEVELS:
        raise LodgsError(f"{path} is no description of streamed levels.", "Choose another file.")
    return levels


# antimatter15's .splat: https://github.com/antimatter15/splat, 32 bytes a splat, no header.
_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, splats: SplatRows) -> None:
    """Writes a ``.splat``: mean and scales, then 8 bits each of colour, opacity and a quaternion wxyz.

    Raises:
        LodgsError: the file cannot be written.
    """
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        for begin in range(0, len(splats), BATCH_ROWS):
            some = splats.select(slice(begin, begin + BATCH_ROWS))
            rows = np.empty(len(some), _ROW)
            rows["mean"], rows["scale"] = some.means, np.exp(some.log_scales)
            opacity = 1 / (1 + np.exp(-some.opacity_logits.astype(np.float64)))
            colour = np.column_stack([0.5 + SH_C0 * some.sh[:, 0], opacity])
            rows["rgba"] = (255 * colour).round().clip(0, 255)
            lengths = np.linalg.norm(some.quats, axis=1, keepdims=True)
            unit = some.quats / np.where(lengths > 0, lengths, 1)
            rows["quat"] = (128 + 128 * unit).round().clip(0, 255)
            file.write(rows.data)


def read_splat(path: Path) -> Splats:
    """Reads a ``.splat``; an opacity of 0 or 255 is the nearest one that has a logit within 8 bits.

    Raises:
        LodgsError: it cannot be read, or is no whole number of rows.
    """
    with open_file(path) as file:
        data = file.read()
    if not data or len(data) % _ROW.itemsize:
        raise LodgsError(
            f"{path} is damaged: {len(data):,} bytes are no rows of {_ROW.itemsize}.", "Export it again."
        )
    rows = np.frombuffer(data, _ROW)
    rgba = rows["rgba"].astype(np.float32) / 255
    opacity = rgba[:, 3].clip(0.25 / 255, 1 - 0.25 / 255)
    with np.errstate(divide="ignore", invalid="ignore"):  # left out as what cannot be drawn
        log_scales = np.log(rows["scale"])
    return Splats(
        rows["mean"].copy(), rows["quat"].astype(np.float32) / 128 - 1, log_scales,
        np.log(opacity / (1 - opacity)), (rgba[:, None, :3] - 0.5) / np.float32(SH_C0),
    )  # fmt: skip
