"""The octree of Octree-GS: distances, levels, voxels and anchors, worked by hand."""

import numpy as np
import pytest

from training.errors import LodgsError
from training.lod import octree
from training.lod.rules import octree_wanted, octree_weights
from training.scenes.cameras import Camera


def camera(z: float, focal: float = 100.0) -> Camera:
    """Looks along +z from (0, 0, z)."""
    matrix = np.eye(4)
    matrix[2, 3] = -z
    return Camera("", 200, 200, focal, focal, 100.0, 100.0, matrix)


def test_the_wanted_level_rises_by_one_with_every_half_of_the_distance():
    distances = np.array([64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1000.0])
    assert octree_wanted(distances, 0.0, 32.0, 4).tolist() == [1, 1, 2, 3, 4, 4, 1]
    assert octree_wanted(distances, 1.0, 32.0, 4).tolist() == [1, 2, 3, 4, 4, 4, 1]


def test_a_level_fades_in_while_the_one_before_it_is_whole():
    wanted = np.array([1.0, 2.0, 2.25, 2.5, 2.625, 2.75, 3.0])
    assert octree_weights(wanted, 1).tolist() == [1, 1, 1, 1, 1, 1, 1]
    assert octree_weights(wanted, 2).tolist() == [0, 1, 1, 1, 1, 1, 1]
    assert octree_weights(wanted, 3).tolist() == [0, 0, 0, 0.5, 0.75, 1, 1]
    assert (octree_weights(wanted, 3) >= 0.5).tolist() == (np.round(wanted + 1e-9) >= 3).tolist()


def test_at_no_distance_at_all_everything_is_wanted():
    with np.errstate(divide="raise"):
        assert octree_wanted(np.zeros(1, np.float32), 0.0, 32.0, 4).tolist() == [4]


def test_numpy_and_torch_agree():
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    distances, bias = rng.uniform(0.1, 50, 1000), rng.uniform(0, 1, 1000)
    level = rng.integers(1, 6, 1000)
    by_numpy = octree_weights(octree_wanted(distances, bias, 20.0, 5), level)
    by_torch = octree_weights(
        octree_wanted(torch.tensor(distances), torch.tensor(bias), 20.0, 5), torch.tensor(level)
    )
    assert np.allclose(by_numpy, by_torch.numpy(), atol=1e-12)


def test_distances_are_of_what_a_view_sees_and_in_one_focal_length():
    points = np.array([[0, 0, 4.0], [0, 3.0, 4.0], [0, 0, -1.0], [30.0, 0, 4.0]])
    near, long = octree.view_distances(points, [camera(0.0), camera(0.0, focal=200.0)], 100.0)
    assert near.tolist() == [4.0, 5.0]  # behind, and outside the image, count for nothing
    assert long.tolist() == [2.0]  # twice the focal length, half as far; the second point is outside


def test_a_view_in_the_midst_of_points_does_not_make_levels_without_end():
    points = np.array([[0, 0, 1e-6], [0, 0, 9.0]])
    tree = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1), coarser=3)
    assert (tree.levels, tree.d_max) == (12, 8 * 9.0)  # log2 has room for 23; the coarse stay


def test_views_that_see_no_point_are_told():
    with pytest.raises(LodgsError, match="No training view sees"):
        octree.build(np.array([[0, 0, -1.0]]), [camera(0.0)], focal_px=100.0, footprint=2.0)


def test_levels_follow_from_the_range_of_distances():
    points = np.array([[0, 0, z] for z in (1.0, 2.0, 4.0, 8.0, 9.0)])
    tree = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1))
    assert (tree.levels, tree.d_max) == (4, 9.0)  # floor(log2 9) + 1
    # at the distance from which on a level is wanted, its voxel covers two pixels
    for level in range(1, 5):
        assert 100.0 * tree.size(level) / (tree.d_max / 2 ** (level - 1)) == pytest.approx(2.0)
    further = octree.build(points, [camera(0.0)], focal_px=100.0, footprint=2.0, quantiles=(0, 1), coarser=2)
    assert (further.levels, further.d_max) == (6, 36.0)
    assert further.size(3) == pytest.approx(tree.size(1))


def test_every_voxel_of_every_level_has_exactly_one_point_of_that_or_a_coarser_level():
    points = np.random.default_rng(3).uniform(-1, 1, (3000, 3))
    tree = octree.Octree(4, 1.0, 100.0, 0.7, points.min(0))
    level = octree.anchors(points, tree)
    for number in range(1, 5):
        occupied = np.unique(tree.keys(points, number))
        standing = tree.keys(points[(level > 0) & (level <= number)], number)
        assert sorted(standing) == occupied.tolist()


def test_voxels_of_different_levels_and_places_have_different_names():
    points = np.array([[x, y, z] for x in range(6) for y in range(6) for z in range(6)]) + 0.5
    tree = octree.Octree(12, 1.0, 1.0, 2048.0, np.zeros(3))
    fine = tree.keys(points, 12)  # voxels of edge 1
    assert len(set(fine)) == len(points)
    assert not set(fine) & set(tree.keys(points, 11))
    assert len(set(tree.keys(points, 11))) == 27
    assert (tree.keys(points, np.full(len(points), 12)) == fine).all()
    assert (fine >= 0).all()
