"""The town that large-scale figures are measured on."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from examples import town, town_shapes
from training.runs.capture import write_scene
from training.scenes.colmap import read_scene


@pytest.fixture(scope="module")
def plan():
    return town.plan_for(40_000)


def test_a_town_has_as_many_splats_as_asked_for_and_is_always_the_same(plan):
    one, other = (town.build(plan, 40_000, sh_degree=2) for _ in range(2))
    assert len(one) == 40_000 and one.sh.shape == (40_000, 9, 3)
    for name, values in vars(one).items():
        if name != "extras":
            assert np.isfinite(values).all(), name
            assert np.array_equal(values, getattr(other, name)), name


def test_more_splats_are_more_blocks_once_walls_are_fine(plan):
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


@pytest.mark.parametrize("way", [town.walk, town.flight])
def test_both_ways_lead_through_the_open_and_other_phases_are_other_places(plan, way):
    cameras, between = way(plan, 40), way(plan, 40, phase=0.5)
    reach = plan.half + town_shapes.PITCH
    for camera in (*cameras, *between):
        x, y = ((camera.center[:2] + reach) / plan.cell).astype(int)
        assert camera.center[2] > plan.heights[y, x] or plan.heights[y, x] < 0.5, camera.name
        right, down, ahead = camera.world_to_camera[:3, :3]
        assert abs(right[2]) < 1e-9 and down[2] < 0 and np.allclose(np.cross(right, down), ahead)
    centers = np.array([camera.center for camera in cameras])
    gap = np.linalg.norm(np.diff(centers, axis=0), axis=1).max()
    nearest = [np.linalg.norm(centers - camera.center, axis=1).min() for camera in between]
    assert 0.2 * gap < np.median(nearest) < gap


def test_its_colmap_scene_has_points_where_the_cameras_see_surfaces(plan, tmp_path):
    splats, cameras = town.build(plan, 40_000), town.walk(plan, 4) + town.flight(plan, 6)
    write_scene(tmp_path / "scene", splats, [c.scaled(0.25) for c in cameras], town.NEAR, points=3000)
    scene = read_scene(tmp_path / "scene")
    assert [camera.name for camera in scene.cameras] == sorted(f"{camera.name}.jpg" for camera in cameras)
    assert len(scene.points) > 500
    assert (scene.points[:, 2] > -1).all()
    walls = np.abs(scene.points[:, :2]).max(axis=1) < plan.half
    assert walls.mean() > 0.5
