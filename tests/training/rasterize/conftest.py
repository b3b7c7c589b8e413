"""Fixtures of the rasterizer's tests."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from training.rasterize import BACKENDS, Gaussians
from training.scenes.cameras import Camera


def random_splats(count: int, seed: int = 0, coefficients: int = 16) -> Gaussians:
    """Create float64 splats of many sizes and opacities in front of ``odd_camera``."""
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


def usable_backend(request) -> str:
    """Return the backend of a fixture's parameter; skip the test if it cannot run."""
    fixtures = {"cuda": "fake_card", "gpu": "graphics"}
    if request.param in fixtures:
        request.getfixturevalue(fixtures[request.param])
    return request.param


@pytest.fixture(params=BACKENDS)
def backend(request) -> str:
    """Every backend by name; cuda runs on the CPU through ``fake_card``."""
    return usable_backend(request)


@pytest.fixture(params=["cpu", "gpu"])
def kernels(request) -> str:
    """Backends with their own kernels, float32 counterparts of the float64 reference."""
    return usable_backend(request)


@pytest.fixture
def odd_camera() -> Camera:
    """Rotated camera with an off-centre principal point, unequal fx and fy, and partial tiles."""
    angle = 0.2
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = -0.5, 0.1, 0.2
    return Camera("odd", 75, 50, 60.0, 66.0, 33.0, 27.5, pose)


@pytest.fixture
def axis_camera() -> Camera:
    """Camera at the origin that looks along z; its axis hits the corner of four tiles."""
    return Camera("axis", 32, 32, 40.0, 40.0, 16.0, 16.0, np.eye(4))
