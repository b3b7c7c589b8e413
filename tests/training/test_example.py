"""Stored example scenes: models and images against the camera definitions of the script."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from examples import rig
from training.evaluate.offset_views import VEIL_DEPTH
from training.optimize.support import midpoint_views
from training.scenes.colmap import read_scene
from training.scenes.offset_views import read_offset_views

EXAMPLES = Path(__file__).parents[2] / "examples"
GARDEN, WALK = EXAMPLES / "lantern_garden", EXAMPLES / "lantern_walk"
CAMERAS = {GARDEN: "view", WALK: "walk"}
"""Set of cameras of each scene."""


@pytest.fixture(scope="module", params=CAMERAS, ids=lambda folder: folder.name)
def scene(request) -> Path:
    return request.param


@pytest.fixture(scope="module")
def model(scene) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(scene / "sparse" / "0")


@pytest.fixture(scope="module")
def images(model) -> list[pycolmap.Image]:
    """Images in the order of their names, which is the order of rendering."""
    return sorted(model.images.values(), key=lambda image: image.name)


@pytest.fixture(scope="module")
def photos(scene, images) -> list[np.ndarray]:
    return [pixels(scene / "images" / image.name) for image in images]


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), float)


def pose(image: pycolmap.Image) -> np.ndarray:
    return np.asarray(image.cam_from_world().matrix())


@pytest.mark.parametrize(("folder", "limit", "count"), [(GARDEN, 8_000_000, 48), (WALK, 5_000_000, 30)])
def test_scenes_are_small_enough_for_the_repository(folder, limit, count):
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= limit
    assert sum(path.suffix == ".jpg" for path in (folder / "images").iterdir()) == count


def test_models_have_the_rendered_cameras(scene, model, images):
    name = CAMERAS[scene]
    expected = rig.world_to_cameras(name)
    assert [image.name for image in images] == [f"{rig.view_name(name, i)}.jpg" for i in range(len(expected))]
    np.testing.assert_allclose([pose(image) for image in images], expected[:, :3], atol=1e-12)
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    assert (camera.width, camera.height) == (rig.WIDTH, rig.HEIGHT)
    np.testing.assert_allclose(camera.params, [rig.FOCAL, rig.FOCAL, rig.WIDTH / 2, rig.HEIGHT / 2])


@pytest.mark.parametrize("name", ["view", "aside"])
def test_photos_show_the_lantern_at_its_position(name):
    pane = rig.LANTERN - [0.0, 0.0725, 0.0]  # centre of its front; the lit box is 0.145 m wide
    folder = GARDEN / {"view": "images", "aside": "aside"}[name]
    for index, matrix in enumerate(rig.world_to_cameras(name)):
        photo = pixels(folder / f"{rig.view_name(name, index)}.jpg")
        (x, y), _ = (values[0] for values in rig.project(pane[None], matrix))
        x, y = int(x), int(y)
        red, green, blue = photo[y - 1 : y + 2, x - 1 : x + 2].mean(axis=(0, 1))
        assert red > 220 and green > 150 and red - blue > 40, (name, index)
        surroundings = photo[max(y - 45, 0) : y + 45, max(x - 45, 0) : x + 45]
        assert np.median(surroundings[..., 0]) < red - 30  # the pane is bright, not the whole photo


def test_views_off_the_path_are_near_it_and_not_in_the_model():
    views = read_offset_views(GARDEN)
    poses, path = rig.world_to_cameras("aside"), rig.world_to_cameras("view")
    assert [view.name for view in views] == [f"{rig.view_name('aside', i)}.jpg" for i in range(len(poses))]
    np.testing.assert_allclose([view.world_to_camera for view in views], poses, atol=1e-12)
    assert not {view.name for view in views} & {camera.name for camera in read_scene(GARDEN).cameras}
    positions, _ = rig.arcs()
    for view in views:
        distances = np.linalg.norm(positions - view.center, axis=1)
        nearest = int(distances.argmin())
        assert 0.4 < distances[nearest] < 1.0
        angle = np.degrees(np.arccos(view.world_to_camera[2, :3] @ path[nearest][2, :3]))
        assert 5 < angle < 25
        assert (view.width, view.height) == (rig.WIDTH, rig.HEIGHT)
        np.testing.assert_allclose([view.fx, view.fy], rig.FOCAL)


def test_views_off_the_path_show_the_same_garden():
    """Compare colours of the model's points at their projections; some points are occluded."""
    points = list(pycolmap.Reconstruction(GARDEN / "sparse" / "0").points3D.values())
    xyz, color = np.array([point.xyz for point in points]), np.array([point.color for point in points], float)
    views = [(camera, pixels(GARDEN / "aside" / camera.name)) for camera in read_offset_views(GARDEN)]

    def difference(shift: float) -> float:
        differences = []
        for camera, image in views:
            moved = replace(camera, cx=camera.cx + shift)
            visible = moved.sees(xyz)
            x, y = np.floor(moved.project(xyz[visible])[0]).astype(int).T
            differences.append(np.abs(image[y, x] - color[visible]).mean(axis=1))
        return float(np.median(np.concatenate(differences)))

    assert difference(0.0) < 10 and difference(3.0) > 2 * difference(0.0)


def test_walk_has_nearby_objects_but_none_in_front_of_the_whole_view():
    scene = read_scene(WALK)
    centers = np.array([camera.center for camera in scene.cameras])
    assert centers[:, 2].min() > 1.5 and centers[:, 2].max() < 1.7  # eye height on level ground
    distances = np.linalg.norm(scene.points[None] - centers[:, None], axis=2)
    nearest = distances.min(axis=1)
    assert nearest.min() > 0.3 and np.median(nearest) < 1.2
    sides = np.sign(scene.points[None] - centers[:, None])[..., :2]
    quarters = [{tuple(side) for side in row[near]} for row, near in zip(sides, distances < 2.5, strict=True)]
    assert np.mean([len(quarter) == 4 for quarter in quarters]) > 0.5
    limit = VEIL_DEPTH * scene.median_depth()
    for view in midpoint_views(scene.cameras):  # evaluations measure veils in these views
        visible = view.sees(scene.points)
        assert (view.view_space(scene.points)[visible, 2] > limit).mean() > 0.99


def test_points_have_the_colours_of_their_projections(model, images, photos):
    points = list(model.points3D.values())
    xyz = np.array([point.xyz for point in points])
    color = np.array([point.color for point in points], float)
    row = {key: i for i, key in enumerate(model.points3D)}

    def difference(shift: float) -> float:
        """Return the median colour difference over all observations, with projections shifted in x."""
        differences = []
        for image, photo in zip(images, photos, strict=True):
            visible = [row[point.point3D_id] for point in image.points2D if point.has_point3D()]
            local = xyz[visible] @ pose(image)[:, :3].T + pose(image)[:, 3]
            assert (local[:, 2] > 0).all()
            pixel = rig.FOCAL * local[:, :2] / local[:, 2:] + [rig.WIDTH / 2 + shift, rig.HEIGHT / 2]
            x, y = np.floor(pixel).astype(int).T
            inside = x < rig.WIDTH
            differences.append(np.abs(photo[y[inside], x[inside]] - color[visible][inside]).mean(axis=1))
        return float(np.median(np.concatenate(differences)))

    exact = difference(0.0)
    assert exact < 10
    assert difference(3.0) > 1.3 * exact  # detects cameras that are off by a few pixels


def test_observations_agree_with_the_cameras(model):
    assert model.compute_mean_reprojection_error() < 1e-3
    assert model.compute_mean_track_length() > 3
    assert 8_000 <= model.num_points3D() <= 20_000


def test_views_contain_near_and_far_points(model, images):
    for image in images:
        visible = np.array([model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()])
        depth = visible @ pose(image)[2, :3] + pose(image)[2, 3]
        near, far = np.percentile(depth, [5, 95])
        assert far / near > 8, image.name


def test_held_out_views_have_neighbours_on_both_sides():
    positions, _ = rig.arcs()
    training = np.delete(positions, np.s_[::8], axis=0)
    for position in positions[::8]:
        offset = training - position
        near = offset[np.linalg.norm(offset, axis=1) < 0.75]
        side = np.sign(near @ np.cross(position, [0, 0, 1]))
        assert (side > 0).any() and (side < 0).any()


def test_scene_reader_agrees_with_pycolmap(scene, model, images):
    parsed = read_scene(scene)
    assert not parsed.warnings and not parsed.distorted
    assert [camera.name for camera in parsed.cameras] == [image.name for image in images]
    read = [camera.world_to_camera[:3] for camera in parsed.cameras]
    np.testing.assert_allclose(read, [pose(image) for image in images], atol=1e-12)
    np.testing.assert_allclose(
        np.sort(parsed.points, axis=0), np.sort([p.xyz for p in model.points3D.values()], axis=0), rtol=1e-6
    )
