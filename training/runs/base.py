"""Splats that a training begins with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import expit, logit

from ..errors import LodgsError
from ..lod.rule import find_rule
from ..lod.selection import complete, select, settings
from ..splats.bundle import Bundle, read_bundle, read_folder
from ..splats.dialects import Warn, silent
from ..splats.gaussians import Splats
from .folder import RunFolder


def read_base(path: str | Path, warn: Warn = silent) -> tuple[Splats, bool]:
    """The finest complete level of a finished run, of a bundle or an exported folder, or of a plain PLY.

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
    bundle = (read_folder if path.is_dir() else read_bundle)(path, warn)
    splats = complete(bundle, bundle.levels[-1])
    rule = find_rule(bundle.rule)
    if rule is not None and rule.always and "camera_center" in bundle.meta:
        splats = _as_seen(bundle, np.asarray(bundle.meta["camera_center"]))
    if not len(splats):
        raise LodgsError(f"{path} holds no splats to begin with.", "Choose another run or PLY.")
    return splats, bundle.antialias


def _as_seen(bundle: Bundle, eye: np.ndarray) -> Splats:
    """All that an eye is shown, its weights in the opacities: without them it is not what was trained."""
    splats, weights = select(bundle, eye, 1.0, settings(bundle, {}))
    if weights is None:
        return splats
    opacities = np.clip(weights * expit(splats.opacity_logits), 1e-6, 1 - 1e-6)
    return replace(splats, opacity_logits=logit(opacities).astype(np.float32))
