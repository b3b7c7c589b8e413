"""What is known of depth: maps of every kind beside photographs, fitted or refused; points of the model and
from maps.

Truth is a floor and a wall whose depths are worked out by hand.
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
from .depth_walls import FITTED, METRIC, depth_of, exr, grey, npy, put, write_walls
from .walls import HEIGHT, WIDTH, render_photo

ONES = np.ones((HEIGHT, WIDTH), np.float32)


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return write_walls(tmp_path_factory.mktemp("walls"))


@pytest.mark.parametrize("kind", METRIC)
def test_metric_maps_are_read_as_they_are(walls, tmp_path, kind):
    scene = read_scene(put(walls, tmp_path, METRIC[kind]))
    depths = DepthPriors(scene, "metric")
    assert depths and not depths.warnings
    for camera in scene.cameras[:2]:
        found = depths.inverse(camera)
        assert found is not None and found.dtype == np.float32
        np.testing.assert_allclose(found, 1 / depth_of(camera), rtol=1e-3)
        half = depths.inverse(camera.scaled(0.5))
        expected = (1 / depth_of(camera)).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(half, expected, rtol=1e-3)


@pytest.mark.parametrize("kind", FITTED)
def test_scale_and_shift_are_found_for_each_view(walls, tmp_path, kind):
    scene = read_scene(put(walls, tmp_path, FITTED[kind]))
    depths = DepthPriors(scene, kind)
    assert depths and not depths.warnings
    for camera in scene.cameras:
        found = depths.inverse(camera)
        assert found is not None
        np.testing.assert_allclose(found, 1 / depth_of(camera), rtol=0.02)


def test_scale_and_shift_whatever_is_hidden():
    """A fifth of the points lie behind what the map shows."""
    rng = np.random.default_rng(0)
    z = rng.uniform(2, 9, 400)
    behind = z * np.where(rng.random(400) < 0.2, rng.uniform(1.2, 3, 400), 1)
    scale, shift = fit_scale_and_shift(3 * (1 / z) + 0.7, behind, depth=False) or (0, 0)
    assert (scale, shift) == pytest.approx((1 / 3, -0.7 / 3), abs=5e-3)
    scale, shift = fit_scale_and_shift(0.5 * z + 0.2, behind, depth=True) or (0, 0)
    assert (scale, shift) == pytest.approx((2, -0.4), abs=0.05)
    assert fit_scale_and_shift(rng.random(400), z, depth=False) is None
    assert fit_scale_and_shift(z, z, depth=False) is None  # the wrong way round
    assert fit_scale_and_shift(1 / z[:5], z[:5], depth=False) is None


def test_maps_in_another_unit_are_not_used(walls, tmp_path):
    scene = read_scene(put(walls, tmp_path, FITTED["inverse"]))
    depths = DepthPriors(scene, "metric")
    assert not depths and depths.inverse(scene.cameras[0]) is None
    assert len(depths.warnings) == 1 and "times as large" in depths.warnings[0]
    begun = add_depth_points(scene)
    assert begun.points is scene.points and begun.warnings == scene.warnings + depths.warnings


def test_maps_that_fit_no_points_are_not_used(walls, tmp_path):
    noise = np.random.default_rng(0)
    scene = read_scene(
        put(walls, tmp_path, lambda folder, n, depth: exr(folder / f"{n}.exr", noise.random(depth.shape)))
    )
    depths = DepthPriors(scene, "inverse")
    assert not depths and "do not go with the scene's points" in depths.warnings[0]


def test_without_maps_nothing_is_known(walls):
    for kind in ("metric", "relative", "inverse"):
        depths = DepthPriors(read_scene(walls), kind)
        assert not depths and "no photograph has a depth map" in " ".join(depths.warnings)


def test_what_is_not_known_stays_so(walls, tmp_path):
    """Zeros of sensors, the sky of renderers; of a mean only what is known counts."""

    def write(folder, number, depth):
        depth[:100], depth[101, 7] = 1e10, 0
        exr(folder / f"{number}.exr", depth)

    scene = read_scene(put(walls, tmp_path, write))
    found = DepthPriors(scene, "metric").inverse(scene.cameras[0])
    assert found is not None and np.isnan(found[:100]).all() and np.isnan(found[101, 7])
    assert np.isfinite(found[100:]).sum() == (HEIGHT - 100) * WIDTH - 1
    values = np.array([[1.0, np.nan, np.nan, np.nan], [3.0, 2.0, np.nan, 4.0]])
    np.testing.assert_array_equal(resample_known(values, 2, 1), [[2.0, np.nan]])


def test_the_models_points_are_known_where_they_are(walls):
    scene = read_scene(walls)
    depths, camera = DepthPriors(scene, "points"), scene.cameras[2]
    found = depths.inverse(camera)
    assert depths and found is not None
    known = np.isfinite(found)
    pixels, z = camera.project(scene.points[camera.sees(scene.points)])
    assert 50 <= known.sum() <= len(pixels)
    x, y = np.floor(pixels).astype(int).T
    np.testing.assert_allclose(found[y, x], 1 / z, rtol=0.2)  # two in one pixel: the nearer one
    np.testing.assert_allclose(found[known], 1 / depth_of(camera)[known], rtol=0.02)
    bare = replace(scene, point_ids=scene.point_ids[:0])  # nobody says who sees them
    depths = DepthPriors(bare, "points")
    assert not depths and "does not tell which photographs see its points" in " ".join(depths.warnings)


def test_points_come_from_maps_where_there_are_few(walls, tmp_path):
    scene = read_scene(put(walls, tmp_path, METRIC["multilayer"]))
    found = add_depth_points(scene)
    new = found.points[len(scene.points) :]
    assert 20_000 < len(new) <= 100_000 and "are taken from the depth maps" in found.warnings[-1]
    _, y, z = new.T
    assert (np.minimum(np.abs(z), np.abs(y - 1)) < 1e-3).all()  # on the floor or the wall
    camera = scene.cameras[0]
    colors = found.point_colors[len(scene.points) :]
    assert abs(float(colors.mean()) - render_photo(camera.center).mean()) < 12
    assert add_depth_points(found) is found
    assert add_depth_points(read_scene(walls)).points is not None


@pytest.mark.parametrize(("unit", "odd"), [(1, False), (1000, True), (0.001, True)])
def test_points_from_maps_in_another_unit_are_warned_of(walls, tmp_path, unit, odd):
    def write(folder, number, depth):
        npy(folder / f"{number}.npy", (unit * depth).astype(np.float32))

    scene = read_scene(put(walls, tmp_path, write))
    nothing = replace(scene, points=scene.points[:0], point_ids=scene.point_ids[:0])
    said = "".join(add_depth_points(nothing).warnings)
    assert "are taken from the depth maps" in said and ("they are in the scene's unit" in said) == odd


@pytest.mark.parametrize("lens", ["OPENCV", "OPENCV_FISHEYE"])
def test_they_are_straightened_like_their_photographs(tmp_path, lens):
    """A photograph that is its own depth map still is; the map has another size."""
    y, x = np.mgrid[: synthetic.HEIGHT, : synthetic.WIDTH]
    ramp = (40 + x + y).astype(np.uint8)
    synthetic.write_scene(tmp_path, synthetic.camera(lens), pixels=np.repeat(ramp[..., None], 3, axis=2))
    for name in ("a.png", "b.png"):
        grey(tmp_path / "depths" / name, np.repeat(np.repeat(ramp.astype(float), 2, axis=0), 2, axis=1))
    scene = undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    assert [camera.depth is None for camera in scene.cameras] == [False, False, True]
    for camera in scene.cameras[:2]:
        assert camera.image is not None and camera.depth is not None
        photograph = 255 * load_image(camera.image, camera.width, camera.height)[..., 0]
        depth = 1000 * read_depth_map(camera.depth)
        assert depth.shape == photograph.shape and np.isfinite(depth).mean() > 0.99
        assert np.nanmean(np.abs(depth - photograph)) < 1 and np.ptp(photograph) > 60


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: write_png(path, np.zeros((HEIGHT, WIDTH, 3), np.uint8)), "is a picture in colours"),
        (lambda path: grey(path, np.ones((HEIGHT, WIDTH // 2))), "other proportions"),
        (lambda path: path.write_bytes(b"dear diary"), "cannot be read as a depth map"),
        (lambda path: exr(path, ONES, "Combined.R"), "no depth"),
        (lambda path: exr(path, ONES, "R", G=ONES), "no depth"),
        (lambda path: npy(path, np.ones((HEIGHT, WIDTH, 3))), "of shape"),
        (lambda path: npy(path, np.full((HEIGHT, WIDTH), "a")), "not a depth map"),
        (lambda path: npy(path, np.full((HEIGHT, WIDTH), None)), "cannot be read as a depth map"),
        (lambda path: npy(path, np.zeros((0, WIDTH))), "no pixels"),
        (lambda path: path.write_bytes(b"\x93NUMPY\1\0v\0{'descr'"), "cannot be read as a depth map"),
    ],
    ids=["colours", "proportions", "text", "one channel", "two channels", "channels of numbers", "words",
         "objects", "nothing", "cut short"],
)  # fmt: skip
def test_what_is_no_depth_map_is_a_sentence(walls, tmp_path, write, words):
    scene = read_scene(put(walls, tmp_path, lambda folder, n, depth: write(folder / f"{n}.png")))
    with pytest.raises(LodgsError, match=words):
        DepthPriors(scene, "metric").inverse(scene.cameras[0])
