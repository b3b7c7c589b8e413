"""Similarity transforms of splats: rendered images, covariances, colours and positions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.training.conftest import look_at
from training.errors import LodgsError
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera
from training.splats.gaussians import Splats
from training.splats.sh import basis, coefficient_count
from training.splats.similarity import Similarity, TransformedRows


def random_splats(count: int, degree: int, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(-2.5, 0.6, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(0.5, 2, count).astype(np.float32),
        sh=rng.normal(0, 0.4, (count, coefficient_count(degree), 3)).astype(np.float32),
    )


def matrix_of(seed: int, scale: float = 1.0, extent: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = rng.uniform(-extent, extent, 3)
    return matrix


def covariances(splats: Splats) -> np.ndarray:
    turns = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].astype(float)).as_matrix()
    half = turns * np.exp(splats.log_scales.astype(float))[:, None, :]
    return half @ half.transpose(0, 2, 1)


def render(splats: Splats, camera: Camera, near: float) -> np.ndarray:
    return rasterize(Gaussians.of(splats), camera, backend="reference", near=near).image.numpy()


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize("scale", [0.37, 12.5])
def test_transformed_scene_matches_transformed_camera(degree, scale):
    """At least 50 dB; unrotated harmonics stay below 30."""
    splats, placement = random_splats(300, degree), Similarity.from_matrix(matrix_of(degree, scale))
    camera = Camera("", 96, 72, 90.0, 80.0, 50.0, 33.0, look_at((2.5, 0.4, 1.5)))
    moved_camera, unit = camera.in_object_space(np.linalg.inv(placement.matrix))
    assert unit == pytest.approx(1 / scale)
    expected = render(splats, camera, 0.01)
    image = render(placement.transform_splats(splats), moved_camera, 0.01 * scale)
    assert expected.std() > 0.1
    assert -10 * np.log10(np.square(image - expected).mean()) > 50
    unrotated = replace(placement.transform_splats(splats), sh=splats.sh)
    image = render(unrotated, moved_camera, 0.01 * scale)
    assert -10 * np.log10(np.square(image - expected).mean()) < 30


@pytest.mark.parametrize("seed", range(5))
def test_colours_covariances_and_positions_are_transformed(seed):
    splats, matrix = random_splats(50, 4, seed), matrix_of(seed, 2.5)
    placed, linear = Similarity.from_matrix(matrix).transform_splats(splats), matrix[:3, :3]
    np.testing.assert_allclose(placed.means, splats.means @ linear.T + matrix[:3, 3], atol=1e-6)
    np.testing.assert_allclose(
        covariances(placed), linear @ covariances(splats) @ linear.T, rtol=1e-4, atol=1e-6
    )
    np.testing.assert_allclose(
        np.linalg.norm(placed.quats, axis=1), np.linalg.norm(splats.quats, axis=1), rtol=1e-6
    )
    directions = np.random.default_rng(seed).normal(size=(3, 50))
    directions /= np.linalg.norm(directions, axis=0)
    original, rotated = np.empty((2, 25, 50))
    basis(*directions, 4, original)
    basis(*(linear / 2.5 @ directions), 4, rotated)
    np.testing.assert_allclose(
        np.einsum("kn,nkc->nc", rotated, placed.sh), np.einsum("kn,nkc->nc", original, splats.sh), atol=1e-5
    )


def test_identity_changes_nothing():
    splats = random_splats(20, 3)
    placed = Similarity.from_matrix(np.eye(4)).transform_splats(splats)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(placed, name), getattr(splats, name))


def test_inverse_restores_the_splats():
    splats, matrix = random_splats(50, 3), matrix_of(4, 0.2)
    restored = Similarity.from_matrix(np.linalg.inv(matrix)).transform_splats(
        Similarity.from_matrix(matrix).transform_splats(splats)
    )
    for name in ("means", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(restored, name), getattr(splats, name), atol=2e-5)
    sign = np.sign((restored.quats * splats.quats).sum(axis=1, keepdims=True))  # q and -q are one rotation
    np.testing.assert_allclose(sign * restored.quats, splats.quats, atol=2e-5)


def test_extra_lengths_and_positions_are_transformed():
    splats = random_splats(3, 0)
    columns = {name: np.float32([1, 2, 3]) for name in ("size", "weight", "px", "py", "pz")}
    splats.extras = columns | {"nx": np.float32([1, 0, 0]), "ny": np.float32([0, 1, 0])}
    splats.extras |= {"nz": np.float32([0, 0, 1]), "far": np.float32([3e38, 0, 1])}
    quarter = np.array([[0, -2, 0, 10], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]])
    placed = Similarity.from_matrix(quarter).transform_splats(splats, ("size",), (("px", "py", "pz"),)).extras
    assert placed["size"].tolist() == [2, 4, 6] and placed["weight"].tolist() == [1, 2, 3]
    assert [placed[name].tolist() for name in ("px", "py", "pz")] == [[8, 6, 4], [2, 4, 6], [2, 4, 6]]
    normals = np.stack([placed[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(normals, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-7)
    assert splats.extras["size"].tolist() == [1, 2, 3]


@pytest.mark.parametrize("seed", range(20))
def test_quaternion_of_a_rotation(seed):
    turn = Rotation.random(random_state=seed)
    if seed < 3:  # half turns, about each axis, have no w
        turn = Rotation.from_rotvec(np.pi * np.eye(3)[seed])
    matrix = np.eye(4)
    matrix[:3, :3] = turn.as_matrix()
    quat, expected = Similarity.from_matrix(matrix).quat, turn.as_quat()[[3, 0, 1, 2]]
    assert abs(quat @ expected) == pytest.approx(1, abs=1e-12)


def test_angles_match_scipy_about_fixed_axes():
    placement = Similarity.from_angles((20, -50, 130), 2.5, (1, 2, 3))
    expected = Rotation.from_euler("xyz", (20, -50, 130), degrees=True).as_matrix()
    np.testing.assert_allclose(placement.matrix[:3, :3], 2.5 * expected, atol=1e-12)
    assert placement.matrix[:3, 3].tolist() == [1, 2, 3]
    with pytest.raises(LodgsError, match="Cannot scale splats by 0"):
        Similarity.from_angles(scale=0.0)
    first, points = Similarity.from_matrix(matrix_of(1, 3.0)), np.eye(3)
    np.testing.assert_allclose(
        placement.compose(first).transform_points(points),
        placement.transform_points(first.transform_points(points)),
        atol=1e-12,
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "linear",
    [
        np.diag([1.0, 1.0, 1.01]),
        np.diag([1.0, 1.0, -1.0]),
        np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
        np.zeros((3, 3)),
        np.diag([np.nan, 1, 1]),
        np.diag([1e300, 1e300, 1e300]),
    ],
)
def test_other_transforms_are_refused(linear):
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    with pytest.raises(LodgsError, match=r"stretches|not an affine transform"):
        Similarity.from_matrix(matrix)


def test_rows_are_transformed_when_read():
    splats, placement = random_splats(30, 1), Similarity.from_matrix(matrix_of(1, 3.0))
    rows = TransformedRows(splats, placement.transform_splats, {"mine": np.arange(30, dtype=np.float32)})
    part, expected = rows.select(slice(10, 20)), placement.transform_splats(splats)
    assert len(rows) == 30 and torch.equal(
        torch.from_numpy(part.means), torch.from_numpy(expected.means[10:20])
    )
    np.testing.assert_array_equal(part.extras["mine"], np.arange(10, 20))
