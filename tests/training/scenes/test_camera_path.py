"""Ways that are known: a straight one stays, a zigzag is flattened, ends are kept."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import LodgsError
from training.scenes.camera_path import smooth_path


def test_a_straight_way_stays_straight_and_even():
    positions = np.linspace((0, 0, 0), (10, 0, 5), 21)
    turns = Rotation.from_euler("z", np.linspace(0, 90, 21)[:, None], degrees=True)
    quats = turns.as_quat()[:, [3, 0, 1, 2]]
    quats[::3] *= -1  # the same rotations
    found, turned, times = smooth_path(positions, quats)
    np.testing.assert_allclose(found, positions, atol=1e-9)
    np.testing.assert_allclose(times, np.linspace(0, 1, 21), atol=1e-9)
    assert (np.einsum("ij,ij->i", turned[1:], turned[:-1]) > 0.99).all()
    angles = (turns.inv() * Rotation.from_quat(turned[:, [1, 2, 3, 0]])).magnitude()
    assert np.degrees(angles).max() < 0.1


def test_steps_are_flattened_and_ends_kept():
    positions = np.column_stack([np.arange(30.0), 0.5 * (-1.0) ** np.arange(30), np.zeros(30)])
    found, _, times = smooth_path(positions, np.tile([1.0, 0, 0, 0], (30, 1)))
    np.testing.assert_allclose(found[[0, -1]], positions[[0, -1]])
    assert np.abs(found[4:-4, 1]).max() < 0.01
    assert (np.diff(times) > 0).all() and (times[0], times[-1]) == (0, 1)


def test_what_makes_no_way_is_refused():
    one = np.array([[1.0, 0, 0, 0]])
    with pytest.raises(LodgsError, match="make no way"):
        smooth_path(np.zeros((1, 3)), one)
    with pytest.raises(LodgsError, match="at one place"):
        smooth_path(np.ones((5, 3)), np.tile(one, (5, 1)))
