"""Strokes, compared with Python loops; visibility, compared with transmittance."""

from itertools import pairwise

import numpy as np
import pytest

from training.editing.brush import (
    OcclusionDepth,
    ProjectedSplats,
    Projection,
    brush_coverage,
    hit_strength,
    lasso_coverage,
)
from training.scenes.cameras import Camera, look_at

SIZE = (96, 64)
PERSPECTIVE = np.float64([[2, 0, 0.1, 0], [0, 3, 0, 0], [0, 0, -1.002, -0.2], [0, 0, -1, 0]])
FLAT = np.diag([0.2, 0.3, -0.02, 1.0])


def centres():
    return [(x + 0.5, y + 0.5) for y in range(SIZE[1]) for x in range(SIZE[0])]


def mask_of(test):
    return np.array([test(x, y) for x, y in centres()]).reshape(SIZE[1], SIZE[0])


def to_segment(x, y, begin, end):
    along, current = np.subtract(end, begin), np.subtract((x, y), begin)
    share = min(max(current @ along / (along @ along), 0), 1) if along.any() else 0
    return np.hypot(*(current - share * along))


def is_enclosed(x, y, corners):
    """Return True if a ray from (x, y) to the left crosses an odd number of edges."""
    result = False
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        if (ay > y) != (by > y) and ax + (y - ay) * (bx - ax) / (by - ay) < x:
            result = not result
    return result


@pytest.mark.parametrize(
    "path", [[(20.3, 30.1)], [(10.2, 10.7), (70.1, 50.3), (72.4, 12.9)], [(-30.0, 5.0), (3.1, 70.2)]]
)
def test_brush_covers_pixels_near_its_path(path):
    ends = list(pairwise(path)) or [(path[0], path[0])]
    expected = mask_of(lambda x, y: min(to_segment(x, y, *item) for item in ends) <= 7.3)
    np.testing.assert_array_equal(brush_coverage(path, 7.3, SIZE), expected)
    assert 0 < expected.sum() < expected.size


@pytest.mark.parametrize("hardness", [0.0, 0.4, 1.0])
def test_soft_brush_falls_off_towards_its_edge(hardness):
    path, radius = [(10.2, 10.7), (70.1, 50.3), (72.4, 12.9)], 13.7

    def strength(x, y):
        t = min(to_segment(x, y, *item) for item in pairwise(path)) / radius
        if t <= hardness:
            return 1.0
        remainder = (1 - t) / (1 - hardness) if t < 1 else 0.0
        return 3 * remainder**2 - 2 * remainder**3

    expected = np.array([strength(x, y) for x, y in centres()]).reshape(SIZE[1], SIZE[0])
    covered = brush_coverage(path, radius, SIZE, hardness)
    np.testing.assert_allclose(covered, expected, atol=1e-5)
    means = np.random.default_rng(3).uniform((-3, -2, -9), (3, 2, -1), (500, 3)).astype(np.float32)
    placed = Projection.of(np.eye(4), PERSPECTIVE, SIZE).place(means)
    x, y = np.floor(placed.x).astype(int), np.floor(placed.y).astype(int)
    inside = (x >= 0) & (x < SIZE[0]) & (y >= 0) & (y < SIZE[1])
    result = hit_strength(covered, placed)
    np.testing.assert_array_equal(result[inside], covered[y[inside], x[inside]])
    assert not result[~inside].any() and 20 < np.count_nonzero(result) < 480


@pytest.mark.parametrize("radius", [2.5, 13.7])
def test_footprints_average_the_coverage(radius):
    """For strokes of any size: compare with the coverage weighted by the splat."""
    covered = brush_coverage([(30.2, 20.7), (60.1, 40.3)], radius, SIZE, 0.4)
    rng = np.random.default_rng(4)
    count = 400
    x, y = rng.uniform(0, SIZE[0], count), rng.uniform(0, SIZE[1], count)
    sigma = np.exp2(rng.uniform(-1, 4, count))
    pixel = rng.uniform(0.01, 0.1, count)
    placed = ProjectedSplats(*(item.astype(np.float32) for item in (x, y, np.ones(count), pixel)))
    result = hit_strength(covered, placed, sigma=(sigma * pixel).astype(np.float32))
    across, down = np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5
    expected = np.array([
        np.exp(-np.square(down - b) / 2 / s**2) @ covered @ np.exp(-np.square(across - a) / 2 / s**2)
        for a, b, s in zip(x, y, sigma, strict=True)
    ]) / (2 * np.pi * sigma**2)  # fmt: skip
    assert np.abs(result - expected).max() < 0.2 and np.sqrt(np.square(result - expected).mean()) < 0.03
    wide = sigma > 4
    assert result[wide].sum() == pytest.approx(expected[wide].sum(), rel=0.05) and expected[wide].max() > 0.05
    assert result[expected < 1e-4].max() < 0.01


def test_dab_between_coarse_splats_hits_them_partly():
    covered = brush_coverage([(48.0, 32.0)], 6.0, SIZE)
    x, y = (item.ravel().astype(np.float32) for item in np.meshgrid([28.0, 68.0], [12.0, 52.0]))
    placed = ProjectedSplats(x, y, np.ones(4, np.float32), np.ones(4, np.float32))
    assert not hit_strength(covered, placed).any(), "their means are outside the stroke"
    result = hit_strength(covered, placed, sigma=np.full(4, 16.0, np.float32))
    np.testing.assert_allclose(
        result, covered.sum() / (2 * np.pi * 16**2) * np.exp(-(20**2) / 16**2), rtol=0.3
    )


@pytest.mark.parametrize(
    "path",
    [
        [(10.2, 10.7), (70.1, 50.3), (72.4, 12.9)],
        [(5.3, 5.1), (60.7, 55.2), (60.1, 5.9), (5.8, 55.6)],  # crosses itself
        [(-40.3, -10.2), (150.8, 20.7), (30.4, 90.9)],  # outside the image
        [(3, 3), (90, 3), (90, 60), (3, 60), (3, 30), (50, 30), (50, 20), (3, 20)],
    ],
)
def test_lasso_covers_enclosed_pixels(path):
    expected = mask_of(lambda x, y: is_enclosed(x, y, path))
    np.testing.assert_array_equal(lasso_coverage(path, SIZE), expected)
    assert 0 < expected.sum() < expected.size


def test_lasso_without_area_covers_nothing():
    for path in ([], [(4, 4)], [(4, 4), (40, 50)]):
        assert not lasso_coverage(np.reshape(path, (-1, 2)), SIZE).any()


@pytest.mark.parametrize("clip", [PERSPECTIVE, FLAT])
def test_stroke_hits_projected_means(clip):
    rng = np.random.default_rng(0)
    means = rng.normal(0, 3, (3000, 3)).astype(np.float32)
    to_camera = np.eye(4)
    to_camera[:3, :3] = 1.7 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    to_camera[:3, 3] = (0.4, -0.2, -4)
    covered = brush_coverage([(20, 20), (70, 50)], 11, SIZE)
    expected, clear = np.zeros(len(means), bool), np.ones(len(means), bool)
    for i, mean in enumerate(means):
        x, y, z, w = clip @ to_camera @ (*mean, 1)
        clear[i] = abs(abs(z) - w) > 1e-4
        if w > 0 and abs(z) < w:
            u, v = (x / w + 1) / 2 * SIZE[0], (y / w + 1) / 2 * SIZE[1]
            clear[i] &= min(abs(u - round(u)), abs(v - round(v))) > 1e-4
            expected[i] = 0 <= u < SIZE[0] and 0 <= v < SIZE[1] and covered[int(v), int(u)]
    result = hit_strength(covered, Projection.of(to_camera, clip, SIZE).place(means))
    np.testing.assert_array_equal(result[clear], expected[clear])
    assert 20 < expected.sum() < 2000 and clear.mean() > 0.95


def test_pinhole_camera_projects_equally():
    pose = look_at(np.array([3.0, -4.0, 1.0]), np.zeros(3), (0.0, 0.0, 1.0))
    camera = Camera("", *SIZE, 80.0, 80.0, SIZE[0] / 2, SIZE[1] / 2, pose)
    means = np.random.default_rng(1).normal(0, 1, (500, 3)).astype(np.float32)
    clip = np.float64([[160 / SIZE[0], 0, 0, 0], [0, 160 / SIZE[1], 0, 0], [0, 0, -1, -0.02], [0, 0, -1, 0]])
    placed = Projection.of(np.diag([1.0, -1, -1, 1]) @ pose, clip, SIZE).place(means)
    pixels, depths = camera.project(means)
    np.testing.assert_allclose(placed.x, pixels[:, 0], atol=1e-3)
    np.testing.assert_allclose(SIZE[1] - placed.y, pixels[:, 1], atol=1e-3)
    np.testing.assert_allclose(placed.depth, depths, rtol=1e-5)
    np.testing.assert_allclose(placed.pixel, depths / 80, rtol=1e-5)


def wall(rng, count, depth, sigma, opacity=0.8, tilt=0.0):
    means = np.column_stack([rng.uniform(-6, 6, (count, 2)), np.full(count, -depth)]).astype(np.float32)
    means[:, 2] += tilt * means[:, 0]
    return means, np.full((count, 3), sigma, np.float32), np.full(count, opacity, np.float32)


@pytest.mark.parametrize("clip", [PERSPECTIVE, FLAT])
@pytest.mark.parametrize(
    ("sigma", "tilt"), [(0.03, 0), (0.15, 0), (0.6, 0), (0.03, 0.8), (0.15, 0.8), (0.6, 0.8), (0.03, 3)]
)
def test_first_wall_occludes_and_fog_does_not(clip, sigma, tilt):
    """Also for walls tilted by 40 and 70 degrees, and with thin fog in front, which is visible."""
    rng = np.random.default_rng(2)
    count = int(150 / sigma**2)
    parts = [
        wall(rng, 300, 8, 0.05, 0.02),
        wall(rng, count, 18, sigma, tilt=tilt),
        wall(rng, count, 30, sigma, tilt=tilt),
    ]
    size = (480, 320)
    projection = Projection.of(np.eye(4), clip, size)
    covered = brush_coverage([(200, 160), (280, 160)], 60, size) > 0
    placed = [projection.place(means) for means, _, _ in parts]
    front = OcclusionDepth(
        [(where, scales, opacities) for where, (_, scales, opacities) in zip(placed, parts, strict=True)]
    )
    shares = []
    for where, (_, scales, _) in zip(placed, parts, strict=True):
        under = hit_strength(covered, where)
        visible = hit_strength(covered, where, 2 * scales.max(axis=1), front)
        assert under.any() and not (visible & ~under).any()
        shares.append(visible.sum() / under.sum())
    assert shares[0] == 1 and shares[1] > 0.95 and shares[2] < 0.02, shares


def test_visibility_matches_transmittance():
    """Compare with the transmittance of each splat: the product over all other splats at its mean.

    Visibility is exact up to the width of a cell: here at most 16 pixels, half a radius of the balls.
    """
    rng = np.random.default_rng(3)
    size, focal = (320, 240), 160.0
    clip = np.float64([[1, 0, 0, 0], [0, 4 / 3, 0, 0], [0, 0, -1, -0.02], [0, 0, -1, 0]])
    ball = rng.normal(size=(3000, 3))
    ball *= 2 / np.linalg.norm(ball, axis=1)[:, None]
    means = np.concatenate([ball + np.array((0, 0, -8)), ball * 0.8 + (1.5, 0.5, -14)]).astype(np.float32)
    scales = np.exp(rng.normal(-2.3, 0.3, (len(means), 3))).astype(np.float32)
    scales[:] = scales[:, :1]
    opacities = rng.uniform(0.2, 0.9, len(means)).astype(np.float32)
    placed = Projection.of(np.eye(4), clip, size).place(means)
    front = OcclusionDepth([(placed, scales, opacities)])
    everywhere = np.ones(size[::-1], bool)
    visible = hit_strength(everywhere, placed, 2 * scales[:, 0], front)

    depth = -means[:, 2].astype(np.float64)
    u, v = focal * means[:, 0] / depth, focal * means[:, 1] / depth
    sigma, current, original = focal * scales[:, 0] / depth, np.ones(len(means)), np.ones(len(means))
    for i in range(len(means)):
        distance = ((u - u[i]) ** 2 + (v - v[i]) ** 2) / sigma**2
        passed = 1 - opacities * np.exp(-distance / 2)
        current[i] = np.prod(passed[depth < depth[i] - 2 * scales[i, 0]])
        original[i] = np.prod(passed[depth < depth[i] - 2 * scales[i, 0] - 1])
    inside = hit_strength(everywhere, placed)
    assert visible[inside & (current > 0.7)].mean() > 0.97
    assert visible[inside & (original < 0.05)].mean() < 0.05
    assert min((current[inside] > 0.7).sum(), (original[inside] < 0.05).sum()) > 400
