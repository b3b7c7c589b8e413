"""Formats of splat files by their contents, to report files with the name of another format."""

from __future__ import annotations

import re
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path

from ..documents import open_file
from ..errors import LodgsError

_HEAD = 4096
"""First bytes of a file that are compared."""
_PLY, _SPZ, _SOG, _GLB = ("PLY", (".ply",)), ("SPZ", (".spz",)), ("SOG", (".sog",)), ("glTF", (".glb",))
_USDA, _USDC, _USDZ = ("USD", (".usda", ".usd")), ("USD", (".usdc", ".usd")), ("USD", (".usdz",))
_STARTS = {b"NGSP": _SPZ, b"glTF": _GLB, b"PXR-USDC": _USDC, b"#usda": _USDA}
"""Format and suffixes by the first bytes of a file."""


def check_name(path: Path) -> str:
    """Raise a LodgsError for checkpoints, and files with splats of another format than their name says.

    Formats without a signature, such as ``.splat``, are not recognised.

    Returns:
        The name of the format, or "" if it is not recognised.

    Raises:
        LodgsError: see above, or the file cannot be read.
    """
    if path.suffix.lower() in (".pt", ".pth", ".ckpt"):
        raise LodgsError(
            f"Cannot read {path}: it is a PyTorch checkpoint.", "Export a PLY with the program that wrote it."
        )
    with open_file(path) as file:
        head = file.read(_HEAD)
    if head.lstrip()[:1] == b"{" and b'"geometricError"' in head:
        raise LodgsError(
            f"Cannot read {path}: it is a tileset of 3D Tiles, which lists other files.",
            "Choose one of its .glb files, or the splats that it was exported from.",
        )
    name, suffixes = _recognise(path, head)
    if suffixes and not path.name.lower().endswith(suffixes):
        raise LodgsError(f"Cannot read {path}: its format is {name}.", f"Rename it to {suffixes[0]}.")
    return name


def _recognise(path: Path, head: bytes) -> tuple[str, tuple[str, ...]]:
    """Return the name of a file's format and its suffixes, the usual one first; empty if unknown."""
    if re.match(rb"ply[ \t]*[\r\n]", head):
        return _PLY
    with suppress(zlib.error):
        if zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, 4) == b"NGSP":
            return _SPZ
    if head.startswith(b"PK\3\4"):
        with suppress(Exception), open_file(path) as file, zipfile.ZipFile(file) as archive:
            names = archive.namelist()  # zipfile documents no exception types
            if "meta.json" in names:
                return _SOG
            if names[0].lower().endswith((".usd", ".usda", ".usdc")):
                return _USDZ
    return next((kind for start, kind in _STARTS.items() if head.startswith(start)), ("", ()))
