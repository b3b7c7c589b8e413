"""Splats that show the tiny scene."""

import numpy as np
import pytest

from training.scenes.colmap import read_scene
from training.splats.gaussians import SH_C0, Splats


@pytest.fixture(scope="module")
def splats(tiny_scene) -> Splats:
    """The points of the tiny scene as opaque spheres of the discs' size."""
    model = read_scene(tiny_scene)
    count = len(model.points)
    return Splats(
        means=model.points,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(0.12), np.float32),
        opacity_logits=np.full(count, 3, np.float32),
        sh=((model.point_colors[:, None] / 255 - 0.5) / SH_C0).astype(np.float32),
    )
