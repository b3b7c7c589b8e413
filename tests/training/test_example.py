"""The example scene as it is kept: model and photographs against the script's statement of the cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from examples import rig
from training.scenes.colmap import read_scene

SCENE = Path(__file__).parents[2] / "examples" / "lantern_garden"


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(SCENE / "sparse" / "0")


@pytest.fixture(scope="module")
def images(model) -> list[pycolmap.Image]:
    """In the order of their names, as the views were rendered."""
    return sorted(model.images.values(), key=lambda image: image.name)


@pytest.fixture(scope="module")
def photographs(images) -> list[np.ndarray]:
    return [np.asarray(Image.open(SCENE / "images" / image.name).convert("RGB"), float) for image in images]


def pose(image: pycolmap.Image) -> np.ndarray:
    return np.asarray(image.cam_from_world().matrix())


def test_it_is_small_enough_for_the_repository():
    files = [path for path in SCENE.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 8_000_000
    assert 36 <= sum(path.suffix == ".jpg" for path in files) <= 60


def test_the_cameras_are_the_ones_that_were_rendered(model, images):
    expected = rig.world_to_cameras()
    assert [image.name for image in images] == [f"{rig.view_name(i)}.jpg" for i in range(len(expected))]
    np.testing.assert_allclose([pose(image) for image in images], expected[:, :3], atol=1e-12)
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    assert (camera.width, camera.height) == (rig.WIDTH, rig.HEIGHT)
    np.testing.assert_allclose(camera.params, [rig.FOCAL, rig.FOCAL, rig.WIDTH / 2, rig.HEIGHT / 2])


def test_the_photographs_show_the_lantern_where_the_script_put_it(images, photographs):
    pane = rig.LANTERN - [0.0, 0.0725, 0.0]  # the middle of its front: the lit box is 0.145 m wide
    for image, photograph in zip(images, photographs, strict=True):
        x, y = np.floor(image.project_point(pane)).astype(int)
        red, green, blue = photograph[y - 1 : y + 2, x - 1 : x + 2].mean(axis=(0, 1))
        assert red > 220 and green > 150 and red - blue > 40, image.name
        around = photograph[max(y - 45, 0) : y + 45, max(x - 45, 0) : x + 45]
        assert np.median(around[..., 0]) < red - 30  # a lit pane among darker things, not a bright picture


def test_points_have_the_colour_of_the_photographs_at_their_projections(model, images, photographs):
    points = list(model.points3D.values())
    xyz = np.array([point.xyz for point in points])
    color = np.array([point.color for point in points], float)
    row = {key: i for i, key in enumerate(model.points3D)}

    def difference(shift: float) -> float:
        """Median colour difference over all observations, photographs read shift pixels to the side."""
        found = []
        for image, photograph in zip(images, photographs, strict=True):
            seen = [row[point.point3D_id] for point in image.points2D if point.has_point3D()]
            local = xyz[seen] @ pose(image)[:, :3].T + pose(image)[:, 3]
            assert (local[:, 2] > 0).all()
            pixel = rig.FOCAL * local[:, :2] / local[:, 2:] + [rig.WIDTH / 2 + shift, rig.HEIGHT / 2]
            x, y = np.floor(pixel).astype(int).T
            inside = x < rig.WIDTH
            found.append(np.abs(photograph[y[inside], x[inside]] - color[seen][inside]).mean(axis=1))
        return float(np.median(np.concatenate(found)))

    exact = difference(0.0)
    assert exact < 10
    assert difference(3.0) > 1.3 * exact  # sharp enough to notice cameras that are off by a few pixels


def test_observations_agree_with_the_cameras(model):
    assert model.compute_mean_reprojection_error() < 1e-3
    assert model.compute_mean_track_length() > 3
    assert 8_000 <= model.num_points3D() <= 20_000


def test_every_view_holds_near_and_far(model, images):
    for image in images:
        seen = np.array([model.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()])
        depth = seen @ pose(image)[2, :3] + pose(image)[2, 3]
        near, far = np.percentile(depth, [5, 95])
        assert far / near > 8, image.name


def test_held_out_views_have_neighbours_on_both_sides():
    eyes, _ = rig.eyes_and_targets()
    training = np.delete(eyes, np.s_[::8], axis=0)
    for eye in eyes[::8]:
        offset = training - eye
        near = offset[np.linalg.norm(offset, axis=1) < 0.75]
        side = np.sign(near @ np.cross(eye, [0, 0, 1]))
        assert (side > 0).any() and (side < 0).any()


def test_our_reader_reads_what_pycolmap_reads(model, images):
    scene = read_scene(SCENE)
    assert not scene.warnings and not scene.distorted
    assert [camera.name for camera in scene.cameras] == [image.name for image in images]
    read = [camera.world_to_camera[:3] for camera in scene.cameras]
    np.testing.assert_allclose(read, [pose(image) for image in images], atol=1e-12)
    np.testing.assert_allclose(
        np.sort(scene.points, axis=0), np.sort([p.xyz for p in model.points3D.values()], axis=0), rtol=1e-6
    )
