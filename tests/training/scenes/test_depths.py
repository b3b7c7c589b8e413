"""Depth priors: maps in all formats, fits and their rejection, points of the model and from maps.

The ground truth is a floor and a wall whose depths are computed by hand.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.depths import (
    DepthPriors,
    add_depth_points,
    fit_scale_and_shift,
    read_depth_map,
    resample_known,
)
from training.scenes.images import load_image, write_png
from training.scenes.undistort import undistort_scene

from . import synthetic
from .depth_walls import (
    FITTED,
    METRIC,
    depth_of,
    write_depth_scene,
    write_exr_map,
    write_npy_map,
    write_png_map,
    write_walls,
)
from .walls import HEIGHT, WIDTH, render_photo

ONES = np.ones((HEIGHT, WIDTH), np.float32)


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return write_walls(tmp_path_factory.mktemp("walls"))


@pytest.mark.parametrize("kind", METRIC)
def test_metric_maps(walls, tmp_path, kind):
    scene = read_scene(write_depth_scene(walls, tmp_path, METRIC[kind]))
    depths = DepthPriors(scene, "metric")
    assert depths and not depths.warnings
    for camera in scene.cameras[:2]:
        inverse = depths.inverse(camera)
        assert inverse is not None and inverse.dtype == np.float32
        np.testing.assert_allclose(inverse, 1 / depth_of(camera), rtol=1e-3)
        half = depths.inverse(camera.scaled(0.5))
        expected = (1 / depth_of(camera)).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(half, expected, rtol=1e-3)


@pytest.mark.parametrize("kind", FITTED)
def test_maps_are_fitted_per_view(walls, tmp_path, kind):
    scene = read_scene(write_depth_scene(walls, tmp_path, FITTED[kind]))
    depths = DepthPriors(scene, kind)
    assert depths and not depths.warnings
    for camera in scene.cameras:
        inverse = depths.inverse(camera)
        assert inverse is not None
        np.testing.assert_allclose(inverse, 1 / depth_of(camera), rtol=0.02)


def test_fit_ignores_occluded_points():
    """A fifth of the points are occluded by the surface of the map."""
    rng = np.random.default_rng(0)
    z = rng.uniform(2, 9, 400)
    occluded = z * np.where(rng.random(400) < 0.2, rng.uniform(1.2, 3, 400), 1)
    scale, shift = fit_scale_and_shift(3 * (1 / z) + 0.7, occluded, is_depth=False) or (0, 0)
    assert (scale, shift) == pytest.approx((1 / 3, -0.7 / 3), abs=5e-3)
    scale, shift = fit_scale_and_shift(0.5 * z + 0.2, occluded, is_depth=True) or (0, 0)
    assert (scale, shift) == pytest.approx((2, -0.4), abs=0.05)
    assert fit_scale_and_shift(rng.random(400), z, is_depth=False) is None
    assert fit_scale_and_shift(z, z, is_depth=False) is None  # a negative scale
    assert fit_scale_and_shift(1 / z[:5], z[:5], is_depth=False) is None


def test_metric_maps_in_another_unit_are_rejected(walls, tmp_path):
    scene = read_scene(write_depth_scene(walls, tmp_path, FITTED["inverse"]))
    depths = DepthPriors(scene, "metric")
    assert not depths and depths.inverse(scene.cameras[0]) is None
    assert len(depths.warnings) == 1 and "times that of the scene's points" in depths.warnings[0]
    result = add_depth_points(scene)
    assert result.points is scene.points and result.warnings == scene.warnings + depths.warnings


def test_maps_that_contradict_points_are_rejected(walls, tmp_path):
    noise = np.random.default_rng(0)
    scene = read_scene(
        write_depth_scene(
            walls,
            tmp_path,
            lambda folder, n, depth: write_exr_map(folder / f"{n}.exr", noise.random(depth.shape)),
        )
    )
    depths = DepthPriors(scene, "inverse")
    assert not depths and "contradict the scene's points" in depths.warnings[0]


def test_missing_maps_give_a_warning(walls):
    for kind in ("metric", "relative", "inverse"):
        depths = DepthPriors(read_scene(walls), kind)
        assert not depths and "no photo has one" in " ".join(depths.warnings)


def test_missing_depth_is_nan(walls, tmp_path):
    """Sensors write 0 and renderers a large value; averages use known values only."""

    def write(folder, number, depth):
        depth[:100], depth[101, 7] = 1e10, 0
        write_exr_map(folder / f"{number}.exr", depth)

    scene = read_scene(write_depth_scene(walls, tmp_path, write))
    inverse = DepthPriors(scene, "metric").inverse(scene.cameras[0])
    assert inverse is not None and np.isnan(inverse[:100]).all() and np.isnan(inverse[101, 7])
    assert np.isfinite(inverse[100:]).sum() == (HEIGHT - 100) * WIDTH - 1
    values = np.array([[1.0, np.nan, np.nan, np.nan], [3.0, 2.0, np.nan, 4.0]])
    np.testing.assert_array_equal(resample_known(values, 2, 1), [[2.0, np.nan]])


def test_depth_of_points(walls):
    scene = read_scene(walls)
    depths, camera = DepthPriors(scene, "points"), scene.cameras[2]
    inverse = depths.inverse(camera)
    assert depths and inverse is not None
    finite = np.isfinite(inverse)
    pixels, z = camera.project(scene.points[camera.sees(scene.points)])
    assert 50 <= finite.sum() <= len(pixels)
    x, y = np.floor(pixels).astype(int).T
    np.testing.assert_allclose(inverse[y, x], 1 / z, rtol=0.2)  # the nearer one of two in a pixel
    np.testing.assert_allclose(inverse[finite], 1 / depth_of(camera)[finite], rtol=0.02)
    unobserved = replace(scene, point_ids=scene.point_ids[:0])
    depths = DepthPriors(unobserved, "points")
    assert not depths and "does not record their observations" in " ".join(depths.warnings)


def test_maps_add_points_to_scenes_of_few_points(walls, tmp_path):
    scene = read_scene(write_depth_scene(walls, tmp_path, METRIC["multilayer"]))
    result = add_depth_points(scene)
    new = result.points[len(scene.points) :]
    assert 20_000 < len(new) <= 100_000 and "initial points from the depth maps" in result.warnings[-1]
    _, y, z = new.T
    assert (np.minimum(np.abs(z), np.abs(y - 1)) < 1e-3).all()  # on the floor or the wall
    camera = scene.cameras[0]
    colors = result.point_colors[len(scene.points) :]
    assert abs(float(colors.mean()) - render_photo(camera.center).mean()) < 12
    assert add_depth_points(result) is result
    assert add_depth_points(read_scene(walls)).points is not None


@pytest.mark.parametrize(
    ("unit", "warned"), [(1, False), (1000, True), pytest.param(0.001, True, marks=pytest.mark.nightly)]
)
def test_implausible_unit_of_maps_gives_a_warning(walls, tmp_path, unit, warned):
    def write(folder, number, depth):
        write_npy_map(folder / f"{number}.npy", (unit * depth).astype(np.float32))

    scene = read_scene(write_depth_scene(walls, tmp_path, write))
    empty = replace(scene, points=scene.points[:0], point_ids=scene.point_ids[:0])
    text = "".join(add_depth_points(empty).warnings)
    assert "initial points from the depth maps" in text and ("in the scene's unit" in text) == warned


@pytest.mark.parametrize("lens", ["OPENCV", "OPENCV_FISHEYE"])
def test_maps_are_undistorted_like_their_photos(tmp_path, lens):
    """A photo that equals its depth map still does; the map has another size."""
    y, x = np.mgrid[: synthetic.HEIGHT, : synthetic.WIDTH]
    ramp = (40 + x + y).astype(np.uint8)
    synthetic.write_scene(tmp_path, synthetic.camera(lens), pixels=np.repeat(ramp[..., None], 3, axis=2))
    for name in ("a.png", "b.png"):
        write_png_map(
            tmp_path / "depths" / name, np.repeat(np.repeat(ramp.astype(float), 2, axis=0), 2, axis=1)
        )
    scene = undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    assert [camera.depth is None for camera in scene.cameras] == [False, False, True]
    for camera in scene.cameras[:2]:
        assert camera.image is not None and camera.depth is not None
        photo = 255 * load_image(camera.image, camera.width, camera.height)[..., 0]
        depth = 1000 * read_depth_map(camera.depth)
        assert depth.shape == photo.shape and np.isfinite(depth).mean() > 0.99
        assert np.nanmean(np.abs(depth - photo)) < 1 and np.ptp(photo) > 60


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: write_png(path, np.zeros((HEIGHT, WIDTH, 3), np.uint8)), "is a colour image"),
        (lambda path: write_png_map(path, np.ones((HEIGHT, WIDTH // 2))), "aspect ratio"),
        (lambda path: path.write_bytes(b"dear diary"), "as a depth map"),
        (lambda path: write_exr_map(path, ONES, "Combined.R"), "no depth"),
        (lambda path: write_exr_map(path, ONES, "R", G=ONES), "no depth"),
        (lambda path: write_npy_map(path, np.ones((HEIGHT, WIDTH, 3))), "of shape"),
        (lambda path: write_npy_map(path, np.full((HEIGHT, WIDTH), "a")), "as a depth map"),
        (lambda path: write_npy_map(path, np.full((HEIGHT, WIDTH), None)), "as a depth map"),
        (lambda path: write_npy_map(path, np.zeros((0, WIDTH))), "no pixels"),
        (lambda path: path.write_bytes(b"\x93NUMPY\1\0v\0{'descr'"), "as a depth map"),
    ],
    ids=["colour", "aspect ratio", "text", "one channel", "two channels", "array of channels", "strings",
         "objects", "empty", "truncated"],
)  # fmt: skip
def test_invalid_depth_map_is_rejected(walls, tmp_path, write, message):
    scene = read_scene(
        write_depth_scene(walls, tmp_path, lambda folder, n, depth: write(folder / f"{n}.png"))
    )
    with pytest.raises(LodgsError, match=message):
        DepthPriors(scene, "metric").inverse(scene.cameras[0])
