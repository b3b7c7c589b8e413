"""Ground planes of synthetic scenes and of the example scene."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.ground import find_ground, fit_plane, ground_placement, ground_plane, scaling_about

UP = np.array([0.0, 0.0, 1.0])
GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def scene(seed: int, size: float = 1.0, roughness: float = 0.01) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points of a ground with a table, a wall and objects, noise below it and distant floaters.

    Returns:
        The points, the ground's normal, tilted by up to 30 degrees, and a point on the ground.
    """
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-5, 5, (3000, 2)), rng.normal(0, roughness, 3000)])
    table = np.column_stack([rng.uniform(-2, 2, (4000, 2)), rng.normal(1, 0.002, 4000)])
    wall = np.column_stack([rng.normal(4, 0.01, 3000), rng.uniform(-5, 5, 3000), rng.uniform(0, 4, 3000)])
    objects = rng.uniform((-3, -3, 0), (3, 3, 2), (2000, 3))
    noise = rng.uniform((-5, -5, -3), (5, 5, 0), (150, 3))
    far = rng.normal(0, 300, (200, 3))
    tilt = Rotation.from_euler("xyz", rng.uniform(-20, 20, 3), degrees=True).as_matrix()
    shift = rng.uniform(-50, 50, 3)
    points = np.concatenate([ground, table, wall, objects, noise, far]) @ tilt.T + shift
    return size * rng.permutation(points), tilt @ UP, size * shift


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_ground_plane_of_synthetic_scenes(seed, size):
    points, expected, point = scene(seed, size)
    normal, center = find_ground(points, UP)
    assert np.degrees(np.arccos(min(normal @ expected, 1))) < 0.2
    assert abs((center - point) @ expected) < 0.01 * size
    repeated, _ = find_ground(points, UP)
    np.testing.assert_array_equal(repeated, normal)


def test_rough_ground_of_splats_is_found():
    points, expected, point = scene(0, roughness=0.25)
    assert ground_plane(points, UP) is None
    normal, center = find_ground(points, UP)
    assert np.degrees(np.arccos(normal @ expected)) < 1
    assert abs((center - point) @ expected) < 0.1


def test_ground_plane_of_example():
    """The garden's ground is at z = 0 with bumps up to 0.03, between hills."""
    garden = read_scene(GARDEN)
    near = np.linalg.norm(garden.points - garden.center, axis=1) < 1.5 * garden.median_depth()
    normal, center = find_ground(garden.points[near], np.array([0.1, 0.1, 1]))
    assert np.degrees(np.arccos(normal[2])) < 0.5 and abs(center[2]) < 0.03


def test_scene_without_ground_is_rejected():
    ball = np.random.default_rng(0).normal(size=(5000, 3))
    for points in (ball / np.linalg.norm(ball, axis=1, keepdims=True), np.zeros((0, 3)), np.ones((100, 3))):
        with pytest.raises(LodgsError, match="no plane"):
            find_ground(points, UP)


def test_fit_plane_is_exact_for_three_points_and_least_squares_for_more():
    normal, center = fit_plane([[0, 0, 1], [1, 0, 2], [0, 1, 1]], UP)
    np.testing.assert_allclose(normal, np.array([-1, 0, 1]) / np.sqrt(2), atol=1e-12)
    np.testing.assert_allclose(center, [1 / 3, 1 / 3, 4 / 3])
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3)) * (3, 2, 0.1) @ Rotation.random(random_state=0).as_matrix()
    normal, center = fit_plane(points, UP)
    residual = np.square((points - center) @ normal).sum()
    for _ in range(300):  # no nearby plane fits better
        nearby = normal + rng.normal(0, 0.02, 3)
        nearby /= np.linalg.norm(nearby)
        assert np.square((points - center - rng.normal(0, 0.01, 3)) @ nearby).sum() >= residual


@pytest.mark.parametrize(
    "points,message",
    [([[0, 0, 0], [1, 1, 1]], "or more, not 2"), ([[0, 0, 0], [1, 1, 1], [3, 3, 3.0]], "on a line"),
     ([[1, 2, 3]] * 3, "on a line")],
)  # fmt: skip
def test_degenerate_points_are_rejected(points, message):
    with pytest.raises(LodgsError, match=message):
        fit_plane(points, UP)


@pytest.mark.parametrize("seed", range(5))
def test_ground_placement_levels_plane_at_zero(seed):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3) if seed else -UP
    normal, center = normal / np.linalg.norm(normal), rng.normal(size=3)
    placement = ground_placement(normal, center)
    np.testing.assert_allclose(placement.rotation @ normal, UP, atol=1e-12)
    np.testing.assert_allclose(placement.rotation @ placement.rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(placement.transform_points(center[None])[0], [*center[:2], 0], atol=1e-12)
    np.testing.assert_allclose(
        scaling_about(center, 3.0).transform_points(np.array([center, center + 1])), [center, center + 3]
    )
