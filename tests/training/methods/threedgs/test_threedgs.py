"""Plain 3DGS: one level, its schedule, and that it is FLoD with one level."""

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.methods import create, method_info
from training.methods.parameters import override


def make(data, name="3dgs", **values):
    return create(name, data, override(method_info(name).preset("draft"), values), seed=0, backend="cpu")


def test_its_one_level_is_there_at_the_end_alone(data):
    method = make(data, steps=4)
    handed_over = []
    for step in range(method.steps):
        assert method.level_at(step) == 1
        method.train_step(step)
        handed_over.append([level.number for level in method.levels_after(step)])
    assert handed_over == [[], [], [], [1]] and method.levels == 1


def test_it_is_flod_with_one_level_to_the_bit(data):
    """FLoD's last level has no constraint (Sec. 4.1): the paper's own baseline."""
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


def test_splats_are_only_added_before_densification_ends(data):
    density = {"densify_interval": 2, "densify_until": 0.5, "grad_threshold": 0.0, "min_opacity": 0.0}
    method = make(data, steps=20, free_depth=0.0, **density)
    counts = []
    for step in range(20):
        method.train_step(step)
        counts.append(method.splats)
    assert counts[0] < counts[1] < counts[9] == counts[19]


def test_positions_rates_fall_in_equal_factors(data):
    method = make(data, steps=100, lr_means=1e-2, lr_means_final=1e-4)
    for step, rate in ((0, 1e-2), (50, 1e-3), (100, 1e-4)):
        method.set_learning_rates(step)
        assert method.model.adam.lr["means"] == pytest.approx(rate * data.extent)


def test_when_all_is_too_transparent_it_says_so(data):
    method = make(data, steps=10, prune_interval=1, min_opacity=1.0)
    with pytest.raises(LodgsError, match=r"No splat is left at step 1.*'min_opacity'"):
        method.train_step(0)


def test_harmonics_join_one_degree_after_the_other(data):
    method = make(data, steps=10, sh_interval=3)
    assert [method.sh_degree(step) for step in (0, 2, 3, 8, 9, 50)] == [0, 0, 1, 2, 3, 3]
    method.train_step(0)
    assert not method.model["sh"][:, 1:].any()
    assert torch.isfinite(method.model["sh"]).all()
