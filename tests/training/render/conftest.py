"""Fixtures for rendering tests: splats that fill a small image, and a camera."""

import numpy as np
import pytest

from training.scenes.cameras import Camera
from training.splats.gaussians import Splats


@pytest.fixture
def make_splats():
    """Return ``make_splats(count, degree=3, seed=0)``, which makes random splats around the origin."""

    def make(count: int, degree: int = 3, seed: int = 0) -> Splats:
        rng = np.random.default_rng(seed)
        return Splats(
            means=rng.normal(0, 0.7, (count, 3)).astype(np.float32),
            quats=rng.normal(size=(count, 4)).astype(np.float32),
            log_scales=rng.normal(-1.8, 0.5, (count, 3)).astype(np.float32),
            opacity_logits=rng.normal(1, 1, count).astype(np.float32),
            sh=(rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3).astype(np.float32),
        )

    return make


@pytest.fixture
def camera() -> Camera:
    """Camera of 64x48 pixels, four units in front of the origin, with an off-center principal point."""
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.05, 4
    return Camera("", 64, 48, 60.0, 62.0, 30.5, 25.0, pose)
