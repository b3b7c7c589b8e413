"""Tests of the depth loss in all methods, and of start points from depth."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.training.scenes.depth_walls import (
    FITTED,
    METRIC,
    depth_of,
    make_view,
    write_depth_scene,
    write_walls,
)
from training.methods import METHODS, create
from training.optimize.training_data import TrainingData
from training.rasterize import Gaussians, rasterize
from training.runs.job import Job
from training.runs.train import train
from training.scenes.colmap import read_scene
from training.scenes.depths import DepthPriors
from training.scenes.images import write_png
from training.splats.bundle import read_bundle


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return write_walls(tmp_path_factory.mktemp("walls"))


@pytest.fixture(scope="module")
def scene(walls, tmp_path_factory):
    return read_scene(write_depth_scene(walls, tmp_path_factory.mktemp("metric"), METRIC["multilayer"]))


@pytest.fixture(scope="module")
def data(scene):
    return TrainingData(scene, image_scale=0.25, test_every=3, depths=DepthPriors(scene, "metric"))


def create_method(name: str, data: TrainingData, weight: float):
    parameters = replace(METHODS[name].preset("draft"), depth_weight=weight, dropout=0.0)
    return create(name, data, parameters, 0, "cpu")


@pytest.mark.parametrize("name", METHODS)
def test_every_method_uses_depth_loss(name, data):
    without_loss, half_weight, full_weight = (
        create_method(name, data, weight).train_step(0).loss() for weight in (0.0, 0.5, 1.0)
    )
    assert full_weight - without_loss > 0.01
    assert half_weight - without_loss == pytest.approx((full_weight - without_loss) / 2, rel=1e-3)


def test_depth_loss_matches_reference(data):
    """Computed in float64 from another backend's image."""
    method = create_method("3dgs", data, 0.7)
    view = method.choose_view(0)
    drawings = method.draw(view, 0)
    actual = float(method.depth_loss(drawings[0].rendering, view.target, 0.0).detach())
    gaussians = Gaussians(*(tensor.detach().double() for tensor in vars(method.model.gaussians).values()))
    drawn = rasterize(
        gaussians,
        view.camera,
        near=data.near,
        antialias=True,
        outputs=("inverse_depth",),
        backend="reference",
    ).inverse_depth
    camera = data.scene.cameras[[item.name for item in data.scene.cameras].index(view.camera.name)]
    small = (1 / depth_of(camera.scaled(0.25 / view.shrink))).astype(np.float64)
    assert drawn is not None and drawn.shape == small.shape
    expected = 0.7 * data.median_depth * np.abs(drawn.numpy() - small).mean()
    assert actual == pytest.approx(expected, rel=0.02)  # reduced depth is inexact at corners
    later = float(method.depth_loss(drawings[0].rendering, view.target, 1.0).detach())
    assert later == pytest.approx(actual / 100, rel=1e-3)


def test_masked_and_held_out_depths_are_ignored(scene, data, tmp_path):
    camera = data.test[0]
    assert data.images.target(camera).inverse_depth is None
    assert data.target(0).inverse_depth is not None
    shutil.copytree(scene.folder, tmp_path / "scene")
    (tmp_path / "scene" / "masks").mkdir()
    mask = np.full((240, 320, 3), 255, np.uint8)
    mask[:, :160] = 0
    for number in range(6):
        write_png(tmp_path / "scene" / "masks" / f"{number}.png", mask)
    masked = read_scene(tmp_path / "scene")
    valid = TrainingData(masked, 0.25, 3, depths=DepthPriors(masked, "metric")).target(0).inverse_depth
    assert valid is not None
    assert valid[:, :40].isnan().all() and valid[:, 40:].isfinite().all()


def copy_without_points(scene: Path) -> None:
    """Replace the model by a copy without points."""
    model = scene / "sparse" / "0"
    original = model.resolve()
    (scene / "sparse").unlink()
    shutil.copytree(original, model)
    (model / "points3D.bin").write_bytes(bytes(8))


def depth_error(run: Path) -> float:
    """Return the median relative depth error of held-out views at drawn pixels."""
    splats, errors = read_bundle(run / "bundle.ply").levels[-1].splats, []
    for number in (0, 3):
        camera = make_view(number).scaled(0.25)
        drawn = rasterize(Gaussians.of(splats), camera, near=0.03, outputs=("depth",), backend="cpu")
        assert drawn.depth is not None
        truth = depth_of(camera)
        errors.append(np.abs(drawn.depth.numpy() / truth - 1)[drawn.alpha.numpy() > 0.5])
    return float(np.median(np.concatenate(errors)))


@pytest.mark.nightly
def test_depth_loss_improves_depth_and_replaces_points(walls, tmp_path, capsys):
    """Train on a floor of random squares, from depth maps of unknown scale, and from maps without points.

    Dropout is off, because 150 steps with four views are too few to compensate for it. No splats start
    between the scene's points, because on planes they have the right depth without the loss.
    """
    actual = {}
    for name, kind, weight in (("off", "inverse", 0.0), ("on", "inverse", 0.3), ("bare", "metric", 0.3)):
        folder = tmp_path / name
        folder.mkdir()
        write_depth_scene(walls, folder, FITTED["inverse"] if kind == "inverse" else METRIC["one layer"])
        if name == "bare":
            copy_without_points(folder)
        keys = {
            "scene": str(folder), "out": str(tmp_path / f"{name}_run"), "method": "3dgs", "backend": "cpu",
            "test_every": 3, "image_scale": 0.25,
            "parameters": {
                "steps": 150, "max_splats": 3000, "depth": kind, "depth_weight": weight, "dropout": 0.0,
                "points_between": 0.0,
            },
        }  # fmt: skip
        assert train(Job.from_dict(keys), sys.stdout) == 0
        actual[name] = depth_error(tmp_path / f"{name}_run")
    assert actual["on"] < 0.7 * actual["off"] and actual["bare"] < 0.7 * actual["off"]
