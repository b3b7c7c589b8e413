"""Scenes that the rasterizer's tests share."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from training.rasterize import BACKENDS, Gaussians
from training.scenes.cameras import Camera


def random_splats(count: int, seed: int = 0, coefficients: int = 16) -> Gaussians:
    """Splats in front of ``odd_camera``, of many sizes and opacities, float64."""
    random = np.random.default_rng(seed)
    means = random.uniform((-1, -1, 2), (1, 1, 4), (count, 3))
    arrays = {
        "means": means,
        "quats": random.normal(size=(count, 4)),
        "log_scales": random.normal(-2.5, 0.8, (count, 3)),
        "opacity_logits": random.normal(0, 2, count),
        "sh": random.normal(0, 0.4, (count, coefficients, 3)),
    }
    return Gaussians(**{name: torch.from_numpy(array).float().double() for name, array in arrays.items()})


@pytest.fixture
def make_splats():
    return random_splats


def working(request) -> str:
    """The backend of a fixture's parameter; the test is skipped where it cannot work."""
    needed = {"cuda": "fake_card", "gpu": "graphics"}
    if request.param in needed:
        request.getfixturevalue(needed[request.param])
    return request.param


@pytest.fixture(params=BACKENDS)
def backend(request) -> str:
    """Every backend by name; cuda on the CPU, as ``fake_card`` has it."""
    return working(request)


@pytest.fixture(params=["cpu", "gpu"])
def kernels(request) -> str:
    """The backends with kernels of our own: what the reference is in float64, they are in float32."""
    return working(request)


@pytest.fixture
def odd_camera() -> Camera:
    """Turned, moved, off-centre, fx unlike fy, and of a size that no tile divides."""
    angle = 0.2
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = -0.5, 0.1, 0.2
    return Camera("odd", 75, 50, 60.0, 66.0, 33.0, 27.5, pose)


@pytest.fixture
def axis_camera() -> Camera:
    """At the origin, looking along z; the axis meets the image where four tiles do."""
    return Camera("axis", 32, 32, 40.0, 40.0, 16.0, 16.0, np.eye(4))
