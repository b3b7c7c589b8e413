"""Cells: borders and views against hand-computed cases, observations against pycolmap."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from training.errors import LodgsError
from training.scenes.cameras import Camera, look_at
from training.scenes.colmap import Scene, read_scene
from training.scenes.observations import observed_points
from training.scenes.regions import CELL_MARGIN, MIN_IMAGE_SHARE, Region, plan_cells

from .synthetic import write_scene


def looking(name, position, target, width=64, height=48, focal=40.0):
    pose = look_at(np.array(position, float), np.array(target, float), np.array([0.0, 0, 1]))
    return Camera(name, width, height, focal, focal, width / 2, height / 2, pose)


def scene_of(cameras, points, tmp_path):
    points = np.array(points, np.float32)
    return Scene(tmp_path, tmp_path, tmp_path, cameras, points, np.zeros(points.shape, np.uint8))


@pytest.fixture
def grid(tmp_path):
    """4 by 2 downward views, 10 units apart, and scattered points from z = 0 to 1."""
    cameras = [
        looking(f"{x}{y}", (10 * x, 10 * y, 3), (10 * x, 10 * y + 0.1, 0)) for x in range(4) for y in range(2)
    ]
    rng = np.random.default_rng(0)
    return scene_of(cameras, rng.uniform((-50, -50, 0), (80, 60, 1), (5000, 3)), tmp_path)


def test_border_lies_midway_between_views_and_cells_do_not_overlap(grid):
    regions = plan_cells(grid, 2, 1)
    assert len(regions) == 2
    masks = np.array([region.contains(grid.points) for region in regions])
    assert (masks.sum(axis=0) == 1).all()
    left = masks[0] if masks[0, grid.points[:, 0].argmin()] else masks[1]
    np.testing.assert_array_equal(left, grid.points[:, 0] < 15)


def test_cells_have_equal_numbers_of_views(grid):
    regions = plan_cells(grid, 2, 2)
    positions = np.array([camera.center for camera in grid.cameras])
    inside = np.array([region.contains(positions) for region in regions])
    assert (inside.sum(axis=0) == 1).all() and (inside.sum(axis=1) == 2).all()
    for region in regions:
        assert np.isinf(region.cell).sum() == 2, "outer corners are unbounded"


def test_cell_is_enlarged_by_a_fifth_of_its_side(grid):
    left = min(plan_cells(grid, 2, 1), key=lambda region: positions_in(region, grid)[:, 0].max())
    enlarged = left.in_enlarged_cell(grid.points)
    np.testing.assert_array_equal(enlarged, grid.points[:, 0] < 15 + CELL_MARGIN * 15)


def test_border_zone_is_a_fifth_of_the_cell_wide(grid):
    """The left cell ends at 15 and is 15 wide, so border zones are 3 wide on both sides."""
    left, right = sorted(plan_cells(grid, 2, 1), key=lambda region: positions_in(region, grid)[:, 0].max())
    x = grid.points[:, 0]
    np.testing.assert_array_equal(left.near_border(grid.points), (x >= 12) & (x < 15))
    np.testing.assert_array_equal(right.near_border(grid.points), (x >= 15) & (x < 18))
    (region,) = plan_cells(grid, 1, 1)
    assert not region.near_border(grid.points).any() and not region.as_seam(grid).views


def test_seam_has_views_on_both_sides_of_the_border(tmp_path):
    cameras = [looking(f"{x:02}", (x, y, 3), (x, y + 0.1, 0)) for x in range(0, 20, 2) for y in (0,)]
    points = np.random.default_rng(0).uniform((-9, -9, 0), (30, 9, 1), (500, 3))
    scene = scene_of(cameras, points, tmp_path)
    left = min(plan_cells(scene, 2, 1), key=lambda region: positions_in(region, scene)[:, 0].max())
    seam = left.as_seam(scene)  # border at 9, cell width 9: the zone is 1.8 on each side
    assert seam.views == ("08", "10") and seam.seam and not left.seam
    np.testing.assert_array_equal(seam.cell, left.cell)
    seam.write(tmp_path / "region.json")
    assert Region.read(tmp_path / "region.json").seam


def test_only_adjacent_cells_overlap(tmp_path):
    cameras = [looking(f"{x:02}", (x, x % 3, 3), (x, 0.1, 0)) for x in range(0, 40, 2)]
    points = np.random.default_rng(0).uniform((-9, -9, 0), (50, 9, 1), (500, 3))
    regions = plan_cells(scene_of(cameras, points, tmp_path), 4, 1)
    for i, first in enumerate(regions):
        for j, second in enumerate(regions):
            assert first.overlaps(second) == (abs(i - j) <= 1)


def positions_in(region, scene):
    positions = np.array([camera.center for camera in scene.cameras])
    return positions[region.contains(positions)]


@pytest.mark.parametrize("focal, belongs", [(40.0, False), (4000.0, True)])
def test_view_belongs_to_cells_that_cover_a_quarter_of_its_image(tmp_path, focal, belongs):
    """The other cell begins 15.4 ahead, 8.4 wide and 2 high: 1/27 of the image with the short lens."""
    points = [(x, y, z) for x in np.linspace(-9, 60, 30) for y in (-2.0, 9.0) for z in (0.0, 2.0)]
    cameras = [looking(f"{x}-{y}", (x, y, 1), (x, y + 0.1, 0)) for x in (0, 3, 6, 40, 43, 46) for y in (0, 6)]
    far = looking("far", (3, 3, 1), (43, 3, 1), focal=focal)
    scene = scene_of([*cameras, far], points, tmp_path)
    right = max(plan_cells(scene, 2, 1), key=lambda region: positions_in(region, scene)[:, 0].mean())
    assert ("far" in right.views) == belongs
    assert {f"{x}-{y}" for x in (40, 43, 46) for y in (0, 6)} <= set(right.views)
    assert "0-0" not in right.views


def test_share_of_image_computed_by_hand():
    from training.scenes.regions import _share_of_image

    view = looking("a", (0, 0, 0), (1, 0, 0), width=64, height=48, focal=32.0)
    # At distance 10, the image is 20 wide and 15 high.
    half = np.array([[10, 11], [0, 1000], [-1000, 1000.0]])
    assert _share_of_image(view, np.eye(3), half) == pytest.approx(0.5)
    part = np.array([[10, 10.001], [-5, 5], [-3.75, 3.75]])
    assert _share_of_image(view, np.eye(3), part) == pytest.approx(0.25, abs=0.01)
    assert _share_of_image(view, np.eye(3), part * [[-1], [1], [1]]) == 0, "behind"
    assert _share_of_image(view, np.eye(3), np.array([[-1, 1]] * 3)) == 1, "from inside"
    assert 0 < MIN_IMAGE_SHARE < 1


@pytest.mark.parametrize("text", [False, True])
def test_observed_points_match_pycolmap(tmp_path, text):
    model = write_scene(tmp_path, names=("a.png", "b b.png", "c.png"))
    if text:
        folder = tmp_path / "sparse" / "0"
        for path in folder.iterdir():
            path.unlink()
        model.write_text(str(folder))
    scene = read_scene(tmp_path)
    for names in (("b b.png",), ("a.png", "c.png"), ("none",)):
        ids = {image.image_id for image in model.images.values() if image.name in names}
        observed = {
            number
            for number, point in model.points3D.items()
            if any(element.image_id in ids for element in point.track.elements)
        }
        if observed:
            np.testing.assert_array_equal(
                observed_points(scene, names), np.isin(scene.point_ids, sorted(observed))
            )
            assert 0 < len(observed) < len(scene.points)
        else:
            assert not observed_points(scene, names).any()
    assert pycolmap.__version__


def test_points_of_a_region_keep_their_observations(tmp_path):
    """The views of a region observe the same positions as in the full scene."""
    write_scene(tmp_path)
    full = read_scene(tmp_path)
    region = Region(np.eye(3), np.zeros((2, 2)), np.zeros((2, 2)), ("b.png", "c.png"))
    scene = region.select_points(region.select_views(full), full)
    assert 0 < len(scene.points) < len(full.points)
    for name in region.views:
        observed, expected = (s.points[observed_points(s, [name])].tolist() for s in (scene, full))
        assert observed == expected and observed


def test_points_in_the_image_count_as_observed_without_tracks(grid):
    observed = observed_points(grid, ["00"])
    np.testing.assert_array_equal(observed, grid.cameras[0].sees(grid.points))
    assert 0 < observed.sum() < len(observed)


def test_region_is_stored_bit_by_bit(grid, tmp_path):
    for region in plan_cells(grid, 2, 2):
        region.write(tmp_path / "region.json")
        stored = Region.read(tmp_path / "region.json")
        for name in ("ground", "cell", "area"):
            np.testing.assert_array_equal(getattr(stored, name), getattr(region, name))
        assert stored.views == region.views


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", '{"ground": 1, "cell": 2, "area": 3, "views": ["a"]}',
        '{"ground": [[1,0,0],[0,1,0],[0,0,2]], "cell": [[0,1],[0,1]], "area": [[0,1],[0,1]], "views": ["a"]}',
        '{"ground": [[1,0,0],[0,1,0],[0,0,1]], "cell": [[1,1],[0,1]], "area": [[0,1],[0,1]], "views": ["a"]}',
        '{"ground": [[1,0,0],[0,1,0],[0,0,1]], "cell": [[0,1],[0,1]], "area": [[0,1],[0,1]], "views": []}',
        '{"ground": [[1,0,0],[0,1,0],[0,0,1]], "cell": [[0,1],[0,1]], "area": [[0,1],[0,""]], "views": [""]}',
        '{"ground": [[1,0,0],[0,1,0],[0,0,1]], "cell": [[0,1],[0,1]], "area": [[0,1],[0,1]], "views": [1]}',
    ],
)  # fmt: skip
def test_invalid_region_file_is_rejected(tmp_path, text):
    (tmp_path / "region.json").write_text(text)
    with pytest.raises(LodgsError):
        Region.read(tmp_path / "region.json")


def test_too_few_views_are_rejected(grid):
    with pytest.raises(LodgsError, match="8 views"):
        plan_cells(grid, 5, 1)
    same = replace(grid, cameras=[replace(grid.cameras[0], name=str(i)) for i in range(8)])
    with pytest.raises(LodgsError, match="one position"):
        plan_cells(same, 3, 1)
