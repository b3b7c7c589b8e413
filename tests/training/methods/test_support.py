"""Where splats may stand and how large they may be, on cameras whose free room is worked out by hand."""

import numpy as np
import pytest
import torch

from training.methods.support import Support
from training.scenes.cameras import Camera


def camera(x: float, width: int = 100) -> Camera:
    """A camera at (x, 0, 0) that looks along +z, 90 degrees wide."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(f"{x:g}", width, width, width / 2, width / 2, width / 2, width / 2, pose)


@pytest.fixture
def support() -> Support:
    """Two cameras 2 apart before a wall at depth 10, with one stray point in 200 at depth 1."""
    x, y = np.meshgrid(np.linspace(-5, 5, 20), np.linspace(-5, 5, 10))
    wall = np.stack([x, y, np.full_like(x, 10.0)], -1).reshape(-1, 3)
    wall[0] = (0, 0, 1)
    return Support([camera(-1), camera(1)], wall.astype(np.float32))


def test_what_stands_nearer_than_a_share_of_the_nearest_points_intrudes(support):
    depths = np.array([0.05, 1.0, 4.9, 5.1, 9.0], np.float32)
    means = np.stack([np.full(5, -1.0), np.zeros(5), depths], 1).astype(np.float32)
    found = support.intruding(means, support.distances(means), share=0.5)
    assert found.tolist() == [True, True, True, False, False]  # half of 10, whatever the stray point says
    assert not support.intruding(means, support.distances(means), share=0.0).any()


def test_only_what_is_in_a_view_intrudes(support):
    behind, beside, at_the_edge = (-1, 0, -0.5), (-1, 3, 2), (-1, 2.3, 2)
    means = np.array([behind, beside, at_the_edge], np.float32)
    # the image ends where |y| = z; widened by a tenth of its height on either side at |y| = 1.2 z
    assert support.intruding(means, support.distances(means), 0.5).tolist() == [False, False, True]


def test_places_between_cameras_are_kept_free(support):
    means = np.array([(0, 0, 0.5)], np.float32)  # 45 degrees wide, the two cameras see it from z = 1 on
    alone = Support([camera(-1), camera(1)], np.array([[0, 0, 10.0]], np.float32))
    alone._views, alone._nearest = alone._views[:2], alone._nearest[:2]
    assert support.intruding(means, support.distances(means), 0.5).all()
    assert not alone.intruding(means, alone.distances(means), 0.5).any()


def test_a_view_without_points_forbids_nothing():
    empty = Support([camera(-1), camera(1)], np.array([[0, 0, -10.0]], np.float32))
    means = np.array([(0, 0, 0.01)], np.float32)
    assert not empty.intruding(means, empty.distances(means), 0.5).any()


def test_distances_are_to_the_nearest_place(support):
    means = np.array([(1, 0, 2), (0, 0, 3), (-4, 4, 0)], np.float32)
    assert support.distances(means) == pytest.approx([2, 3, 5])


def test_training_leaves_nothing_in_the_way_and_nothing_too_large(data):
    """A splat before the camera goes, one that wraps the scene shrinks, the others stay as they are."""
    from training.methods import METHODS, create

    method = create("3dgs", data, METHODS["3dgs"].presets["draft"], 0, "cpu")
    p, before = method.parameters, len(method.model)
    eye = data.train[0]
    ahead = torch.tensor(eye.center + 0.02 * eye.world_to_camera[2, :3], dtype=torch.float32)
    rows = method.model.rows(torch.tensor([0, 0]))
    rows["means"][0] = ahead
    rows["log_scales"][1] = 9.0
    method.model.append(rows)
    method.keep_supported(0)
    assert len(method.model) == before + 1
    largest = method.model["log_scales"].detach().exp().amax(1).numpy()
    allowed = p.largest * data.support.distances(method.model["means"].detach().numpy())
    assert (largest <= allowed * 1.0001).all() and largest[-1] == pytest.approx(allowed[-1], rel=1e-4)
