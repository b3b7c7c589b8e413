"""Photographs continued beyond their edges, on walls whose places and colours are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.methods import METHODS, create
from training.optimize.margins import DEPTH_FACTOR, Margins, blur_outward
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera
from training.splats.gaussians import SH_C0

NEAR = 0.01
ORANGE = (0.9, 0.5, 0.1)


def camera(x: float = 0.0, z: float = 0.0) -> Camera:
    """At (x, 0, z), looking along +z, 90 degrees wide and 74 high."""
    pose = np.eye(4)
    pose[:3, 3] = -x, 0, -z
    return Camera(f"{x:g}", 96, 72, 48.0, 48.0, 48.0, 36.0, pose)


def wall(depth: float, left: float, right: float, color=ORANGE) -> Gaussians:
    """Opaque splats at a depth, as high as a camera at the origin sees there."""
    x, y = np.meshgrid(np.arange(left, right, 0.1), np.arange(-0.75 * depth, 0.75 * depth, 0.1))
    means = torch.tensor(np.stack([x, y, np.full_like(x, depth)], -1).reshape(-1, 3)).float()
    sh = torch.zeros(len(means), 4, 3)
    sh[:, 0] = (torch.tensor(color) - 0.5) / SH_C0
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1)
    return Gaussians(means, quats, torch.full_like(means, np.log(0.07)), torch.full((len(means),), 3.0), sh)


def draw(gaussians: Gaussians, view: Camera):
    return rasterize(gaussians, view, near=NEAR, backend="cpu")


def margins(*cameras: Camera, share: float = 0.5) -> Margins:
    return Margins(cameras, share, NEAR, "cpu")


def test_a_wall_goes_on_beyond_the_photograph():
    seen, shown = wall(4, -4, 4), camera()
    added = margins(shown).extend(seen, 10_000)
    u, depth = shown.project(added.means.numpy().astype(np.float64))
    outside = (u < 0).any(1) | (u[:, 0] > 96) | (u[:, 1] > 72)
    assert len(added) > 500 and outside.all()
    assert depth == pytest.approx(DEPTH_FACTOR * 4, rel=1e-3)
    colors = 0.5 + SH_C0 * added.sh[:, 0].numpy()
    assert np.abs(colors - ORANGE).max() < 0.05 and not added.sh[:, 1:].any()
    wide, everything = shown.widened(0.45), Gaussians.concatenated([seen, added])
    before, after = draw(seen, wide).alpha, draw(everything, wide).alpha
    assert (before < 0.5).float().mean() > 0.5 and after.min() > 0.5
    inner = (slice(6, -6), slice(6, -6))
    torch.testing.assert_close(
        draw(everything, shown).image[inner], draw(seen, shown).image[inner], atol=0.02, rtol=0
    )


def test_nothing_stands_before_what_another_photograph_shows():
    """The second camera looks past the end of the near wall at one that is far."""
    near, far = wall(4, -4, 4), wall(12, 4, 30, color=(0.1, 0.2, 0.9))
    first, second = camera(), camera(x=12)
    both = Gaussians.concatenated([near, far])
    for cameras, seen, stands in (((first,), near, True), ((first, second), both, False)):
        means = margins(*cameras).extend(seen, 10_000).means.numpy().astype(np.float64)
        assert (second.sees(means) & (means[:, 2] < 12)).any() == stands


def test_what_is_shown_everywhere_is_not_continued():
    assert len(margins(camera()).extend(wall(4, -12, 12), 10_000)) < len(
        margins(camera()).extend(wall(4, -4, 4), 10_000)
    )
    enclosed = replace(wall(4, -12, 12), log_scales=wall(4, -12, 12).log_scales + 4)
    assert len(margins(camera()).extend(enclosed, 10_000)) == 0


def test_where_nothing_is_shown_nothing_is_continued():
    behind = wall(4, -4, 4)
    behind = replace(behind, means=-behind.means)
    assert len(margins(camera()).extend(behind, 10_000)) == 0


def test_a_photograph_that_ends_in_nothing_is_not_continued():
    """Something in the middle before nothing."""
    low = wall(4, -1, 1)
    low = low.select(low.means[:, 1].abs() < 1)
    assert len(margins(camera(), camera(x=1)).extend(low, 10_000)) == 0


def test_the_scenes_unit_does_not_matter():
    small = margins(camera(), camera(x=1)).extend(wall(4, -4, 4), 10_000)
    scale = 1000.0
    seen = wall(4, -4, 4)
    large = replace(seen, means=scale * seen.means, log_scales=seen.log_scales + np.log(scale))
    there = Margins([camera(), camera(x=scale)], 0.5, scale * NEAR, "cpu").extend(large, 10_000)
    assert there.means.numpy() / scale == pytest.approx(small.means.numpy(), rel=1e-3, abs=1e-3)
    assert there.log_scales.numpy() - np.log(scale) == pytest.approx(small.log_scales.numpy(), abs=1e-3)


def test_fewer_are_larger():
    many, few = (margins(camera()).extend(wall(4, -4, 4), most) for most in (10_000, 300))
    assert len(many) > 500 and 100 < len(few) <= 300
    assert few.log_scales.min() > many.log_scales.max()
    wide = camera().widened(0.45)
    assert draw(Gaussians.concatenated([wall(4, -4, 4), few]), wide).alpha.min() > 0.5
    assert len(margins(camera()).extend(wall(4, -4, 4), 30)) == 0


def test_blurring_gives_what_is_known_its_own_value_and_stops_where_nothing_is_near():
    values, known = np.full((9, 400, 1), 7.0), np.zeros((9, 400), bool)
    found, reached = blur_outward(values, known)
    assert not reached.any() and not found.any()
    known[:, :10] = True
    values[:, 10:] = np.nan  # is not looked at
    found, reached = blur_outward(values, known)
    assert reached[:, :20].all() and not reached[:, 200:].any()
    assert found[reached] == pytest.approx(7.0)


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_continues_its_photographs(data, name):
    """What is added lies beyond the photographs, is there at the end, and has all that its rule reads."""
    steps = {"steps": [6, 6], "levels": 2, "finish_share": 0.0} if name == "flod" else {"steps": 12}
    made = {}
    for margin in (0.0, 0.5):
        preset = METHODS[name].preset("draft")
        tuning = {"tune_steps": 6} if hasattr(preset, "tune_steps") else {}
        parameters = override(preset, steps | tuning | {"margin": margin, "sh_degree": 0})
        method, levels = create(name, data, parameters, seed=0, backend="cpu"), {}
        for step in range(method.steps):
            method.train_step(step)
            levels |= {level.number: level.rows.select(slice(None)) for level in method.levels_after(step)}
        made[margin] = levels
    for number, without in made[0.0].items():
        splats = made[0.5][number]
        assert set(splats.extras) == set(without.extras)
        means = splats.means.astype(np.float64)
        outside = ~np.any([view.sees(means) for view in data.train], axis=0)
        if number == 1 or name == "flod":
            assert outside.sum() > (~np.any([v.sees(without.means) for v in data.train], axis=0)).sum()
