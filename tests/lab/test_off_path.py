"""Statistics of `lab/off_path.py`, against a wall with a known surface."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import torch

from lab.off_path import decibels, pixels, positions
from training.errors import LodgsError
from training.rasterize import Gaussians, Target
from training.scenes.cameras import Camera

DEPTH = 2.0


def camera(name: str, x: float = 0.0) -> Camera:
    """Return a view of a wall at z = DEPTH, from a position on the x axis."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(f"{name}.jpg", 12, 8, 10.0, 10.0, 6.0, 4.0, pose)


def write_wall(folder, view: Camera) -> None:
    """Write the positions of the wall under a view's pixels, as the renderer does."""
    x, y = np.meshgrid(np.arange(12) + 0.5, np.arange(8) + 0.5)
    rays = np.stack([(x - 6) / 10 * DEPTH, (y - 4) / 10 * DEPTH, np.full_like(x, DEPTH)])
    positions_xyz = (rays + view.center[:, None, None]).astype(np.float32)
    (folder / "positions").mkdir(exist_ok=True)
    path = folder / "positions" / f"{view.name[:-4]}.exr"
    OpenEXR.File({}, dict(zip("XYZ", positions_xyz, strict=True))).write(str(path))


def test_training_views_of_each_pixel_are_counted(tmp_path):
    target, same, shifted, distant = (
        camera("target"), camera("same"), camera("shifted", 0.8), camera("distant", 50.0)
    )  # fmt: skip
    for view in (target, same, shifted, distant):
        write_wall(tmp_path, view)
    wall = Gaussians(
        torch.tensor([[0.0, 0.0, 1.5 * DEPTH]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 3.0),
        torch.tensor([9.0]), torch.zeros(1, 1, 3),
    )  # fmt: skip
    evaluation = SimpleNamespace(
        data=SimpleNamespace(train=[same, shifted, distant], near=0.01), antialias=False, backend="cpu",
        target=lambda view: Target(torch.zeros(8, 12, 3)),
    )  # fmt: skip
    ((errors, views, depths),) = pixels(evaluation, wall, [target], tmp_path)  # type: ignore[arg-type]
    views = views.reshape(8, 12)
    # 0.8 to the right is 4 pixels; border pixels are not evaluated
    assert (views[1:-1, 1:5] == 1).all() and (views[1:-1, 5:-1] == 2).all()
    assert errors == pytest.approx((np.round(0.99 * 0.5 * 255) / 255) ** 2, abs=1e-4)  # grey, alpha 0.99
    assert depths == pytest.approx(1.5)


def test_psnr_uses_the_mean_error():
    assert decibels(np.array([0.02, 0.0])) == pytest.approx(20.0)


def test_surfaces_of_another_size_are_rejected(tmp_path):
    write_wall(tmp_path, camera("target"))
    with pytest.raises(LodgsError, match="12x8"):
        positions(tmp_path, camera("target").scaled(2))
