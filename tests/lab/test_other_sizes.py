"""Quality at other image sizes by `lab/other_sizes.py`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from lab.other_sizes import psnr_by_size
from training.rasterize import Gaussians, rasterize
from training.runs.job import Job
from training.runs.train import train
from training.scenes.colmap import read_scene
from training.splats.bundle import read_bundle


def test_splats_trained_at_half_size_are_compared_with_full_photos(tiny_scene, tmp_path):
    parameters = {"steps": 3, "first_resolution": 1.0}
    job = Job(
        str(tiny_scene), str(tmp_path / "run"), "3dgs", backend="reference", image_scale=0.5, test_every=4,
        parameters=parameters,
    )  # fmt: skip
    assert train(job) == 0
    results = list(psnr_by_size(tmp_path / "run"))
    assert [size for size, _, _ in results] == [1] * 3 + [2] * 3  # four times exceeds the photos
    quality = {size: levels for size, renderer, levels in results if not renderer}
    (level,) = read_bundle(tmp_path / "run" / "bundle.ply").levels
    scene, errors = read_scene(tiny_scene), []
    for camera in scene.split(4)[1]:
        image = rasterize(Gaussians.of(level.splats), camera, near=scene.near(), antialias=True,
                          backend="reference").image  # fmt: skip
        photo = np.asarray(Image.open(camera.image), np.float32) / 255
        rendering = (255 * image.clamp(0, 1)).round() / 255
        errors.append(torch.mean((rendering - torch.from_numpy(photo)) ** 2).item())
    assert quality[2][level.number] == pytest.approx(np.mean(-10 * np.log10(errors)), abs=0.01)
    assert abs(quality[1][level.number] - quality[2][level.number]) > 0.05
