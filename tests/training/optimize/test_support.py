"""Where splats may stand and how large they may be, on cameras whose free room is worked out by hand."""

import numpy as np
import pytest
import torch

from training.optimize.support import Support
from training.scenes.cameras import Camera


def camera(x: float, width: int = 100) -> Camera:
    """A camera at (x, 0, 0) that looks along +z, 90 degrees wide."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(f"{x:g}", width, width, width / 2, width / 2, width / 2, width / 2, pose)


def from_the_side(y: float, z: float) -> Camera:
    """A camera at (3, y, z) that looks along -x, 90 degrees wide."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[:3, 3] = -pose[:3, :3] @ [3, y, z]
    return Camera(f"{y:g}", 100, 100, 50, 50, 50, 50, pose)


def intruding(support: Support, means, share: float = 0.5) -> list[bool]:
    means = np.array(means, np.float32)
    return support.find_intruding(means, *support.nearest_positions(means), share).tolist()


@pytest.fixture
def support() -> Support:
    """Two cameras 2 apart before a wall at depth 10, with one stray point in 200 at depth 1."""
    x, y = np.meshgrid(np.linspace(-5, 5, 20), np.linspace(-5, 5, 10))
    wall = np.stack([x, y, np.full_like(x, 10.0)], -1).reshape(-1, 3)
    wall[0] = (0, 0, 1)
    return Support([camera(-1), camera(1)], wall.astype(np.float32))


def test_what_stands_nearer_than_a_share_of_the_nearest_points_intrudes(support):
    means = [(-1, 0, depth) for depth in (0.05, 1.0, 4.9, 5.1, 9.0)]
    assert intruding(support, means) == [True, True, True, False, False]  # half of 10, not of 1
    assert not any(intruding(support, means, share=0.0))


def test_what_is_farther_away_intrudes_only_in_a_view(support):
    # 5.1 away at least; the image ends where |y| = z, a tenth of its height wider on either side at 1.2 z
    beside, at_the_edge, in_the_image = (-1, 5, 4), (-1, 4.7, 4), (-1, 3.9, 4)
    assert intruding(support, [beside, at_the_edge, in_the_image]) == [False, True, True]


def test_what_is_beside_or_behind_a_camera_intrudes_unless_two_photographs_see_it():
    far, thing = (0, 0, 10.0), (0, 0, -2.0)
    beside, behind, away = (0, -4, 0), thing, (0, 0, -5.1)  # half of 10 around the eye has to be free
    for others, stays in (((), False), ((0,), False), ((0, 1), True)):
        cameras = [camera(0), camera(0.001), *(from_the_side(y, -2.0) for y in others)]
        alone = Support(cameras, np.array([far, thing], np.float32))
        assert intruding(alone, [beside, behind, away]) == [True, not stays, False]


def test_places_between_cameras_are_kept_free():
    # 90 degrees wide, the two cameras see x = 0 from z = 1 on: a share of 0.1 leaves 1 of 10 free
    around, before = (0, 0, 0.5), (0, 0.9, 0.8)  # 0.5 and 1.2 from between the two, 1.1 and 1.6 from them
    support = Support([camera(-1), camera(1)], np.array([[0, 0, 10.0]], np.float32))
    assert intruding(support, [around, before], 0.1) == [True, True]
    alone = Support([camera(-1)], np.array([[0, 0, 10.0]], np.float32))
    assert intruding(alone, [around, before], 0.1) == [False, False]


def test_a_view_without_points_forbids_nothing():
    empty = Support([camera(-1), camera(1)], np.array([[0, 0, -10.0]], np.float32))
    assert intruding(empty, [(0, 0, 0.01), (-1, 0, -0.01)]) == [False, False]


def test_the_nearest_place_of_a_point(support):
    means = np.array([(1, 0, 2), (0, 0, 3), (-4, 4, 0)], np.float32)
    distances, places = support.nearest_positions(means)
    assert distances == pytest.approx([2, 3, 5])
    assert places[[0, 2]].tolist() == [1, 0] and places[1] >= 2  # cameras come first, then what lies between


def test_training_leaves_nothing_in_the_way_and_nothing_too_large(data):
    """A splat before the camera goes, one that wraps the scene shrinks, the others stay as they are."""
    from training.methods import METHODS, create

    method = create("3dgs", data, METHODS["3dgs"].presets["draft"], 0, "cpu")
    p, before = method.parameters, len(method.model)
    eye = data.train[0]
    ahead = torch.tensor(eye.center + 0.02 * eye.world_to_camera[2, :3], dtype=torch.float32)
    rows = method.model.read_rows(torch.tensor([0, 0]))
    rows["means"][0] = ahead
    rows["log_scales"][1] = 9.0
    method.model.append(rows)
    method.prune_unsupported(0)
    assert len(method.model) == before + 1
    largest = method.model["log_scales"].detach().exp().amax(1).numpy()
    allowed = p.largest * data.support.nearest_positions(method.model["means"].detach().numpy())[0]
    assert (largest <= allowed * 1.0001).all() and largest[-1] == pytest.approx(allowed[-1], rel=1e-4)
