"""Smooth camera paths: straight paths stay, zigzags are flattened, ends are fixed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.errors import LodgsError
from training.scenes.camera_path import smooth_path


def test_straight_path_stays_straight_with_constant_speed():
    positions = np.linspace((0, 0, 0), (10, 0, 5), 21)
    rotations = Rotation.from_euler("z", np.linspace(0, 90, 21)[:, None], degrees=True)
    quats = rotations.as_quat()[:, [3, 0, 1, 2]]
    quats[::3] *= -1  # the same rotations
    smooth, smooth_quats, times = smooth_path(positions, quats)
    np.testing.assert_allclose(smooth, positions, atol=1e-9)
    np.testing.assert_allclose(times, np.linspace(0, 1, 21), atol=1e-9)
    assert (np.einsum("ij,ij->i", smooth_quats[1:], smooth_quats[:-1]) > 0.99).all()
    angles = (rotations.inv() * Rotation.from_quat(smooth_quats[:, [1, 2, 3, 0]])).magnitude()
    assert np.degrees(angles).max() < 0.1


def test_zigzag_is_flattened_between_fixed_ends():
    positions = np.column_stack([np.arange(30.0), 0.5 * (-1.0) ** np.arange(30), np.zeros(30)])
    smooth, _, times = smooth_path(positions, np.tile([1.0, 0, 0, 0], (30, 1)))
    np.testing.assert_allclose(smooth[[0, -1]], positions[[0, -1]])
    assert np.abs(smooth[4:-4, 1]).max() < 0.01
    assert (np.diff(times) > 0).all() and (times[0], times[-1]) == (0, 1)


def test_path_needs_two_distinct_positions():
    quat = np.array([[1.0, 0, 0, 0]])
    with pytest.raises(LodgsError, match="1 view"):
        smooth_path(np.zeros((1, 3)), quat)
    with pytest.raises(LodgsError, match="one position"):
        smooth_path(np.ones((5, 3)), np.tile(quat, (5, 1)))
