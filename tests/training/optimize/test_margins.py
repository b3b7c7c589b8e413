"""Tests of margins, on walls with known positions and colours."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from training.methods import METHODS, create
from training.optimize.margins import DEPTH_FACTOR, MarginGenerator, blur_outward
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera
from training.splats.gaussians import SH_C0

NEAR = 0.01
ORANGE = (0.9, 0.5, 0.1)


def camera(x: float = 0.0, z: float = 0.0) -> Camera:
    """Return a camera at (x, 0, z) that looks along +z, 90 degrees wide and 74 high."""
    pose = np.eye(4)
    pose[:3, 3] = -x, 0, -z
    return Camera(f"{x:g}", 96, 72, 48.0, 48.0, 48.0, 36.0, pose)


def wall(depth: float, x_min: float, x_max: float, color=ORANGE) -> Gaussians:
    """Return opaque splats at a depth, as high as the view of a camera at the origin."""
    x, y = np.meshgrid(np.arange(x_min, x_max, 0.1), np.arange(-0.75 * depth, 0.75 * depth, 0.1))
    means = torch.tensor(np.stack([x, y, np.full_like(x, depth)], -1).reshape(-1, 3)).float()
    sh = torch.zeros(len(means), 4, 3)
    sh[:, 0] = (torch.tensor(color) - 0.5) / SH_C0
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1)
    return Gaussians(means, quats, torch.full_like(means, np.log(0.07)), torch.full((len(means),), 3.0), sh)


def draw(gaussians: Gaussians, view: Camera):
    return rasterize(gaussians, view, near=NEAR, backend="cpu")


def margins(*cameras: Camera, share: float = 0.5) -> MarginGenerator:
    data = SimpleNamespace(train=cameras, near=NEAR, transparent=False)
    return MarginGenerator(data, share, "cpu")


def test_margins_continue_a_wall_beyond_the_photo():
    visible, view = wall(4, -4, 4), camera()
    added = margins(view).extend(visible, 10_000)
    u, depth = view.project(added.means.numpy().astype(np.float64))
    outside = (u < 0).any(1) | (u[:, 0] > 96) | (u[:, 1] > 72)
    assert len(added) > 500 and outside.all()
    assert depth == pytest.approx(DEPTH_FACTOR * 4, rel=1e-3)
    colors = 0.5 + SH_C0 * added.sh[:, 0].numpy()
    assert np.abs(colors - ORANGE).max() < 0.05 and not added.sh[:, 1:].any()
    wide, total = view.widened(0.45), Gaussians.concatenated([visible, added])
    plain_alpha, total_alpha = draw(visible, wide).alpha, draw(total, wide).alpha
    assert (plain_alpha < 0.5).float().mean() > 0.5 and total_alpha.min() > 0.5
    inner = (slice(6, -6), slice(6, -6))
    torch.testing.assert_close(
        draw(total, view).image[inner], draw(visible, view).image[inner], atol=0.02, rtol=0
    )


def test_margins_do_not_cover_surfaces_of_other_photos():
    """The second camera looks past the end of the near wall at a far wall."""
    near, far = wall(4, -4, 4), wall(12, 4, 30, color=(0.1, 0.2, 0.9))
    first, second = camera(), camera(x=12)
    combined = Gaussians.concatenated([near, far])
    for cameras, visible, covered in (((first,), near, True), ((first, second), combined, False)):
        means = margins(*cameras).extend(visible, 10_000).means.numpy().astype(np.float64)
        assert (second.sees(means) & (means[:, 2] < 12)).any() == covered


def test_covered_surroundings_get_no_margins():
    assert len(margins(camera()).extend(wall(4, -12, 12), 10_000)) < len(
        margins(camera()).extend(wall(4, -4, 4), 10_000)
    )
    enclosed = replace(wall(4, -12, 12), log_scales=wall(4, -12, 12).log_scales + 4)
    assert len(margins(camera()).extend(enclosed, 10_000)) == 0


def test_empty_photos_get_no_margins():
    invisible = wall(4, -4, 4)
    invisible = replace(invisible, means=-invisible.means)
    assert len(margins(camera()).extend(invisible, 10_000)) == 0


def test_photos_with_empty_edges_get_no_margins():
    """Only the middle of the image is covered."""
    low = wall(4, -1, 1)
    low = low.select(low.means[:, 1].abs() < 1)
    assert len(margins(camera(), camera(x=1)).extend(low, 10_000)) == 0


def test_margins_scale_with_the_scene():
    small = margins(camera(), camera(x=1)).extend(wall(4, -4, 4), 10_000)
    scale = 1000.0
    splats = wall(4, -4, 4)
    large = replace(splats, means=scale * splats.means, log_scales=splats.log_scales + np.log(scale))
    data = SimpleNamespace(train=[camera(), camera(x=scale)], near=scale * NEAR, transparent=False)
    scaled = MarginGenerator(data, 0.5, "cpu").extend(large, 10_000)
    assert scaled.means.numpy() / scale == pytest.approx(small.means.numpy(), rel=1e-3, abs=1e-3)
    assert scaled.log_scales.numpy() - np.log(scale) == pytest.approx(small.log_scales.numpy(), abs=1e-3)


def test_smaller_budget_gives_larger_splats():
    small, large = (margins(camera()).extend(wall(4, -4, 4), budget) for budget in (10_000, 300))
    assert len(small) > 500 and 100 < len(large) <= 300
    assert large.log_scales.min() > small.log_scales.max()
    wide = camera().widened(0.45)
    assert draw(Gaussians.concatenated([wall(4, -4, 4), large]), wide).alpha.min() > 0.5
    assert len(margins(camera()).extend(wall(4, -4, 4), 30)) == 0


def test_blur_preserves_known_values_and_has_limited_reach():
    values, valid = np.full((9, 400, 1), 7.0), np.zeros((9, 400), bool)
    blurred, reached = blur_outward(values, valid)
    assert not reached.any() and not blurred.any()
    valid[:, :10] = True
    values[:, 10:] = np.nan  # unknown values are ignored
    blurred, reached = blur_outward(values, valid)
    assert reached[:, :20].all() and not reached[:, 200:].any()
    assert blurred[reached] == pytest.approx(7.0)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=[pytest.mark.nightly] * (name in ("flod_scaffold", "matryoshka", "octree_neural"))
        )
        for name in sorted(METHODS)
    ],
)
def test_every_method_adds_margins(data, name):
    """Margins are outside the photos, in the final levels, and have the columns of the rule."""
    steps = {"steps": [6, 6], "levels": 2} if name in ("flod", "flod_scaffold") else {"steps": 12}
    steps |= {"finish_share": 0.0} if name == "flod" else {}
    results = {}
    for margin in (0.0, 0.5):
        preset = METHODS[name].preset("draft")
        tuning = {key: 6 for key in ("tune_steps", "refine_steps") if hasattr(preset, key)}
        parameters = override(preset, steps | tuning | {"margin": margin, "sh_degree": 0})
        method, levels = create(name, data, parameters, seed=0, backend="cpu"), {}
        for step in range(method.steps):
            method.train_step(step)
            levels |= {level.number: level.rows.select(slice(None)) for level in method.levels_after(step)}
        results[margin] = levels
    for number, plain in results[0.0].items():
        splats = results[0.5][number]
        assert set(splats.extras) == set(plain.extras)
        means = splats.means.astype(np.float64)
        outside = ~np.any([view.sees(means) for view in data.train], axis=0)
        if number == 1 or name == "flod":
            assert outside.sum() > (~np.any([v.sees(plain.means) for v in data.train], axis=0)).sum()
