"""Cost curves as lines and as a plot."""

import numpy as np
import pytest
from PIL import Image

from training.evaluate import costs
from training.evaluate.costs import cost_curves, cost_lines, write_cost_plot
from training.splats.level_colors import level_color

CURVES = [
    {"level": 2, "distances": [4.0, 10.0, 16.0], "costs": [812.0, 301.2, 400.0], "before": 830.4},
    {"level": 1, "distances": [20.0, 40.0], "costs": [290.0, 1250.0]},
]


def test_each_level_has_one_line():
    assert cost_lines({"costs": CURVES}, "{:.1f} m".format) == [
        "Level 2 from 10.0 m: 830 → 301",
        "Level 1 from 20.0 m: 290",
    ]
    assert cost_curves({"costs": CURVES})[0].chosen == (10.0, 301.2)


@pytest.mark.parametrize(
    "invalid",
    [
        3, [3], [{}], [{"level": 1}], [{"level": "one", "distances": [1], "costs": [1]}],
        [{"level": 1, "distances": [], "costs": []}], [{"level": 1, "distances": [1, 2], "costs": [1]}],
        [{"level": 1, "distances": ["near"], "costs": [1]}],
        [{"level": 1, "distances": [None], "costs": [1]}],
        [{"level": 1, "distances": [[1]], "costs": [[1]]}],
        [{"level": 0, "distances": [1], "costs": [1]}],
    ],
)  # fmt: skip
def test_invalid_curves_are_ignored(invalid):
    assert cost_lines({"costs": invalid}) == [] == cost_lines({})


def test_plot_draws_points_at_their_values(tmp_path):
    write_cost_plot(tmp_path / "costs.png", {"costs": CURVES})
    pixels = np.asarray(Image.open(tmp_path / "costs.png"))
    width, height = costs.PLOT_SIZE
    assert pixels.shape == (height, width, 3)
    for entry in CURVES:
        color = np.round(255 * np.array(level_color(entry["level"])))
        rows, columns = np.nonzero((np.abs(pixels - color) < 3).all(-1) & (np.arange(width) < 775))
        # axes end at the first round number that is large enough: 40 and 1500
        for distance, cost in zip(entry["distances"], entry["costs"], strict=True):
            x, y = 80 + 680 * distance / 40, 476 - 412 * cost / 1500
            assert np.hypot(columns - x, rows - y).min() < 2


def test_costs_of_views_without_splats_are_plotted(tmp_path):
    write_cost_plot(
        tmp_path / "a.png", {"costs": [{"level": 1, "distances": [2.0, 4.0], "costs": [0.0, 0.0]}]}
    )
    assert costs._ticks(0.0)[-1] == 1


@pytest.mark.parametrize("maximum", [1e-9, 0.049, 1, 1.0001, 4.2, 50, 51, 830, 99_999])
def test_ticks_are_round_and_cover_the_range(maximum):
    ticks = costs._ticks(maximum)
    assert 4 <= len(ticks) <= 12 and ticks[0] == 0 and ticks[-2] < maximum <= ticks[-1] * (1 + 1e-12)
    step = ticks[1] / 10 ** np.floor(np.log10(ticks[1] * (1 + 1e-9)))
    assert min(abs(step - size) for size in (1, 2, 5)) < 1e-6
