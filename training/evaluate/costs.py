"""Costs of candidate distances for LODGE levels (Fig. 4), as text and as a plot. No torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..files import atomic_write
from ..scenes.images import write_png
from ..splats.level_colors import level_color

PLOT_SIZE = 960, 540
"""Width and height of the plot in pixels."""
OVERSAMPLING = 2
"""Factor by which the plot is drawn larger, then averaged."""
_MARGINS = 80, 200, 64, 64
"""Left, right, top and bottom margin of the plot area in pixels."""
_BACKGROUND = (24, 24, 24)
_GRID = (58, 58, 58)
_TEXT = (225, 225, 225)


@dataclass(frozen=True)
class CostCurve:
    """Cost of a level as a function of the distance from which it is shown.

    Attributes:
        level: number of the level.
        distances: (M,) candidate distances, ascending, in scene units.
        costs: (M,) mean number of splats that a tile of 16x16 pixels processes, with this level from each
            distance on.
        cost_before: cost without the level; None if it was not recorded.
    """

    level: int
    distances: np.ndarray
    costs: np.ndarray
    cost_before: float | None = None

    @property
    def chosen(self) -> tuple[float, float]:
        """Distance with the lowest cost, and this cost."""
        index = int(np.argmin(self.costs))
        return float(self.distances[index]), float(self.costs[index])


def cost_curves(meta: dict) -> list[CostCurve]:
    """Return the valid curves under ``costs`` of a bundle's meta, finest level first."""
    entries = meta.get("costs")
    curves = map(_parse_curve, entries if isinstance(entries, list) else [])
    return [curve for curve in curves if curve is not None]


def _parse_curve(entry: Any) -> CostCurve | None:
    match entry:
        case {"level": int(level), "distances": list(distances), "costs": list(costs), **further} if (
            level > 0
        ):
            try:
                rows = np.array([distances, costs], np.float64)
            except (ValueError, TypeError):
                return None
            if rows.ndim == 2 and rows.shape[1] and np.isfinite(rows).all():
                cost_before = further.get("before")
                cost_before = cost_before if isinstance(cost_before, (int, float)) else None
                return CostCurve(level, rows[0], rows[1], cost_before)
    return None


def cost_lines(meta: dict, length: Callable[[float], str] = "{:.3g}".format) -> list[str]:
    """Format the chosen distance of each level and its change in splats per tile as lines.

    Args:
        length: formats a length in scene units.
    """
    lines = []
    for curve in cost_curves(meta):
        distance, cost = curve.chosen
        change = f"{cost:,.0f}" if curve.cost_before is None else f"{curve.cost_before:,.0f} → {cost:,.0f}"
        lines.append(f"Level {curve.level} from {length(distance)}: {change}")
    return lines


def write_cost_plot(path: Path, meta: dict) -> None:
    """Plot the curves of a bundle's meta as a PNG: cost over distance, with the chosen distances marked.

    Raises:
        LodgsError: the file cannot be written.
    """
    from PIL import Image

    plot = _Plot(cost_curves(meta))
    plot.draw_axes()
    for row, curve in enumerate(plot.curves):
        plot.draw_curve(row, curve)
    with atomic_write(path) as temporary:
        write_png(temporary, np.asarray(plot.sheet.resize(PLOT_SIZE, Image.Resampling.BOX)))


class _Plot:
    """An oversampled plot of cost curves with common axes."""

    def __init__(self, curves: list[CostCurve]) -> None:
        from PIL import Image, ImageDraw, ImageFont

        self.curves = curves
        self.width, self.height = (OVERSAMPLING * side for side in PLOT_SIZE)
        self.left, self.right, self.top, self.bottom = (OVERSAMPLING * margin for margin in _MARGINS)
        self.sheet = Image.new("RGB", (self.width, self.height), _BACKGROUND)
        self.canvas = ImageDraw.Draw(self.sheet)
        self.font = ImageFont.load_default(size=OVERSAMPLING * 16)
        self.small_font = ImageFont.load_default(size=OVERSAMPLING * 13)
        self.x_ticks = _ticks(max(curve.distances.max() for curve in curves))
        self.y_ticks = _ticks(max(max(curve.costs.max(), curve.cost_before or 0) for curve in curves))

    def position(self, distance: float, cost: float) -> tuple[float, float]:
        """Return the pixel of a distance and a cost."""
        x = self.left + (self.width - self.left - self.right) * distance / self.x_ticks[-1]
        y = self.height - self.bottom - (self.height - self.top - self.bottom) * cost / self.y_ticks[-1]
        return x, y

    def draw_axes(self) -> None:
        """Draw title, grid, ticks and labels."""
        title = "Splats that a tile of 16x16 pixels processes, by the distance from which a level is shown"
        self.canvas.text((self.left, self.top / 2), title, _TEXT, self.font, anchor="lm")
        for x in self.x_ticks:
            self.canvas.line([self.position(x, 0), self.position(x, self.y_ticks[-1])], _GRID, OVERSAMPLING)
            column, row = self.position(x, 0)
            self.canvas.text((column, row + 8 * OVERSAMPLING), f"{x:g}", _TEXT, self.small_font, anchor="mt")
        for y in self.y_ticks:
            self.canvas.line([self.position(0, y), self.position(self.x_ticks[-1], y)], _GRID, OVERSAMPLING)
            column, row = self.position(0, y)
            self.canvas.text((column - 8 * OVERSAMPLING, row), f"{y:g}", _TEXT, self.small_font, anchor="rm")
        self.canvas.text(
            ((self.left + self.width - self.right) / 2, self.height - self.bottom / 4),
            "distance in scene units",
            _TEXT,
            self.small_font,
            anchor="mb",
        )

    def draw_curve(self, row: int, curve: CostCurve) -> None:
        """Draw a curve, its chosen distance, its cost before and its entry in row ``row`` of the legend."""
        color = tuple(round(255 * value) for value in level_color(curve.level))
        points = [self.position(*point) for point in zip(curve.distances, curve.costs, strict=True)]
        self.canvas.line(points, color, 3 * OVERSAMPLING, joint="curve")
        for point in points:
            self._draw_dot(point, 3.5 * OVERSAMPLING, color)
        distance, cost = curve.chosen
        self._draw_dot(self.position(distance, cost), 8 * OVERSAMPLING, _TEXT)
        self._draw_dot(self.position(distance, cost), 5.5 * OVERSAMPLING, color)
        x, y = self.width - self.right + 20 * OVERSAMPLING, self.top + row * 54 * OVERSAMPLING
        self.canvas.text((x, y), f"level {curve.level}", color, self.font, anchor="lt")
        text = f"from {distance:.3g}: {cost:.0f}"
        self.canvas.text((x, y + 24 * OVERSAMPLING), text, _TEXT, self.small_font, anchor="lt")
        if curve.cost_before is not None:
            dashes = np.linspace(0, self.x_ticks[-1], 60)
            for begin, end in zip(dashes[::2], dashes[1::2], strict=True):
                line = [self.position(begin, curve.cost_before), self.position(end, curve.cost_before)]
                self.canvas.line(line, color, OVERSAMPLING)

    def _draw_dot(self, center: tuple[float, float], radius: float, color: tuple[int, ...]) -> None:
        x, y = center
        self.canvas.ellipse([x - radius, y - radius, x + radius, y + radius], fill=color)


def _ticks(maximum: float) -> np.ndarray:
    """Return round numbers from 0 to the first that is not below ``maximum``, four to nine of them.

    They reach 1 if the maximum is 0, as for costs of views without splats.
    """
    maximum = maximum or 1.0
    scale = 10.0 ** np.floor(np.log10(max(maximum, 1e-12)))
    step = next(step * scale for step in (0.2, 0.5, 1, 2) if maximum <= 5 * step * scale)
    return step * np.arange(np.ceil(maximum / step) + 1)
