"""The ground of made-up scenes whose plane is known, and of the example, whose makers laid it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.ground import find_ground, fit_plane, ground_placement, scaling_about

UP = np.array([0.0, 0.0, 1.0])
GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def scene(seed: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of an uneven ground with a table, a wall and things on it, some noise below, floaters far away.

    Returns:
        The places, the ground's normal, which leans up to 30 degrees, and a point of it.
    """
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-5, 5, (3000, 2)), rng.normal(0, 0.01, 3000)])
    table = np.column_stack([rng.uniform(-2, 2, (4000, 2)), rng.normal(1, 0.002, 4000)])
    wall = np.column_stack([rng.normal(4, 0.01, 3000), rng.uniform(-5, 5, 3000), rng.uniform(0, 4, 3000)])
    things = rng.uniform((-3, -3, 0), (3, 3, 2), (2000, 3))
    noise = rng.uniform((-5, -5, -3), (5, 5, 0), (150, 3))
    far = rng.normal(0, 300, (200, 3))
    tilt = Rotation.from_euler("xyz", rng.uniform(-20, 20, 3), degrees=True).as_matrix()
    shift = rng.uniform(-50, 50, 3)
    places = np.concatenate([ground, table, wall, things, noise, far]) @ tilt.T + shift
    return size * rng.permutation(places), tilt @ UP, size * shift


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_the_ground_is_under_the_table_and_level_with_what_stands_on_it(seed, size):
    places, wanted, point = scene(seed, size)
    normal, middle = find_ground(places, UP)
    assert np.degrees(np.arccos(min(normal @ wanted, 1))) < 0.2
    assert abs((middle - point) @ wanted) < 0.01 * size
    again, _ = find_ground(places, UP)
    np.testing.assert_array_equal(again, normal)


def test_the_examples_ground_is_found():
    """A level garden at z = 0, of which its maker says that nothing is more than 0.03 high; there are hills
    about it."""
    garden = read_scene(GARDEN)
    near = np.linalg.norm(garden.points - garden.center, axis=1) < 1.5 * garden.median_depth()
    normal, middle = find_ground(garden.points[near], np.array([0.1, 0.1, 1]))
    assert np.degrees(np.arccos(normal[2])) < 0.5 and abs(middle[2]) < 0.03


def test_a_scene_without_a_ground_is_refused_in_a_sentence():
    ball = np.random.default_rng(0).normal(size=(5000, 3))
    for places in (ball / np.linalg.norm(ball, axis=1, keepdims=True), np.zeros((0, 3)), np.ones((100, 3))):
        with pytest.raises(LodgsError, match="No plane lies under"):
            find_ground(places, UP)


def test_three_places_make_their_plane_and_more_the_one_with_least_squares():
    normal, middle = fit_plane([[0, 0, 1], [1, 0, 2], [0, 1, 1]], UP)
    np.testing.assert_allclose(normal, np.array([-1, 0, 1]) / np.sqrt(2), atol=1e-12)
    np.testing.assert_allclose(middle, [1 / 3, 1 / 3, 4 / 3])
    rng = np.random.default_rng(0)
    places = rng.normal(size=(40, 3)) * (3, 2, 0.1) @ Rotation.random(random_state=0).as_matrix()
    normal, middle = fit_plane(places, UP)
    least = np.square((places - middle) @ normal).sum()
    for _ in range(300):  # no plane nearby is nearer
        other = normal + rng.normal(0, 0.02, 3)
        other /= np.linalg.norm(other)
        assert np.square((places - middle - rng.normal(0, 0.01, 3)) @ other).sum() >= least


@pytest.mark.parametrize(
    "places,words",
    [([[0, 0, 0], [1, 1, 1]], "2 places"), ([[0, 0, 0], [1, 1, 1], [3, 3, 3.0]], "on a line"),
     ([[1, 2, 3]] * 3, "on a line")],
)  # fmt: skip
def test_what_makes_no_plane_is_refused(places, words):
    with pytest.raises(LodgsError, match=words):
        fit_plane(places, UP)


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_becomes_level_at_zero_about_its_point(seed):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3) if seed else -UP
    normal, middle = normal / np.linalg.norm(normal), rng.normal(size=3)
    placement = ground_placement(normal, middle)
    np.testing.assert_allclose(placement.rotation @ normal, UP, atol=1e-12)
    np.testing.assert_allclose(placement.rotation @ placement.rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(placement.points(middle[None])[0], [*middle[:2], 0], atol=1e-12)
    np.testing.assert_allclose(scaling_about(middle, 3.0).points([middle, middle + 1]), [middle, middle + 3])
