"""Evidence for splats whose visibility and angles are known."""

import numpy as np
import pytest

from tests.training.conftest import look_at
from training.scenes.cameras import Camera
from training.scenes.splat_evidence import GRADES, measure_splat_evidence


def camera(position, target=(0.0, 0.0, 0.0)) -> Camera:
    return Camera("view", 320, 240, 300.0, 300.0, 160.0, 120.0, look_at(position, target))


def arc(*degrees: float, distance: float = 4.0) -> list[Camera]:
    """Cameras around the origin, at angles from the z axis."""
    angles = np.radians(degrees)
    return [camera((distance * np.sin(a), 0.0, distance * np.cos(a))) for a in angles]


def measure(cameras, means, size=0.01, opacity=1.0):
    count = len(means)
    return measure_splat_evidence(
        cameras, np.array(means, np.float32), np.full(count, size), np.full(count, opacity)
    )


def test_photos_and_angles_of_a_single_splat():
    evidence = measure(arc(-20, 0, 40), [(0.0, 0.0, 0.0), (0.0, 9.0, 0.0)])
    assert evidence.photos.tolist() == [3, 0]  # the second is outside of every frame
    middle = np.degrees(np.arctan2(np.sin(np.radians([-20, 0, 40])).sum(),
                                   np.cos(np.radians([-20, 0, 40])).sum()))  # fmt: skip
    assert evidence.parallax[0] == pytest.approx(2 * max(40 - middle, middle + 20), abs=1e-3)
    assert evidence.parallax[1] == 0


def test_opaque_splats_in_front_hide_others():
    """The first camera looks along z onto a wall; the second sees behind it."""
    grid = np.mgrid[-1:1:81j, -1:1:81j].reshape(2, -1).T
    wall = np.column_stack([grid, np.zeros(len(grid))])
    means = [*wall.tolist(), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)]
    views = [camera((0.0, 0.0, 4.0)), camera((0.0, 0.0, -4.0))]
    photos = measure(views, means, size=0.02).photos
    assert photos[-2:].tolist() == [1, 1]
    assert (photos[:-2] == 2).mean() > 0.95  # the wall from both sides
    assert measure(views, means, size=0.02, opacity=0.3).photos.min() == 2  # transparent


def test_large_splats_hide_what_lies_between_their_centers():
    means, sizes = np.array([(0.0, 0.0, 0.0), (0.3, 0.2, -2.0), (0.0, 0.0, 2.0)]), [1.0, 0.01, 0.01]
    evidence = measure_splat_evidence([camera((0.0, 0.0, 6.0))], means, np.array(sizes), np.ones(3))
    assert evidence.photos.tolist() == [1, 0, 1]


def test_grades_follow_photos_and_angles():
    means = [(0.0, 0.0, 0.0)]
    cases = {(): 0, (0,): 0, (0, 40): 1, (0, 1, 2): 2, (0, 10, 20): 3}
    for degrees, grade in cases.items():
        assert measure(arc(*degrees), means).grades.tolist() == [grade]
    assert len(GRADES) == 4
