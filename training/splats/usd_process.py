"""Program that reads the splats of a USD file: ``python -m lodgs.splats.usd_process SCENE BUNDLE``.

It ends early when its standard input is closed.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import numpy as np

from ..errors import LodgsError, printable
from .bundle import write_bundle
from .gaussians import Splats, equalize_degrees
from .levels import MAX_READ_LEVELS, Bundle, Level
from .portable_levels import (
    DISTANCE,
    DISTANCE_RULE,
    join_levels,
    parse_description,
    place_splats,
    splats_from_activated,
    upright_meta,
)
from .sh import MAX_DEGREE, coefficient_count
from .usd import DESCRIPTION, error_reason, load_usd, report_error

_MEMORY = 1 << 27
"""Bytes that a file of any size may unpack to."""
_RATIO = 64
"""Bytes that a file may unpack to per byte of its size, in addition to ``_MEMORY``."""
_COPIES = 4
"""Memory for reading in multiples of the unpacked size."""
_SPLAT_BYTES = 56
"""Bytes of a splat of SH degree 0."""


def main() -> int:
    """Read the file and write the bundle; report errors on standard output."""
    source, target = (Path(word) for word in sys.argv[1:])
    Thread(target=_end_with_parent, daemon=True).start()
    usd = load_usd()
    limit_memory(source)
    try:
        write_bundle(target, read_levels(usd, source))
    except LodgsError as error:
        report_error(error)
    except UnicodeEncodeError:
        report_error(
            LodgsError(f"Cannot read {source}: its path is not UTF-8, as USD requires.", "Rename it.")
        )
    except (usd.Tf.ErrorException, MemoryError, ValueError, RuntimeError, OverflowError) as error:
        reason = error_reason(error)
        report_error(LodgsError(f"Cannot read {source}: it is damaged ({reason}).", "Export it again."))
    return 0


def _end_with_parent() -> None:
    """End this process when the other end of standard input is closed."""
    os.read(0, 1)
    os._exit(1)


def limit_memory(path: Path) -> None:
    """Limit the memory of this process, because compressed arrays may unpack to any size. Linux only."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        status = Path("/proc/self/status").read_text("ascii", "replace")
        used = int(status.split("VmData:")[1].split()[0]) * 1024
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (used + _COPIES * _unpacked_limit(path), hard))


def read_levels(usd: SimpleNamespace, path: Path) -> Bundle:
    """Return the levels of all roots of levels, each with the fields outside, or all splats as one level.

    Raises:
        LodgsError: the file has no splats or invalid ones, or refers to other files.
    """
    stage = _open(usd, path)
    prims = list(stage.Traverse(usd.Usd.TraverseInstanceProxies()))
    fields = [prim for prim in prims if prim.GetTypeName() == "ParticleField3DGaussianSplat"]
    if not fields:
        raise LodgsError(f"Cannot read {path}: it has no Gaussian splats.", "Choose another file.")
    _check_size(path, fields)
    roots = [prim for prim in prims if prim.HasAPI(usd.UsdLod.RootAPI)]
    groups = {root: below for root in roots if (below := _take_below(fields, root))}
    fields = [prim for prim in fields if _is_shown(usd, prim)] or ([] if groups else fields)
    count = max(map(len, groups.values()), default=1)
    if count > MAX_READ_LEVELS:
        raise LodgsError(f"Cannot read {path}: it has {count} levels.", "Export fewer levels.")
    cache = usd.UsdGeom.XformCache(usd.Usd.TimeCode.EarliestTime())
    unit = _metres_per_unit(usd, stage)
    metres = np.diag([unit] * 3 + [1.0])
    items = [*fields, *(prim for group in groups.values() for prim in group)]
    matrices = [metres @ np.array(cache.GetLocalToWorldTransform(prim)).T for prim in items]
    data = stage.GetRootLayer().customLayerData
    if DESCRIPTION in data and len(groups) == 1 and not fields:
        bundle, placement = parse_description(data[DESCRIPTION], path)
        same = all(np.allclose(matrix, placement, rtol=1e-9, atol=1e-9) for matrix in matrices)
        if same and len(bundle.levels) == count:
            parts = equalize_degrees([_read_field(prim, path) for prim in items])
            for level, splats in zip(reversed(bundle.levels), parts, strict=True):
                level.splats = splats
            return bundle
    placed = [
        place_splats(_read_field(prim, path), matrix, path)
        for prim, matrix in zip(items, matrices, strict=True)
    ]
    up = usd.UsdGeom.GetStageUpAxis(stage)
    meta, placed = upright_meta(placed, "Z" if up == usd.UsdGeom.Tokens.z else "Y")
    splats = dict(zip(items, equalize_degrees(placed), strict=True))
    distances = next((d for root in groups if (d := _thresholds(usd, root, count))), [])
    levels = [
        Level(
            count - i,
            Splats.concatenated([splats[prim] for prim in prims]),
            {DISTANCE: unit * distances[i]} if distances else {},
        )
        for i, prims in reversed(list(enumerate(join_levels(list(groups.values()), fields))))
    ]
    return Bundle("", levels, DISTANCE_RULE if distances else "", meta=meta)


def _take_below(fields: list, root) -> list:
    """Return the fields below a prim, and remove them from the list."""
    below = [prim for prim in fields if prim.GetPath().HasPrefix(root.GetPath())]
    fields[:] = [prim for prim in fields if not prim.GetPath().HasPrefix(root.GetPath())]
    return below


def _is_shown(usd: SimpleNamespace, prim) -> bool:
    """Return whether renderers show a prim: it is neither hidden nor a proxy or guide."""
    imageable, tokens = usd.UsdGeom.Imageable(prim), usd.UsdGeom.Tokens
    hidden = imageable.ComputeVisibility(usd.Usd.TimeCode.EarliestTime()) == tokens.invisible
    return not hidden and imageable.ComputePurpose() not in (tokens.proxy, tokens.guide)


def _metres_per_unit(usd: SimpleNamespace, stage) -> float:
    """Return the unit of a stage in metres; 1 if none is stored, or one that is no length."""
    unit = usd.UsdGeom.GetStageMetersPerUnit(stage)
    return unit if usd.UsdGeom.StageHasAuthoredMetersPerUnit(stage) and 0 < unit < np.inf else 1.0


def _open(usd: SimpleNamespace, path: Path):
    """Open a file that needs no other one. Layers of a package may need each other, as those of 3DGRUT do."""
    layer = usd.Sdf.Layer.FindOrOpen(str(path))
    if layer is None:
        raise LodgsError(f"Cannot read {path}: it is not a USD file.", "Choose another file.")
    layers, others = [layer], []
    for part in layers:
        for name in filter(None, part.GetCompositionAssetDependencies()):  # "": a reference within the layer
            place = usd.Sdf.ComputeAssetPathRelativeToLayer(part, name)
            inside = place.startswith(f"{layer.identifier}[") and usd.Sdf.Layer.FindOrOpen(place)
            if not inside:
                others.append(printable(name))
            elif inside not in layers:
                layers.append(inside)
    if others:
        names = ", ".join(others)[:300]
        raise LodgsError(f"Cannot read {path}: it refers to other files ({names}).", "Flatten it first.")
    return usd.Usd.Stage.Open(layer)


def _check_size(path: Path, fields: list) -> None:
    """Refuse a file that declares more splats than it can hold."""
    count = 0
    for prim in fields:
        values = _first_value(prim.GetAttribute("positions")) or _first_value(prim.GetAttribute("positionsh"))
        count += len(values) if values is not None else 0
    if count * _SPLAT_BYTES > _unpacked_limit(path):
        raise LodgsError(f"Cannot read {path}: it is too short for {count:,} splats.", "Export it again.")


def _unpacked_limit(path: Path) -> int:
    """Return the bytes that a file may unpack to."""
    return _MEMORY + _RATIO * path.stat().st_size


def _read_field(prim, path: Path) -> Splats:
    """Return the splats of a particle field in its own coordinates.

    As the schema says, attributes without a value for each position have their default, and excess values are
    ignored. Incomplete coefficients of harmonics are an error, because the default is grey.
    """

    def values(name: str, width: int) -> np.ndarray:
        for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
            value = _first_value(attribute) if attribute else None
            if value is not None and len(value):
                return np.array(value, np.float32).reshape(-1, width)
        return np.zeros((0, width), np.float32)

    def values_or(default: tuple[float, ...], name: str) -> np.ndarray:
        rows = values(name, len(default))
        if len(rows) >= len(means):
            return rows[: len(means)]
        return np.tile(np.array(default, np.float32), (len(means), 1))

    means = values("positions", 3)
    quats = values_or((0, 0, 0, 1), "orientations")[:, [3, 0, 1, 2]]
    scales, alphas = values_or((1, 1, 1), "scales"), values_or((1,), "opacities")[:, 0]
    degree = _first_value(prim.GetAttribute("radiance:sphericalHarmonicsDegree"))
    sh = values("radiance:sphericalHarmonicsCoefficients", 3)
    if not len(sh):
        sh, degree = np.zeros_like(means), 0
    if type(degree) is not int or not 0 <= degree <= MAX_DEGREE:
        raise LodgsError(f"Cannot read {path}: its SH degree is {degree}.", "Use degree 0 to 4.")
    needed = len(means) * coefficient_count(degree)
    if len(sh) < needed:
        raise LodgsError(
            f"Cannot read {path}: {printable(prim.GetPath())} has {len(sh):,} coefficients for "
            f"{len(means):,} splats of SH degree {degree}.",
            "Export it again.",
        )
    return splats_from_activated(means, quats, scales, alphas, sh[:needed].reshape(len(means), -1, 3))


def _first_value(attribute):
    """Return the value of an attribute, or its value at the first time if it is animated."""
    times = attribute.GetTimeSamples()
    return attribute.Get(times[0]) if times else attribute.Get()


def _thresholds(usd: SimpleNamespace, root, count: int) -> list[float]:
    """Return the distance from which on each level is drawn, fine to coarse; empty if there are none."""
    for target in usd.UsdLod.RootAPI(root).GetLodHeuristicsRel().GetTargets():
        heuristic = usd.UsdLod.DistanceHeuristic(root.GetStage().GetPrimAtPath(target))
        if heuristic:
            values = [float(value) for value in heuristic.GetThresholdsAttr().Get() or ()]
            valid = np.isfinite(values).all() and values == sorted(values) and min(values, default=0) >= 0
            return [0.0, *values] if len(values) == count - 1 and valid else []
    return []


if __name__ == "__main__":
    sys.exit(main())
