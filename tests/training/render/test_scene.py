"""Several sets of splats in one image: transforms, colours, depths and levels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from training.errors import LodgsError
from training.rasterize import Gaussians, rasterize
from training.render.image import NO_DEPTH
from training.render.scene import Instance, SplatSet, draw
from training.splats.gaussians import Splats


def transform(rotation=(0, 0, 0), scale=1.0, translation=(0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", rotation).as_matrix() * scale
    matrix[:3, 3] = translation
    return matrix


def moved(camera, matrix):
    """Return the camera whose image of a transformed world is unchanged."""
    pose = camera.world_to_camera @ np.linalg.inv(matrix)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    return replace(camera, world_to_camera=np.diag([scale, scale, scale, 1]) @ pose)


def test_image_matches_the_rasterizer(make_splats, camera):
    splats = make_splats(200)
    weights = np.random.default_rng(1).uniform(size=200).astype(np.float32)
    image = draw([Instance(SplatSet(splats, weights))], camera, background=(0.2, 0.5, 0.9))
    expected = rasterize(
        Gaussians.of(splats), camera, weights=torch.from_numpy(weights), background=(0.2, 0.5, 0.9)
    )
    np.testing.assert_array_equal(image.image, expected.image)
    assert (image.alpha == 1).all()
    clear = draw([Instance(SplatSet(splats, weights))], camera, background=None)
    np.testing.assert_allclose(clear.alpha, expected.alpha)


def test_set_looks_the_same_at_any_transform(make_splats, camera):
    splats, matrix = SplatSet(make_splats(200)), transform((0.3, -0.8, 2), 3.0, (5, -2, 7))
    expected = draw([Instance(splats)], camera, depth=True)
    image = draw([Instance(splats, matrix)], moved(camera, matrix), near=0.03, depth=True)
    np.testing.assert_allclose(image.image, expected.image, atol=2e-5)
    covered = expected.depth < NO_DEPTH
    assert covered.any()
    np.testing.assert_allclose(image.depth[covered], 3 * expected.depth[covered], rtol=1e-3)


def test_sets_with_different_transforms_keep_their_colours(make_splats, camera):
    """A second set forces drawing in the world, where harmonics must rotate with the set."""
    splats, matrix = SplatSet(make_splats(200)), transform((1, 0.5, -2), 0.5, (1, 2, 3))
    far = SplatSet(make_splats(1))
    behind_camera = transform(translation=(0, 0, -1e4))
    expected = draw([Instance(splats)], camera)
    image = draw([Instance(splats, matrix), Instance(far, behind_camera)], moved(camera, matrix))
    np.testing.assert_allclose(image.image, expected.image, atol=1e-4)


def test_flat_splats_are_drawn_at_any_transform(make_splats, camera):
    """Splats with a size of 0 along axes are rotated or sheared, with a second set in the scene."""
    splats, far = make_splats(50), make_splats(1)
    splats.log_scales[::2, 0] = -np.inf
    splats.log_scales[::5] = -np.inf
    thin = replace(splats, log_scales=splats.log_scales.clip(-60, None))
    behind_camera = transform(translation=(0, 0, -1e4))
    for matrix in (transform((1, 0.5, -2), 0.5), np.eye(4) + 0.4 * np.eye(4, k=1) * np.array([1, 1, 0, 0])):
        images = [
            draw([Instance(SplatSet(x), matrix), Instance(SplatSet(far), behind_camera)], camera).image
            for x in (splats, thin)
        ]
        np.testing.assert_allclose(*images, atol=1e-5)
        assert np.ptp(images[0]) > 0.1


def test_two_sets_are_sorted_together(make_splats, camera):
    """Compare with one set that is transformed in float64; constant colours need no rotation."""
    first, second = make_splats(100, degree=0), make_splats(100, degree=0, seed=1)
    matrix = transform((0.4, 1, 0), 1.5, (0.2, 0, 0.3))
    rotation = Rotation.from_matrix(matrix[:3, :3] / 1.5)
    transformed = Splats(
        means=(second.means @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32),
        quats=(rotation * Rotation.from_quat(second.quats[:, [1, 2, 3, 0]]))
        .as_quat()[:, [3, 0, 1, 2]]
        .astype(np.float32),
        log_scales=second.log_scales + np.float32(np.log(1.5)),
        opacity_logits=second.opacity_logits,
        sh=second.sh,
    )
    together = draw([Instance(SplatSet(first)), Instance(SplatSet(second), matrix)], camera)
    expected = draw([Instance(SplatSet(Splats.concatenated([first, transformed])))], camera)
    np.testing.assert_allclose(together.image, expected.image, atol=1e-4)


@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("first", [False, True])
def test_sets_with_and_without_antialiasing_are_combined(make_splats, camera, first, in_world):
    """One set is behind the other, so separate images can be composited."""
    front, back = make_splats(300), make_splats(300, seed=1)
    for splats, ahead in ((front, 3.0), (back, 6.0)):
        splats.means[:, 2] = ahead + splats.means[:, 2] / 10
        splats.log_scales -= 2
        splats.opacity_logits -= 1
    camera = replace(camera, world_to_camera=np.eye(4))
    front_image = rasterize(Gaussians.of(front), camera, antialias=first, backend="reference")
    back_image = rasterize(Gaussians.of(back), camera, antialias=not first, backend="reference")
    expected = front_image.image + (1 - front_image.alpha[..., None]) * back_image.image
    further = [Instance(SplatSet(back), transform(translation=(0, 0, -1e4)))] * in_world
    sets = [SplatSet(front), SplatSet(back)]
    mixed = [Instance(x, antialias=flag) for x, flag in zip(sets, (first, not first), strict=True)]
    same_filter = [Instance(x, antialias=first) for x in sets]
    np.testing.assert_allclose(draw([*mixed, *further], camera).image, expected, atol=1e-4)
    assert np.abs(draw([*same_filter, *further], camera).image - expected.numpy()).max() > 0.05


@pytest.mark.parametrize("matrix", ["stretched", "sheared", "mirrored"])
def test_affine_transforms_change_covariances(make_splats, matrix):
    linear = {
        "stretched": np.diag([3.0, 1, 0.5]),
        "sheared": np.array([[1, 0.7, 0], [0, 1, 0.2], [0, 0, 1.0]]),
        "mirrored": np.diag([-1.0, 1, 1]),
    }[matrix]
    affine = np.eye(4)
    affine[:3, :3] = linear
    splats = make_splats(50)
    gaussians = SplatSet(splats).transformed(affine)
    means, quats, log_scales = gaussians.means, gaussians.quats, gaussians.log_scales

    def covariances(quats, log_scales):
        axes = Rotation.from_quat(np.asarray(quats, float)[:, [1, 2, 3, 0]]).as_matrix()
        axes = axes * np.exp(np.asarray(log_scales, float))[:, None]
        return axes @ axes.transpose(0, 2, 1)

    expected = linear @ covariances(splats.quats, splats.log_scales) @ linear.T
    np.testing.assert_allclose(covariances(quats, log_scales), expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(means, splats.means @ linear.T, rtol=1e-5)


def wall(z: float, color: tuple[float, float, float]) -> Splats:
    """Return one opaque splat that fills the image at a depth."""
    return Splats(
        means=np.float32([[0, 0, z]]), quats=np.float32([[1, 0, 0, 0]]),
        log_scales=np.log(np.float32([[50, 50, 0.01]])), opacity_logits=np.float32([20]),
        sh=((np.float32(color) - 0.5) / 0.28209479177387814)[None, None].astype(np.float32),
    )  # fmt: skip


def test_depth_and_level_passes(camera):
    """A transparent wall of level 2 is in front of an opaque one of level 3 (alpha is capped at 0.99)."""
    camera = replace(camera, world_to_camera=np.eye(4))
    front = Instance(SplatSet(wall(2, (1, 0, 0)), np.float32([0.25])), level=2)
    back = Instance(SplatSet(wall(6, (0, 1, 0))), level=3)
    image = draw([front, back], camera, depth=True, levels=True, background=None)
    center = 24, 32
    assert image.depth[center] == pytest.approx(6)
    assert image.levels == [2, 3] and image.level[center] == 3
    assert image.masks[:, 24, 32] == pytest.approx([0.25, 0.75 * 0.99], abs=2e-3)
    thin = draw([front], camera, depth=True, levels=True, background=None)
    assert thin.depth[center] == pytest.approx(2)  # less than half of the light is stopped: the mean depth
    assert thin.level[center] == 2
    assert thin.alpha[center] == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize("background", [None, (0.2, 0.4, 1.0)])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_meshes_hold_out_splats_behind_them(camera, background, scale):
    """A red wall of alpha 0.25 is at depth 2, a green one at 6, a mesh at 3 on the left and one at 1 below.

    The walls have coordinates of another scale.
    """
    camera = replace(camera, world_to_camera=np.eye(4))
    limit = np.full((48, 64), NO_DEPTH, np.float32)
    limit[:, :32], limit[40:] = 3, 1
    matrix = np.diag([scale, scale, scale, 1])

    def instance(z, color, weight):
        splats = wall(z / scale, color)
        splats.log_scales -= np.float32(np.log(scale))
        return Instance(SplatSet(splats, np.float32([weight])), matrix, level=int(z))

    walls = [instance(2, (1, 0, 0), 0.25), instance(6, (0, 1, 0), 1)]
    image = draw(walls, camera, limit=limit, background=background, depth=True, levels=True)
    back_color = (0, 0, 0) if background is None else background
    full = 0.25, 0.75 * 0.99
    left, right, below = (24, 31), (24, 32), (40, 32)
    np.testing.assert_allclose(image.image[left], (0.25, 0, 0), atol=2e-3)
    np.testing.assert_allclose(
        image.image[right], np.array([*full, 0]) + np.multiply(0.0075, back_color), atol=2e-3
    )
    assert (image.image[below] == 0).all() and image.depth[below] == np.float32(NO_DEPTH)
    at_right = pytest.approx(0.9925, abs=1e-3) if background is None else 1
    assert (image.alpha[left], image.alpha[right]) == (pytest.approx(0.25, abs=2e-3), at_right)
    assert image.alpha[below] == 0
    assert image.depth[left] == pytest.approx(2) and image.depth[right] == pytest.approx(6)
    assert image.masks[:, 24, 31] == pytest.approx([0.25, 0], abs=2e-3)
    window = draw(walls, camera, limit=limit[10:44, 20:50], window=(20, 10, 30, 34), background=background)
    # alphas are computed row by row from the top of a tile, so rounding depends on the window
    np.testing.assert_allclose(window.image, image.image[10:44, 20:50], atol=4e-6)
    empty = draw([], camera, limit=limit, background=background)
    assert empty.alpha[left] == 0 and empty.alpha[24, 40] == (background is not None)


def test_empty_scene_is_the_background(camera, make_splats):
    empty = Instance(SplatSet(make_splats(3).select(slice(0))), level=1)
    for instances in ([], [empty]):
        image = draw(instances, camera, background=(0.1, 0.2, 0.3), depth=True, levels=True)
        assert image.image[5, 5] == pytest.approx((0.1, 0.2, 0.3))
        assert (image.depth == NO_DEPTH).all() and (image.level == 0).all()
        assert (draw(instances, camera, background=None).alpha == 0).all()


def test_drawing_can_be_cancelled(make_splats, camera, monkeypatch):
    monkeypatch.setattr("training.render.scene.STRIP_PIXELS", 1)
    shares = []
    image = draw([Instance(SplatSet(make_splats(5)))], camera, progress=lambda share: shares.append(share))
    assert image is None and shares == [pytest.approx(16 / 48)]


def test_flat_transform_is_refused(make_splats, camera):
    with pytest.raises(LodgsError, match="its scale is 0"):
        draw([Instance(SplatSet(make_splats(5)), np.diag([1.0, 1, 0, 1]))], camera)
