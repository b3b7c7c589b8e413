"""Views that are pulled back: camera, rule of a bundle, and popping."""

from types import SimpleNamespace

import numpy as np
import pytest

from training.evaluate.distance import FRAMES, measure_farther_views, measure_popping, pull_back
from training.evaluate.metrics import MAX_PSNR
from training.evaluate.views import Evaluation
from training.lod.selection import complete_splats, resolve_controls, select
from training.scenes.cameras import Camera
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level


def splats(count: int, seed: int, size: float, bias: float = 0.0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform((-1, -1, 4), (1, 1, 6), (count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(size), np.float32),
        opacity_logits=np.full(count, 1.0, np.float32),
        sh=rng.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
        extras={"lod_bias": np.full(count, bias, np.float32)},
    )


@pytest.fixture
def bundle() -> Bundle:
    """Full detail up to a distance of 8, level 1 alone from 32 on."""
    levels = [Level(1, splats(60, 1, 0.3)), Level(2, splats(200, 2, 0.1)), Level(3, splats(800, 3, 0.05))]
    return Bundle("octree", levels, "octree", {"d_max": 32.0, "d_max_focal": 100.0}, cumulative=True)


@pytest.fixture
def camera() -> Camera:
    return Camera("a", 64, 64, 100.0, 100.0, 32.0, 32.0, np.eye(4))


@pytest.fixture
def evaluation(camera) -> Evaluation:
    data = SimpleNamespace(train=[], test=[camera], median_depth=5.0, near=0.01)
    return Evaluation(data, "cpu")


def test_pulled_back_camera_multiplies_the_distance(camera):
    rng = np.random.default_rng(0)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, 3] = rng.normal(size=3)
    view = Camera("a", 64, 64, 100.0, 100.0, 32.0, 32.0, pose)
    target = np.linalg.inv(pose) @ [0, 0, 5, 1]  # straight ahead
    for factor in (1, 2, 8):
        moved = pull_back(view, factor, 5.0)
        assert np.linalg.norm(target[:3] - moved.center) == pytest.approx(5 * factor)
        assert np.allclose((moved.world_to_camera @ target)[:2], 0)


def test_octree_weights_match_the_formula(bundle):
    center, focal = np.array([0.5, 0, -7.0]), 80.0
    chosen, weights = select(bundle, center, focal, resolve_controls(bundle, {"offset": 0.25}))
    assert weights is not None
    expected = []
    for level in bundle.levels:  # per splat: L* = log2(d_max / d) + offset, rounded in half a level
        for mean in level.splats.means:
            distance = np.linalg.norm(mean - center) * 100 / focal
            target = min(max(np.log2(32 / distance) + 0.25, 0), 2)
            weight = min(max(2 * (target + 1 - level.number + 0.5) + 0.5, 0), 1)
            if weight > 0:
                expected.append((*mean, weight))
    assert len(expected) > 300 and sum(0 < weight < 1 for *_, weight in expected) > 50
    np.testing.assert_allclose(np.column_stack([chosen.means, weights]), expected, atol=1e-5)


def test_only_cumulative_levels_include_coarser_ones(bundle):
    assert len(complete_splats(bundle, bundle.levels[1])) == 260
    separate = Bundle("flod", bundle.levels)
    assert len(complete_splats(separate, separate.levels[1])) == 200


@pytest.mark.slow
def test_farther_views_draw_fewer_splats(bundle, evaluation):
    rows = measure_farther_views(evaluation, bundle, resolve_controls(bundle, {}))
    assert [row["factor"] for row in rows] == [1, 2, 4, 8]
    drawn = [row["drawn"] for row in rows]
    assert drawn[0] == rows[0]["drawn_full"] and rows[0]["psnr"] == MAX_PSNR
    assert drawn[0] > drawn[2] > drawn[3]
    assert all(np.isfinite(row["psnr"]) for row in rows[2:])


def test_fading_reduces_popping(bundle, evaluation, camera):
    popping = measure_popping(evaluation, bundle, resolve_controls(bundle, {}), camera)
    assert len(popping["faded"]) == FRAMES - 1 and max(popping["faded"]) < max(popping["hard"])


def test_invisible_splats_do_not_pop(bundle, evaluation, camera):
    for level in bundle.levels:
        level.splats.opacity_logits[:] = -20
    popping = measure_popping(evaluation, bundle, resolve_controls(bundle, {}), camera)
    assert popping == {"faded": [0] * (FRAMES - 1), "hard": [0] * (FRAMES - 1)}
