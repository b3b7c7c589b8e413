"""The example scenes as they are kept: models and pictures against the script's statement of the cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from examples import rig
from training.evaluate.offset_views import VEIL_DEPTH
from training.optimize.support import halfway
from training.scenes.colmap import read_scene
from training.scenes.offset_views import read_offset_views

EXAMPLES = Path(__file__).parents[2] / "examples"
GARDEN, WALK = EXAMPLES / "lantern_garden", EXAMPLES / "lantern_walk"
CAMERAS = {GARDEN: "view", WALK: "walk"}
"""The sets of cameras that the scenes' photographs are of."""


@pytest.fixture(scope="module", params=CAMERAS, ids=lambda folder: folder.name)
def scene(request) -> Path:
    return request.param


@pytest.fixture(scope="module")
def model(scene) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(scene / "sparse" / "0")


@pytest.fixture(scope="module")
def images(model) -> list[pycolmap.Image]:
    """In the order of their names, as the views were rendered."""
    return sorted(model.images.values(), key=lambda image: image.name)


@pytest.fixture(scope="module")
def photographs(scene, images) -> list[np.ndarray]:
    return [pixels(scene / "images" / image.name) for image in images]


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), float)


def pose(image: pycolmap.Image) -> np.ndarray:
    return np.asarray(image.cam_from_world().matrix())


@pytest.mark.parametrize(("folder", "most", "count"), [(GARDEN, 8_000_000, 48), (WALK, 5_000_000, 30)])
def test_they_are_small_enough_for_the_repository(folder, most, count):
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= most
    assert sum(path.suffix == ".jpg" for path in (folder / "images").iterdir()) == count


def test_the_cameras_are_the_ones_that_were_rendered(scene, model, images):
    name = CAMERAS[scene]
    expected = rig.world_to_cameras(name)
    assert [image.name for image in images] == [f"{rig.view_name(name, i)}.jpg" for i in range(len(expected))]
    np.testing.assert_allclose([pose(image) for image in images], expected[:, :3], atol=1e-12)
    (camera,) = model.cameras.values()
    assert camera.model == pycolmap.CameraModelId.PINHOLE
    assert (camera.width, camera.height) == (rig.WIDTH, rig.HEIGHT)
    np.testing.assert_allclose(camera.params, [rig.FOCAL, rig.FOCAL, rig.WIDTH / 2, rig.HEIGHT / 2])


@pytest.mark.parametrize("name", ["view", "aside"])
def test_the_photographs_show_the_lantern_where_the_script_put_it(name):
    pane = rig.LANTERN - [0.0, 0.0725, 0.0]  # the middle of its front: the lit box is 0.145 m wide
    folder = GARDEN / {"view": "images", "aside": "aside"}[name]
    for index, matrix in enumerate(rig.world_to_cameras(name)):
        photograph = pixels(folder / f"{rig.view_name(name, index)}.jpg")
        (x, y), _ = (values[0] for values in rig.project(pane[None], matrix))
        x, y = int(x), int(y)
        red, green, blue = photograph[y - 1 : y + 2, x - 1 : x + 2].mean(axis=(0, 1))
        assert red > 220 and green > 150 and red - blue > 40, (name, index)
        around = photograph[max(y - 45, 0) : y + 45, max(x - 45, 0) : x + 45]
        assert np.median(around[..., 0]) < red - 30  # a lit pane among darker things, not a bright picture


def test_views_off_the_path_are_a_step_aside_and_no_photographs_of_the_model():
    views = read_offset_views(GARDEN)
    poses, path = rig.world_to_cameras("aside"), rig.world_to_cameras("view")
    assert [view.name for view in views] == [f"{rig.view_name('aside', i)}.jpg" for i in range(len(poses))]
    np.testing.assert_allclose([view.world_to_camera for view in views], poses, atol=1e-12)
    assert not {view.name for view in views} & {camera.name for camera in read_scene(GARDEN).cameras}
    eyes, _ = rig.arcs()
    for view in views:
        away = np.linalg.norm(eyes - view.center, axis=1)
        nearest = int(away.argmin())
        assert 0.4 < away[nearest] < 1.0
        turned = np.degrees(np.arccos(view.world_to_camera[2, :3] @ path[nearest][2, :3]))
        assert 5 < turned < 25
        assert (view.width, view.height) == (rig.WIDTH, rig.HEIGHT)
        np.testing.assert_allclose([view.fx, view.fy], rig.FOCAL)


def test_views_off_the_path_show_the_same_garden():
    """Colours of the model's points where they are projected; some of them stand behind something there."""
    points = list(pycolmap.Reconstruction(GARDEN / "sparse" / "0").points3D.values())
    xyz, color = np.array([point.xyz for point in points]), np.array([point.color for point in points], float)
    views = [(camera, pixels(GARDEN / "aside" / camera.name)) for camera in read_offset_views(GARDEN)]

    def difference(shift: float) -> float:
        found = []
        for camera, picture in views:
            moved = replace(camera, cx=camera.cx + shift)
            seen = moved.sees(xyz)
            x, y = np.floor(moved.project(xyz[seen])[0]).astype(int).T
            found.append(np.abs(picture[y, x] - color[seen]).mean(axis=1))
        return float(np.median(np.concatenate(found)))

    assert difference(0.0) < 10 and difference(3.0) > 2 * difference(0.0)


def test_the_walk_has_things_close_by_but_nothing_hangs_before_the_scene():
    scene = read_scene(WALK)
    eyes = np.array([camera.center for camera in scene.cameras])
    assert eyes[:, 2].min() > 1.5 and eyes[:, 2].max() < 1.7  # eye height on level ground
    away = np.linalg.norm(scene.points[None] - eyes[:, None], axis=2).min(axis=1)
    assert away.min() > 0.3 and np.median(away) < 1.2
    sides = np.sign(scene.points[None] - eyes[:, None])[..., :2]
    near = np.linalg.norm(scene.points[None] - eyes[:, None], axis=2) < 2.5
    quarters = [{tuple(side) for side in found[close]} for found, close in zip(sides, near, strict=True)]
    assert np.mean([len(found) == 4 for found in quarters]) > 0.5
    limit = VEIL_DEPTH * scene.median_depth()
    for place in halfway(scene.cameras):  # so that what an evaluation calls a veil is one
        seen = place.sees(scene.points)
        assert (place.view_space(scene.points)[seen, 2] > limit).mean() > 0.99


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
    eyes, _ = rig.arcs()
    training = np.delete(eyes, np.s_[::8], axis=0)
    for eye in eyes[::8]:
        offset = training - eye
        near = offset[np.linalg.norm(offset, axis=1) < 0.75]
        side = np.sign(near @ np.cross(eye, [0, 0, 1]))
        assert (side > 0).any() and (side < 0).any()


def test_our_reader_reads_what_pycolmap_reads(scene, model, images):
    found = read_scene(scene)
    assert not found.warnings and not found.distorted
    assert [camera.name for camera in found.cameras] == [image.name for image in images]
    read = [camera.world_to_camera[:3] for camera in found.cameras]
    np.testing.assert_allclose(read, [pose(image) for image in images], atol=1e-12)
    np.testing.assert_allclose(
        np.sort(found.points, axis=0), np.sort([p.xyz for p in model.points3D.values()], axis=0), rtol=1e-6
    )
