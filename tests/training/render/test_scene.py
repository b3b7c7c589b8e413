"""Sets of splats in one picture: their places, colours, depths and levels."""

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
    """The camera that sees a world moved by a similarity as it saw it before."""
    pose = camera.world_to_camera @ np.linalg.inv(matrix)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    return replace(camera, world_to_camera=np.diag([scale, scale, scale, 1]) @ pose)


def test_it_draws_what_the_rasterizer_draws(make_splats, camera):
    splats = make_splats(200)
    weights = np.random.default_rng(1).uniform(size=200).astype(np.float32)
    picture = draw([Instance(SplatSet(splats, weights))], camera, background=(0.2, 0.5, 0.9))
    drawn = rasterize(
        Gaussians.of(splats), camera, weights=torch.from_numpy(weights), background=(0.2, 0.5, 0.9)
    )
    np.testing.assert_array_equal(picture.image, drawn.image)
    assert (picture.alpha == 1).all()
    clear = draw([Instance(SplatSet(splats, weights))], camera, background=None)
    np.testing.assert_allclose(clear.alpha, drawn.alpha)


def test_one_set_looks_the_same_wherever_it_stands(make_splats, camera):
    placed, matrix = SplatSet(make_splats(200)), transform((0.3, -0.8, 2), 3.0, (5, -2, 7))
    here = draw([Instance(placed)], camera, depth=True)
    there = draw([Instance(placed, matrix)], moved(camera, matrix), near=0.03, depth=True)
    np.testing.assert_allclose(there.image, here.image, atol=2e-5)
    covered = here.depth < NO_DEPTH
    assert covered.any()
    np.testing.assert_allclose(there.depth[covered], 3 * here.depth[covered], rtol=1e-3)


def test_sets_in_several_places_keep_their_colours(make_splats, camera):
    """Drawn in the world, beside an empty corner of it, as in its own coordinates: harmonics turn along."""
    splats, matrix = SplatSet(make_splats(200)), transform((1, 0.5, -2), 0.5, (1, 2, 3))
    far = SplatSet(make_splats(1))
    behind = transform(translation=(0, 0, -1e4))
    here = draw([Instance(splats)], camera)
    there = draw([Instance(splats, matrix), Instance(far, behind)], moved(camera, matrix))
    np.testing.assert_allclose(there.image, here.image, atol=1e-4)


def test_flat_splats_are_drawn_wherever_they_stand(make_splats, camera):
    """A size of 0 along an axis, whose direction no length tells: beside another set, turned, and sheared."""
    splats, other = make_splats(50), make_splats(1)
    splats.log_scales[::2, 0] = -np.inf
    splats.log_scales[::5] = -np.inf
    thin = replace(splats, log_scales=splats.log_scales.clip(-60, None))
    behind = transform(translation=(0, 0, -1e4))
    for matrix in (transform((1, 0.5, -2), 0.5), np.eye(4) + 0.4 * np.eye(4, k=1) * np.array([1, 1, 0, 0])):
        drawn = [
            draw([Instance(SplatSet(each), matrix), Instance(SplatSet(other), behind)], camera).image
            for each in (splats, thin)
        ]
        np.testing.assert_allclose(*drawn, atol=1e-5)
        assert np.ptp(drawn[0]) > 0.1


def test_two_sets_are_sorted_together(make_splats, camera):
    """Moved by hand in float64 and drawn as one set; constant colours, which no rotation changes."""
    first, second = make_splats(100, degree=0), make_splats(100, degree=0, seed=1)
    matrix = transform((0.4, 1, 0), 1.5, (0.2, 0, 0.3))
    rotation = Rotation.from_matrix(matrix[:3, :3] / 1.5)
    by_hand = Splats(
        means=(second.means @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32),
        quats=(rotation * Rotation.from_quat(second.quats[:, [1, 2, 3, 0]]))
        .as_quat()[:, [3, 0, 1, 2]]
        .astype(np.float32),
        log_scales=second.log_scales + np.float32(np.log(1.5)),
        opacity_logits=second.opacity_logits,
        sh=second.sh,
    )
    together = draw([Instance(SplatSet(first)), Instance(SplatSet(second), matrix)], camera)
    one = draw([Instance(SplatSet(Splats.concatenated([first, by_hand])))], camera)
    np.testing.assert_allclose(together.image, one.image, atol=1e-4)


@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("first", [False, True])
def test_sets_of_either_filter_in_one_picture(make_splats, camera, first, in_world):
    """One behind the other, so that the picture is by hand what each is alone."""
    front, back = make_splats(300), make_splats(300, seed=1)
    for splats, ahead in ((front, 3.0), (back, 6.0)):
        splats.means[:, 2] = ahead + splats.means[:, 2] / 10
        splats.log_scales -= 2
        splats.opacity_logits -= 1
    camera = replace(camera, world_to_camera=np.eye(4))
    before = rasterize(Gaussians.of(front), camera, antialias=first, backend="reference")
    behind = rasterize(Gaussians.of(back), camera, antialias=not first, backend="reference")
    expected = before.image + (1 - before.alpha[..., None]) * behind.image
    elsewhere = [Instance(SplatSet(back), transform(translation=(0, 0, -1e4)))] * in_world
    sets = [SplatSet(front), SplatSet(back)]
    mixed = [Instance(one, antialias=flag) for one, flag in zip(sets, (first, not first), strict=True)]
    alike = [Instance(one, antialias=first) for one in sets]
    np.testing.assert_allclose(draw([*mixed, *elsewhere], camera).image, expected, atol=1e-4)
    assert np.abs(draw([*alike, *elsewhere], camera).image - expected.numpy()).max() > 0.05


@pytest.mark.parametrize("matrix", ["stretched", "sheared", "mirrored"])
def test_a_set_that_is_no_longer_similar_has_the_covariances_of_its_transform(make_splats, matrix):
    linear = {
        "stretched": np.diag([3.0, 1, 0.5]),
        "sheared": np.array([[1, 0.7, 0], [0, 1, 0.2], [0, 0, 1.0]]),
        "mirrored": np.diag([-1.0, 1, 1]),
    }[matrix]
    whole = np.eye(4)
    whole[:3, :3] = linear
    splats = make_splats(50)
    there = SplatSet(splats).transformed(whole)
    means, quats, log_scales = there.means, there.quats, there.log_scales

    def covariances(quats, log_scales):
        axes = Rotation.from_quat(np.asarray(quats, float)[:, [1, 2, 3, 0]]).as_matrix()
        axes = axes * np.exp(np.asarray(log_scales, float))[:, None]
        return axes @ axes.transpose(0, 2, 1)

    expected = linear @ covariances(splats.quats, splats.log_scales) @ linear.T
    np.testing.assert_allclose(covariances(quats, log_scales), expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(means, splats.means @ linear.T, rtol=1e-5)


def wall(z: float, color: tuple[float, float, float]) -> Splats:
    """One opaque splat that fills the picture at a depth."""
    return Splats(
        means=np.float32([[0, 0, z]]), quats=np.float32([[1, 0, 0, 0]]),
        log_scales=np.log(np.float32([[50, 50, 0.01]])), opacity_logits=np.float32([20]),
        sh=((np.float32(color) - 0.5) / 0.28209479177387814)[None, None].astype(np.float32),
    )  # fmt: skip


def test_depth_and_levels(camera):
    """A half transparent wall of level 2 before an opaque one of level 3 (alpha is capped at 0.99)."""
    camera = replace(camera, world_to_camera=np.eye(4))
    before = Instance(SplatSet(wall(2, (1, 0, 0)), np.float32([0.25])), level=2)
    behind = Instance(SplatSet(wall(6, (0, 1, 0))), level=3)
    picture = draw([before, behind], camera, depth=True, levels=True, background=None)
    center = 24, 32
    assert picture.depth[center] == pytest.approx(6)
    assert picture.levels == [2, 3] and picture.level[center] == 3
    assert picture.masks[:, 24, 32] == pytest.approx([0.25, 0.75 * 0.99], abs=2e-3)
    thin = draw([before], camera, depth=True, levels=True, background=None)
    assert thin.depth[center] == pytest.approx(2)  # nothing brings the light to a half: the mean
    assert thin.level[center] == 2
    assert thin.alpha[center] == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize("background", [None, (0.2, 0.4, 1.0)])
@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_meshes_hold_out_what_is_behind_them(camera, background, scale):
    """A red wall of alpha a quarter at 2, a green one at 6, a mesh at 3 on the left, a nearer one below. One
    scale brings the walls to their places from a space of other units."""
    camera = replace(camera, world_to_camera=np.eye(4))
    limit = np.full((48, 64), NO_DEPTH, np.float32)
    limit[:, :32], limit[40:] = 3, 1
    matrix = np.diag([scale, scale, scale, 1])

    def placed(z, color, weight):
        splats = wall(z / scale, color)
        splats.log_scales -= np.float32(np.log(scale))
        return Instance(SplatSet(splats, np.float32([weight])), matrix, level=int(z))

    both = [placed(2, (1, 0, 0), 0.25), placed(6, (0, 1, 0), 1)]
    picture = draw(both, camera, limit=limit, background=background, depth=True, levels=True)
    behind = (0, 0, 0) if background is None else background
    full = 0.25, 0.75 * 0.99
    left, right, below = (24, 31), (24, 32), (40, 32)
    np.testing.assert_allclose(picture.image[left], (0.25, 0, 0), atol=2e-3)
    np.testing.assert_allclose(
        picture.image[right], np.array([*full, 0]) + np.multiply(0.0075, behind), atol=2e-3
    )
    assert (picture.image[below] == 0).all() and picture.depth[below] == np.float32(NO_DEPTH)
    at_right = pytest.approx(0.9925, abs=1e-3) if background is None else 1
    assert (picture.alpha[left], picture.alpha[right]) == (pytest.approx(0.25, abs=2e-3), at_right)
    assert picture.alpha[below] == 0
    assert picture.depth[left] == pytest.approx(2) and picture.depth[right] == pytest.approx(6)
    assert picture.masks[:, 24, 31] == pytest.approx([0.25, 0], abs=2e-3)
    window = draw(both, camera, limit=limit[10:44, 20:50], window=(20, 10, 30, 34), background=background)
    np.testing.assert_allclose(window.image, picture.image[10:44, 20:50], atol=1e-6)
    nothing = draw([], camera, limit=limit, background=background)
    assert nothing.alpha[left] == 0 and nothing.alpha[24, 40] == (background is not None)


def test_nothing_to_draw_is_the_background(camera, make_splats):
    nothing = Instance(SplatSet(make_splats(3).select(slice(0))), level=1)
    for placed in ([], [nothing]):
        picture = draw(placed, camera, background=(0.1, 0.2, 0.3), depth=True, levels=True)
        assert picture.image[5, 5] == pytest.approx((0.1, 0.2, 0.3))
        assert (picture.depth == NO_DEPTH).all() and (picture.level == 0).all()
        assert (draw(placed, camera, background=None).alpha == 0).all()


def test_it_ends_when_it_is_no_longer_wanted(make_splats, camera, monkeypatch):
    monkeypatch.setattr("training.render.scene.STRIP_PIXELS", 1)
    told = []
    picture = draw([Instance(SplatSet(make_splats(5)))], camera, progress=lambda share: told.append(share))
    assert picture is None and told == [pytest.approx(16 / 48)]


def test_a_flat_transform_is_refused(make_splats, camera):
    with pytest.raises(LodgsError, match="scaled to nothing"):
        draw([Instance(SplatSet(make_splats(5)), np.diag([1.0, 1, 0, 1]))], camera)
