"""Splat files of other programs. Each module of this package declares one format as ``FORMAT``.

``.ksplat``, ``.gltf``, ``.usd``, ``.usda`` and SOG in a folder are only read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from ...documents import open_file
from ...errors import LodgsError
from ...files import temporary_folder
from ..content import check_name
from ..dialects import comments_from_meta
from ..gaussians import SplatRows
from ..ksplat import KsplatRows
from ..ply import write_ply
from ..sog import META as SOG_FILE
from ..splat_format import NeedsTrainer, SplatFormat
from ..streamed_levels import STREAMED_FILE, read_streamed_levels
from .compressed_ply import FORMAT as COMPRESSED_PLY
from .glb import FORMAT as GLB
from .ply import FORMAT as PLY
from .sog import FORMAT as SOG
from .usdc import FORMAT as USDC

FORMATS: tuple[SplatFormat, ...] = tuple(
    sorted(
        (import_module(f"{__name__}.{module.name}").FORMAT for module in iter_modules(__path__)),
        key=lambda kind: (kind is not PLY, -kind.splat_bytes[-1], kind.suffix),
    )
)
"""Export formats: PLY, then by size, largest first."""
KSPLAT, GLTF = ".ksplat", ".gltf"
_ALIASES = {GLTF: GLB, ".usd": USDC, ".usda": USDC}
"""Formats by further suffixes of their files, which are only read."""
FILE_EXTENSIONS = (
    *(kind.suffix for kind in FORMATS if kind.readable and kind.suffix.rfind(".") == 0),
    KSPLAT,
    *_ALIASES,
)
"""Last parts of the names of readable files."""
LEVEL_FORMATS = tuple(kind for kind in FORMATS if kind.write_levels)
"""Formats of all levels in one file."""
MAIN_FILES = STREAMED_FILE, SOG_FILE
"""Names of readable files with other files in their folder."""
READABLE = (*FILE_EXTENSIONS, *MAIN_FILES)
"""Ends of the names of readable files."""
_HEADER = 1 << 16
"""Bytes that hold the header of a PLY, also with long comments."""
Convert = Callable[[Path, Path], None]
"""Function that converts a splat file to a bundle, whose path is the second argument."""


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


def write_splats(path: Path, splats: SplatRows, meta: dict) -> None:
    """Write splats in the format of the file name, which is not one of :data:`LEVEL_FORMATS`.

    Args:
        meta: meta of the splats' bundle.

    Raises:
        LodgsError: the file cannot be written, or the format does not support the splats.
    """
    kind = find_format(path)
    assert kind.write is not None, "it is a format of levels"
    kind.write(path, splats, meta)


def find_level_format(path: Path) -> SplatFormat:
    """Return the format of all levels for a file name.

    Raises:
        LodgsError: no format has the name's suffix.
    """
    for kind in LEVEL_FORMATS:
        if path.name.lower().endswith(kind.suffix):
            return kind
    suffixes = ", ".join(kind.suffix for kind in LEVEL_FORMATS)
    raise LodgsError(f"Cannot write levels as {path.name}: unsupported format.", f"Use one of {suffixes}.")


@contextmanager
def open_as_ply(path: Path, convert: Convert | None = None) -> Iterator[Path]:
    """Yield a PLY with the splats of a file, or a folder of PLYs with streamed levels.

    A PLY or a folder without one of :data:`MAIN_FILES` is yielded unchanged. Other files are converted to a
    temporary one of the same name: a bundle if they have levels.

    Args:
        convert: function for files that need a package which this Python lacks.

    Raises:
        NeedsTrainer: a package is missing, and there is no ``convert``.
        LodgsError: the file cannot be read.
    """
    if path.is_dir():
        path = next((path / name for name in MAIN_FILES if (path / name).is_file()), path)
    if path.is_dir() or is_plain_ply(path):
        yield path
        return
    name = path.name.lower()
    check_name(path)
    stem = path.resolve().parent.name if name in MAIN_FILES else path.stem.removesuffix(".compressed")
    with temporary_folder() as folder:
        converted = folder / f"{stem or 'splats'}.ply"
        try:
            converted = _convert(path, converted)
        except NeedsTrainer:
            if convert is None:
                raise
            convert(path, converted)
        yield converted


def _convert(path: Path, converted: Path) -> Path:
    """Convert a file to a PLY, or streamed levels to a folder, and return its path."""
    name = path.name.lower()
    if name == STREAMED_FILE:
        converted = converted.with_suffix("")
        read_streamed_levels(path, converted)
    elif (read_levels := _level_reader(name)) is not None:
        read_levels(path, converted)
    else:
        _read_plain(path, converted)
    return converted


def _level_reader(name: str) -> Callable[[Path, Path], None] | None:
    """Return the reader of files with levels for a name in lower case, or None."""
    kinds = {kind.suffix: kind for kind in LEVEL_FORMATS} | _ALIASES
    return next((kind.read_levels for suffix, kind in kinds.items() if name.endswith(suffix)), None)


def _read_plain(path: Path, converted: Path) -> None:
    """Convert a file of one level to a PLY."""
    name = path.name.lower()
    readers = {kind.suffix: kind.read for kind in FORMATS if kind.read}
    readers |= {PLY.suffix: COMPRESSED_PLY.read, KSPLAT: lambda path: (KsplatRows(path), {})}
    readers[SOG_FILE] = SOG.read
    read = next(read for suffix, read in readers.items() if read and name.endswith(suffix))
    splats, meta = read(path)
    write_ply(converted, splats, comments_from_meta(meta))


def is_plain_ply(path: Path) -> bool:
    """Return True if a file needs no conversion: an uncompressed PLY, or an unknown format.

    Raises:
        LodgsError: the file cannot be read.
    """
    name = path.name.lower()
    if not name.endswith(PLY.suffix):
        return not name.endswith(READABLE)
    with open_file(path) as file:
        return b"packed_position" not in file.read(_HEADER)
