"""Projection of points, computed by hand and by pycolmap."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from training.scenes.cameras import Camera, look_at
from training.scenes.lenses import Intrinsics, make_intrinsics

POSE = np.array([[0.0, 1, 0, -2], [-1, 0, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]])
"""A quarter turn about z and a translation: world point (x, y, z) is (y - 2, 3 - x, z + 4) in camera axes."""


def test_projection_computed_by_hand():
    camera = Camera("a", 100, 80, 50.0, 60.0, 40.5, 30.0, POSE)
    points = np.array([[3, 2, 0], [2, 4, 1], [3, 2, -8], [0, 2, 0]], np.float32)
    uv, depth = camera.project(points)
    assert depth.tolist() == [4, 5, -4, 4] and uv.dtype == np.float64
    assert uv[[0, 1, 3]].tolist() == [[40.5, 30], [40.5 + 50 * 2 / 5, 30 + 60 * 1 / 5], [40.5, 75]]
    assert camera.view_space(points)[1].tolist() == [2, 1, 5]
    assert camera.sees(points).tolist() == [True, True, False, True]
    assert camera.sees(points, near=4).tolist() == [False, True, False, False]
    assert camera.focal == 50 and Camera("b", 1, 1, 7.0, 6.0, 0, 0, POSE).focal == 6


def test_image_includes_left_and_upper_edges_only():
    """A margin extends all four edges."""
    camera = Camera("a", 8, 4, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    uv = np.array([[0, 0], [8, 0], [0, 4], [7.75, 3.75], [-0.25, 0], [0, -0.25], [-2, -1], [9.75, 4.75]])
    points = np.column_stack([uv, np.ones(len(uv))])
    assert camera.sees(points).tolist() == [True, False, False, True, False, False, False, False]
    assert camera.sees(points, margin=0.25).all()
    assert not camera.sees(points * [1, 1, 0]).any(), "points at depth 0 are invisible"
    assert camera.sees(np.zeros((0, 3))).shape == (0,)


def test_projection_matches_pycolmap():
    """Pixel centres lie at +0.5, and y points down."""
    random = np.random.default_rng(3)
    intrinsics = 61.5, 58.25, 47.25, 33.0
    lens = pycolmap.Camera(model="PINHOLE", width=96, height=72, params=intrinsics)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (0.4, -1.1, 0.2)).as_matrix()
    pose[:3, 3] = 0.5, -1, 6
    camera = Camera("a", 96, 72, *intrinsics, pose)
    points = random.uniform(-2, 2, (200, 3))
    uv, depth = camera.project(points)
    local = np.array([pycolmap.Rigid3d(pose[:3]) * point for point in points])
    np.testing.assert_allclose(depth, local[:, 2], rtol=1e-12)
    assert (depth > 0).all()
    np.testing.assert_allclose(uv, [lens.img_from_cam(point) for point in local], rtol=1e-10, atol=1e-9)
    visible = camera.sees(points)
    assert 0 < visible.sum() < len(visible)
    assert np.array_equal(visible, ((uv >= 0) & (uv < (96, 72))).all(1))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (3, 2, 1)])
def test_look_at_centres_target_with_up_above(up):
    """(3, 2, 1) is the view direction itself, for which any roll is valid."""
    position, target = np.array([1.0, -2.0, 0.5]), np.array([4.0, 0.0, 1.5])
    pose = look_at(position, target, up)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose) == pytest.approx(1)
    np.testing.assert_allclose(pose @ [*position, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pose @ [*target, 1], [0, 0, np.sqrt(14), 1], atol=1e-12)
    x, y, _ = pose[:3, :3] @ up
    assert abs(x) < 1e-12 and (y < -0.5 or up == (3, 2, 1))  # y points down


LENSES = {
    "SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": (0.05,), "RADIAL": (0.05, -0.02),
    "OPENCV": (0.05, -0.02, 0.004, -0.003),
    "FULL_OPENCV": (0.05, -0.02, 0.004, -0.003, 0.01, 0.02, 0.0, 0.01),
    "OPENCV_FISHEYE": (0.05, -0.02, 0.004, -0.003), "SIMPLE_RADIAL_FISHEYE": (0.05,),
    "RADIAL_FISHEYE": (0.05, -0.02), "SIMPLE_FISHEYE": (), "SIMPLE_DIVISION": (-0.05,),
    "THIN_PRISM_FISHEYE": (0.05, -0.02, 0.004, -0.003, 0.01, 0.02, 0.005, -0.006),
}  # fmt: skip
ONE_FOCAL = {name for name in LENSES if name.startswith(("SIMPLE", "RADIAL"))}


def project_with_colmap(lens: Intrinsics, rays: np.ndarray) -> np.ndarray:
    camera = pycolmap.Camera(
        model=lens.lens.name, width=lens.width, height=lens.height, params=lens.parameters.tolist()
    )
    return np.array([camera.img_from_cam(ray) for ray in rays])


@pytest.mark.parametrize("name", LENSES)
def test_lenses_fit_resized_and_turned_photos(name):
    """Pixels of COLMAP, moved by hand to the changed photo. An upright photo has 72 x 96 pixels."""
    focal = (80.0,) if name in ONE_FOCAL else (80.0, 84.0)
    lens = make_intrinsics(name, 72, 96, np.array([*focal, 35.0, 50.0, *LENSES[name]]))
    rays = np.array([(0.1, 0.2, 1.0), (-0.3, 0.25, 1.0), (0.2, -0.4, 1.0)])
    pixels = project_with_colmap(lens, rays)
    np.testing.assert_allclose(
        project_with_colmap(lens.resized(144, 200), rays), pixels * (2, 200 / 96), atol=1e-9
    )
    x, y = pixels.T
    view = Camera("", 72, 96, *lens.pinhole, np.eye(4))
    for turns, columns in ((1, (y, 72 - x)), (2, (72 - x, 96 - y)), (3, (96 - y, x))):
        stored = np.stack(columns, axis=1)
        turned_rays = rays @ view.turned(turns).world_to_camera[:3, :3].T
        np.testing.assert_allclose(project_with_colmap(lens.turned(turns), turned_rays), stored, atol=1e-9)


def test_scaled_sides_do_not_lose_a_pixel_to_rounding():
    """0.29 * 100 is 28.999999999999996, and 960 / 1100 * 1100 is 959.9999999999999."""
    camera = Camera("view", 100, 75, 90.0, 90.0, 50.0, 37.5, np.eye(4))
    assert [(view.width, view.height) for view in (camera.scaled(0.29), camera.scaled(0.5))] == [
        (29, 21),
        (50, 37),
    ]
    widths = range(64, 9000)
    assert all(camera.resized(width, 64).scaled(960 / width).width == 960 for width in widths)
