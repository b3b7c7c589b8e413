"""COLMAP scenes from rendered views: an analytic ball on the ground, in files like Blender's."""

import os
from dataclasses import replace
from pathlib import Path

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

WIDTH, HEIGHT, NO_SURFACE = 64, 48, 1e10


def views(count: int = 6) -> list[Camera]:
    """Return views around a ball of radius 1 at (0, 0, 1) on the ground z = 0, with an asymmetric lens."""
    turns = 2 * np.pi * np.arange(count) / count
    return [
        Camera(
            f"view_{n + 1:04d}", WIDTH, HEIGHT, 60.0, 55.0, 30.0, 26.0,
            look_at(np.array([5 * np.cos(turn), 5 * np.sin(turn), 3.0]), np.array([0, 0, 1.0]), (0, 0, 1)),
        )
        for n, turn in enumerate(turns)
    ]  # fmt: skip


def render(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render depths (H, W) and colours (H, W, 3) of a red ball on green ground that ends at radius 8."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = rays @ camera.world_to_camera[:3, :3]
    position = camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -position[2] / rays[..., 2]
        point = position + ground[..., None] * rays
        ground = np.where((ground > 0) & (np.hypot(point[..., 0], point[..., 1]) < 8), ground, NO_SURFACE)
        a, b = (rays**2).sum(-1), rays @ (position - [0, 0, 1])
        root = b**2 - a * (((position - [0, 0, 1]) ** 2).sum() - 1)
        ball = np.where(root > 0, (-b - np.sqrt(root)) / a, NO_SURFACE)
    color = np.select(
        [ball[..., None] < ground[..., None], ground[..., None] < SKY_DEPTH], [[200, 0, 0], [0, 90, 0]], 60
    )
    return np.minimum(ball, ground), color.astype(np.uint8)


def write_views(folder, cameras, channel="ViewLayer.Depth.Z"):
    for camera in cameras:
        depth, color = render(camera)
        for kind in ("depths", "images"):
            (folder / kind).mkdir(exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        far = np.full_like(depth, NO_SURFACE, dtype=np.float32)
        channels = {channel: depth.astype(np.float32), "Other.Depth.Z": far} if channel else {"Y": far}
        OpenEXR.File(header, channels).write(str(folder / "depths" / f"{camera.name}.exr"))
        write_png(folder / "images" / f"{camera.name}.png", color)
        write_camera(folder / "cameras" / f"{camera.name}.json", camera, 0.1)


def test_points_have_positions_and_colors_of_the_surfaces(tmp_path):
    cameras = views(12)
    write_views(tmp_path, cameras)
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
    distance = np.linalg.norm(points[sky] - np.mean([camera.center for camera in cameras], axis=0), axis=1)
    assert distance == pytest.approx(MIN_SKY_DISTANCE * 5, rel=1e-5), "the sky is a distant sphere"
    assert 0 < sky.mean() <= 0.1 and (scene.point_colors[sky] == 60).all()
    assert 4 < scene.median_depth() < 7, "the sky does not change the scale"
    np.testing.assert_array_equal(scene.point_colors[ball & ~ground], [[200, 0, 0]] * (ball & ~ground).sum())
    np.testing.assert_array_equal(scene.point_colors[ground & ~ball], [[0, 90, 0]] * (ground & ~ball).sum())


def test_coverage_counts_the_views_of_each_point():
    cameras = views()
    depths = [np.where(depth < SKY_DEPTH, depth, 0) for depth, _ in map(render, cameras)]
    points, counts = sample_coverage(cameras, depths, 3000)
    assert 1000 < len(points) <= 3000 and counts.min() >= 1
    for kind in (np.abs(points[:, 2]) < 1e-6, np.abs(np.linalg.norm(points - [0, 0, 1], axis=1) - 1) < 1e-6):
        assert kind.sum() > 100
    low, high = np.zeros(len(points)), np.zeros(len(points))
    for camera in cameras:  # a point is visible if the ball does not intersect its ray
        position = camera.center
        ray = points - position
        closest = np.clip(((np.array([0, 0, 1]) - position) * ray).sum(1) / (ray**2).sum(1), 0, 1)
        clearance = np.linalg.norm(position + closest[:, None] * ray - [0, 0, 1], axis=1)
        facing = ((points - [0, 0, 1]) * (position - points)).sum(1)
        on_ball = points[:, 2] > 1e-6
        slack = np.where(on_ball, facing / 3, clearance - 1)  # about 0 at outlines
        low += camera.sees(points, margin=-0.05) & (slack > 1) & (np.hypot(*points[:, :2].T) < 7)
        high += camera.sees(points) & (slack > -1)
    assert (counts <= high).all() and (counts >= low).all()
    assert low.max() >= 2 and high.min() <= 2, "the bounds are not trivial"
    assert len(sample_coverage(cameras, [np.zeros((4, 6))] * len(cameras), 100)[0]) == 0
    assert len(sample_coverage([], [], 100)[0]) == 0


def test_model_is_replaced(tmp_path):
    write_views(tmp_path, views())
    _, default_count = write_rendered_model(tmp_path)
    views_count, count = write_rendered_model(tmp_path, limit=200)
    assert views_count == 6 and count <= 200 < default_count
    assert len(read_scene(tmp_path).points) == count
    assert {path.name for path in tmp_path.iterdir()} == {"cameras", "depths", "images", "sparse"}


def test_interrupted_replacement_keeps_the_model(tmp_path, monkeypatch):
    write_views(tmp_path, views())
    _, count = write_rendered_model(tmp_path)
    rename = os.rename

    def interrupt(source, target):
        if Path(source).name in ("sparse", "new"):
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr(os, "rename", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_rendered_model(tmp_path, limit=200)
    assert len(read_scene(tmp_path).points) == count


def test_transparent_pixels_give_no_sky(tmp_path):
    cameras = views()
    write_views(tmp_path, cameras)
    for camera in cameras:
        depth, color = render(camera)
        alpha = np.where(depth < SKY_DEPTH, 255, 0)[..., None].astype(np.uint8)
        write_png(tmp_path / "images" / f"{camera.name}.png", np.concatenate([color, alpha], axis=2))
    write_rendered_model(tmp_path)
    scene = read_scene(tmp_path)
    assert len(scene.points) > 1000 and np.abs(scene.points).max() < 9
    assert set(map(tuple, scene.point_colors)) == {(200, 0, 0), (0, 90, 0)}


def test_sky_fills_missing_depth():
    rng, view = np.random.default_rng(0), views()[0]
    sky = Sky(np.array([1.0, 2, 3]), 50.0)
    depth = np.where(rng.random((HEIGHT, WIDTH)) < 0.5, 3.0, NO_SURFACE)
    filled = sky.fill_depth(view, depth)
    np.testing.assert_array_equal(filled[depth < SKY_DEPTH], 3)
    y, x = np.nonzero(depth > SKY_DEPTH)
    points = view.unproject(np.column_stack([x, y]) + 0.5, filled[y, x])
    np.testing.assert_allclose(np.linalg.norm(points - sky.center, axis=1), 50, rtol=1e-9)


def test_spacing_is_proportional_to_pixel_size():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (80_000, 3)) * [1, 1, 0]
    points[40_000:, 0] += 10
    sizes = np.repeat([0.01, 0.04], 40_000)  # two octaves
    chosen = thin_by_grid(points, sizes, 3000, rng)
    near = (chosen < 40_000).sum()
    assert 2000 < len(chosen) <= 3000 and near / (len(chosen) - near) == pytest.approx(16, rel=0.1)
    everything = thin_by_grid(points, sizes, 10**6, rng)
    assert sorted(everything) == list(range(80_000))


def test_thin_evenly_spaces_near_points_evenly_and_far_points_wider():
    rng = np.random.default_rng(0)
    near = rng.uniform(0, 1, (40_000, 3)) * [1, 1, 0]
    dense = rng.uniform(0, 0.1, (40_000, 3)) * [1, 1, 0]  # more pixels
    far = rng.uniform(0, 8, (40_000, 3)) * [1, 1, 0] + [100, 0, 0]
    points = np.concatenate([near, dense, far])
    depths = np.concatenate([np.full(80_000, 1.0), np.full(40_000, 8.5)])  # three octaves farther
    chosen = thin_evenly(points, depths, 2000, rng)
    assert 1500 < len(chosen) <= 2000 and len(np.unique(chosen)) == len(chosen)
    near_chosen = points[chosen[chosen < 80_000]]
    corner = (near_chosen < 0.1).all(axis=1).sum()
    assert corner / len(near_chosen) == pytest.approx(0.01, abs=0.008), (
        "a hundredth of the area, despite its many pixels"
    )
    assert (chosen >= 80_000).sum() == pytest.approx(len(near_chosen), rel=0.2), (
        "64 times the area, cubes 8 times larger"
    )


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "depths" / "view_0002.exr").unlink(), "view_0002.exr"),
        (lambda folder: (folder / "images" / "view_0002.png").unlink(), "view_0002.png"),
        (lambda folder: write_views(folder, views(), channel=""), "no depth channel"),
        (lambda folder: [path.unlink() for path in (folder / "cameras").iterdir()], "found 0 camera files"),
        (lambda folder: [write_camera(folder / "cameras" / f"{view.name}.json", view.resized(32, 24), 0.1)
                         for view in views()], "differs from its camera's"),
        (lambda folder: write_views(folder, [replace(view, world_to_camera=look_at(
            view.center, view.center + np.eye(3)[2], (1, 0, 0))) for view in views()]), "no two views"),
    ],
)  # fmt: skip
def test_missing_or_invalid_files_are_reported(tmp_path, capsys, damage, message):
    write_views(tmp_path, views())
    write_rendered_model(tmp_path)
    damage(tmp_path)
    assert main(["model", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert len(read_scene(tmp_path).points) if "image" not in message and ".png" not in message else True


def test_depth_is_the_nearest_layer(tmp_path):
    view = views()[0]
    write_views(tmp_path, [view])
    depth, truth = read_exr_depth(tmp_path / "depths" / f"{view.name}.exr"), render(view)[0]
    np.testing.assert_allclose(depth[truth < SKY_DEPTH], truth[truth < SKY_DEPTH], rtol=1e-6)
    assert (depth[truth > SKY_DEPTH] > SKY_DEPTH).all() and (truth > SKY_DEPTH).any()
