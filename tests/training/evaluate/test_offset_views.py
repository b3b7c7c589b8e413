"""Veils and oversized splats between cameras, for positions and walls with known results."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from training.evaluate.offset_views import MAX_POSITIONS, VEIL_DEPTH, count_oversized, measure_veil
from training.evaluate.views import Evaluation
from training.optimize.support import midpoint_views
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera, pick_evenly
from training.splats.gaussians import Splats

MEDIAN_DEPTH = 10.0


def camera(x: float, angle: float = 0.0, width: int = 64) -> Camera:
    """Return a camera at (x, 0, 0) that looks along +z, turned about y, with a field of view of 90°."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = -pose[:3, :3] @ [x, 0, 0]
    return Camera(f"{x}", width, width, width / 2, width / 2, width / 2, width / 2, pose)


def wall(depth: float, left: float = -1.2, right: float = 1.2, opacity_logit: float = 6.0) -> Splats:
    """Return a grid of small round splats at z = ``depth``, from ``left`` to ``right`` times the depth."""
    x, y = (
        axis.ravel() * depth for axis in np.meshgrid(np.arange(left, right, 0.04), np.arange(-1.2, 1.2, 0.04))
    )
    count = len(x)
    return Splats(
        means=np.stack([x, y, np.full(count, depth)], 1).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(0.02 * depth), np.float32),
        opacity_logits=np.full(count, opacity_logit, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def evaluation(*cameras: Camera) -> Evaluation:
    centers = np.array([camera.center for camera in cameras])
    data = SimpleNamespace(
        train=list(cameras), test=[], median_depth=MEDIAN_DEPTH, near=0.01 * MEDIAN_DEPTH,
        mean_camera=centers.mean(0), extent=2.0,
    )  # fmt: skip
    return Evaluation(data, "cpu")


def test_positions_are_halfway_to_the_first_second_and_fourth_nearest():
    cameras = [camera(x, turn) for x, turn in ((0, 0.1), (1, 0.2), (3, 0.3), (7, 0.4), (15, 0.5))]
    offset_cameras = midpoint_views(cameras)
    assert [round(float(offset.center[0]), 6) for offset in offset_cameras] == [
        0.5, 1.5, 7.5,  # from 0: to 1, 3 and 15
        0.5, 2.0, 8.0,  # from 1: to 0, 3 and 15
        2.0, 1.5, 9.0,  # from 3: to 1, 0 and 15
        5.0, 4.0, 11.0,  # from 7: to 3, 1 and 15
        11.0, 9.0, 7.5,  # from 15: to 7, 3 and 0
    ]  # fmt: skip
    for number, offset in enumerate(offset_cameras):
        np.testing.assert_array_equal(
            offset.world_to_camera[:3, :3], cameras[number // 3].world_to_camera[:3, :3]
        )
        assert offset.image is None


def test_two_cameras_share_their_midpoint():
    assert [offset.center[0] for offset in midpoint_views([camera(-1), camera(1)])] == [0, 0]


def test_positions_are_limited_evenly():
    chosen = pick_evenly(range(3 * MAX_POSITIONS), MAX_POSITIONS)  # three per camera
    assert len(chosen) == len(set(chosen)) == MAX_POSITIONS
    assert (chosen[0], chosen[-1]) == (0, 3 * MAX_POSITIONS - 1)
    kinds = np.bincount(np.array(chosen) % 3)
    assert kinds.min() >= MAX_POSITIONS / 4
    assert pick_evenly([7, 8, 9], 5) == [7, 8, 9] and pick_evenly([], 5) == []


@pytest.mark.parametrize(
    ("splats", "share"),
    [
        (wall(0.5), 1.0),
        (wall(0.95), 1.0),
        (wall(1.05), 0.0),
        (wall(5.0), 0.0),
        (wall(0.05), 0.0),  # in front of the near plane
        (wall(0.5, right=0.0), 0.5),
        (wall(0.5, left=0.5), 0.25),
        (wall(0.5, opacity_logit=-4.0), 0.0),  # absorbs less than half of the light
        (wall(0.5, opacity_logit=-4.0).select(slice(0, 0)), 0.0),
    ],
)
def test_veil_of_a_wall_is_its_share_of_the_image(splats, share):
    result = measure_veil(evaluation(camera(-1), camera(1)), lambda camera: (splats, None))
    assert result["mean"] == result["max"] == pytest.approx(share, abs=0.03)  # soft edge of half a splat


def test_veiled_pixels_have_a_median_depth_below_the_limit():
    """Compare with the reference rasterizer's median depth of random splats."""
    rng = np.random.default_rng(3)
    splats = wall(1.0).select(slice(0, 400))
    means = rng.uniform((-1, -1, 0.2), (1, 1, 3), (400, 3)).astype(np.float32)
    logits, scales = rng.normal(0, 2, 400), rng.normal(-2.5, 0.5, (400, 3))
    splats = replace(
        splats, means=means, opacity_logits=logits.astype(np.float32), log_scales=scales.astype(np.float32)
    )
    views = evaluation(camera(-1), camera(1))
    depth = rasterize(
        Gaussians.of(splats), camera(0), near=views.data.near, outputs=("median_depth",), backend="reference"
    ).median_depth
    assert depth is not None
    share = float(((depth > 0) & (depth < VEIL_DEPTH * MEDIAN_DEPTH)).float().mean())
    assert 0.05 < share < 0.95
    assert measure_veil(views, lambda camera: (splats, None))["mean"] == pytest.approx(share, abs=1e-3)


def test_weights_of_each_position_are_applied():
    splats = wall(0.5)
    positions = []

    def source(camera):
        positions.append(float(camera.center[0]))
        return splats, np.full(len(splats), 0.0 if len(positions) % 2 else 1.0, np.float32)

    result = measure_veil(evaluation(camera(-1), camera(1)), source)
    assert positions == [0, 0] and result == {"mean": 0.5, "max": 1.0}


def test_mean_and_maximum_are_over_positions():
    # positions: 0 and 49 from -1, 0 and 50 from 1, 100 and 50 from 99, 100 and 51 from 101; the wall is at 0
    views = evaluation(camera(-1), camera(1), camera(99), camera(101))
    assert measure_veil(views, lambda camera: (wall(0.5), None)) == {"mean": 0.25, "max": 1.0}


def test_oversized_splats_are_opaque_large_and_among_the_cameras():
    large, small, opaque, clear = np.log(5.1), np.log(4.9), 0.1, -0.1
    rows = [  # x, largest scale, opacity
        (0.0, large, opaque),  # counted
        (1.9, large, opaque),  # counted
        (2.1, large, opaque),  # outside
        (0.0, small, opaque),
        (0.0, large, clear),
    ]
    x, scale, logit = np.array(rows, np.float32).T
    splats = replace(wall(1.0).select(slice(0, len(rows))), opacity_logits=logit)
    splats = replace(
        splats,
        means=np.stack([x, 0 * x, 0 * x], 1),
        log_scales=np.stack([scale - 3, scale, scale - 1], 1),
    )
    data = evaluation(camera(-1), camera(1)).data
    assert count_oversized(data, lambda camera: (splats, None)) == 2
    weights = np.float32([1.0, 0.9, 1, 1, 1])  # 0.9 of 0.525 is not opaque
    assert count_oversized(data, lambda camera: (splats, weights)) == 1
