"""Readers for a base: the splats from which a training starts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..lod.rule import Values
from ..lod.selection import complete_splats, full_detail_controls, select
from ..scenes.cameras import Camera
from ..scenes.view_tables import read_view_tables
from ..splats.bundle import open_bundle, read_bundle, read_header, read_tables
from ..splats.dialects import Warn, ignore
from ..splats.file_rows import DrawableRows
from ..splats.gaussians import SplatRows, Splats
from ..splats.level_folder import read_folder, read_origin
from ..splats.levels import Bundle
from .folder import RunFolder
from .job import Job


def read_base(path: str | Path, warn: Warn = ignore) -> tuple[Splats, bool]:
    """Read a base as :func:`open_base` does, with all splats in memory."""
    rows, antialias = open_base(path, warn)
    return rows.select(slice(None)), antialias


def open_base(path: str | Path, warn: Warn = ignore) -> tuple[SplatRows, bool]:
    """Open the finest complete level of a finished run, a bundle, an exported folder or a plain PLY.

    Splats stay on disk where the file stores them in the form that training needs. The file is read once
    to verify it.

    Args:
        path: run folder, folder of levels with a manifest, or PLY file.
        warn: see ``read_bundle``.

    Returns:
        The splats, and whether they are antialiased (``Bundle.antialias``).

    Raises:
        LodgsError: the path does not exist, the run is not finished, the file is unreadable or has no splats.
    """
    path = _base_file(Path(path))
    head = None if path.is_dir() else read_header(path)
    if head is None or head.cumulative or full_detail_controls(head) is not None:
        bundle = (read_folder if path.is_dir() else read_bundle)(path, warn)
        splats: SplatRows = _finest(bundle)
    else:
        bundle, rows = open_bundle(path)
        splats = DrawableRows(rows[bundle.levels[-1].number], warn)
    if not len(splats):
        raise LodgsError(f"Cannot read base splats: {path} has none.", "Choose another run or PLY file.")
    return splats, bundle.antialias


def read_base_origin(path: str | Path) -> np.ndarray:
    """Return the local origin (3,) of a base.

    Raises:
        LodgsError: see :func:`open_base`.
    """
    return read_origin(_base_file(Path(path)))


def read_base_cameras(path: str | Path) -> tuple[list[Camera], float]:
    """Return the cameras that a base has in its tables, and their near depth; none in most PLY files.

    Raises:
        LodgsError: see :func:`open_base`.
    """
    path = _base_file(Path(path))
    return ([], 0.0) if path.is_dir() else read_view_tables(read_tables(path))[:2]


def base_origin(job: Job) -> np.ndarray | None:
    """Return the local origin of a job's base, in which the job trains; None to choose the scene's own.

    A base without an origin lies near 0, so its scene chooses the origin, except for captures of the base.

    Raises:
        LodgsError: see :func:`open_base`.
    """
    if not job.base:
        return None
    origin = read_base_origin(job.base)
    return origin if origin.any() or job.capture else None


def _base_file(path: Path) -> Path:
    """Return the file, or folder of levels, of a base.

    Raises:
        LodgsError: the path does not exist, or is a run that is not finished.
    """
    if not path.exists():
        raise LodgsError(
            f"Cannot read base splats: {path} does not exist.", "Choose a run folder or a PLY file of splats."
        )
    if path.is_dir() and not (path / "manifest.json").exists():
        path = RunFolder(path).bundle
        if not path.exists():
            raise LodgsError(
                f"Cannot read base splats: {path.parent} is not a finished run (it has no {path.name}).",
                "Finish training it first, or choose a PLY file of splats.",
            )
    return path


def _finest(bundle: Bundle) -> Splats:
    controls = full_detail_controls(bundle)
    if controls is not None and "camera_center" in bundle.meta:
        return _with_weights_baked(bundle, np.asarray(bundle.meta["camera_center"]), controls)
    return complete_splats(bundle, bundle.levels[-1])


def _with_weights_baked(bundle: Bundle, center: np.ndarray, controls: Values) -> Splats:
    """Return all splats, with the weights for a camera position (3,) multiplied into their opacities.

    The splats were trained with these weights.
    """
    from scipy.special import expit, logit  # Blender lacks scipy

    splats, weights = select(bundle, center, 1.0, controls)
    if weights is None:
        return splats
    opacities = np.clip(weights * expit(splats.opacity_logits), 1e-6, 1 - 1e-6)
    return replace(splats, opacity_logits=logit(opacities).astype(np.float32))
