"""What finding the distances of levels has told (LODGE, Fig. 4): as lines of text and as a plot. No torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..files import atomic_write
from ..lod.colors import level_color
from ..scenes.images import write_png

PLOT_SIZE = 960, 540
"""Width and height of the plot in pixels."""
OVERSAMPLING = 2
"""It is drawn so many times larger, then averaged."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 80, 200, 64, 64
_PAPER, _GRID, _TEXT = (24, 24, 24), (58, 58, 58), (225, 225, 225)


@dataclass(frozen=True)
class CostCurve:
    """What a level's distance would have cost.

    Attributes:
        level: its number.
        distances: (M,) that were tried, rising, in scene units.
        costs: (M,) splats that a tile of 16x16 pixels has to look at, on average, with this level from there.
        before: the same without the level; None where that was not recorded.
    """

    level: int
    distances: np.ndarray
    costs: np.ndarray
    before: float | None = None

    @property
    def chosen(self) -> tuple[float, float]:
        """The distance that costs least, and what it costs."""
        place = int(np.argmin(self.costs))
        return float(self.distances[place]), float(self.costs[place])


def cost_curves(meta: dict) -> list[CostCurve]:
    """The curves that a bundle's meta has under ``costs``, finest level first; what is odd is passed over."""
    entries = meta.get("costs")
    found = map(_curve, entries if isinstance(entries, list) else [])
    return [curve for curve in found if curve is not None]


def _curve(entry: object) -> CostCurve | None:
    match entry:
        case {"level": int(level), "distances": list(distances), "costs": list(costs), **rest} if level > 0:
            try:
                rows = np.array([distances, costs], np.float64)
            except (ValueError, TypeError):
                return None
            if rows.ndim == 2 and rows.shape[1] and np.isfinite(rows).all():
                before = rest.get("before")
                return CostCurve(
                    level, rows[0], rows[1], before if isinstance(before, (int, float)) else None
                )
    return None


def cost_lines(meta: dict, length: Callable[[float], str] = "{:.3g}".format) -> list[str]:
    """A line for each level whose distance was found by its cost: from where, and the splats in a tile.

    Args:
        length: says a length in scene units.
    """
    lines = []
    for curve in cost_curves(meta):
        distance, cost = curve.chosen
        from_to = f"{cost:,.0f}" if curve.before is None else f"{curve.before:,.0f} → {cost:,.0f}"
        lines.append(f"Level {curve.level} from {length(distance)}: {from_to}")
    return lines


def write_cost_plot(path: Path, meta: dict) -> None:
    """Writes the curves of a bundle's meta as a PNG: cost over distance, the chosen ones marked.

    Raises:
        LodgsError: it cannot be written.
    """
    from PIL import Image, ImageDraw, ImageFont

    curves = cost_curves(meta)
    width, height = (OVERSAMPLING * side for side in PLOT_SIZE)
    left, right, top, bottom = (OVERSAMPLING * side for side in (_LEFT, _RIGHT, _TOP, _BOTTOM))
    font, small = (ImageFont.load_default(size=OVERSAMPLING * points) for points in (16, 13))
    sheet = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    xs = _ticks(max(curve.distances.max() for curve in curves))
    ys = _ticks(max(max(curve.costs.max(), curve.before or 0) for curve in curves))

    def place(distance: float, cost: float) -> tuple[float, float]:
        x = left + (width - left - right) * distance / xs[-1]
        return x, height - bottom - (height - top - bottom) * cost / ys[-1]

    title = "Splats that a tile of 16x16 pixels looks at, by the distance from which a level is shown"
    draw.text((left, top / 2), title, _TEXT, font, anchor="lm")
    for x in xs:
        draw.line([place(x, 0), place(x, ys[-1])], _GRID, OVERSAMPLING)
        at = place(x, 0)
        draw.text((at[0], at[1] + 8 * OVERSAMPLING), f"{x:g}", _TEXT, small, anchor="mt")
    for y in ys:
        draw.line([place(0, y), place(xs[-1], y)], _GRID, OVERSAMPLING)
        at = place(0, y)
        draw.text((at[0] - 8 * OVERSAMPLING, at[1]), f"{y:g}", _TEXT, small, anchor="rm")
    draw.text(
        ((left + width - right) / 2, height - bottom / 4),
        "distance in scene units",
        _TEXT,
        small,
        anchor="mb",
    )
    for row, curve in enumerate(curves):
        color = tuple(round(255 * value) for value in level_color(curve.level))
        points = [place(*each) for each in zip(curve.distances, curve.costs, strict=True)]
        draw.line(points, color, 3 * OVERSAMPLING, joint="curve")
        for x, y in points:
            _dot(draw, x, y, 3.5 * OVERSAMPLING, color)
        distance, cost = curve.chosen
        _dot(draw, *place(distance, cost), 8 * OVERSAMPLING, _TEXT)
        _dot(draw, *place(distance, cost), 5.5 * OVERSAMPLING, color)
        at = width - right + 20 * OVERSAMPLING, top + row * 54 * OVERSAMPLING
        draw.text(at, f"level {curve.level}", color, font, anchor="lt")
        text = f"from {distance:.3g}: {cost:.0f}"
        draw.text((at[0], at[1] + 24 * OVERSAMPLING), text, _TEXT, small, anchor="lt")
        if curve.before is not None:
            line = np.linspace(0, xs[-1], 60)
            for a, b in zip(line[::2], line[1::2], strict=True):
                draw.line([place(a, curve.before), place(b, curve.before)], color, OVERSAMPLING)
    with atomic_write(path) as temporary:
        write_png(temporary, np.asarray(sheet.resize(PLOT_SIZE, Image.Resampling.BOX)))


def _dot(draw, x: float, y: float, radius: float, color: tuple[int, ...]) -> None:
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=color)


def _ticks(most: float) -> np.ndarray:
    """Round numbers from 0 to the first that is not below ``most``, four to nine of them."""
    scale = 10.0 ** np.floor(np.log10(max(most, 1e-12)))
    step = next(step * scale for step in (0.2, 0.5, 1, 2) if most <= 5 * step * scale)
    return step * np.arange(np.ceil(most / step) + 1)
