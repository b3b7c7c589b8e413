"""Tests of plain 3DGS: its level, its schedule, and equality with one-level FLoD."""

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.methods import create, method_info
from training.optimize.density_control import peak_scores
from training.optimize.parameters import override
from training.rasterize import contributions, rasterize


def make(data, name="3dgs", **values):
    return create(name, data, override(method_info(name).preset("draft"), values), seed=0, backend="cpu")


def test_single_level_is_returned_at_the_end(data):
    method = make(data, steps=4)
    completed = []
    for step in range(method.steps):
        assert method.level_at(step) == 1
        method.train_step(step)
        completed.append([level.number for level in method.levels_after(step)])
    assert completed == [[], [], [], [1]] and method.levels == 1


def test_equals_flod_with_one_level(data):
    """FLoD's last level has no constraint (Sec. 4.1), which makes it the paper's baseline."""
    values = {
        "steps": 24, "densify_interval": 4, "densify_until": 0.75, "prune_interval": 6, "max_splats": 90,
        "opacity_reset_interval": 10, "grad_threshold": 0.0,
    }  # fmt: skip
    models = []
    for method in (make(data, **values), make(data, "flod", levels=1, **values)):
        for step in range(24):
            method.train_step(step)
        models.append(method.model.splats())
    assert len(models[0]) > 60
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(*(getattr(splats, name) for splats in models))


def test_no_splats_are_added_after_densification(data):
    density = {"densify_interval": 2, "densify_until": 0.5, "grad_threshold": 0.0, "min_opacity": 0.0}
    method = make(data, steps=20, free_depth=0.0, **density)
    counts = []
    for step in range(20):
        method.train_step(step)
        counts.append(method.splats)
    assert counts[0] < counts[1] < counts[9] == counts[19]


@pytest.mark.parametrize("threshold", [0.003, 0.01])
def test_max_criterion_starts_at_densify_from(data, threshold):
    """Splats with a product above the threshold are added, normalized to one megapixel."""
    method = make(
        data, steps=40, densify_interval=4, densify_from=7, densify_by="max", max_threshold=threshold,
        margin=0.0, free_depth=0.0, largest=0.0, prune_interval=0, first_resolution=1.0,
    )  # fmt: skip
    counts, above = [method.splats], 0
    for step in range(8):
        if step == 7:  # scores of density control in the 8th step, without the view of that step
            above = int((peak_scores(method.model) > threshold * np.sqrt(1e6 / (64 * 48))).sum())
        method.train_step(step)
        counts.append(method.splats)
    assert counts[7] == counts[0] and counts[8] - counts[0] == pytest.approx(above, abs=3)
    assert above > 3


def test_unimportant_splats_are_pruned_three_times(data):
    method = make(
        data, steps=30, least_weight=0.08, densify_until=0.0, prune_interval=0, free_depth=0.0, margin=0.0
    )
    counts = [method.splats]
    for step in range(30):
        if step + 1 in (8, 16, 24):  # scores of the previous step are similar
            actual = contributions(method.model.gaussians, data.train, near=data.near, backend="reference")
            expected = int((actual.largest >= 0.08).sum())
        method.train_step(step)
        counts.append(method.splats)
        if step + 1 == 8:
            assert 0 < counts[-1] == pytest.approx(expected, abs=3) and counts[-1] < counts[0]
    pruned = [step for step in range(1, 31) if counts[step] < counts[step - 1]]
    assert 8 in pruned and set(pruned) <= {8, 16, 24}


def test_antialiasing_is_used_in_training(data):
    """A step renders with the antialiasing filter, and the bundle records it."""
    for antialias in (False, True):
        method = make(data, steps=10, antialias=antialias, random_background=False, dropout=0.0)
        with torch.no_grad():
            method.model["log_scales"].sub_(3)
        gaussians, camera = method.model.gaussians.detach(), method.choose_view(0).camera
        options = {"near": data.near, "sh_degree": 0, "backend": "reference"}
        expected = [
            rasterize(gaussians, camera, antialias=flag, **options).image
            for flag in (antialias, not antialias)
        ]
        image = method.train_step(0).image()
        assert (image - expected[0]).abs().max() < 1e-4 < 0.01 < (image - expected[1]).abs().max()
        assert method.meta().get("antialias", False) is antialias


def test_position_rate_decays_exponentially(data):
    method = make(data, steps=100, lr_means=1e-2, lr_means_final=1e-4)
    for step, rate in ((0, 1e-2), (50, 1e-3), (100, 1e-4)):
        method.set_learning_rates(step)
        assert method.model.adam.lr["means"] == pytest.approx(rate * data.extent)


@pytest.mark.parametrize("name", ["3dgs", "flod", "clod"])
def test_other_rates_fall_at_the_end(data, name):
    """From 85 % of the steps on, by a factor of 0.1 ** ((share - 0.85) / 0.15), worked by hand."""
    method = make(data, name, lr_final=0.1)
    parameters = method.parameters
    steps = parameters.stages[0][1] if name == "flod" else parameters.steps
    for share, factor in ((0.0, 1.0), (0.849, 1.0), (0.925, 0.1**0.5), (1.0, 0.1)):
        method.set_learning_rates(round(share * steps) - (share == 1))
        lr = method.model.lr
        assert lr["log_scales"] == pytest.approx(factor * parameters.lr_scales, rel=0.01)
        assert lr["opacity_logits"] == pytest.approx(factor * parameters.lr_opacities, rel=0.01)
        assert lr["sh"][0].item() == pytest.approx(factor * parameters.lr_sh, rel=0.01)


@pytest.mark.parametrize("name", ["3dgs", "flod"])
def test_transparent_model_raises(data, name):
    method = make(data, name, steps=10, prune_interval=1, min_opacity=1.0)
    with pytest.raises(LodgsError, match=r"no splats remain at step 1.*Lower or disable 'min_opacity'"):
        method.train_step(0)


def test_harmonics_degrees_join_one_by_one(data):
    method = make(data, steps=10, sh_interval=3)
    assert [method.sh_degree(step) for step in (0, 2, 3, 8, 9, 50)] == [0, 0, 1, 2, 3, 3]
    method.train_step(0)
    assert not method.model["sh"][:, 1:].any()
    assert torch.isfinite(method.model["sh"]).all()


@pytest.mark.parametrize(("name", "levels"), [("3dgs", {}), ("flod", {"levels": 1})])
def test_opacities_fall_while_splats_are_added(data, name, levels):
    """By the decay times the strength for 6 of 40 photos, at the removal of transparent splats only."""
    method = make(data, name, steps=20, densify_interval=1000, densify_until=0.5, prune_interval=2,
                  min_opacity=0.0, opacity_decay=0.2, margin=0.0, **levels)  # fmt: skip
    assert len(data.train) == 6
    expected = method.model.read("opacity_logits").sigmoid().clone()
    for step, factor in ((0, 1.0), (1, 1 - 0.2 * (1 - 6 / 40)), (11, 1.0)):
        method.control_density(step)
        expected *= factor
        torch.testing.assert_close(method.model.read("opacity_logits").sigmoid(), expected)


def test_opacities_of_a_base_stay(data):
    """Photos that show only a part of it must not remove the rest."""
    base = make(data, steps=20).model.splats()
    method = create("3dgs", data, method_info("3dgs").preset("draft"), seed=0, backend="cpu", base=base)
    method.control_density(99)
    assert method.model.splats().opacity_logits.tolist() == base.opacity_logits.tolist()


@pytest.mark.parametrize("name", ["3dgs", "flod"])
def test_training_starts_with_splats_between_points(data, name, monkeypatch):
    between = np.array([[0.25] * 3, [0.5] * 3, [0.75] * 3], np.float32)
    limits = []

    def points_between(scene, cameras, limit, seed, region):
        limits.append(limit)
        return between, np.full((3, 3), 128, np.uint8)

    monkeypatch.setattr("training.optimize.initialize.points_between", points_between)
    method = make(data, name, points_between=0.5, max_splats=10_000)
    means = method.model.read("means").numpy()
    assert limits == [round(0.5 * (len(means) - 3))]
    assert {tuple(point) for point in between} <= {tuple(mean) for mean in means}
