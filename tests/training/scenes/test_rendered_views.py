"""What a renderer drew becomes a COLMAP scene: a ball on a ground, by formulas, in files like Blender's."""

from dataclasses import replace

import numpy as np
import OpenEXR
import pytest

from training.__main__ import main
from training.scenes.cameras import Camera, look_at, write_camera
from training.scenes.colmap import read_scene
from training.scenes.images import write_png
from training.scenes.rendered_views import (
    MIN_SKY_DISTANCE,
    SKY_DEPTH,
    Sky,
    read_exr_depth,
    sample_coverage,
    thin_by_grid,
    thin_evenly,
    write_rendered_model,
)

WIDTH, HEIGHT, NOTHING = 64, 48, 1e10


def views(count: int = 6) -> list[Camera]:
    """Around the ball of radius 1 at (0, 0, 1), which stands on the ground z = 0; lenses are odd."""
    turns = 2 * np.pi * np.arange(count) / count
    return [
        Camera(
            f"view_{n + 1:04d}", WIDTH, HEIGHT, 60.0, 55.0, 30.0, 26.0,
            look_at(np.array([5 * np.cos(turn), 5 * np.sin(turn), 3.0]), np.array([0, 0, 1.0]), (0, 0, 1)),
        )
        for n, turn in enumerate(turns)
    ]  # fmt: skip


def seen(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depths (H, W) and colours (H, W, 3): the ball red, the ground as far as 8 m green, else nothing."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = rays @ camera.world_to_camera[:3, :3]
    eye = camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -eye[2] / rays[..., 2]
        place = eye + ground[..., None] * rays
        ground = np.where((ground > 0) & (np.hypot(place[..., 0], place[..., 1]) < 8), ground, NOTHING)
        a, b = (rays**2).sum(-1), rays @ (eye - [0, 0, 1])
        root = b**2 - a * (((eye - [0, 0, 1]) ** 2).sum() - 1)
        ball = np.where(root > 0, (-b - np.sqrt(root)) / a, NOTHING)
    color = np.select(
        [ball[..., None] < ground[..., None], ground[..., None] < SKY_DEPTH], [[200, 0, 0], [0, 90, 0]], 60
    )
    return np.minimum(ball, ground), color.astype(np.uint8)


def draw(folder, cameras, channel="ViewLayer.Depth.Z"):
    for camera in cameras:
        depth, color = seen(camera)
        for kind in ("depths", "images"):
            (folder / kind).mkdir(exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        far = np.full_like(depth, NOTHING, dtype=np.float32)
        channels = {channel: depth.astype(np.float32), "Other.Depth.Z": far} if channel else {"Y": far}
        OpenEXR.File(header, channels).write(str(folder / "depths" / f"{camera.name}.exr"))
        write_png(folder / "images" / f"{camera.name}.png", color)
        write_camera(folder / "cameras" / f"{camera.name}.json", camera, 0.1)


def test_points_lie_on_what_is_seen_in_its_colours(tmp_path):
    cameras = views(12)
    draw(tmp_path, cameras)
    assert main(["model", str(tmp_path)]) == 0
    scene = read_scene(tmp_path)
    assert [camera.name for camera in scene.cameras] == [f"{camera.name}.png" for camera in cameras]
    for camera, truth in zip(scene.cameras, cameras, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, truth.world_to_camera, atol=1e-9)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60, 55, 30, 26)
    points = scene.points
    ball = np.abs(np.linalg.norm(points - [0, 0, 1], axis=1) - 1) < 1e-4
    ground = np.abs(points[:, 2]) < 1e-4
    assert ball.sum() > 100 and ground.sum() > 100
    sky = ~ball & ~ground
    away = np.linalg.norm(points[sky] - np.mean([camera.center for camera in cameras], axis=0), axis=1)
    assert away == pytest.approx(MIN_SKY_DISTANCE * 5, rel=1e-5), "the sky is a sphere far beyond"
    assert 0 < sky.mean() <= 0.1 and (scene.point_colors[sky] == 60).all()
    assert 4 < scene.median_depth() < 7, "which is not what the scene is measured by"
    np.testing.assert_array_equal(scene.point_colors[ball & ~ground], [[200, 0, 0]] * (ball & ~ground).sum())
    np.testing.assert_array_equal(scene.point_colors[ground & ~ball], [[0, 90, 0]] * (ground & ~ball).sum())


def test_coverage_counts_the_views_that_see_a_place():
    cameras = views()
    depths = [np.where(depth < SKY_DEPTH, depth, 0) for depth, _ in map(seen, cameras)]
    points, counts = sample_coverage(cameras, depths, 3000)
    assert 1000 < len(points) <= 3000 and counts.min() >= 1
    for kind in (np.abs(points[:, 2]) < 1e-6, np.abs(np.linalg.norm(points - [0, 0, 1], axis=1) - 1) < 1e-6):
        assert kind.sum() > 100
    least, most = np.zeros(len(points)), np.zeros(len(points))
    for camera in cameras:  # a ray meets nothing of the ball before it comes to the point
        eye = camera.center
        ray = points - eye
        along = np.clip(((np.array([0, 0, 1]) - eye) * ray).sum(1) / (ray**2).sum(1), 0, 1)
        passes = np.linalg.norm(eye + along[:, None] * ray - [0, 0, 1], axis=1)
        faces = ((points - [0, 0, 1]) * (eye - points)).sum(1)
        on_ball = points[:, 2] > 1e-6
        slack = np.where(on_ball, faces / 3, passes - 1)  # where that is near 0, it lies at an outline
        least += camera.sees(points, margin=-0.05) & (slack > 1) & (np.hypot(*points[:, :2].T) < 7)
        most += camera.sees(points) & (slack > -1)
    assert (counts <= most).all() and (counts >= least).all()
    assert least.max() >= 2 and most.min() <= 2, "there is something to tell apart"
    assert len(sample_coverage(cameras, [np.zeros((4, 6))] * len(cameras), 100)[0]) == 0
    assert len(sample_coverage([], [], 100)[0]) == 0


def test_a_model_is_made_anew_whole(tmp_path):
    draw(tmp_path, views())
    _, before = write_rendered_model(tmp_path)
    views_count, count = write_rendered_model(tmp_path, most=200)
    assert views_count == 6 and count <= 200 < before
    assert len(read_scene(tmp_path).points) == count
    assert {path.name for path in tmp_path.iterdir()} == {"cameras", "depths", "images", "sparse"}


def test_nothing_is_no_sky_where_pictures_are_transparent(tmp_path):
    cameras = views()
    draw(tmp_path, cameras)
    for camera in cameras:
        depth, color = seen(camera)
        alpha = np.where(depth < SKY_DEPTH, 255, 0)[..., None].astype(np.uint8)
        write_png(tmp_path / "images" / f"{camera.name}.png", np.concatenate([color, alpha], axis=2))
    write_rendered_model(tmp_path)
    scene = read_scene(tmp_path)
    assert len(scene.points) > 1000 and np.abs(scene.points).max() < 9
    assert set(map(tuple, scene.point_colors)) == {(200, 0, 0), (0, 90, 0)}


def test_the_sky_is_behind_all_that_is_seen_in_every_view():
    rng, view = np.random.default_rng(0), views()[0]
    sky = Sky(np.array([1.0, 2, 3]), 50.0)
    depth = np.where(rng.random((HEIGHT, WIDTH)) < 0.5, 3.0, NOTHING)
    filled = sky.behind(view, depth)
    np.testing.assert_array_equal(filled[depth < SKY_DEPTH], 3)
    y, x = np.nonzero(depth > SKY_DEPTH)
    places = view.unproject(np.column_stack([x, y]) + 0.5, filled[y, x])
    np.testing.assert_allclose(np.linalg.norm(places - sky.center, axis=1), 50, rtol=1e-9)


def test_points_are_as_far_apart_as_pixels_are_large():
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 1, (80_000, 3)) * [1, 1, 0]
    places[40_000:, 0] += 10
    sizes = np.repeat([0.01, 0.04], 40_000)  # two octaves
    kept = thin_by_grid(places, sizes, 3000, rng)
    near = (kept < 40_000).sum()
    assert 2000 < len(kept) <= 3000 and near / (len(kept) - near) == pytest.approx(16, rel=0.1)
    few = thin_by_grid(places, sizes, 10**6, rng)
    assert sorted(few) == list(range(80_000))


def test_places_are_even_in_space_and_farther_apart_far_away():
    rng = np.random.default_rng(0)
    near = rng.uniform(0, 1, (40_000, 3)) * [1, 1, 0]
    dense = rng.uniform(0, 0.1, (40_000, 3)) * [1, 1, 0]  # looked at more closely
    far = rng.uniform(0, 8, (40_000, 3)) * [1, 1, 0] + [100, 0, 0]
    points = np.concatenate([near, dense, far])
    depths = np.concatenate([np.full(80_000, 1.0), np.full(40_000, 8.5)])  # three octaves beyond
    kept = thin_evenly(points, depths, 2000, rng)
    assert 1500 < len(kept) <= 2000 and len(np.unique(kept)) == len(kept)
    here = points[kept[kept < 80_000]]
    corner = (here < 0.1).all(axis=1).sum()
    assert corner / len(here) == pytest.approx(0.01, abs=0.008), (
        "a hundredth of the area, in spite of most pixels"
    )
    assert (kept >= 80_000).sum() == pytest.approx(len(here), rel=0.2), (
        "64 times the area, cubes 8 times as large"
    )


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: (folder / "depths" / "view_0002.exr").unlink(), "view_0002.exr cannot be read"),
        (lambda folder: (folder / "images" / "view_0002.png").unlink(), "view_0002.png"),
        (lambda folder: draw(folder, views(), channel=""), "holds no depth"),
        (lambda folder: [path.unlink() for path in (folder / "cameras").iterdir()], "no two camera files"),
        (lambda folder: [write_camera(folder / "cameras" / f"{view.name}.json", view.resized(32, 24), 0.1)
                         for view in views()], "not of its camera's size"),
        (lambda folder: draw(folder, [replace(view, world_to_camera=look_at(
            view.center, view.center + np.eye(3)[2], (1, 0, 0))) for view in views()]), "No two views see"),
    ],
)  # fmt: skip
def test_what_is_missing_is_said_in_a_sentence(tmp_path, capsys, spoil, says):
    draw(tmp_path, views())
    write_rendered_model(tmp_path)
    spoil(tmp_path)
    assert main(["model", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert says in said and "Traceback" not in said
    assert len(read_scene(tmp_path).points) if "image" not in says and ".png" not in says else True


def test_depth_is_of_the_nearest_layer_and_nothing_is_far_away(tmp_path):
    view = views()[0]
    draw(tmp_path, [view])
    depth, truth = read_exr_depth(tmp_path / "depths" / f"{view.name}.exr"), seen(view)[0]
    np.testing.assert_allclose(depth[truth < SKY_DEPTH], truth[truth < SKY_DEPTH], rtol=1e-6)
    assert (depth[truth > SKY_DEPTH] > SKY_DEPTH).all() and (truth > SKY_DEPTH).any()
