"""Evidence of a scene's regions by photos, against arrangements with known counts and angles."""

import numpy as np

from training.scenes import evidence
from training.scenes.cameras import Camera, look_at
from training.scenes.evidence import measure_evidence


def arc(angles, distance=4.0):
    """Cameras at some angles in degrees around the z axis, which look at the origin."""
    return [
        Camera(f"{number}", 100, 80, 90.0, 90.0, 50.0, 40.0, look_at(
            distance * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0]),
            np.zeros(3), (0.0, 0.0, 1.0),
        ))
        for number, angle in enumerate(angles)
    ]  # fmt: skip


def test_regions_count_their_photos_and_the_angle_between_the_outermost():
    points = np.array([[0.01, 0.01, 0.01], [0.02, 0.02, 0.01], [1.0, 1.0, 1.0]], np.float32)
    observed = {"0": np.array([0]), "1": np.array([1]), "2": np.array([0, 1, 1]), "3": np.array([2])}
    result = measure_evidence(arc([0, 20, 40, 60]), points, observed)
    order = np.argsort(-result.points)
    assert result.points[order].tolist() == [2, 1]  # the first two points share a region
    assert result.photos[order].tolist() == [3, 1]
    np.testing.assert_allclose(result.parallax[order], [40, 0], atol=0.5)


def test_shares_weight_regions_by_their_points():
    result = evidence.Evidence(np.array([6, 3, 1]), np.array([5, 2, 4]), np.array([30.0, 1.0, 2.0]))
    np.testing.assert_allclose([result.weak_share, result.flat_share], [0.3, 0.1])
    assert result.quantile(result.photos, 0.5) == 5 and result.quantile(result.photos, 0.1) == 2


def test_coverage_does_not_depend_on_the_unit():
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.5, (200, 3)).astype(np.float32)
    observed = {str(view): rng.choice(200, 60) for view in range(6)}
    first = measure_evidence(arc(range(0, 60, 10)), points, observed)
    second = measure_evidence(arc(range(0, 60, 10), 4.0 * 64), 64 * points, observed)
    for values, scaled in zip(first, second, strict=True):
        np.testing.assert_allclose(values, scaled, atol=1e-3)


def test_scene_without_observations_has_no_regions():
    result = measure_evidence(arc([0, 20]), np.zeros((5, 3), np.float32), {})
    assert len(result.points) == 0 and result.weak_share == 0
