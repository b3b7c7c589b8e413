"""Depths of parts of photos, in scenes of planes whose depths are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from training.lod.crop import Crop
from training.optimize import observed_depths
from training.optimize.initialize import initial_points
from training.optimize.model import Model
from training.optimize.observed_depths import photo_parts, points_between
from training.optimize.support import ObservedSpace, SupportPruning
from training.scenes.cameras import Camera

WALL, HALF = 10.0, 5.0
GRAY, RED = (90, 90, 90), (200, 0, 0)


def camera(name: str = "a") -> Camera:
    """Return a camera at the origin that looks along +z, 90 degrees wide."""
    return Camera(name, 640, 640, 320, 320, 320, 320, np.eye(4))


def plane(depth: float = WALL, spacing: float = 0.5) -> np.ndarray:
    """Return points that fill the camera's image at a depth."""
    side = np.arange(-depth, depth, spacing) + spacing / 3
    return np.stack([*np.meshgrid(side, side), np.full((len(side), len(side)), depth)], -1).reshape(-1, 3)


def scene_of(points: np.ndarray, color=GRAY) -> SimpleNamespace:
    colors = np.broadcast_to(np.array(color, np.uint8), (len(points), 3))
    return SimpleNamespace(points=points.astype(np.float32), point_colors=colors)


@pytest.fixture(autouse=True)
def all_observed(monkeypatch):
    """Every camera but one called 'blind' observes all points."""

    def observed_pixels(scene, names, limit):
        indices = np.arange(len(scene.points))
        return {name: (indices, np.zeros((len(indices), 2))) for name in names if name != "blind"}

    monkeypatch.setattr(observed_depths, "observed_pixels", observed_pixels)


def test_points_fill_a_hole_at_the_depth_around_it():
    points = plane()
    hole = np.abs(points[:, :2]).max(1) < 0.8
    added, colors = points_between(scene_of(points[~hole]), [camera()], 100_000, 0)
    inside = np.abs(added[:, :2]).max(1) < 0.6
    assert inside.sum() >= 9  # parts of 640 / 64 pixels are 0.31 wide at this depth
    assert added[:, 2] == pytest.approx(WALL, rel=1e-5)
    assert (colors == GRAY).all()


def test_no_points_between_surfaces_of_different_depths():
    near, far = plane(HALF), plane(WALL)
    points = np.concatenate([near[near[:, 0] < -0.4], far[far[:, 0] > 0.8]])
    added, _ = points_between(scene_of(points), [camera()], 100_000, 0)
    at_a_depth = np.abs(added[:, 2:] - [[HALF, WALL]]).min(1) < 1e-3
    assert len(added) and at_a_depth.all()


def test_inverse_depth_is_interpolated_on_a_slanted_plane():
    """Within 5 %, since weights by distance are not linear: points have a spacing of 0.5, or 2 % in depth."""
    points = plane()
    points[:, 2] += 0.3 * points[:, 0]
    added, _ = points_between(scene_of(points), [camera()], 100_000, 0)
    error = (added[:, 2] - (WALL + 0.3 * added[:, 0])) / added[:, 2]
    assert len(added) > 100 and np.abs(error).max() < 0.05


def test_colors_are_mixed_from_those_around():
    points = plane()
    scene = scene_of(points)
    scene.point_colors = np.where(points[:, :1] < 0, GRAY, RED).astype(np.uint8)
    added, colors = points_between(scene, [camera()], 100_000, 0)
    assert (colors[added[:, 0] < -1] == GRAY).all() and (colors[added[:, 0] > 1] == RED).all()


def test_no_points_where_the_mask_ignores_the_photo(tmp_path):
    """Nothing would train or remove them: the background of an object, which no photo shows."""
    mask = np.zeros((64, 64), np.uint8)
    mask[:, 32:] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    masked = replace(camera(), mask=tmp_path / "mask.png")
    scene = scene_of(plane(spacing=1))
    added, _ = points_between(scene, [masked], 100_000, 0)
    everywhere, _ = points_between(scene, [camera()], 100_000, 0)
    right = {tuple(point) for point in everywhere[everywhere[:, 0] > 0]}
    assert len(right) > 100 and {tuple(point) for point in added} == right


def test_points_between_are_inside_the_region_of_the_job():
    """The rest is trained coarsely, so that photos spend their share of the limit on the region."""
    points, region = plane(spacing=1), Crop.sphere((WALL / 2, 0, WALL), 3)
    scene = scene_of(points)
    added = initial_points(scene, [camera()], 1.0, 5000, 0, region)[0][len(points) :]
    everywhere, _ = points_between(scene, [camera()], 100_000, 0)
    assert len(added) == region.contains(everywhere).sum() > 100 and region.contains(added).all()


def test_photos_share_the_limit_evenly():
    views = [camera("a"), camera("b"), camera("blind")]
    assert len(points_between(scene_of(plane(spacing=1)), views, 300, 0)[0]) == 200
    for limit in (2, 0, -5):
        assert len(points_between(scene_of(plane(spacing=1)), views, limit, 0)[0]) == 0


def test_points_are_added_to_at_most_half_of_the_limit():
    points = plane(spacing=1)
    assert len(points) == 400
    for between, limit, expected in ((0.0, 10**6, 400), (0.1, 10**6, 440), (1.0, 1000, 500), (1.0, 300, 300)):
        assert len(initial_points(scene_of(points), [camera()], between, limit, 0)[0]) == expected
    start = initial_points(scene_of(points), [camera()], 0.1, 10**6, 0)[0][:400]
    assert {tuple(point) for point in start} == {tuple(point) for point in points.astype(np.float32)}


def test_free_depth_is_the_smallest_around_and_zero_without_points():
    points = plane()
    corner = points[(points[:, 0] < 0) & (points[:, 1] < 0)]
    (parts,) = photo_parts(scene_of(corner), [camera()])
    free = parts.free_depths
    assert free.shape == (64, 64)
    assert free[:28, :28] == pytest.approx(WALL) and not free[40:, 40:].any()
    (parts,) = photo_parts(scene_of(np.concatenate([corner, [(-2.0, -2.0, HALF)]])), [camera()])
    assert parts.free_depths[19, 19] == HALF  # at 320 - 320 * 2 / 5 = 192 pixels, part 19


def test_views_that_observe_few_points_have_no_parts():
    assert not list(photo_parts(scene_of(plane()), [camera("blind")]))
    assert not list(photo_parts(scene_of(plane()[:7]), [camera()]))


def test_splats_in_front_of_observed_points_intrude():
    space = ObservedSpace(scene_of(plane()), [camera()])
    means = np.array([(0, 0, 6.9), (0, 0, 7.1), (0, 0, -1), (9, 0, 4)], np.float32)
    assert space.find_intruding(means, 0).tolist() == [True, False, False, False]


def test_splats_near_scene_points_do_not_intrude():
    pole = np.array([(0, 0, 3.0)])
    space = ObservedSpace(scene_of(np.concatenate([plane(), pole])), [camera()])
    space_without = ObservedSpace(scene_of(plane()), [camera()])
    means = np.array([(0.08, 0, 3), (0.5, 0, 3)], np.float32)  # 0.03 of the depth is 0.09
    assert space_without.find_intruding(means, 0).all()
    # the pole's point limits the free depth around it, but not at 53 pixels from it
    assert space.find_intruding(means, 0).tolist() == [False, True]


def test_each_test_uses_other_photos():
    turned = np.diag([-1.0, 1, -1, 1])  # looks along -z
    views = [camera("blind")] * 9 + [
        Camera("back", 640, 640, 320, 320, 320, 320, turned) if n == 8 else camera(f"{n}") for n in range(9)
    ]
    both = np.concatenate([plane(), plane() * (1, 1, -1)])
    space = ObservedSpace(scene_of(both), views)
    means = np.array([(0, 0, 4), (0, 0, -4)], np.float32)
    assert space.find_intruding(means, 0).tolist() == [True, False]
    assert space.find_intruding(means, 1).tolist() == [True, True]  # photos 8, 0, 1, ...
    many = np.repeat(means, 400_000, 0)  # only one photo at a time
    assert [space.find_intruding(many, turn)[[0, -1]].tolist() for turn in (0, 8, 9)] == [
        [True, False],
        [False, True],
        [True, False],
    ]


@pytest.mark.parametrize("use_observations", [True, False])
def test_pruning_uses_observations_unless_disabled(use_observations):
    """A splat at 0.6 of the wall's depth is beyond the free space around cameras, which is half of it."""
    row = {
        "means": torch.tensor([(0.0, 0.0, 6.0), (0.0, 0.0, 9.0)]),
        "log_scales": torch.zeros(2, 3),
    }
    model = Model(row, dict.fromkeys(row, 0.01))
    scene = scene_of(plane())
    SupportPruning(scene, [camera("a"), camera("b")], 0.5, 0.0, use_observations).prune(model, 0, 0)
    assert model["means"][:, 2].tolist() == ([9] if use_observations else [6, 9])
