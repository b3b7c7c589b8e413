"""Levels and comparisons for the tests of formats of levels."""

import numpy as np
import pytest

from tests.training.splats.test_formats import random_splats
from training.scenes.cameras import Camera
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import read_bundle
from training.splats.formats import open_as_ply
from training.splats.levels import Bundle, Level

UP = [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6]]


def camera(name="images/a b.jpg"):
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, -1, 0], [0.6, 0, 0.8], [-0.8, 0, 0.6]])
    pose[:3, 3] = (0.3, -0.2, 4)
    return Camera(name, 640, 480, 500.0, 520.0, 300.0, 250.0, pose)


def flod(degree=3, **meta):
    levels = [
        Level(number, random_splats(20 * number, degree, number), {"s_min": s_min})
        for number, s_min in ((1, 0.4), (2, 0.1), (3, 0.0))
    ]
    tables = make_view_tables([camera(), camera(), camera("c.png")], 0.05)
    return Bundle("flod", levels, "bands", tables=tables, meta={"up_rotation": UP, **meta})


def read(path, warn=pytest.fail):
    with open_as_ply(path) as ply:
        return read_bundle(ply, warn)


def assert_equal(actual, expected, tolerance=1e-5):
    unit = expected.quats / np.linalg.norm(expected.quats, axis=1, keepdims=True)
    for actual_values, expected_values, limit in (
        (actual.means, expected.means, tolerance), (actual.log_scales, expected.log_scales, 1e-5),
        (actual.quats, unit, 1e-6), (actual.opacity_logits, expected.opacity_logits, 2e-3),
        (actual.sh, expected.sh, 0),
    ):  # fmt: skip
        np.testing.assert_allclose(actual_values, expected_values, atol=limit, rtol=1e-6)
