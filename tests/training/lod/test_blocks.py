"""Blocks of splats: culling does not change images, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.lod.blocks import SIZE, BlockIndex, block_quantiles
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera, look_at
from training.splats.gaussians import Splats
from training.splats.morton import spatial_order

COUNT = 40 * SIZE + 7  # of 41 blocks


@pytest.fixture(scope="module")
def splats():
    """A wide field of splats, with large ones on one side and some close to the camera."""
    rng = np.random.default_rng(3)
    means = (rng.uniform(-20, 20, (COUNT, 3)) * (1, 1, 0.05)).astype(np.float32)
    scales = rng.normal(-4, 0.7, (COUNT, 3)).astype(np.float32)
    scales[means[:, 0] > 14] += 3
    result = Splats(
        means, rng.normal(size=(COUNT, 4)).astype(np.float32), scales,
        rng.normal(0, 2, COUNT).astype(np.float32), rng.normal(size=(COUNT, 1, 3)).astype(np.float32),
    )  # fmt: skip
    return result.select(spatial_order(means))


def cameras():
    rng = np.random.default_rng(4)
    for number in range(12):
        focal = rng.uniform(20, 200)
        pose = look_at(rng.normal(0, (9, 9, 1)), rng.normal(0, (9, 9, 1)), (0, 0, 1))
        yield Camera(f"{number}", 96, 64, focal, focal * 1.2, rng.uniform(-20, 110), 30, pose)


def test_culled_blocks_are_invisible(splats):
    blocks, gaussians, left_out = BlockIndex.of(splats.means, splats.log_scales), Gaussians.of(splats), 0
    for camera in cameras():
        for near in (0.05, 2.0):
            visible = blocks.in_view(camera, near)
            rows = torch.from_numpy(blocks.rows(visible))
            culled = rasterize(gaussians, camera, near=near, rows=rows, backend="cpu")
            complete = rasterize(gaussians, camera, near=near, backend="cpu")
            assert torch.equal(culled.image, complete.image)
            assert torch.equal(culled.radii, complete.radii)
            left_out += len(gaussians) - len(rows)
    assert left_out > 0.2 * 24 * COUNT


def test_blocks_outside_the_image_are_culled():
    """Eight rows of splats along x, at different positions."""
    means = np.zeros((8 * SIZE, 3), np.float32)
    means[:, 0] = np.repeat(np.arange(-35, 45, 10), SIZE)
    blocks = BlockIndex.of(means, np.full((8 * SIZE, 3), -5.0))
    camera = Camera(
        "", 100, 100, 100.0, 100.0, 50.0, 50.0, look_at(np.zeros(3), np.array([1.0, 0, 0]), (0, 0, 1))
    )
    assert blocks.in_view(camera, 0.1).tolist() == [False] * 4 + [True] * 4
    assert blocks.in_view(camera, 20.0).tolist() == [False] * 6 + [True] * 2
    aside = replace(
        camera, world_to_camera=look_at(np.array([0, 0, 20.0]), np.array([5.0, 0, 20]), (0, 0, 1))
    )
    assert blocks.in_view(aside, 0.1).tolist() == [False] * 7 + [False]


def test_bounds_and_distances(splats):
    blocks = BlockIndex.of(splats.means, splats.log_scales)
    for position in ((0, 0, 0), (30, -4, 2)):
        distance = np.linalg.norm(splats.means.astype(np.float64) - position, axis=1)
        minimum, limit = (np.repeat(item, SIZE)[:COUNT] for item in blocks.distances(position))
        assert (minimum <= distance + 1e-9).all() and (distance <= limit + 1e-9).all()
    tight = np.linalg.norm(blocks.high - blocks.low, axis=1)
    shuffled = splats.select(np.random.default_rng(0).permutation(COUNT))
    mixed = BlockIndex.of(shuffled.means, shuffled.log_scales)
    loose = np.linalg.norm(mixed.high - mixed.low, axis=1)
    assert np.median(tight) < 0.4 * np.median(loose)


def test_rows_of_blocks(splats):
    blocks = BlockIndex.of(splats.means, splats.log_scales)
    assert len(blocks) == 41
    np.testing.assert_array_equal(blocks.rows(np.ones(41, bool)), np.arange(COUNT))
    subset = np.zeros(41, bool)
    subset[[1, 40]] = True
    np.testing.assert_array_equal(blocks.rows(subset), [*range(SIZE, 2 * SIZE), *range(40 * SIZE, COUNT)])
    assert blocks.rows(np.zeros(41, bool)).size == 0
    nothing = BlockIndex.of(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    assert nothing.rows(np.zeros(0, bool)).size == 0 and spatial_order(np.zeros((0, 3))).size == 0


def test_quantiles_within_blocks():
    values = np.random.default_rng(0).random(2 * SIZE + 100).astype(np.float32)
    result = block_quantiles(values, 0.7)
    for begin in (0, SIZE, 2 * SIZE):
        block, retained = values[begin : begin + SIZE], (values >= result)[begin : begin + SIZE]
        assert len(set(result[begin : begin + SIZE])) == 1
        assert retained.mean() == pytest.approx(0.3, abs=1.1 / len(block))
    assert (block_quantiles(values, 0.0) <= values).all()
    assert block_quantiles(values[:0], 0.5).size == 0
