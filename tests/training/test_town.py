"""The generated town for measurements on large scenes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from examples import town, town_shapes
from training.runs.capture import write_scene
from training.scenes.colmap import read_scene


@pytest.fixture(scope="module")
def plan():
    return town.plan_for(40_000)


def test_town_is_reproducible_and_has_the_requested_number_of_splats(plan):
    first, second = (town.build(plan, 40_000, sh_degree=2) for _ in range(2))
    assert len(first) == 40_000 and first.sh.shape == (40_000, 9, 3)
    for name, values in vars(first).items():
        if name != "extras":
            assert np.isfinite(values).all(), name
            assert np.array_equal(values, getattr(second, name)), name


@pytest.mark.nightly
def test_large_numbers_of_splats_give_more_blocks(plan):
    assert plan.blocks == 3 == town.plan_for(1_000_000).blocks
    assert town.plan_for(10_000_000).blocks > 3


def test_walls_and_ground_are_flat_discs_on_their_surfaces(plan):
    splats = town.build(plan, 40_000)
    ground = np.abs(splats.means[:, 2]) < 1e-6
    assert ground.mean() > 0.05
    normals = Rotation.from_quat(splats.quats[ground], scalar_first=True).as_matrix()[:, :, 2]
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (ground.sum(), 1)), atol=1e-6)
    scales = np.exp(splats.log_scales[ground])
    assert (scales[:, 2] < 0.5 * scales[:, :2].min(axis=1)).all()


@pytest.mark.parametrize("path", [town.walk, town.flight])
def test_camera_paths_avoid_obstacles_and_phases_differ(plan, path):
    cameras, shifted = path(plan, 40), path(plan, 40, phase=0.5)
    reach = plan.half + town_shapes.PITCH
    for camera in (*cameras, *shifted):
        x, y = ((camera.center[:2] + reach) / plan.cell).astype(int)
        assert camera.center[2] > plan.heights[y, x] or plan.heights[y, x] < 0.5, camera.name
        right, down, ahead = camera.world_to_camera[:3, :3]
        assert abs(right[2]) < 1e-9 and down[2] < 0 and np.allclose(np.cross(right, down), ahead)
    centers = np.array([camera.center for camera in cameras])
    gap = np.linalg.norm(np.diff(centers, axis=0), axis=1).max()
    nearest = [np.linalg.norm(centers - camera.center, axis=1).min() for camera in shifted]
    assert 0.2 * gap < np.median(nearest) < gap


def test_captured_scene_of_the_town_has_points_on_its_surfaces(plan, tmp_path):
    splats, cameras = town.build(plan, 40_000), town.walk(plan, 4) + town.flight(plan, 6)
    write_scene(tmp_path / "scene", splats, [c.scaled(0.25) for c in cameras], town.NEAR, points=3000)
    scene = read_scene(tmp_path / "scene")
    assert [camera.name for camera in scene.cameras] == sorted(f"{camera.name}.jpg" for camera in cameras)
    assert len(scene.points) > 500
    assert (scene.points[:, 2] > -1).all()
    walls = np.abs(scene.points[:, :2]).max(axis=1) < plan.half
    assert walls.mean() > 0.5


def test_courtyard_views_stand_in_a_garden_between_walls(plan):
    cameras = town.courtyard(plan, 24)
    centers = np.array([camera.center for camera in cameras])
    reach = plan.half + town_shapes.PITCH
    x, y = ((centers[:, :2] + reach) / plan.cell).astype(int).T
    assert (plan.heights[y, x] < 0.5).all() and np.abs(centers[:, 2] - 1.65).max() < 0.2
    center = centers.mean(0)
    assert np.linalg.norm(centers - center, axis=1)[:, None].max() < 10
    for camera in cameras:  # views face the centre, with a house in most directions
        ahead = camera.world_to_camera[2, :3]
        assert ahead @ (center - camera.center) > 0
    angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    rays = center[:2] + np.arange(1, 25)[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
    column, row = np.moveaxis(((rays + reach) / plan.cell).astype(int), -1, 0)
    assert (plan.heights[row, column] > 4).any(0).mean() > 0.7
