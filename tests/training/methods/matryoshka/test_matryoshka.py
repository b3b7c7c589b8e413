"""Tests of Matryoshka: order, random prefixes, levels and whole runs."""

import numpy as np
import pytest
import torch

from training.editing.export import FileOptions, export_finest_level
from training.lod.rule import rules
from training.lod.selection import resolve_controls, select
from training.methods import create, method_info
from training.optimize.merging import merge
from training.optimize.parameters import override
from training.rasterize import contributions
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle
from training.splats.ply import read_ply


def make(data, base=None, preset="draft", **values):
    values = {"steps": 24, "begin": 0.5, "densify_until": 0.4, "order_interval": 5, **values}
    return create(
        "matryoshka", data, override(method_info("matryoshka").preset(preset), values), 0, "cpu", base
    )


def trained(method, until=None):
    levels = []
    for step in range(until or method.steps):
        method.train_step(step)
        levels += method.levels_after(step)
    return levels


def bundle_of(method, levels) -> Bundle:
    return Bundle("matryoshka", levels, "prefix", method.facts, cumulative=True, meta=method.meta())


def test_steps_before_the_order_equal_3dgs(data):
    values = {"steps": 24, "densify_until": 0.4}
    plain = create("3dgs", data, override(method_info("3dgs").preset("draft"), values), 0, "cpu")
    method = make(data)
    for step in range(12):
        assert method.train_step(step).loss() == plain.train_step(step).loss()
    assert torch.equal(method.model["means"], plain.model["means"])
    assert not method.model.columns["importance"].any()
    method.train_step(12)
    assert method.model.columns["importance"].any()


@pytest.mark.parametrize("order_by", ["total", "largest", "opacity"])
def test_order_follows_importance(data, order_by):
    method = make(data, order_by=order_by, margin=0.0, base_share=0.0)
    trained(method, 12)
    gaussians = method.model.gaussians.detach()
    measured = contributions(gaussians, data.train, near=data.near, antialias=True, backend="cpu")
    opacity = gaussians.opacity_logits.sigmoid()
    expected = {"total": measured.total, "largest": measured.largest, "opacity": opacity}[order_by]
    method.compute_order()
    ordered = expected[method.order()].numpy()
    assert (np.diff(ordered) <= 0).all() and ordered[0] > ordered[-1]


def test_each_step_renders_all_splats_and_a_prefix(data):
    method = make(data, dropout=0.0, random_background=False, prefix_weight=0.5)
    trained(method, 13)
    view = method.choose_view(13)
    full, prefix = method.draw(view, 13)
    count = method.random_length(13)
    rows = method.order()[:count]
    subset = method.model.gaussians.detach().select(rows)
    expected = method.rasterize_model(view.camera, 13, gaussians=subset).image
    torch.testing.assert_close(prefix.rendering.image, expected, atol=1e-5, rtol=1e-5)
    losses = [float(method.loss([drawing], view, 13).detach()) for drawing in (full, prefix)]
    assert float(method.loss([full, prefix], view, 13).detach()) == pytest.approx(losses[0] + losses[1] / 2)


@pytest.mark.parametrize("log_uniform", [True, False])
def test_random_lengths(data, log_uniform):
    method = make(data, log_uniform=log_uniform, min_prefix=0.1)
    shares = np.array([method.random_length(step) for step in range(4000)]) / len(method.model)
    expected = 0.1**0.5 if log_uniform else 0.55
    assert np.median(shares) == pytest.approx(expected, abs=0.02)
    assert shares.min() == pytest.approx(0.1, abs=0.02) and shares.max() == pytest.approx(1, abs=0.02)


def test_levels_are_prefixes(data):
    method = make(data, levels=3, level_ratio=0.5)
    levels = trained(method)
    total = len(method.model)
    assert [level.number for level in levels] == [1, 2, 3]
    assert [len(level.splats) for level in levels] == [
        round(total / 4), round(total / 2) - round(total / 4), total - round(total / 2)
    ]  # fmt: skip
    ranks = np.concatenate([level.splats.extras["prefix_rank"] for level in levels])
    np.testing.assert_array_equal(ranks, np.arange(total))
    means = np.concatenate([level.splats.means for level in levels])
    np.testing.assert_array_equal(means, method.model["means"].detach()[method.order()].numpy())


@pytest.mark.parametrize("drawn", [0.3, pytest.param(0.6, marks=pytest.mark.nightly)])
def test_fraction_drawn_at_the_view_distance(data, drawn):
    method = make(data, drawn=drawn)
    bundle = bundle_of(method, trained(method))
    splats = bundle.levels[-1].splats
    distances = np.stack([np.linalg.norm(splats.means - camera.center, axis=1) for camera in data.train])
    visible = np.stack([camera.sees(splats.means, near=data.near) for camera in data.train])
    mean = np.where(visible.any(0), (distances * visible).sum(0) / visible.sum(0).clip(1), distances.min(0))
    np.testing.assert_allclose(splats.extras["view_distance"], mean, rtol=1e-5)
    total = len(method.model)
    columns = {"prefix_rank": np.arange(total, dtype=np.float32), "view_distance": np.full(total, 3, "f4")}
    facts, means = method.facts | {"level": 1, "levels": 1}, np.tile(np.float32([3, 0, 0]), (total, 1))
    rule = rules()["prefix"]
    weights = rule.weights(means, np.zeros(3), data.focal, columns, facts, rule.defaults([1]))
    assert weights.sum() == pytest.approx(drawn * total, abs=1)


def test_truncated_plain_ply_is_a_level(data, tmp_path):
    """The first splats of the exported file equal a selection by the rule's budget."""
    method = make(data)
    bundle = bundle_of(method, trained(method))
    write_bundle(tmp_path / "bundle.ply", bundle)
    export_finest_level(tmp_path / "plain.ply", bundle, FileOptions(antialiased=True))
    values = resolve_controls(bundle, {"at_most": 20, "distance_scale": 0.01})
    expected, weights = select(bundle, data.train[0].center, data.train[0].focal, values)
    assert weights is None and len(expected) == 20
    for name in ("plain.ply", "bundle.ply"):
        first = read_ply(tmp_path / name).select(slice(0, 20))
        for name_of_array in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            np.testing.assert_array_equal(getattr(first, name_of_array), getattr(expected, name_of_array))


def test_order_begins_with_a_merge_of_all_splats(data):
    """The merge comes first in later orders, too."""
    method = make(data, base_share=0.1, order_interval=3)
    trained(method, 12)
    original = method.model.splats()
    count = round(0.1 * len(original))
    method.begin_step(12)
    assert len(method.model) == len(original)
    first = method.model.splats().select(method.order()[:count].numpy())
    np.testing.assert_array_equal(np.sort(first.means, 0), np.sort(merge(original, count).means, 0))
    for step in range(13, 20):
        method.train_step(step)
    assert set(method.order()[:count].tolist()) == set(range(count))


def test_base_is_ordered_in_the_first_step(data):
    base = make(data).model.splats()
    method = make(data, base=base)
    method.train_step(0)
    assert method.model.columns["importance"].any() and len(method.draw(method.choose_view(1), 1)) == 2
    assert len(method.model) == len(base)


@pytest.mark.parametrize("stop", [15, *(pytest.param(step, marks=pytest.mark.nightly) for step in (7, 23))])
def test_resume_is_bit_identical(data, stop, check_resumed):
    check_resumed(lambda: make(data), stop)


def test_resumed_end_keeps_the_facts(data):
    method, second = make(data), make(data)
    trained(method)
    second.load_state_dict(method.state_dict())
    assert second.facts == method.facts and second.facts.keys() == {"share", "share_focal", "splats"}
