"""Points in parts of photos without features, compared with the surfaces that the photos show."""

import time
from dataclasses import dataclass

import numpy as np

from training.scenes.fill_points import CELLS, CellView, cell_colors, fill_cells

WIDTH, HEIGHT, FOCAL = 480, 320, 400.0
NEAR, FAR = 5.0, 60.0
"""Depths of a wall below the horizon, and of the sky and of the mountains on the horizon."""
SKY = (90.0, 140.0, 220.0)


@dataclass
class Pinhole:
    width: int = WIDTH
    height: int = HEIGHT

    def img_from_cam(self, points: np.ndarray) -> np.ndarray:
        return points[:, :2] / points[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]

    def cam_from_img(self, pixels: np.ndarray) -> np.ndarray:
        return (pixels - [WIDTH / 2, HEIGHT / 2]) / FOCAL


def make_scene(count: int = 3) -> tuple[list[CellView], np.ndarray]:
    """Views from positions along x, and features on the horizon and on the wall except for a part."""
    y, x = np.mgrid[:32, :CELLS] + 0.5
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2) * 10
    wall = np.concatenate([(pixels - [240, 160]) / FOCAL, np.ones((len(pixels), 1))], axis=1) * NEAR
    wall = wall[(pixels[:, 1] > 200) & (np.abs(pixels[:, 0] - 280) > 40)]
    horizon = np.array([((n - 240) / FOCAL * FAR, 0.0, FAR) for n in range(5, 480, 10)])
    views = []
    for number in range(count):
        pose = np.column_stack([np.eye(3), [-0.5 * number, 0, 0]])
        stripes = 100 + 60 * np.sin((x + 0.5 * number / NEAR * FOCAL / 10) / 3)  # painted on the wall
        lit = np.where(y[..., None] < 16, SKY, stripes[..., None])
        views.append(CellView(Pinhole(), pose, lit, np.arange(len(wall) + len(horizon))))
    return views, np.concatenate([wall, horizon])


def test_sky_and_plain_wall_have_the_depths_of_their_surfaces():
    views, points = make_scene()
    new, colors = fill_cells(views, points, np.inf)
    sky = (colors == SKY).all(axis=1)
    assert sky.sum() > 10 * CELLS and np.median(new[sky, 2]) > 0.9 * FAR
    x, y = Pinhole().img_from_cam(new).T
    part = (y > 200) & (np.abs(x - 280) < 40)
    assert part.sum() >= 8 * 12 and np.mean(np.isclose(new[part, 2], NEAR)) > 0.95


def test_each_cell_is_filled_once():
    views, points = make_scene()
    new, _ = fill_cells(views[:1], points, np.inf)
    all_points = np.concatenate([points, new])
    pixels = Pinhole().img_from_cam(all_points) / 10
    cells = np.unique(np.floor(pixels).astype(int), axis=0)
    assert len(cells) >= 32 * CELLS and len(new) < 32 * CELLS
    repeated, _ = fill_cells([views[0], views[0]], points, np.inf)
    assert len(repeated) == len(new)


def test_ignored_cells_stay_empty():
    views, points = make_scene(1)
    views[0].colors[:10] = np.nan
    new, _ = fill_cells(views, points, np.inf)
    assert len(new) and Pinhole().img_from_cam(new)[:, 1].min() > 100


def test_time_limit():
    views, points = make_scene()
    new, colors = fill_cells(views, points, time.monotonic() - 1)
    assert new.shape == (0, 3) and colors.shape == (0, 3)


def test_cell_colors_are_means():
    pixels = np.arange(96 * 50 * 3, dtype=np.float64).reshape(50, 96, 3)
    visible = np.ones((50, 96), bool)
    visible[3, 7] = False
    cells = cell_colors(pixels, visible)
    assert cells.shape == (25, 48, 3)
    np.testing.assert_allclose(cells[2, 5], pixels[4:6, 10:12].mean(axis=(0, 1)))
    assert np.isnan(cells[1, 3]).all() and np.isnan(cells).any(axis=2).sum() == 1
