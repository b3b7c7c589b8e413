"""Animated cameras: a path through the example's photos, and a turntable."""

from pathlib import Path

import numpy as np
import pytest

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy, lodgs):
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 48
    return lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)


def animated_poses(bpy, camera, frames):
    poses = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        poses.append(np.array(camera.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world))
    return np.array(poses)


def test_path_runs_from_first_to_last_photo(bpy, lodgs, root):
    assert bpy.ops.lodgs.camera_path() == {"FINISHED"}
    camera, views = bpy.context.scene.camera, lodgs("data.photographs").views(root)
    poses = animated_poses(bpy, camera, range(1, 49))
    np.testing.assert_allclose(poses[0], views[0].matrix_world, atol=1e-4)
    np.testing.assert_allclose(poses[-1], views[-1].matrix_world, atol=1e-4)
    centers = np.array([view.matrix_world.translation for view in views])
    extent = np.linalg.norm(np.ptp(centers, axis=0))
    distances = np.linalg.norm(poses[:, None, :3, 3] - centers, axis=2).min(axis=1)
    assert distances.max() < 0.2 * extent
    assert camera.data.lens == pytest.approx(views[0].data.lens) and not camera.data.background_images
    assert camera not in views and camera.parent == root.lodgs.axes


def test_turntable_circles_the_center_evenly(bpy, lodgs, root):
    center, size = lodgs("data.photographs").central_bounds(root)
    assert bpy.ops.lodgs.turntable() == {"FINISHED"}
    poses = animated_poses(bpy, bpy.context.scene.camera, range(1, 50))
    to_center = np.array(center) - poses[:, :3, 3]
    distances = np.linalg.norm(to_center, axis=1)
    np.testing.assert_allclose(
        np.einsum("ij,ij->i", to_center / distances[:, None], -poses[:, :3, 2]), 1, atol=1e-5
    )
    np.testing.assert_allclose(distances, distances[0], rtol=1e-4)
    assert bpy.context.scene.camera.data.dof.focus_distance == pytest.approx(distances[0], rel=1e-4)
    assert distances[0] > size / 2 and (poses[:, 1 + 1, 1] > 0.9).all()  # upright
    angles = np.unwrap(np.arctan2(-to_center[:, 1], -to_center[:, 0]))
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / 48, atol=1e-3)


@pytest.mark.parametrize("verb", ["camera_path", "turntable"])
def test_new_path_is_evaluated_at_the_current_frame(bpy, lodgs, root, verb):
    bpy.context.scene.frame_set(20)
    getattr(bpy.ops.lodgs, verb)()
    camera = bpy.context.scene.camera
    bpy.context.view_layer.update()
    pose = np.array(camera.matrix_world)
    np.testing.assert_allclose(pose, animated_poses(bpy, camera, [21, 20])[1], atol=1e-5)


@pytest.mark.parametrize("verb", ["camera_path", "turntable"])
def test_empty_scene_is_rejected(bpy, lodgs, root, verb):
    bpy.data.batch_remove([*root.lodgs.cameras.objects, root.lodgs.points])
    before = len(bpy.data.objects), len(bpy.data.cameras)
    with pytest.raises(RuntimeError, match=r"0 camera|neither splats nor points"):
        getattr(bpy.ops.lodgs, verb)()
    assert (len(bpy.data.objects), len(bpy.data.cameras)) == before
