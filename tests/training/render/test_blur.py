"""Blur and projections of one small splat, against the formulas of a thin lens and of each projection."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.color import linear_from_srgb, srgb_from_linear
from training.rasterize.rendering import DILATION
from training.render.blur import Blur, draw_blurred
from training.render.lens import EQUIRECTANGULAR, ORTHOGRAPHIC, Aperture, LensProjection
from training.render.scene import Instance, SplatSet, draw
from training.scenes.cameras import Camera
from training.splats.gaussians import Splats

FOCAL = 60.0
CAMERA = Camera("", 96, 64, FOCAL, FOCAL, 48.0, 32.0, np.eye(4))
ORTHO = LensProjection(ORTHOGRAPHIC, distance=4.0)


def dot(position, sigma=(1e-4, 1e-4, 1e-4), color=(0.5, 0.5, 0.5), rotation=None) -> Instance:
    """Return a set of one opaque splat."""
    quat = (rotation or Rotation.identity()).as_quat()[[3, 0, 1, 2]]
    splats = Splats(
        means=np.float32([position]), quats=np.float32([quat]), log_scales=np.log(np.float32([sigma])),
        opacity_logits=np.float32([4]), sh=(np.float32([[color]]) - 0.5) / np.float32(0.28209479177387814),
    )  # fmt: skip
    return Instance(SplatSet(splats))


def moments(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean pixel (x, y) and the covariance (2, 2) of an image's coverage."""
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    points = np.stack([columns.ravel(), rows.ravel()], 1)
    mean = np.average(points, axis=0, weights=alpha.ravel())
    return mean, np.cov(points.T, aweights=alpha.ravel().astype(np.float64), bias=True)


@pytest.mark.parametrize(
    ("projection", "depth", "radius"),
    [
        (LensProjection(), 2.0, FOCAL * 0.3 * (1 / 2 - 1 / 4)),
        (LensProjection(), 4.0, 0.0),
        (LensProjection(), 8.0, FOCAL * 0.3 * (1 / 4 - 1 / 8)),
        (ORTHO, 7.0, FOCAL / ORTHO.distance * 0.3 * (7 / 4 - 1)),
    ],
)
def test_point_out_of_focus_becomes_the_circle_of_confusion(projection, depth, radius):
    """Coverage of a disk of radius R has the variance R²/4 along each axis; R = f r |1/focus - 1/depth|."""
    point = [dot((0.1, -0.2, depth))]
    sharp = draw_blurred(point, CAMERA, projection, background=None)
    blur = Blur(100, Aperture(0.3, focus=4.0))
    blurred = draw_blurred(point, CAMERA, projection, blur, background=None)
    (centre, covariance), (moved_centre, moved) = moments(sharp.alpha), moments(blurred.alpha)
    np.testing.assert_allclose(moved_centre, centre, atol=0.05)
    np.testing.assert_allclose(moved - covariance, np.eye(2) * radius**2 / 4, atol=0.01 * radius**2 + 1e-3)
    assert blurred.alpha.sum() == pytest.approx(sharp.alpha.sum(), rel=0.03)


def test_blades_and_ratio_shape_the_opening():
    """A square has the variance r²/6 along both axes, an anamorphic lens 1/ratio of the width."""
    square = Aperture(2.0, 1.0, blades=4, rotation=0.2).points(4000)
    np.testing.assert_allclose(np.cov(square.T), np.eye(2) * 4 / 6, atol=0.01)
    aligned = square @ Rotation.from_euler("z", 0.2).as_matrix()[:2, :2].T  # y is down: undo the rotation
    assert np.abs(aligned).sum(1).max() == pytest.approx(2, abs=0.01)  # corners on the axes, at the radius
    few = Aperture(1.0, 1.0, blades=6, rotation=0.4).points(64)
    np.testing.assert_allclose(np.cov(few.T, bias=True), np.eye(2) * 2.5 / 12, atol=0.01)
    wide = Aperture(1.0, 1.0, ratio=2.0).points(1000)
    assert np.abs(wide).max(0) == pytest.approx([0.5, 1], abs=0.02)


@pytest.mark.parametrize("moving", ["splat", "camera"])
def test_moving_splat_becomes_a_streak(moving):
    """The streak of an even motion of L pixels has the variance L²/12 along it."""
    keys = [np.eye(4) for _ in range(3)]
    for key, shift in zip(keys, (-0.5, 0.0, 0.5), strict=True):
        key[0, 3] = shift if moving == "splat" else -shift
    point = dot((0, 0, 3))
    sharp = draw_blurred([point], CAMERA, background=None)
    if moving == "splat":
        point, blur = replace(point, motion=tuple(keys)), Blur(40)
    else:
        poses = [np.linalg.inv(key) for key in keys]
        blur = Blur(40, cameras=tuple(replace(CAMERA, world_to_camera=pose) for pose in poses))
    blurred = draw_blurred([point], CAMERA, blur=blur, background=None, depth=True)
    (centre, covariance), (moved_centre, moved) = moments(sharp.alpha), moments(blurred.alpha)
    length = FOCAL / 3
    np.testing.assert_allclose(moved_centre, centre, atol=0.01)
    np.testing.assert_allclose(moved - covariance, [[length**2 / 12, 0], [0, 0]], atol=0.02 * length**2 / 12)
    assert (blurred.depth < 1e9).sum() == (sharp.alpha > 0).sum()  # the depth is sharp


def test_turning_camera_keeps_its_place_between_keys():
    poses = []
    for angle in (-0.4, 0.4):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", angle).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ (0.5, 0, 0)
        poses.append(replace(CAMERA, world_to_camera=pose))
    blurred = draw_blurred([dot((0.5, 0, 3))], CAMERA, blur=Blur(1, cameras=tuple(poses)), background=None)
    np.testing.assert_allclose(moments(blurred.alpha)[0], (48, 32), atol=0.01)


def test_set_turns_around_its_origin_between_keys():
    """Halfway through a rotation by 180 degrees, a set is rotated by 90 degrees, also a mirrored one."""
    for mirror in (1, -1):
        keys = [np.diag([mirror, 1.0, 1, 1]), np.diag([mirror, 1.0, 1, 1])]
        keys[1][:3, :3] = Rotation.from_euler("z", 179.9, degrees=True).as_matrix() @ keys[0][:3, :3]
        point = replace(dot((1, 0, 3)), motion=tuple(keys))
        image = draw_blurred([point], CAMERA, blur=Blur(1), background=None)
        np.testing.assert_allclose(moments(image.alpha)[0], (48, 32 + mirror * FOCAL / 3), atol=0.05)


def test_blur_averages_linear_light_over_the_background():
    """A white wall during half of the shutter time over black: half of the light, not half of the code."""
    hidden = np.eye(4)
    hidden[2, 3] = -100
    wall = dot((0, 0, 3), sigma=(50, 50, 0.01), color=(1, 1, 1))
    keys = [np.eye(4)] * 3 + [hidden] * 3  # samples at 1/8, 3/8, 5/8 and 7/8
    image = draw_blurred([replace(wall, motion=tuple(keys))], CAMERA, blur=Blur(4))
    opaque = draw([wall], CAMERA).image[32, 48]
    assert image.image[32, 48] == pytest.approx(srgb_from_linear(linear_from_srgb(opaque) / 2), abs=1e-5)
    assert (image.alpha == 1).all()


def test_orthographic_splats_have_their_projected_covariance():
    """Scales are the same at all depths, also at the border of the image, and for a rotated set."""
    rotation = Rotation.from_euler("xyz", (0.4, -0.7, 1.1))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix() * 2
    sigma = np.array([0.25, 0.1, 0.05])
    splat_rotation = Rotation.from_euler("z", 0.6)
    axes = matrix[:3, :3] @ splat_rotation.as_matrix() * sigma
    scale = FOCAL / ORTHO.distance
    expected = scale**2 * (axes @ axes.T)[:2, :2] + np.eye(2) * DILATION
    for position in ((0, 0, 3), (1.2, -0.6, 9)):
        local = np.linalg.solve(matrix, (*position, 1))[:3]
        item = replace(dot(local, sigma, rotation=splat_rotation), matrix=matrix)
        item.splats.gaussians.opacity_logits[:] = 0
        image = draw_blurred([item], CAMERA, ORTHO, background=None, depth=True)
        centre, covariance = moments(image.alpha)
        np.testing.assert_allclose(centre, scale * np.array(position[:2]) + (48, 32), atol=0.01)
        np.testing.assert_allclose(covariance, expected, rtol=0.06)  # tails below 1/255 are not drawn
        assert image.depth[image.alpha > 0] == pytest.approx(position[2], rel=1e-4)


def test_orthographic_colours_and_order_are_those_of_a_distant_camera(make_splats):
    splats = SplatSet(make_splats(200))
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", (0.4, -0.7, 1.1)).as_matrix()
    pose = np.eye(4)
    pose[2, 3] = 4
    near_camera = replace(CAMERA, world_to_camera=pose)
    pose = pose.copy()
    pose[2, 3] = 4000
    far_camera = replace(CAMERA, fx=FOCAL * 1000, fy=FOCAL * 1000, world_to_camera=pose)
    image = draw_blurred([Instance(splats, matrix)], near_camera, ORTHO, near=-100.0)
    expected = draw([Instance(splats, matrix)], far_camera)
    assert np.ptp(expected.image) > 0.5
    np.testing.assert_allclose(image.image, expected.image, atol=0.02)


def test_panorama_shows_directions_at_their_angles_and_distances():
    """Splats in all directions, at the borders of cube sides, and a part of the image."""
    projection = LensProjection(EQUIRECTANGULAR, longitude=(-np.pi, np.pi), latitude=(-np.pi / 2, np.pi / 2))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", (0.2, 0.5, -0.3)).as_matrix()
    camera = replace(CAMERA, width=128, height=64, world_to_camera=turn)
    for longitude, latitude in ((0, 0), (45, 0), (100, 30), (-140, -60), (-90, 10), (20, 44)):
        a, b = np.radians((longitude, latitude))
        direction = np.array([np.cos(b) * np.sin(a), -np.sin(b), np.cos(b) * np.cos(a)])
        point = dot(turn[:3, :3].T @ (5 * direction), sigma=(0.15, 0.15, 0.15))
        image = draw_blurred([point], camera, projection, background=None, depth=True)
        expected = (longitude + 180) / 360 * 128, (90 - latitude) / 180 * 64
        np.testing.assert_allclose(moments(image.alpha)[0], expected, atol=0.1)
        assert image.depth[image.alpha > 0.3] == pytest.approx(5, rel=0.06)
    window = draw_blurred([point], camera, projection, window=(60, 5, 20, 30), background=None)
    np.testing.assert_allclose(window.alpha, image.alpha[5:35, 60:80], atol=1e-6)
    background = draw_blurred([point], camera, projection, background=(1, 1, 1))
    assert (background.alpha == 1).all() and background.image[0, 0] == pytest.approx((1, 1, 1))
    west, east = np.radians((-30, 60))
    projection = LensProjection(EQUIRECTANGULAR, longitude=(west, east), latitude=np.radians((0, 60)))
    image = draw_blurred([point], camera, projection, background=None)
    np.testing.assert_allclose(moments(image.alpha)[0], (50 / 90 * 128, 16 / 60 * 64), atol=0.2)


@pytest.mark.parametrize("longitude", [-150, -100, 20, 60])
def test_large_splats_have_no_edge_in_a_panorama(longitude):
    """A splat as large as the sky: its image is as smooth as the Gaussian along the rays."""
    size = 0.5  # standard deviation divided by distance
    projection = LensProjection(EQUIRECTANGULAR, longitude=(-np.pi, np.pi), latitude=(-np.pi / 2, np.pi / 2))
    camera = replace(CAMERA, width=128, height=64, world_to_camera=np.eye(4))
    a, b = np.radians((longitude, 25))
    direction = np.array([np.cos(b) * np.sin(a), -np.sin(b), np.cos(b) * np.cos(a)])
    splat = dot(tuple(5 * direction), sigma=(5 * size,) * 3)
    image = draw_blurred([splat], camera, projection, background=None)
    steepest = 0.6065 / size  # slope of a Gaussian per radian, at one standard deviation
    rows = slice(16, 48)  # away from the poles
    change = np.abs(np.diff(image.alpha[rows], axis=1)).max() / np.radians(360 / 128)
    assert 0.5 * steepest < change < 1.5 * steepest


def test_blurred_image_can_be_cancelled_in_any_sample(monkeypatch):
    shares = []

    def progress(share):
        shares.append(share)
        return len(shares) < 3

    assert draw_blurred([dot((0, 0, 3))], CAMERA, blur=Blur(8, Aperture(0.1, 2)), progress=progress) is None
    assert shares == pytest.approx([1 / 8, 2 / 8, 3 / 8])
