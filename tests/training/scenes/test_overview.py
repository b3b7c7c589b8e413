"""Up direction, extent and first view of splats without cameras, on scenes of simple shapes."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from training.scenes.cameras import look_at
from training.scenes.overview import (
    _clarity,
    central_ball,
    choose_view,
    complete_meta,
    describe_clutter,
    guess_up_rotation,
)
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

Y_DOWN = np.float32([(1, 0, 0), (0, 0, -1), (0, 1, 0)])
"""Rotation of scenes with z up to the convention of 3DGS, -y up."""
OFFSET = np.float32([300, -200, 50])


def splats_at(means: np.ndarray, size: float = 0.02) -> Splats:
    count = len(means)
    return Splats(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), np.log(size), np.float32),
        np.full(count, 4, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def box_faces(half: tuple[float, float, float], count: int = 6000) -> np.ndarray:
    """Return random points on the faces of a box around the origin, in proportion to their area."""
    rng = np.random.default_rng(0)
    half = np.float64(half)
    points = rng.uniform(-1, 1, (count, 3)) * half
    areas = half.prod() / half
    axes = rng.choice(3, count, p=areas / areas.sum())
    points[np.arange(count), axes] = half[axes] * rng.choice([-1, 1], count)
    return points


def garden() -> np.ndarray:
    """Return a round ground of radius 4 at z = 0 with things up to 1 high."""
    rng = np.random.default_rng(1)
    angles, radii = rng.uniform(0, 2 * np.pi, 6000), 4 * np.sqrt(rng.uniform(0, 1, 6000))
    heights = np.where(rng.uniform(0, 1, 6000) < 0.5, 0, rng.uniform(0, 1, 6000))
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])


def facade() -> np.ndarray:
    """Return a wall of 12 x 6 at y = 0, with things up to 1 before it (y < 0)."""
    rng = np.random.default_rng(2)
    depths = np.where(rng.uniform(0, 1, 6000) < 0.6, 0, rng.uniform(-1, 0, 6000))
    return np.column_stack([rng.uniform(-6, 6, 6000), depths, rng.uniform(-3, 3, 6000)])


def test_outliers_do_not_move_the_central_ball():
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(1000, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0, 1, (1000, 1))
    means[:100] = 1e4
    center, radius = central_ball(means + OFFSET)
    np.testing.assert_allclose(center, OFFSET, atol=0.1)
    assert 0.7 < radius < 1.6


@pytest.mark.parametrize("points", [garden(), box_faces((3, 2.5, 1.3))], ids=["garden", "room"])
def test_ground_is_below(points):
    up = {}
    for name, turn in {
        "z": np.eye(3),
        "-z": np.diag([1, -1, -1]),
        "-y": Y_DOWN,
        "y": -Y_DOWN @ np.diag([-1, 1, 1]),
    }.items():
        rotation = guess_up_rotation(splats_at(points @ np.float64(turn).T + OFFSET))
        up[name] = None if rotation is None else rotation[2].tolist()
    assert up["z"] == [0, 0, 1] and up["-y"] is None
    if not np.isclose(points[:, 2].min(), -points[:, 2].max(), atol=0.01):  # a room has two grounds
        assert up["-z"] == [0, 0, -1] and up["y"] == [0, 1, 0]


def test_wall_is_no_ground():
    assert guess_up_rotation(splats_at(facade() @ Y_DOWN.T)) is None


@pytest.mark.parametrize("axes", ["xyz", "xzy"])
def test_flat_splats_and_needles_show_the_vertical_axis_of_a_high_scene(axes):
    """A ground of discs and a high tower of vertical needles, in files with z or -y up.

    In the file with -y up, most flat splats face y; a facade that faces z has no needles across it.
    """
    rng = np.random.default_rng(7)
    ground, tower = rng.uniform(-3, 3, (3000, 3)) * (1, 1, 0.1), rng.uniform(-1, 1, (3000, 3)) * (1, 1, 3)
    splats = splats_at(np.concatenate([ground, tower + np.float64([0, 0, 3])]))
    splats.log_scales[:3000, 2] -= 2
    splats.log_scales[3000:, 2] += 2
    order = ["xyz".index(axis) for axis in axes]
    turned = replace(splats, means=splats.means[:, order], log_scales=splats.log_scales[:, order])
    rotation = guess_up_rotation(turned)
    assert rotation is None if axes == "xzy" else np.array_equal(rotation, np.eye(3))
    wall = replace(turned, log_scales=turned.log_scales.copy())
    wall.log_scales[3000:] = wall.log_scales[3000:, [1, 2, 0]]  # needles along another axis
    assert guess_up_rotation(wall) is None


def test_view_shows_the_background_behind_the_subject():
    """A ball in front of a large wall at y = 2."""
    rng = np.random.default_rng(5)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    wall = np.column_stack([rng.uniform(-5, 5, 2500), np.full(2500, 2), rng.uniform(-3, 3, 2500)])
    splats = splats_at(np.concatenate([ball, wall]) + OFFSET, 0.1)
    position, target = choose_view(splats, np.float64([0, 0, 1]))
    assert position[1] < OFFSET[1] - 1 and position[2] > target[2]


@pytest.mark.parametrize(("size", "is_background"), [(0.05, False), (3.0, True)])
def test_small_outliers_are_no_background(size, is_background):
    """They cover less than a hundredth of a cell of the view. As many large splats fill the cells."""
    rng = np.random.default_rng(8)
    depths = rng.uniform(20, 60, 2000)
    means = np.column_stack([rng.uniform(-1, 1, (2000, 2)) * (0.7, 0.39), np.ones(2000)]) * depths[:, None]
    empty = _clarity(np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.eye(4), 5.0)
    score = _clarity(means, np.full(2000, size), np.full(2000, 0.9), np.eye(4), 5.0)
    assert empty == pytest.approx(0.3)
    assert score == pytest.approx(1.5 if is_background else 0.3, abs=0.1)


def test_view_of_a_room_is_from_inside():
    half = np.float64([3, 2.5, 1.3])
    position, _ = choose_view(splats_at(box_faces(tuple(half)), 0.1), np.float64([0, 0, 1]))
    assert (np.abs(position) < half).all()


def test_view_of_a_furnished_room_is_from_inside():
    """A table in the middle has a tenth of the splats."""
    half = np.float64([3, 2.5, 1.3])
    walls = box_faces(tuple(half))
    table = np.random.default_rng(7).uniform(-0.5, 0.5, (len(walls) // 9, 3)) * (1, 0.7, 0.4) - (0, 0, 0.8)
    means = np.concatenate([walls, table])
    position, _ = choose_view(splats_at(means, 0.1), np.float64([0, 0, 1]))
    assert (np.abs(position) < half).all()
    open_air = means[means[:, 2] < 1.2]  # without a ceiling
    position, _ = choose_view(splats_at(open_air, 0.1), np.float64([0, 0, 1]))
    assert not (np.abs(position) < half).all()


def test_view_of_a_room_shows_the_furniture():
    """A sofa in the middle has an eighth of the splats. It is completely in the image."""
    half, sofa, middle = np.float64([(3, 4, 1.4), (0.9, 0.4, 0.4), (0, 0.5, -1)])
    walls = box_faces(tuple(half))
    filled = np.random.default_rng(7).uniform(-1, 1, (len(walls) // 7, 3)) * sofa + middle
    up = np.float64([0, 0, 1])
    position, target = choose_view(splats_at(np.concatenate([walls, filled]), 0.1), up)
    assert (np.abs(position) < half).all()
    pose = look_at(position, target, up)
    corners = middle + sofa * list(itertools.product((-1, 1), repeat=3))
    x, y, z = pose[:3, :3] @ corners.T + pose[:3, 3:]
    assert (z > 0.1).all() and (np.abs(x) < 0.7 * z).all() and (np.abs(y) < 0.7 * 9 / 16 * z).all()


@pytest.mark.parametrize("case", ["brush", "postshot", "outliers"])
def test_splats_of_other_programs_open_with_the_same_view(case):
    """A garden as Brush (y down, other scale), Postshot (z up, far from 0) and with far, large outliers."""
    base = splats_at(garden(), 0.1)
    turn, scale, offset = np.float64(Y_DOWN), 1.0, np.zeros(3)
    if case == "brush":
        scale = 0.3
    elif case == "postshot":
        turn, offset = np.eye(3), np.float64([5200, -3100, 400])
    splats = splats_at(scale * base.means.astype(np.float64) @ turn.T + offset, 0.1 * scale)
    if case == "outliers":
        rng = np.random.default_rng(6)
        directions = rng.normal(size=(300, 3))
        directions *= rng.uniform(100, 1000, (300, 1)) / np.linalg.norm(directions, axis=1, keepdims=True)
        splats = Splats.concatenated([splats, splats_at(directions, 5.0)])
    bundle = Bundle("", [Level(1, splats)])
    complete_meta(bundle)
    position, target = (np.float64(point) - offset for point in bundle.meta["view"])
    position, target = (point @ turn / scale for point in (position, target))  # in the garden's own space
    np.testing.assert_allclose(bundle.up_rotation[2], turn @ (0, 0, 1), atol=1e-9)
    np.testing.assert_allclose(target, (0, 0, 0.25), atol=0.3)
    assert 0.5 < position[2] < 5 and 3 < np.linalg.norm(position[:2]) < 10


def test_view_avoids_splats_near_the_eye():
    """A veil covers one half of the candidates around a ball."""
    rng = np.random.default_rng(4)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    veil = splats_at(
        np.column_stack([rng.uniform(1.2, 3, 60), rng.uniform(-3, 3, 60), rng.uniform(0, 2, 60)]), 0.5
    )
    position, _ = choose_view(Splats.concatenated([splats_at(ball, 0.05), veil]), np.float64([0, 0, 1]))
    assert position[0] < 0


def test_clutter_is_counted():
    means = np.concatenate([box_faces((1, 1, 1), 2000), np.full((7, 3), 1e3)])
    splats = splats_at(means)
    splats.log_scales[:3] = np.log(2.0)
    assert [line.split(" splats ")[0] for line in describe_clutter(splats)] == ["3", "7"]
    assert describe_clutter(splats_at(box_faces((1, 1, 1), 2000))) == []


def test_known_directions_and_views_are_kept():
    meta = {"up_rotation": np.eye(3).tolist(), "view": [[0, 0, 1], [0, 0, 0]]}
    bundle = Bundle("", [Level(1, splats_at(garden()))], meta=dict(meta))
    complete_meta(bundle)
    assert bundle.meta == meta
    bundle = Bundle("", [Level(1, splats_at(garden()))])
    complete_meta(bundle)
    assert bundle.meta["up_rotation"] == np.eye(3).tolist() and np.shape(bundle.meta["view"]) == (2, 3)
    few = Bundle("", [Level(1, splats_at(garden()[:100]))])
    complete_meta(few)
    assert few.meta == {}


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
def test_invalid_values_change_nothing(value):
    """Files of other programs have such values in some splats; all of them may be invalid."""
    splats = splats_at(garden())
    expected = choose_view(splats, np.float64([0, 0, 1]))
    bad = splats_at(garden()[:300])
    bad.means[:100], bad.log_scales[100:200], bad.opacity_logits[200:] = value, value, np.nan
    damaged = Splats.concatenated([splats, bad])
    position, target = choose_view(damaged, np.float64([0, 0, 1]))
    np.testing.assert_allclose(target, expected[1], atol=0.5)
    assert np.isfinite(position).all() and guess_up_rotation(damaged).tolist() == np.eye(3).tolist()
    describe_clutter(damaged)
    splats.means[:] = np.nan
    assert choose_view(splats, np.float64([0, 0, 1])) is None and describe_clutter(splats) == []
