"""Baking of Mip-Splatting's filter into opacities, for programs without that filter. numpy only.

With the filter, small splats are drawn with less than their opacity: times sqrt(det before / det after) of
    the image covariance (Mip-Splatting, Eq. 10). Other programs draw the full opacity. Here, each splat gets
    its average filtered opacity over the training views at training size, so that images of about that size
    look right. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..scenes.cameras import Camera, pick_evenly
from ..scenes.view_tables import read_view_tables
from ..splats.batches import batch_slices
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import NO_SPLATS, Bundle, Level
from ..splats.quats import rotation_matrices

MIP_VARIANCE = 0.1
"""Variance in square pixels that the filter adds: about a pixel's extent (Yu et al. 2024, Eq. 10)."""
MAX_VIEWS = 24
"""Maximum number of views to average over."""
VIEW_MARGIN = 0.5
"""Views are extended by this fraction of their size on every side."""
_BATCH = 1 << 16


def bake_filter(bundle: Bundle) -> Bundle:
    """Return a bundle with the filter baked into opacities, which is no longer antialiased.

    Returns the bundle itself if it is not antialiased, or has no views.

    Raises:
        LodgsError: corrupt views.
    """
    views, near, _ = read_view_tables(bundle.tables)
    if not (bundle.antialias and views):
        return bundle
    focal = float(np.median([view.focal for view in views]))
    scale = float(bundle.meta.get("focal_px", focal)) / focal  # views have the photos' size
    views = [view.scaled(scale).widened(VIEW_MARGIN) for view in pick_evenly(views, MAX_VIEWS)]
    levels = [
        Level(level.number, NO_SPLATS, level.facts, RowsWithBakedFilter(level.rows, views, near))
        for level in bundle.levels
    ]
    meta = {name: value for name, value in bundle.meta.items() if name != "antialias"}
    return replace(bundle, levels=levels, meta=meta)


@dataclass(frozen=True)
class RowsWithBakedFilter:
    """Splats whose opacities are filtered when they are read.

    Attributes:
        rows: splats with unfiltered opacities.
        views: cameras to average over, at training size.
        near: depth where rendering begins.
    """

    rows: SplatRows
    views: Sequence[Camera]
    near: float

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Read a range of rows, or some rows (M,) ascending."""
        splats = self.rows.select(index)
        logits = splats.opacity_logits.copy()
        for batch in batch_slices(len(splats), _BATCH):
            logits[batch] = self._logits(splats.select(batch))
        return replace(splats, opacity_logits=logits)

    def _logits(self, splats: Splats) -> np.ndarray:
        shapes = _shapes(splats)
        total = np.zeros(len(splats))
        counts = np.zeros(len(splats), np.int64)
        for view in self.views:
            rows = np.flatnonzero(view.sees(splats.means, self.near))
            total[rows] += _filter_factor(splats.means[rows], shapes[rows], view)
            counts[rows] += 1
        # splats outside all views get the average factor
        factor = np.where(counts, total / np.maximum(counts, 1), total.sum() / max(counts.sum(), 1) or 1.0)
        log_opacity = np.log(np.maximum(factor, 1e-6)) - np.logaddexp(0, -splats.opacity_logits)
        logits = log_opacity - np.log(-np.expm1(np.minimum(log_opacity, -1e-7)))
        return np.minimum(logits, splats.opacity_logits).astype(np.float32)


def _shapes(splats: Splats) -> np.ndarray:
    """Return (N, 3, 3) matrices M with M M^T = covariance of each splat."""
    lengths = np.linalg.norm(splats.quats, axis=1, keepdims=True)
    unit = (splats.quats / np.where(lengths > 0, lengths, 1)).astype(np.float64)
    return rotation_matrices(unit) * np.exp(splats.log_scales.astype(np.float64))[:, None]


def _filter_factor(means: np.ndarray, shapes: np.ndarray, view: Camera) -> np.ndarray:
    """Return the filter's opacity factor in a view, (N,) in [0, 1]: sqrt(det before / det after)."""
    x, y, z = view.view_space(means).T
    right, down, ahead = view.world_to_camera[:3, :3]
    across = (view.fx / z)[:, None] * (right - (x / z)[:, None] * ahead)
    along = (view.fy / z)[:, None] * (down - (y / z)[:, None] * ahead)
    first, second = (np.einsum("ni,nij->nj", axis, shapes) for axis in (across, along))
    a, b, c = ((u * v).sum(1) for u, v in ((first, first), (first, second), (second, second)))
    determinant = np.maximum(a * c - b * b, 0)
    return np.sqrt(determinant / ((a + MIP_VARIANCE) * (c + MIP_VARIANCE) - b * b))
