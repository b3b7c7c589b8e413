"""Splats for programs that do not know Mip-Splatting's filter, as opaque as it shows them. numpy only.

What was trained with the filter is drawn with less than its opacity where it is small: times
sqrt(det before / det after) of its covariance on the image (Mip-Splatting, Eq. 10). Others draw all of it.
Here each splat gets the opacity that it has on average in the views that the scene was photographed from, at
the size of training: a picture of that size then looks about as it should. This is not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..scenes.cameras import Camera, pick_evenly
from ..scenes.view_tables import read_view_tables
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import NO_SPLATS, Bundle, Level

MIP_VARIANCE = 0.1
"""Added to a splat's variance on the image, in square pixels, about a pixel's own extent (Yu et al. 2024,
Eq. 10)."""
MAX_VIEWS = 24
"""In so many views opacities are looked up."""
VIEW_MARGIN = 0.5
"""Views are as much wider on every side, as a share of their size: where photographs are continued."""
_AT_ONCE = 1 << 16


def bake_filter(bundle: Bundle) -> Bundle:
    """Splats for programs that do not know the filter, which are not antialiased any more.

    The bundle itself where it is not antialiased, or does not know from where it was photographed.

    Raises:
        LodgsError: its views are damaged.
    """
    views, near, _ = read_view_tables(bundle.tables)
    if not (bundle.antialias and views):
        return bundle
    focal = float(np.median([view.focal for view in views]))
    share = float(bundle.meta.get("focal_px", focal)) / focal  # views are of the photographs' own size
    views = [view.scaled(share).widened(VIEW_MARGIN) for view in pick_evenly(views, MAX_VIEWS)]
    levels = [
        Level(level.number, NO_SPLATS, level.facts, RowsWithBakedFilter(level.rows, views, near))
        for level in bundle.levels
    ]
    meta = {name: value for name, value in bundle.meta.items() if name != "antialias"}
    return replace(bundle, levels=levels, meta=meta)


@dataclass(frozen=True)
class RowsWithBakedFilter:
    """Splats with the opacity that the filter gives them in some views, as they are read.

    Attributes:
        rows: the splats with their own.
        views: of the size of training.
        near: depth at which drawing begins.
    """

    rows: SplatRows
    views: Sequence[Camera]
    near: float

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, some: slice | np.ndarray, /) -> Splats:
        """The splats of a range of rows, or of some rows (M,) ascending."""
        splats = self.rows.select(some)
        logits = splats.opacity_logits.copy()
        for begin in range(0, len(splats), _AT_ONCE):
            block = slice(begin, begin + _AT_ONCE)
            logits[block] = self._logits(splats.select(block))
        return replace(splats, opacity_logits=logits)

    def _logits(self, splats: Splats) -> np.ndarray:
        shapes, total, seen = _shapes(splats), np.zeros(len(splats)), np.zeros(len(splats), np.int64)
        for view in self.views:
            rows = np.flatnonzero(view.sees(splats.means, self.near))
            total[rows] += _kept(splats.means[rows], shapes[rows], view)
            seen[rows] += 1
        # what no view sees keeps as much as all others do
        share = np.where(seen, total / np.maximum(seen, 1), total.sum() / max(seen.sum(), 1) or 1.0)
        log_opacity = np.log(np.maximum(share, 1e-6)) - np.logaddexp(0, -splats.opacity_logits)
        logits = log_opacity - np.log(-np.expm1(np.minimum(log_opacity, -1e-7)))
        return np.minimum(logits, splats.opacity_logits).astype(np.float32)


def _shapes(splats: Splats) -> np.ndarray:
    """(N, 3, 3) whose products with their transposes are the splats' covariances."""
    lengths = np.linalg.norm(splats.quats, axis=1, keepdims=True)
    w, x, y, z = (splats.quats / np.where(lengths > 0, lengths, 1)).astype(np.float64).T
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3) * np.exp(splats.log_scales.astype(np.float64))[:, None]


def _kept(means: np.ndarray, shapes: np.ndarray, view: Camera) -> np.ndarray:
    """What the filter leaves of opacities in a view, (N,) in [0, 1]: sqrt(det before / det after)."""
    x, y, z = view.view_space(means).T
    right, down, ahead = view.world_to_camera[:3, :3]
    across = (view.fx / z)[:, None] * (right - (x / z)[:, None] * ahead)
    along = (view.fy / z)[:, None] * (down - (y / z)[:, None] * ahead)
    first, second = ((axis[:, None] @ shapes)[:, 0] for axis in (across, along))
    a, b, c = ((u * v).sum(1) for u, v in ((first, first), (first, second), (second, second)))
    before = np.maximum(a * c - b * b, 0)
    return np.sqrt(before / ((a + MIP_VARIANCE) * (c + MIP_VARIANCE) - b * b))
