"""Tests of training an object before a transparent background: same transparency, no halo."""

import sys

import numpy as np
import pytest
import torch

from training.lod.selection import complete_splats
from training.optimize.training_data import TrainingData
from training.rasterize import Gaussians, Target, rasterize
from training.runs.job import Job
from training.runs.train import train
from training.scenes.cameras import Camera, look_at
from training.scenes.colmap import read_scene
from training.scenes.images import load_image, write_png
from training.scenes.write_colmap import write_colmap
from training.splats.bundle import read_bundle

SIDE = 64


def ring() -> list[Camera]:
    """Return sixteen cameras around the object, at two heights."""
    cameras = []
    for number in range(16):
        angle = 2 * np.pi * number / 16
        position = np.array([3 * np.cos(angle), 3 * np.sin(angle), 0.8 if number % 2 else -0.4])
        pose = look_at(position, np.zeros(3), (0, 0, 1))
        cameras.append(Camera(f"{number:02d}.png", SIDE, SIDE, 90.0, 90.0, SIDE / 2, SIDE / 2, pose))
    return cameras


def ball(random: np.random.Generator) -> Gaussians:
    """Return bright splats on a sphere of radius 0.5."""
    means = random.normal(size=(500, 3))
    means *= 0.5 / np.linalg.norm(means, axis=1, keepdims=True)
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(500, 1),
        log_scales=torch.full((500, 3), float(np.log(0.05))),
        opacity_logits=torch.full((500,), 4.0),
        sh=torch.tensor(random.uniform(0.5, 1.5, (500, 1, 3)), dtype=torch.float32),
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Write photos with straight alpha, as a renderer does."""
    folder, truth = tmp_path_factory.mktemp("ball"), ball(np.random.default_rng(0))
    for camera in ring():
        drawn = rasterize(truth, camera, near=0.1, backend="cpu")
        alpha = drawn.alpha[..., None].numpy()
        straight = np.where(alpha > 0, drawn.image.numpy() / np.maximum(alpha, 1e-6), 0.9)  # light background
        codes = np.rint(255 * np.concatenate([straight, alpha], axis=2).clip(0, 1)).astype(np.uint8)
        (folder / "images").mkdir(exist_ok=True)
        write_png(folder / "images" / camera.name, codes)
    points = truth.means.numpy()[::4]
    visible = np.ones((16, len(points)), bool)
    write_colmap(folder, ring(), points, visible, np.full((len(points), 3), 200))
    return folder


def test_photos_are_composited_over_black(scene):
    data = TrainingData(read_scene(scene), test_every=8)
    assert data.transparent
    target, truth = data.target(0), ball(np.random.default_rng(0))
    drawn = rasterize(truth, data.train[0], near=0.1, backend="cpu")
    assert target.alpha is not None
    np.testing.assert_allclose(target.alpha, drawn.alpha, atol=1 / 255)
    np.testing.assert_allclose(target.image, drawn.image, atol=2 / 255)
    red = target.over((1.0, 0.0, 0.0))
    np.testing.assert_allclose(red.image[..., 0], drawn.image[..., 0] + 1 - drawn.alpha, atol=3 / 255)
    np.testing.assert_allclose(red.image[..., 1], drawn.image[..., 1], atol=2 / 255)
    opaque = Target(np.zeros((2, 2, 3), np.float32))
    assert opaque.over((1.0, 0.0, 0.0)) is opaque


@pytest.mark.parametrize("method", ["3dgs", pytest.param("octree", marks=pytest.mark.nightly)])
@pytest.mark.slow
def test_trained_object_is_as_transparent(scene, tmp_path, method, capsys):
    parameters = {"steps": 400, "max_splats": 1500}
    parameters |= {"levels_from": "anchors"} if method == "octree" else {}
    keys = {
        "scene": str(scene), "out": str(tmp_path / "run"), "method": method, "backend": "cpu",
        "test_every": 8, "parameters": parameters,
    }  # fmt: skip
    assert train(Job.from_dict(keys), sys.stdout) == 0
    bundle = read_bundle(tmp_path / "run" / "bundle.ply")
    splats = complete_splats(bundle, bundle.levels[-1])
    for camera in (ring()[0], ring()[8]):  # held out
        drawn = rasterize(Gaussians.of(splats), camera, near=0.03, backend="cpu")
        pixels = load_image(scene / "images" / camera.name, SIDE, SIDE, alpha=True)
        outside = pixels[..., 3] == 0
        assert drawn.alpha.numpy()[outside].mean() < 0.02, "no halo"
        assert drawn.alpha.numpy()[pixels[..., 3] > 0.99].mean() > 0.9
        assert np.abs(drawn.image.numpy() - pixels[..., :3]).mean() < 0.05
