"""Tests of the octree of Octree-GS: distances, levels, voxels and anchors."""

import numpy as np
import pytest

from training.errors import LodgsError
from training.optimize.anchors import anchor_octree as octree
from training.scenes.cameras import Camera


def camera(z: float, focal: float = 100.0) -> Camera:
    """Return a camera at (0, 0, z) that looks along +z."""
    matrix = np.eye(4)
    matrix[2, 3] = -z
    return Camera("", 200, 200, focal, focal, 100.0, 100.0, matrix)


def test_distances_use_visible_points_and_one_focal_length():
    points = np.array([[0, 0, 4.0], [0, 3.0, 4.0], [0, 0, -1.0], [30.0, 0, 4.0]])
    near, long = octree.visible_distances(points, [camera(0.0), camera(0.0, focal=200.0)], 100.0)
    assert near.tolist() == [4.0, 5.0]  # points behind the camera or outside the image are ignored
    assert long.tolist() == [2.0]  # twice the focal length halves distances; the second point is outside


def test_camera_among_points_gives_few_levels():
    points = np.array([[0, 0, 1e-6], [0, 0, 9.0]])
    tree = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1), coarser=3)
    assert (tree.levels, tree.d_max) == (12, 8 * 9.0)  # the range has 23 levels; coarse ones are kept


def test_views_without_points_raise():
    with pytest.raises(LodgsError, match="no training view sees"):
        octree.build(np.array([[0, 0, -1.0]]), [camera(0.0)], focal_px=100.0, footprint=2.0)


def test_level_count_from_distance_range():
    points = np.array([[0, 0, z] for z in (1.0, 2.0, 4.0, 8.0, 9.0)])
    tree = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1))
    assert (tree.levels, tree.d_max) == (4, 9.0)  # floor(log2 9) + 1
    # at the distance where a level starts, its voxel covers two pixels
    for level in range(1, 5):
        assert 100.0 * tree.size(level) / (tree.d_max / 2 ** (level - 1)) == pytest.approx(2.0)
    further = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1), coarser=2)
    assert (further.levels, further.d_max) == (6, 36.0)
    assert further.size(3) == pytest.approx(tree.size(1))
    single = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1), levels=1)
    assert single.d_max == 9.0
    assert 100.0 * single.size(1) / 1.0 == pytest.approx(2.0), "two pixels at the nearest point"


def test_every_voxel_has_one_point():
    points = np.random.default_rng(3).uniform(-1, 1, (3000, 3))
    tree = octree.AnchorOctree(4, 1.0, 100.0, 0.7, points.min(0))
    level = octree.anchors(points, tree)
    for number in range(1, 5):
        occupied = np.unique(tree.keys(points, number))
        standing = tree.keys(points[(level > 0) & (level <= number)], number)
        assert sorted(standing) == occupied.tolist()


def test_voxel_keys_are_unique():
    points = np.array([[x, y, z] for x in range(6) for y in range(6) for z in range(6)]) + 0.5
    tree = octree.AnchorOctree(12, 1.0, 1.0, 2048.0, np.zeros(3))
    fine = tree.keys(points, 12)  # voxels of edge 1
    assert len(set(fine)) == len(points)
    assert not set(fine) & set(tree.keys(points, 11))
    assert len(set(tree.keys(points, 11))) == 27
    assert (tree.keys(points, np.full(len(points), 12)) == fine).all()
    assert (fine >= 0).all()
