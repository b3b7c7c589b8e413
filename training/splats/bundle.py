"""Levels of detail in files: one PLY that ordinary viewers open (the bundle), or a folder of plain PLYs.

``docs/bundle.md`` specifies both. Constraints that a method applies outside the parameters (FLoD's s_min, the
filters of Mip-Splatting and LODGE) are part of the scales and opacities handed over here: ``log_scales`` are
final, and ``s_min`` is a record of how they came about.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import atomic_write
from .gaussians import Splats
from .ply import Element, columns_of, columns_of_extras, read_elements, read_ply, splats_from, write_elements

FORMAT_VERSION = 1
ORDERS = ("finest_first", "stream")
_TAG = "lodsplat "
# Some viewers search the whole header for these words, so no comment may hold one.
_FORBIDDEN = ("packed_", "f_rest_", "end_header", "element chunk")
# Some viewers read no further than 10 KB to find the end of the header.
_MAX_COMMENTS = 2560
# What readers rely on of meta.
_META_SHAPES = {
    "camera_center": (3,), "up_rotation": (3, 3), "gamma": (), "focal_px": (), "d_max": (),
}  # fmt: skip


@dataclass
class Level:
    """One level of detail.

    Attributes:
        number: 1 is the coarsest.
        splats: the level's splats with final scales and opacities.
        s_min: the smallest standard deviation that training allowed, in scene units (FLoD, Eq. 3); None where
            the method has none.
    """

    number: int
    splats: Splats
    s_min: float | None = None


@dataclass
class Bundle:
    """Levels of detail of one scene.

    Attributes:
        method: the name of the method that made them ("flod", "3dgs", ...; "" when unknown).
        levels: in ascending number, all of one SH degree.
        meta: further facts, of types that JSON knows (numpy scalars and arrays are converted).
        cumulative: False when each level replaces the others; True when each level only holds what it adds to
            the coarser ones, so that level n is drawn as levels 1 to n together.
    """

    method: str
    levels: list[Level]
    meta: dict = field(default_factory=dict)
    cumulative: bool = False


@dataclass(frozen=True)
class Facts:
    """What a file says of its levels, without their splats; attributes as in `Bundle`.

    Attributes:
        numbers: the levels' numbers in ascending order.
    """

    method: str
    numbers: list[int]
    meta: dict = field(default_factory=dict)
    cumulative: bool = False


def write_bundle(path: str | Path, bundle: Bundle, order: str = "finest_first") -> None:
    """Write all levels into one PLY whose first element ``vertex`` is a complete, plain 3DGS scene.

    ``order`` says which level is ``vertex``: the finest ("finest_first"), or the coarsest ("stream", where a
    reader that stops after any level has a complete scene). A cumulative bundle has one ``vertex``, coarse to
    fine, in either order.

    Raises:
        LodgsError: the file cannot be written, or the bundle is not one (see `Bundle`), or meta is too long.
    """
    if order not in ORDERS:
        raise ValueError(f"order is {order!r}, not one of {ORDERS}")
    _check(bundle)
    levels = list(enumerate(reversed(bundle.levels)))  # lod 0 is the finest
    if order == "stream" or bundle.cumulative:
        levels.reverse()
    if bundle.cumulative:
        elements = [Element("vertex", [columns_of(level.splats) for _, level in levels])]
    else:
        names = ["vertex", *(f"lod_{lod}_vertex" for lod, _ in levels[1:])]
        elements = [
            Element(name, [columns_of(level.splats)]) for name, (_, level) in zip(names, levels, strict=True)
        ]
    extras = {
        lod: Element(f"lod_extra_{lod}", [columns])
        for lod, level in levels
        if (columns := columns_of_extras(level.splats))
    }
    comments = [_comment(_head(bundle, order=order, cumulative=bundle.cumulative))]
    offset = 0
    for i, (lod, level) in enumerate(levels):
        element = elements[0 if bundle.cumulative else i]
        facts = _facts(lod, level) | {"element": element.name, "offset": offset}
        if lod in extras:
            facts["extras"] = extras[lod].name
        comments.append(_comment(facts))
        offset += len(level.splats) * element.dtype.itemsize
    comments.append(_comment({"meta": bundle.meta}))
    if sum(len(comment) + 9 for comment in comments) > _MAX_COMMENTS:
        raise LodgsError(
            f"The facts beside the levels of {path} take more than {_MAX_COMMENTS} bytes of header.",
            "Keep meta to a few numbers and names.",
        )
    write_elements(path, [*elements, *extras.values()], comments)


def read_bundle(path: str | Path) -> Bundle:
    """Read a bundle as it was written, bit for bit; any other 3DGS PLY reads as one level of unknown method.

    Elements and comments that are not ours are passed over.

    Raises:
        LodgsError: not a PLY of splats, cut short, from a newer version, or a header that contradicts itself.
    """
    elements, comments = read_elements(path)
    head, facts = _parse(comments, path)
    if head is None:
        return Bundle("", [Level(1, splats_from(elements["vertex"], path))])
    try:
        levels = []
        begin = dict.fromkeys(elements, 0)
        for fact in facts:
            if "level" not in fact:
                continue
            name, count = fact["element"], fact["count"]
            rows = elements[name][begin[name] : begin[name] + count]
            begin[name] += count
            splats = splats_from(rows, path)
            extras = elements[fact["extras"]] if "extras" in fact else None
            if len(rows) != count or (extras is not None and len(extras) != count):
                raise ValueError(f"level {fact['level']} should have {count} splats")
            if extras is not None:
                splats.extras |= {column: np.array(extras[column]) for column in extras.dtype.names or ()}
            levels.append(_level(fact, splats))
        levels.sort(key=lambda level: level.number)
        return Bundle(head.method, levels, head.meta, head.cumulative)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _contradiction(path, error) from error


def read_facts(path: str | Path) -> Facts:
    """What a bundle says of its levels, in the time that its header takes: splats stay in the file.

    Any other 3DGS PLY is one level of unknown method.

    Raises:
        LodgsError: as `read_bundle`.
    """
    return _parse(read_elements(path)[1], path)[0] or Facts("", [1])


def write_folder(folder: str | Path, bundle: Bundle) -> str:
    """Write every level as a complete plain PLY, ``lod0.ply`` the finest, and ``manifest.json``.

    All files have the same columns, as splat-transform wants it: extras that not every level has are left
    out. The manifest is moved into place last.

    Returns:
        The command line that makes streamed LOD for the web of the folder with splat-transform.

    Raises:
        LodgsError: as `write_bundle`.
    """
    _check(bundle)
    folder = Path(folder)
    first = columns_of_extras(bundle.levels[0].splats)
    shared = {
        name
        for name, column in first.items()
        if all(name in x.splats.extras and x.splats.extras[name].dtype == column.dtype for x in bundle.levels)
    }
    manifest = _head(bundle) | {"levels": [], "meta": bundle.meta}
    command = ["splat-transform"]
    with ExitStack() as stack:
        manifest_file = stack.enter_context(atomic_write(folder / "manifest.json"))
        for lod, level in enumerate(reversed(bundle.levels)):
            path = folder / f"lod{lod}.ply"
            temporary = stack.enter_context(atomic_write(path))
            drawn = [
                x for x in bundle.levels if x is level or (bundle.cumulative and x.number < level.number)
            ]
            parts = [
                columns_of(x.splats) | {name: x.splats.extras[name] for name in sorted(shared)} for x in drawn
            ]
            element = Element("vertex", parts)
            write_elements(temporary, [element])
            with open(temporary, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            manifest["levels"].append(
                _facts(lod, level)
                | {
                    "file": path.name,
                    "count": element.count,
                    "bytes": temporary.stat().st_size,
                    "sha256": digest,
                }
                | {"bounds": _bounds([x.splats for x in drawn])}
            )
            command += [str(path), "-l", str(lod)]
        manifest_file.write_text(
            json.dumps(manifest, indent=1, default=_plain, allow_nan=False) + "\n", "ascii"
        )
    return shlex.join([*command, str(folder / "web" / "lod-meta.json")])


def read_folder(folder: str | Path) -> Bundle:
    """Read a folder of levels: by its ``manifest.json``, or any one series ``lodN.ply`` or ``NAME_lodN.ply``.

    Raises:
        LodgsError: no levels, several series, or a file that cannot be read.
    """
    folder = Path(folder)
    manifest_file = folder / "manifest.json"
    if manifest_file.exists():
        try:
            manifest = json.loads(manifest_file.read_bytes())
            _check_version(manifest, manifest_file)
            facts = sorted(manifest["levels"], key=lambda fact: fact["level"])
            levels = [_level(fact, read_ply(folder / Path(fact["file"]).name)) for fact in facts]
            if not levels:
                raise ValueError("no levels")
            _check_meta(manifest["meta"])
            return Bundle(manifest["method"], levels, manifest["meta"])
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise _contradiction(manifest_file, error) from error
    series: dict[str, list[tuple[int, Path]]] = {}
    for file in folder.glob("*.ply"):
        if found := re.fullmatch(r"(|.+_)lod(\d+)\.ply", file.name):
            series.setdefault(found[1], []).append((int(found[2]), file))
    if len(series) != 1:
        raise LodgsError(
            f"{folder} has {len(series) or 'no'} series of levels (lod0.ply, lod1.ply, ...).",
            "Choose a folder with one series, or a single PLY.",
        )
    coarse_first = sorted(next(iter(series.values())), reverse=True)
    return Bundle("", [Level(i, read_ply(file)) for i, (_, file) in enumerate(coarse_first, 1)])


def describe(path: str | Path) -> str:
    """What a bundle, a plain PLY or a folder of levels holds, as a few lines of text.

    Raises:
        LodgsError: as `read_bundle` and `read_folder`.
    """
    bundle = read_folder(path) if Path(path).is_dir() else read_bundle(path)
    splats = [level.splats for level in bundle.levels]
    low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in _bounds(splats))
    lines = [
        f"{path}: {bundle.method or 'plain 3DGS PLY'}, {len(splats)} level{'s'[: len(splats) > 1]}, "
        f"{'each adding to the coarser ones' if bundle.cumulative else 'each complete'}, "
        f"SH degree {splats[0].sh_degree}",
        f"bounds  ({low}) to ({high})",
        f"{'level':>5}  {'splats':>10}  {'MB':>8}  {'s_min':>10}  extras",
    ]
    for level in bundle.levels:
        columns = columns_of(level.splats) | columns_of_extras(level.splats)
        size = Element("", [columns]).size / 1e6
        s_min = "-" if level.s_min is None else f"{level.s_min:.6g}"
        extras = ", ".join(level.splats.extras) or "-"
        lines.append(f"{level.number:>5}  {len(level.splats):>10,}  {size:>8.2f}  {s_min:>10}  {extras}")
    lines += [f"{name}: {json.dumps(value)}" for name, value in bundle.meta.items()]
    return "\n".join(lines)


def _check(bundle: Bundle) -> None:
    numbers = [level.number for level in bundle.levels]
    if not numbers or numbers != sorted(set(numbers)):
        raise ValueError(f"a bundle needs levels in ascending number, not {numbers}")
    degrees = {level.splats.sh_degree for level in bundle.levels}
    if len(degrees) > 1:
        raise LodgsError(
            f"The levels have spherical harmonics of different degrees {sorted(degrees)}.",
            "Give all levels one degree, or export each level as a plain PLY.",
        )


def _head(bundle: Bundle, **further) -> dict:
    return {"v": FORMAT_VERSION, "method": bundle.method, "sh": bundle.levels[0].splats.sh_degree, **further}


def _facts(lod: int, level: Level) -> dict:
    return {"level": level.number, "lod": lod, "count": len(level.splats), "s_min": level.s_min}


def _level(facts: dict, splats: Splats) -> Level:
    s_min = facts["s_min"]
    return Level(int(facts["level"]), splats, None if s_min is None else float(s_min))


def _parse(comments: list[str], path: str | Path) -> tuple[Facts | None, list[dict]]:
    """The facts in a PLY's comments, as a whole and one by one; None and none where it is no bundle."""
    ours = [comment[len(_TAG) :] for comment in comments if comment.startswith(_TAG)]
    if not ours:
        return None, []
    try:
        head, *facts = [json.loads(text) for text in ours]
        _check_version(head, path)
        numbers = sorted(int(fact["level"]) for fact in facts if "level" in fact)
        if not numbers:
            raise ValueError("no levels")
        meta = next((fact["meta"] for fact in facts if "meta" in fact), {})
        _check_meta(meta)
        return Facts(head["method"], numbers, meta, head["cumulative"]), facts
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _contradiction(path, error) from error


def _check_version(head: dict, path: str | Path) -> None:
    if head["v"] > FORMAT_VERSION:
        raise LodgsError(f"{path} is a bundle of the newer version {head['v']}.", "Update LODGS to read it.")


def _check_meta(meta: dict) -> None:
    """ValueError or TypeError where a fact that readers rely on is not as many numbers as it should be."""
    for name, shape in _META_SHAPES.items():
        if name in meta and np.asarray(meta[name], np.float64).shape != shape:
            raise ValueError(f"{name} is not of shape {shape}")


def _contradiction(path: str | Path, error: Exception) -> LodgsError:
    return LodgsError(
        f"{path} describes its levels in a way that cannot be followed ({type(error).__name__}: {error}).",
        "Another program may have changed it; export it again.",
    )


def _bounds(splats: list[Splats]) -> list[list[float]]:
    """Smallest and largest x, y, z of the means."""
    parts = [x.means for x in splats if len(x)]
    if not parts:
        return [[0.0] * 3] * 2
    return [
        np.min([x.min(axis=0) for x in parts], axis=0).tolist(),
        np.max([x.max(axis=0) for x in parts], axis=0).tolist(),
    ]


def _comment(facts: dict) -> str:
    text = json.dumps(facts, separators=(",", ":"), default=_plain, allow_nan=False)
    for word in _FORBIDDEN:  # such words only occur inside JSON strings, where an escape means the same
        text = text.replace(word, f"{word[:-1]}\\u{ord(word[-1]):04x}")
    return _TAG + text


def _plain(value):
    """A numpy scalar or array as json knows it."""
    return value.tolist()
