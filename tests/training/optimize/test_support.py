"""Tests of the free space around cameras and the size limit of splats, computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.optimize.support import Support
from training.scenes.cameras import Camera


def camera(x: float, width: int = 100) -> Camera:
    """Return a camera at (x, 0, 0) that looks along +z, 90 degrees wide."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(f"{x:g}", width, width, width / 2, width / 2, width / 2, width / 2, pose)


def side_camera(y: float, z: float) -> Camera:
    """Return a camera at (3, y, z) that looks along -x, 90 degrees wide."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[:3, 3] = -pose[:3, :3] @ [3, y, z]
    return Camera(f"{y:g}", 100, 100, 50, 50, 50, 50, pose)


def intruding(support: Support, means, share: float = 0.5) -> list[bool]:
    means = np.array(means, np.float32)
    return support.find_intruding(means, *support.nearest_positions(means), share).tolist()


@pytest.fixture
def support() -> Support:
    """Two cameras at distance 2 face a wall at depth 10; one of 200 points is an outlier at depth 1."""
    x, y = np.meshgrid(np.linspace(-5, 5, 20), np.linspace(-5, 5, 10))
    wall = np.stack([x, y, np.full_like(x, 10.0)], -1).reshape(-1, 3)
    wall[0] = (0, 0, 1)
    return Support([camera(-1), camera(1)], wall.astype(np.float32))


def test_points_closer_than_a_share_of_the_nearest_depth_intrude(support):
    means = [(-1, 0, depth) for depth in (0.05, 1.0, 4.9, 5.1, 9.0)]
    assert intruding(support, means) == [True, True, True, False, False]  # half of 10, not of 1
    assert not any(intruding(support, means, share=0.0))


def test_more_distant_points_intrude_only_inside_a_view(support):
    # at distances above 5.1; the image ends at |y| = z, with the margin at |y| = 1.2 z
    outside, at_the_edge, in_the_image = (-1, 5, 4), (-1, 4.7, 4), (-1, 3.9, 4)
    assert intruding(support, [outside, at_the_edge, in_the_image]) == [False, True, True]


def test_points_outside_the_frame_intrude_unless_two_photos_see_them():
    far, point = (0, 0, 10.0), (0, 0, -2.0)
    lateral, rear, distant = (0, -4, 0), point, (0, 0, -5.1)  # half of 10 around the camera is free space
    for heights, supported in (((), False), ((0,), False), ((0, 1), True)):
        cameras = [camera(0), camera(0.001), *(side_camera(y, -2.0) for y in heights)]
        support = Support(cameras, np.array([far, point], np.float32))
        assert intruding(support, [lateral, rear, distant]) == [True, not supported, False]


def test_points_between_cameras_intrude():
    # the two cameras see x = 0 from z = 1; a share of 0.1 keeps 1 of 10 free
    around, in_front = (0, 0, 0.5), (0, 0.9, 0.8)  # 0.5 and 1.2 from the midpoint, 1.1 and 1.6 from cameras
    support = Support([camera(-1), camera(1)], np.array([[0, 0, 10.0]], np.float32))
    assert intruding(support, [around, in_front], 0.1) == [True, True]
    single = Support([camera(-1)], np.array([[0, 0, 10.0]], np.float32))
    assert intruding(single, [around, in_front], 0.1) == [False, False]


def test_views_without_points_have_no_free_space():
    empty = Support([camera(-1), camera(1)], np.array([[0, 0, -10.0]], np.float32))
    assert intruding(empty, [(0, 0, 0.01), (-1, 0, -0.01)]) == [False, False]


def test_nearest_positions_are_cameras_or_midpoints(support):
    means = np.array([(1, 0, 2), (0, 0, 3), (-4, 4, 0)], np.float32)
    distances, positions = support.nearest_positions(means)
    assert distances == pytest.approx([2, 3, 5])
    assert positions[[0, 2]].tolist() == [1, 0] and positions[1] >= 2  # cameras first, then midpoints


def test_training_removes_intruding_splats_and_limits_sizes(data):
    """A splat in front of a camera is removed, a huge one shrinks, the others do not change."""
    from training.methods import METHODS, create

    method = create("3dgs", data, METHODS["3dgs"].presets["draft"], 0, "cpu")
    p, count = method.parameters, len(method.model)
    camera = data.train[0]
    in_front = torch.tensor(camera.center + 0.02 * camera.world_to_camera[2, :3], dtype=torch.float32)
    rows = method.model.read_rows(torch.tensor([0, 0]))
    rows["means"][0] = in_front
    rows["log_scales"][1] = 9.0
    method.model.append(rows)
    method.prune_unsupported(0, 0)
    assert len(method.model) == count + 1
    largest = method.model["log_scales"].detach().exp().amax(1).numpy()
    support = Support(data.train, data.scene.points)
    allowed = p.largest * support.nearest_positions(method.model["means"].detach().numpy())[0]
    assert (largest <= allowed * 1.0001).all() and largest[-1] == pytest.approx(allowed[-1], rel=1e-4)


def test_support_is_tested_less_often_after_density_control(data, monkeypatch):
    from training.methods import METHODS, create

    draft = replace(METHODS["3dgs"].presets["draft"], steps=800, densify_until=0.25)
    method = create("3dgs", data, draft, 0, "cpu")
    monkeypatch.setattr(method, "_step_without_autograd", lambda view, step: True)
    monkeypatch.setattr(method, "control_density", lambda step: None)
    calls = []
    monkeypatch.setattr(method, "prune_unsupported", lambda step, turn: calls.append((step + 1, turn)))
    for step in range(800):
        method.train_step(step)
    assert calls == [(50, 0), (100, 1), (150, 2), (200, 3), (400, 1), (600, 2), (800, 3)]
