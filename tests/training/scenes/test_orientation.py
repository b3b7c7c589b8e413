"""Estimated up directions of hand-placed cameras and real scenes."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from training.scenes.cameras import Camera
from training.scenes.colmap import read_scene
from training.scenes.image_headers import quarter_turns
from training.scenes.orientation import up_rotation


def look_at(position, target, up, roll: float = 0.0) -> Camera:
    """Return a camera in OpenCV axes; roll is in radians."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    right = np.cos(roll) * right + np.sin(roll) * np.cross(forward, right)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = [right, np.cross(forward, right), forward]
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ position
    return Camera("a", 64, 48, 50.0, 50.0, 32.0, 24.0, world_to_camera)


def rotated(cameras: list[Camera], rotation: np.ndarray) -> list[Camera]:
    """Return the cameras in a rotated world."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return [
        Camera("a", 64, 48, 50.0, 50.0, 32.0, 24.0, camera.world_to_camera @ matrix.T) for camera in cameras
    ]


def random_rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def angle(a, b) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def ring(elevation: float) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return [look_at((3 * np.cos(t), 3 * np.sin(t), 3 * elevation), (0, 0, 0), (0, 0, 1)) for t in angles]


def nadir(headings, tilt: float) -> list[Camera]:
    """Return a drone's grid of downward views with random tilts in radians and alternating headings."""
    random = np.random.default_rng(0)
    cameras = []
    for i in range(30):
        x, y = i % 6, i // 6
        heading = headings[i % len(headings)]
        aim = (x + random.normal() * 5 * tilt, y + random.normal() * 5 * tilt, 0)
        cameras.append(look_at((x, y, 5), aim, (np.cos(heading), np.sin(heading), 0)))
    return cameras


@pytest.mark.parametrize(("turns", "orientation"), [(0, 1), (1, 6), (2, 3), (3, 8)])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_orientation_of_photos_is_used(tmp_path, turns, orientation, suffix):
    path = tmp_path / f"a.{suffix}"
    exif = Image.Exif()
    exif[274] = orientation
    Image.new("RGB", (6, 4)).save(path, exif=exif)
    assert quarter_turns(path) == turns
    cameras = [replace(look_at((3, y, 1), (0, 0, 0), (0, 0, 1)), turns=turns) for y in (-1, 0, 1)]
    sensor = np.eye(4)  # rotated counter-clockwise, so that the photo must be rotated clockwise
    angle_ = np.pi / 2 * turns
    sensor[:2, :2] = [[np.cos(angle_), np.sin(angle_)], [-np.sin(angle_), np.cos(angle_)]]
    cameras = [replace(camera, world_to_camera=sensor @ camera.world_to_camera) for camera in cameras]
    upright = up_rotation([look_at((3, y, 1), (0, 0, 0), (0, 0, 1)) for y in (-1, 0, 1)])
    np.testing.assert_allclose(up_rotation(cameras), upright, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("elevation", [0.0, 0.6, -0.3])
def test_ring_of_cameras_gives_up_in_any_world(seed, elevation):
    world = random_rotation(seed)
    rotation = up_rotation(rotated(ring(elevation), world))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert angle(rotation @ world @ [0, 0, 1], np.array([0, 0, 1])) < 1e-5


@pytest.mark.parametrize("tilt", [0.0, 0.05])
@pytest.mark.parametrize("headings", [(0, np.pi), (0, 1, 2, 3, 4, 5)])
def test_downward_drone_views_give_up(headings, tilt):
    world = random_rotation(5)
    rotation = up_rotation(rotated(nadir(headings, tilt), world))
    assert angle(rotation @ world @ [0, 0, 1], np.array([0, 0, 1])) < 1


def test_two_views_straight_down_without_a_plane():
    cameras = [look_at((0, 0, 5), (0, 0, 0), (0, 1, 0)), look_at((1, 0, 5), (1, 0, 0), (0, -1, 0))]
    assert angle(up_rotation(cameras) @ [0, 0, 1], np.array([0, 0, 1])) < 1e-6


def test_front_view_matches_the_cameras():
    """The view direction of upright cameras becomes +y, and their right becomes +x."""
    cameras = [look_at((0, y, 0), (5, y, 0), (0, 0, 1)) for y in (-1, 0, 1)]
    rotation = up_rotation(cameras)
    np.testing.assert_allclose(rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation @ [0, -1, 0], [1, 0, 0], atol=1e-12)


def test_single_camera_and_no_camera():
    camera = look_at((0, 0, 0), (0, 5, 0), (0, 0, 1))
    np.testing.assert_allclose(up_rotation([camera]), np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(up_rotation([]), np.eye(3))


def test_opposite_cameras_give_a_rotation():
    up, down = look_at((0, 0, 0), (0, 5, 0), (0, 0, 1)), look_at((0, 0, 0), (0, 5, 0), (0, 0, -1))
    back = [look_at((0, 0, 0), (0, -5, 0), (0, 0, 1)), look_at((0, 0, 0), (0, -5, 0), (0, 0, -1))]
    rotation = up_rotation([up, down, *back])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_ground_of_real_drone_scene_is_level_below_the_cameras(shared_scenes):
    """The thinnest direction of the points is the ground's normal."""
    scene = read_scene(shared_scenes / "caliterra")
    rotation = up_rotation(scene.cameras)
    points = scene.points @ rotation.T
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    assert min(angle(normal, np.array([0, 0, 1])), angle(-normal, np.array([0, 0, 1]))) < 3
    heights = np.array([rotation @ camera.center for camera in scene.cameras])[:, 2]
    assert heights.min() > np.median(points[:, 2])


def test_cameras_around_real_statue_have_equal_heights(shared_scenes):
    """Points of house fronts extend farther above the cameras than below."""
    scene = read_scene(shared_scenes / "saharov")
    rotation = up_rotation(scene.cameras)
    centers = np.array([rotation @ camera.center for camera in scene.cameras])
    assert np.ptp(centers[:, 2]) < 0.05 * np.ptp(centers[:, 0])
    heights = (scene.points @ rotation.T)[:, 2] - centers[:, 2].mean()
    assert np.quantile(heights, 0.98) > -2 * np.quantile(heights, 0.02)


def test_photos_of_real_fox_are_upright(shared_scenes):
    """Up points to the top of each photo, within the roll of a hand-held camera."""
    scene = read_scene(shared_scenes / "fox")
    rotation = up_rotation(scene.cameras)
    ups = np.array([camera.world_to_camera[:3, :3] @ rotation.T @ [0, 0, 1] for camera in scene.cameras])
    assert (ups[:, 1] < 0).all()
    assert np.median(np.degrees(np.arctan2(np.abs(ups[:, 0]), -ups[:, 1]))) < 10
