"""Splats that a training begins with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import expit, logit

from ..errors import LodgsError
from ..lod.rule import find_rule
from ..lod.selection import complete, select, settings
from ..splats.bundle import Bundle, DrawableRows, open_bundle, read_bundle, read_folder, read_head
from ..splats.dialects import Warn, silent
from ..splats.gaussians import SplatRows, Splats
from .folder import RunFolder


def read_base(path: str | Path, warn: Warn = silent) -> tuple[Splats, bool]:
    """:func:`open_base`, with all splats in memory."""
    rows, antialias = open_base(path, warn)
    return rows.select(slice(None)), antialias


def open_base(path: str | Path, warn: Warn = silent) -> tuple[SplatRows, bool]:
    """The finest complete level of a finished run, of a bundle or an exported folder, or of a plain PLY.

    They stay in the file where that has them as they are to begin with; it is read once to be sure of it.

    Args:
        path: a run's folder, one of levels with its manifest, or a PLY.
        warn: as for ``read_bundle``.

    Returns:
        The splats, and whether they are antialiased (``Bundle.antialias``).

    Raises:
        LodgsError: there is no such file, the run is not finished, the file cannot be read, or it has no
            splats.
    """
    path = Path(path)
    if not path.exists():
        raise LodgsError(f"There is no {path} to begin with.", "Choose a run's folder or a PLY of splats.")
    if path.is_dir() and not (path / "manifest.json").exists():
        path = RunFolder(path).bundle
        if not path.exists():
            raise LodgsError(
                f"{path.parent} holds no finished run (no {path.name}).",
                "Train it to the end first, or choose a PLY of splats.",
            )
    head = None if path.is_dir() else read_head(path)
    rule = None if head is None else find_rule(head.rule)
    if head is None or head.cumulative or (rule is not None and rule.always):
        bundle = (read_folder if path.is_dir() else read_bundle)(path, warn)
        splats: SplatRows = _finest(bundle)
    else:
        bundle, rows = open_bundle(path)
        splats = DrawableRows(rows[bundle.levels[-1].number], warn)
    if not len(splats):
        raise LodgsError(f"{path} holds no splats to begin with.", "Choose another run or PLY.")
    return splats, bundle.antialias


def _finest(bundle: Bundle) -> Splats:
    rule = find_rule(bundle.rule)
    if rule is not None and rule.always and "camera_center" in bundle.meta:
        return _as_seen(bundle, np.asarray(bundle.meta["camera_center"]))
    return complete(bundle, bundle.levels[-1])


def _as_seen(bundle: Bundle, eye: np.ndarray) -> Splats:
    """All that an eye is shown, its weights in the opacities: without them it is not what was trained."""
    splats, weights = select(bundle, eye, 1.0, settings(bundle, {}))
    if weights is None:
        return splats
    opacities = np.clip(weights * expit(splats.opacity_logits), 1e-6, 1 - 1e-6)
    return replace(splats, opacity_logits=logit(opacities).astype(np.float32))
