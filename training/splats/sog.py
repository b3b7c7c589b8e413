"""PlayCanvas' SOG: the values of splats as the pixels of lossless WebP images.

Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/ (version 2).
Files of version 1 are only read. Reading needs Pillow, writing also scipy. Blender lacks both; the trainer
and the command line have them.
"""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable
from math import ceil, sqrt
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from ..documents import open_file, parse_json, read_bytes
from ..errors import LodgsError, printable
from ..files import atomic_write
from .coding import MAX_LOGIT
from .gaussians import SplatRows, Splats
from .morton import spatial_order
from .packed_files import MAX_PALETTE_PIXELS, check_sog_file
from .quats import join_quats, split_quats
from .sh import degree_from_count
from .splat_format import NeedsTrainer, require_degree

META = "meta.json"
"""Main file of a SOG, in an archive or in a folder with its images."""
MAX_DEGREE = 3
MAX_PALETTE = 1 << 16
"""Maximum number of sets of SH coefficients that splats share."""
_MAX_META, _MAX_FILE = 1 << 20, 1 << 30
"""Maximum bytes of the main file, whose codebooks take most of them, and of another file in a folder."""
_MIN_LOG_SCALE = -20.0
"""Minimum of stored scales; smaller ones would widen the steps of all."""
_ENTRIES = 256
"""Entries of a codebook for single values."""
_ROUNDS = 8
"""Rounds of k-means for codebooks and palettes."""
_ROW = 64
"""Sets of coefficients in a row of their image."""
_LARGEST = 252
"""Alpha of a rotation whose largest component is w; 253 to 255 for x, y and z."""


def load_packages() -> SimpleNamespace:
    """Return Pillow's image module and scipy's clustering functions.

    Raises:
        LodgsError: a package is missing.
    """
    try:
        from PIL import Image
        from scipy.cluster.vq import kmeans2, vq
    except ImportError as error:
        raise LodgsError(
            f"Cannot write SOG: a package of the trainer is missing ({error}).", "Install the trainer."
        ) from error
    return SimpleNamespace(Image=Image, kmeans2=kmeans2, vq=vq)


def write_sog(path: Path, splats: SplatRows, meta: dict) -> None:
    """Write splats as one SOG file.

    Args:
        meta: meta of the splats' bundle; the file stores whether it is antialiased.

    Raises:
        LodgsError: there are no splats, their SH degree is too high, the file cannot be written, or a package
            is missing.
    """
    if not len(splats):
        raise LodgsError("Cannot write SOG: there are no splats.", "Make some splats visible.")
    require_degree(splats, MAX_DEGREE, "SOG")
    values = splats.select(slice(0, len(splats)))
    antialias = bool(meta.get("antialias"))
    files = encode_sog(values.select(spatial_order(values.means)), antialias)
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data)  # without the time: equal splats give equal files


def encode_sog(splats: Splats, antialias: bool = False) -> dict[str, bytes]:
    """Return the files of a SOG by name; the splats keep their order.

    Neighbours in the order should be neighbours in space, because then images are smaller.

    Args:
        splats: N >= 1 splats with finite means, of SH degree 0 to :data:`MAX_DEGREE`.
        antialias: they are drawn with Mip-Splatting's filter.

    Raises:
        LodgsError: a package is missing.
    """
    packages = load_packages()
    count = len(splats)
    width = 4 * ceil(sqrt(count) / 4)
    height = 4 * ceil(count / width / 4)
    files: dict[str, bytes] = {}
    asset = {"generator": "LODGS"}
    meta: dict[str, Any] = {"version": 2, "asset": asset, "count": count, "antialias": antialias}

    def add(name: str, *channels: np.ndarray, size: tuple[int, int] = (width, height)) -> str:
        pixels = np.zeros((size[0] * size[1], 4), np.uint8)
        pixels[:, 3] = 255
        for i, channel in enumerate(channels):
            pixels[: len(channel), i] = channel
        target = io.BytesIO()
        image = packages.Image.fromarray(pixels.reshape(size[1], size[0], 4))
        image.save(target, "WEBP", lossless=True, exact=True, quality=50, method=3)
        files[name] = target.getvalue()
        return name

    stretched = np.sign(splats.means) * np.log1p(np.abs(splats.means.astype(np.float64)))
    low, high = stretched.min(axis=0), stretched.max(axis=0)
    codes = np.rint((stretched - low) * (65535 / np.maximum(high - low, 1e-12))).astype(np.uint16)
    names = [add("means_l.webp", *(codes & 255).T), add("means_u.webp", *(codes >> 8).T)]
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": names}

    table, scales = _codebook(splats.log_scales.clip(_MIN_LOG_SCALE))
    meta["scales"] = {"codebook": table.tolist(), "files": [add("scales.webp", *scales.T)]}
    largest, smaller = split_quats(splats.quats)
    channels = *np.rint(255 * smaller).T, _LARGEST + largest
    meta["quats"] = {"files": [add("quats.webp", *channels)]}
    table, colors = _codebook(splats.sh[:, 0])
    opacities = 255 / (1 + np.exp(-splats.opacity_logits.clip(-MAX_LOGIT, MAX_LOGIT).astype(np.float64)))
    meta["sh0"] = {
        "codebook": table.tolist(),
        "files": [add("sh0.webp", *colors.T, np.rint(opacities).astype(np.uint8))],
    }
    if splats.sh_degree:
        sets, labels = make_palette(splats.sh[:, 1:].reshape(count, -1))
        coefficients = splats.sh.shape[1] - 1
        table, codes = _codebook(sets)
        size = _ROW * coefficients, ceil(len(sets) / _ROW)
        names = [
            add("shN_centroids.webp", *codes.reshape(-1, 3).T, size=size),
            add("shN_labels.webp", labels & 255, labels >> 8),
        ]
        shared = {"count": len(sets), "bands": splats.sh_degree, "codebook": table.tolist()}
        meta["shN"] = {**shared, "files": names}
    return {META: json.dumps(meta).encode(), **files}


def read_sog(path: Path) -> tuple[Splats, dict]:
    """Read a ``.sog`` file, or a :data:`META` with its images beside it; return splats and meta.

    Raises:
        LodgsError: the file cannot be read, is damaged, or refers to files outside its folder, or Pillow is
            missing.
    """
    try:
        if path.suffix.lower() == ".json":
            return decode_sog(lambda name: read_bytes(_sibling(path, name), _MAX_FILE), path)
        check_sog_file(path)
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            return decode_sog(archive.read, path)
    except LodgsError:
        raise
    except Exception as error:  # zipfile documents no exception types
        raise sog_error(path, error) from error


def _sibling(main: Path, name: str) -> Path:
    """Return the path of a file of a SOG in a folder."""
    return main if name == META else main.with_name(*relative_parts(name))


def relative_parts(name: str) -> tuple[str, ...]:
    """Return the parts of a relative path.

    Raises:
        ValueError: it leaves the folder.
    """
    parts = tuple(name.split("/"))
    if any(part in ("", ".", "..") or set(part) & set("\\:") for part in parts):
        raise ValueError(f"{name!r} is not a path in the folder")
    return parts


def sog_error(path: Path, error: Exception) -> LodgsError:
    """Return the error for a damaged file."""
    reason = printable(f"{type(error).__name__}: {error}")[:300]
    return LodgsError(f"Cannot read {path}: it is damaged ({reason}).", "Export it again.")


def decode_sog(read: Callable[[str], bytes], path: Path = Path(META)) -> tuple[Splats, dict]:
    """Return the splats and the meta of the files of a SOG.

    Version 2 stores values as entries of a codebook. Version 1 has no version number and stores them as
    fractions of a range, opacities as logits.

    Args:
        read: function that returns the content of a file by name.
        path: path for messages.

    Raises:
        KeyError, ValueError, TypeError, IndexError, OSError, LodgsError: the files are damaged.
        NeedsTrainer: Pillow is missing.
    """
    image_module = _load_pillow()
    meta = parse_json(read(META), f"The file {META} of {path}", _MAX_META)
    if meta.get("version", 1) not in (1, 2):
        raise LodgsError(
            f"Cannot read {path}: it is SOG of version {printable(meta['version'])}.",
            "Export it as version 2 or as PLY.",
        )
    count = int(meta["count"] if "count" in meta else meta["means"]["shape"][0])

    def pixels(part: str, index: int = 0, size: int | None = count) -> np.ndarray:
        values = _read_image(image_module, read(meta[part]["files"][index]), count)
        if size is None:
            return values
        values = values.reshape(-1, 4)[:size]
        if len(values) != size:
            raise ValueError(f"an image is too small for {count:,} splats")
        return values

    low, high = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    codes = pixels("means", 0)[:, :3] + 256 * pixels("means", 1)[:, :3].astype(np.int64)
    stretched = low + codes * ((high - low) / 65535)
    colors = pixels("sh0")
    sh = _decode(meta["sh0"], colors[:, :3])[:, None]
    if "shN" in meta:
        palette = pixels("shN", 0, None)
        sets = _decode(meta["shN"], palette.reshape(-1, 4)[:, :3]).reshape(-1, palette.shape[1] // _ROW, 3)
        labels = pixels("shN", 1).astype(np.int64)
        sh = np.concatenate([sh, sets[labels[:, 0] + 256 * labels[:, 1]]], axis=1)
        degree_from_count(sh.shape[1])
    rotations = pixels("quats")
    quats = join_quats((rotations[:, 3].astype(np.int64) - _LARGEST).clip(0, 3), rotations[:, :3] / 255.0)
    logits = _decode_opacities(meta["sh0"], colors)
    with np.errstate(over="ignore"):  # such splats cannot be drawn, and are dropped later
        means = (np.sign(stretched) * np.expm1(np.abs(stretched))).astype(np.float32)
    splats = Splats(means, quats, _decode(meta["scales"], pixels("scales")[:, :3]), logits, sh)
    return splats, {"antialias": True} if meta.get("antialias") is True else {}


def _load_pillow() -> ModuleType:
    """Return Pillow's image module.

    Raises:
        NeedsTrainer: Pillow is missing.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise NeedsTrainer(
            f"Cannot read SOG: a package of the trainer is missing ({error}).", "Install the trainer."
        ) from error
    return Image


def _read_image(image_module: ModuleType, data: bytes, count: int) -> np.ndarray:
    """Return the pixels (H, W, 4) uint8 of a WebP or PNG image for ``count`` splats.

    Raises:
        ValueError: the image is too large.
    """
    with image_module.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
        width, height = image.size
        if width * height > max(2 * count, MAX_PALETTE_PIXELS):
            raise ValueError(f"an image has {width}x{height} pixels for {count:,} splats")
        return np.asarray(image.convert("RGBA"))


def _decode_opacities(part: dict, codes: np.ndarray) -> np.ndarray:
    """Return the logits (N,) of opacities, the fourth of the codes (N, 4) of colours."""
    if "codebook" not in part:
        return _decode(part, codes)[:, 3]
    opacities = (codes[:, 3] / 255).clip(1 / 1024, 1 - 1 / 1024)
    return np.log(opacities / (1 - opacities)).astype(np.float32)


def _decode(part: dict, codes: np.ndarray) -> np.ndarray:
    """Return the values (N, C) float32 of codes (N, C) uint8.

    Args:
        part: description of the values: a codebook, or in version 1 a range for all or each of the channels.
    """
    with np.errstate(over="ignore"):  # infinities are dropped later
        if "codebook" not in part:
            low, high = (np.atleast_1d(np.array(part[end], np.float64)) for end in ("mins", "maxs"))
            low, high = low[: codes.shape[1]], high[: codes.shape[1]]
            return (low + codes * ((high - low) / 255)).astype(np.float32)
        table = np.array(part["codebook"], np.float32)
    if np.isnan(table[0]):  # null, which splat-transform wrote for -infinity
        table[0] = table[1] + (table[1] - table[-1]) / 255
    return table[codes]


def _codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a table (256,) float32 for values of any shape and the code of each value, uint8.

    k-means of single values: the groups are ranges of the sorted values, so a round needs only their sums.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    even = np.linspace(ordered[0], ordered[-1], _ENTRIES)
    quantiles = ordered[np.linspace(0, len(ordered) - 1, _ENTRIES).astype(int)]
    table = (even + quantiles) / 2  # the ends of the range stay within reach
    for _ in range(_ROUNDS):
        ends = np.searchsorted(ordered, (table[1:] + table[:-1]) / 2)
        begins, ends = np.concatenate([[0], ends]), np.concatenate([ends, [len(ordered)]])
        counts = ends - begins
        means = (sums[ends] - sums[begins]) / np.maximum(counts, 1)
        table = np.sort(np.where(counts > 0, means, table))
    table = table.astype(np.float32)
    return table, np.searchsorted((table[1:] + table[:-1]) / 2, values).astype(np.uint8)


def make_palette(sets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at most :data:`MAX_PALETTE` sets (K, C) for sets (N, C), and the row (N,) uint16 of each.

    Sets are divided into groups by k-means, and each group gets a share of the palette: far fewer distances
    than with one k-means.
    """
    packages, count = load_packages(), len(sets)
    size = min(MAX_PALETTE, 1024 << max((count // 1024).bit_length() - 1, 0))
    sets = sets.astype(np.float32)
    if count <= size:
        return sets, np.arange(count, dtype=np.uint16)
    group_count = ceil(sqrt(size))
    groups = _cluster(packages, sets, group_count)[1]
    palette, labels, first = [], np.empty(count, np.uint16), 0
    order = np.argsort(groups, kind="stable")
    for rows in np.split(order, np.cumsum(np.bincount(groups))[:-1]):
        if not len(rows):
            continue
        share = 1 + (size - group_count) * (len(rows) - 1) // count  # together at most ``size``
        centers, members = _cluster(packages, sets[rows], share)
        palette.append(centers)
        labels[rows] = first + members
        first += len(centers)
    return np.concatenate(palette), labels


def _cluster(packages: SimpleNamespace, sets: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most ``count`` centers (K, C) of sets (N, C), and the center of each set (N,)."""
    if len(sets) <= count:
        return sets, np.arange(len(sets))
    starts = sets[np.linspace(0, len(sets) - 1, count).astype(int)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty cluster keeps its center
        centers, _ = packages.kmeans2(sets, starts, iter=_ROUNDS, minit="matrix", check_finite=False)
    return centers, packages.vq(sets, centers, check_finite=False)[0]
