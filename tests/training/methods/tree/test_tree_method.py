"""Tests of A LoD of Gaussians as a method: leaves, tree, training of cuts, resuming."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.training.lod.tree.trees import surfaces
from training.errors import LodgsError
from training.lod.selection import BundleSelector, resolve_controls
from training.lod.tree.forest import merge_forest
from training.lod.tree.nodes import min_parent_size
from training.lod.tree.shape import splat_size
from training.methods import create, method_info
from training.methods.tree.store import record_layout
from training.optimize.out_of_core.cut_cache import SLOT_BYTES
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize
from training.splats.gaussians import Splats
from training.splats.levels import Bundle


def make(data, base=None, preset="draft", **values):
    short = {"steps": 12, "densify_until": 0.4, "prune_interval": 6, "tune_steps": 8, "margin": 0.0}
    return create("tree", data, override(method_info("tree").preset(preset), short | values), 0, "cpu", base)


def test_limit_of_one_splat_is_refused_before_training():
    draft = method_info("tree").preset("draft")
    with pytest.raises(LodgsError, match="'max_splats' is 1, but it needs at least two splats"):
        override(draft, {"max_splats": 1})
    assert override(draft, {"max_splats": 1, "sky_points": 1}).max_trained_splats == 2


def trained(tree, begin=0, until=None):
    levels = []
    for step in range(begin, until or tree.steps):
        tree.train_step(step)
        levels += [
            replace(level, splats=level.rows.select(slice(None)), on_disk=None)
            for level in tree.levels_after(step)
        ]
    return levels


def cut_rows(tree, camera, pixels):
    """Return the rows of a view's cut."""
    tree.store.cache.evict_all()
    return tree.store.cache.rows_at(tree.store.load_cut(camera, pixels, tree.data.near))


def inner_rows(tree):
    """Return which rows are inner nodes."""
    forest = tree.store.shape
    offsets = np.concatenate([np.arange(2 * count - 1) - count for count in forest.counts.tolist()])
    return np.append(offsets, np.zeros(len(forest.counts) - 1)) >= 0


def records(tree):
    tree.store.cache.write_back()
    return tree.store.rows.read(np.arange(len(tree.store)))


def same(first: Splats, second: Splats) -> bool:
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    columns = first.extras.keys() == second.extras.keys() and all(
        np.array_equal(first.extras[name], second.extras[name]) for name in first.extras
    )
    return columns and all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


@pytest.fixture(scope="module")
def base(data) -> Splats:
    parameters = override(method_info("3dgs").preset("draft"), {"steps": 12, "margin": 0.0})
    plain = create("3dgs", data, parameters, 0, "cpu")
    return trained(plain)[-1].splats


def test_run_returns_leaves_then_all_nodes(data):
    tree = make(data)
    assert tree.steps == tree.parameters.total_steps == 12 + 1 + 8 and tree.levels == 2
    first, inner, leaves = trained(tree)
    assert [level.number for level in (first, inner, leaves)] == [2, 1, 2]
    assert (
        len(first.splats) == len(leaves.splats) == len(inner.splats) + 1 == merge_forest(tree.store)[1].leaves
    )
    camera = data.train[0]  # before the tree is built, all splats are drawn
    weights = BundleSelector(Bundle("tree", [first], "cut")).weights(
        camera.center, camera.focal, {"pixels": 16.0}
    )
    assert weights.all()


def test_first_steps_are_3dgs(data):
    values = {"steps": 12, "densify_until": 0.4, "prune_interval": 6, "margin": 0.0}
    plain = create("3dgs", data, override(method_info("3dgs").preset("draft"), values), 0, "cpu")
    tree = make(data)
    assert [step for step in range(12) if tree.ends_level(step)] == [11]
    for step in range(12):
        assert tree.train_step(step).loss() == pytest.approx(plain.train_step(step).loss(), rel=1e-5)
    torch.testing.assert_close(tree.model["means"], plain.model["means"])


def test_sky_points_leave_room_for_other_splats(data):
    values = {"max_splats": 70, "grad_threshold": 1e-9, "densify_interval": 2}
    plain, tree = make(data, **values), make(data, sky_points=200, **values)
    for step in range(4):
        plain.train_step(step)
        tree.train_step(step)
    assert (len(plain.model), len(tree.model)) == (70, 270)


def test_sky_points_lie_evenly_on_a_sphere(data, base):
    """Off by default; A.2: the initial points are augmented with a sky."""
    plain, tree = make(data), make(data, sky_points=200)
    count = len(plain.model)
    assert len(tree.model) == count + 200 and make(data, base, sky_points=200).splats == len(base)
    assert torch.equal(tree.model["means"][:count], plain.model["means"])
    center = np.mean([camera.center for camera in data.train], axis=0)
    points = tree.model["means"].detach().numpy()[count:] - center
    radius = 10 * np.quantile(np.linalg.norm(data.scene.points - center, axis=1), 0.99)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), radius, rtol=1e-5)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.01 * radius)
    # 200 points share the area 4 pi of the unit sphere, so neighbours are sqrt(4 pi / 200) apart
    scales = tree.model["log_scales"].detach().numpy()[count:].astype(float)
    np.testing.assert_allclose(np.exp(scales), radius * (4 * np.pi / 200) ** 0.5, rtol=0.15)
    for camera in data.train:  # each image contains some of them
        assert camera.sees(tree.model["means"].detach().numpy()[count:]).sum() > 2
    tree.train_step(0)
    assert tree.parameters.max_trained_splats == tree.parameters.max_splats + 200


def test_schedules_of_3dgs_end_before_the_tree(data, base):
    tree, based = make(data), make(data, base)
    p = tree.parameters
    for step, done in ((0, 0), (6, 0.5), (12, 1), (20, 1)):
        tree.set_learning_rates(step)
        rate = p.lr_means * (p.lr_means_final / p.lr_means) ** done * data.extent
        assert tree.model.adam.lr["means"] == pytest.approx(rate)
    assert [step for step in range(20) if tree.collects_stats(data.view(0), step)] == [0, 1, 2, 3, 4]
    based.set_learning_rates(1)
    assert based.model.adam.lr["means"] == pytest.approx(p.lr_means_final * data.extent)


def test_margins_are_added_before_the_tree_is_built(data, monkeypatch):
    """The number of later steps has no influence."""
    tree, steps = make(data, tune_steps=40, densify_until=0.9), []
    monkeypatch.setattr(tree.model, "append", lambda rows: steps.append(step))
    for step in range(tree.steps):
        tree.add_margins(step)
    assert steps == [10]


def test_without_tuning_leaves_equal_the_base(data, base):
    tree = make(data, base, tune_steps=0)
    assert tree.steps == tree.parameters.base_steps == 1
    inner, leaves = trained(tree)
    leaves.splats.extras = {}
    first, second = (splats.select(np.lexsort(splats.means.T)) for splats in (leaves.splats, base))
    assert same(first, second) and inner.number == 1


def test_leaf_rate_zero_freezes_leaves(data, base):
    tree = make(data, base, leaf_rate=0.0, pixels=16.0)
    trained(tree, until=1)
    built, inner = records(tree), inner_rows(tree)
    trained(tree, begin=1)
    values = slice(11 + 3 * 16)
    assert torch.equal(records(tree)[~inner, values], built[~inner, values])
    assert (records(tree)[inner, values] != built[inner, values]).any()


def test_leaf_rate_decreases(data, base):
    """The rate of leaves falls to ``leaf_end`` of its initial value, that of nodes to ``node_end``."""
    tree = make(data, base, leaf_rate=0.2, leaf_end=0.04, node_rate=3.0, node_end=0.25, tune_steps=400)
    trained(tree, until=1)
    camera = data.train[0]
    indices = tree.store.load_cut(camera, 16.0, data.near)
    inner = inner_rows(tree)[tree.store.cache.rows_at(indices)]
    assert inner.any() and not inner.all()
    for step, leaf_rate, node_rate in ((1, 0.2, 3), (201, 0.04, 1.5), (401, 0.008, 0.75)):
        actual = tree._rate_factors(indices, step).numpy()
        np.testing.assert_allclose(actual, np.where(inner, node_rate, leaf_rate), rtol=0.01)


@pytest.mark.parametrize("merge_by", ["error", "size"])
def test_sizes_are_saturated_after_training(data, base, merge_by):
    tree = make(
        data, base, merge_by=merge_by, lr_scales=0.5, lr_means_final=0.05
    )  # large rates move nodes far
    levels = trained(tree)
    splats, nodes = merge_forest(tree.store)
    errors = splats.extras["node_size"]
    sizes = nodes.sizes(splats.means, splats.log_scales, errors=errors)
    own_sizes = splat_size(splats.log_scales) if merge_by == "size" else errors
    for node in range(nodes.leaves, len(nodes)):
        assert sizes[node] >= own_sizes[node] > 0
        for child in nodes.children[node - nodes.leaves]:
            distance = np.linalg.norm(splats.means[child].astype(float) - splats.means[node].astype(float))
            assert float(sizes[node]) >= min_parent_size(np.array(float(sizes[child])), np.array(distance))
    np.testing.assert_array_equal(
        np.sort(levels[0].splats.extras["node_size"]), np.sort(sizes[nodes.leaves :])
    )


def test_step_updates_only_the_cut_of_its_view(data, base):
    center = base.means.mean(axis=0)
    small = replace(
        base, means=center + (base.means - center) / 30, log_scales=base.log_scales - np.float32(3)
    )
    tree = make(data, small, lod_noise=0.0, octaves=0.0)
    trained(tree, until=4)
    initial = records(tree)
    tree.store.cache.evict_all()
    tree.train_step(4)
    moved = (records(tree) != initial).any(dim=1)
    rows = cut_rows(tree, tree.choose_view(4).camera, tree.parameters.pixels)
    cut = torch.zeros_like(moved)
    cut[rows] = True
    assert moved.sum() > 0 and not (moved & ~cut).any()
    assert moved[inner_rows(tree)].any()  # inner nodes are trained


def test_training_cut_equals_bundle_cut(data, base):
    tree = make(data, base, tune_steps=0)
    bundle = Bundle("tree", trained(tree), "cut")
    selector = BundleSelector(bundle)
    for pixels in (0.5, 3.0, 11.0):
        for camera in data.train[:3]:
            rows = cut_rows(tree, camera, pixels)
            gaussians = tree.store.gaussians_at(tree.store.load_cut(camera, pixels, data.near))
            first = tree.rasterize_model(camera, 0, gaussians=gaussians).image
            weights = selector.weights(
                camera.center, camera.focal, resolve_controls(bundle, {"pixels": pixels})
            )
            gaussians = Gaussians.of(selector.splats)
            expected, reference = (
                rasterize(
                    gaussians, camera, weights=torch.from_numpy(weights), near=data.near,
                    background=tree.background(0), sh_degree=tree.sh_degree(0), antialias=True,
                    backend=backend,
                ).image
                for backend in ("cpu", "reference")
            )  # fmt: skip
            assert len(rows) <= (weights > 0).sum()
            torch.testing.assert_close(first.detach(), expected, atol=2e-5, rtol=1e-4)
            # rounding may move a splat's alpha across its threshold of 1/255 in a pixel
            off = ~torch.isclose(first.detach(), reference, atol=2e-5, rtol=1e-4).all(-1)
            assert off.sum() <= 2 and (first.detach() - reference).abs().max() < 1 / 255


def test_bundle_has_block_table(data, base):
    tree = make(data, base, tune_steps=0)
    assert tree.tables() == {}
    levels = trained(tree)
    table = tree.tables()["blocks"]
    assert table["level"].tolist() == [1, 2]  # fewer than 512 rows each
    for row, level in enumerate(levels):
        assert table["parent_size"][row] == level.splats.extras["parent_size"].max()


def test_rendering_uses_trained_granularity(data, base):
    tree = make(data, base, tune_steps=0, pixels=3.0)
    bundle = Bundle("tree", trained(tree), "cut", controls=tree.controls)
    assert resolve_controls(bundle, {})["pixels"] == 3


def test_lod_noise_follows_fourth_power(data, base):
    tree = make(data, base, pixels=2.0, lod_noise=5.0, octaves=0.0)
    actual = np.array([tree._pixels(step) for step in range(4000)])
    assert actual.min() >= 2 and actual.max() <= 12
    # A.6: 1 + 5 r⁴ is below 2 for r < (1/5)^(1/4) = 0.669
    assert (actual < 4).mean() == pytest.approx(0.669, abs=0.02)


def test_granularity_is_uniform_in_octaves(data, base):
    tree = make(data, base, pixels=2.0, octaves=4.0)
    octaves = np.log2([tree._pixels(step) / 2 for step in range(4000)])
    assert np.histogram(octaves, bins=4, range=(0, 4))[0] == pytest.approx([1000] * 4, rel=0.1)


def test_view_without_splats_completes_its_step(data, base):
    """All splats are behind one camera."""
    camera = data.train[0]
    splats_behind = replace(base, means=(base.means - camera.center + 0).astype(np.float32))
    splats_behind.means = (
        camera.center - 50 * camera.world_to_camera[2, :3] + 0.01 * splats_behind.means
    ).astype(np.float32)
    tree = make(data, splats_behind)
    trained(tree, until=1)
    view = replace(tree.choose_view(1), camera=camera)
    assert len(cut_rows(tree, camera, 1.0)) == 0
    tree.choose_view = lambda step: view
    assert np.isfinite(tree.train_step(1).loss())


@pytest.mark.parametrize(
    "stop", [12, *(pytest.param(step, marks=pytest.mark.nightly) for step in (11, 13, 16))]
)
def test_resume_is_bit_identical(data, stop):
    """Stop in the 3DGS steps, at their end, before the first step of the tree, and between size updates."""
    values = {"resize_interval": 3, "lr_scales": 0.1}
    full_run, first = make(data, **values), make(data, **values)
    levels = trained(full_run)
    initial = trained(first, until=stop)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = make(data, **values)
    second.load_state_dict(torch.load(file, weights_only=True))
    final = initial + trained(second, stop)
    assert [level.number for level in final] == [level.number for level in levels]
    assert all(
        same(level.splats, expected_level.splats) for level, expected_level in zip(levels, final, strict=True)
    )


def test_density_control_grows_the_tree(data, base):
    """It grows up to its limit, and resuming before and after growth is bit-identical."""
    values = {
        "tune_steps": 24,
        "grow_interval": 6,
        "grow_until": 0.6,
        "max_threshold": 1e-5,
        "unseen_epochs": 1.0,
    }
    values["max_splats"] = len(base) + 60
    tree = make(data, base, **values)
    counts = []
    for step in range(tree.steps):
        tree.train_step(step)
        counts.append(int(tree.store.shape.counts.sum()))
    assert counts[5] == len(base) and counts[6] == len(base) + 60
    assert counts[-1] == counts[13] <= len(base) + 60
    (inner, leaves), *_ = [tree.levels_after(tree.steps - 1)]
    assert len(leaves.rows) == counts[-1] == len(inner.rows) + 1
    for pause in (4, 9, 14):
        second = make(data, base, **values)
        trained(second, until=pause)
        file = io.BytesIO()
        torch.save(second.state_dict(), file)
        file.seek(0)
        resumed = make(data, base, **values)
        resumed.load_state_dict(torch.load(file, weights_only=True))
        trained(resumed, begin=pause)
        assert torch.equal(records(resumed), records(tree))


def test_coarsening_for_budget_warns_once(data, monkeypatch):
    leaves = surfaces(3_000, degree=0)
    leaves.means = (0.03 * leaves.means + data.scene.points.mean(axis=0)).astype(np.float32)
    leaves.log_scales = (leaves.log_scales + np.log(0.03)).astype(np.float32)
    record = SLOT_BYTES + 4 * record_layout(0).width
    for room, count in ((600, 1), (10_000, 0)):
        monkeypatch.setattr(data, "splat_memory", room * record + 4 * (2 * len(leaves) - 1))
        tree, messages = make(data, leaves, sh_degree=0, pixels=0.1, lod_noise=0.0), []
        tree.warn = messages.append
        trained(tree)
        assert len(messages) == count and all(
            "coarser" in item and "splat_memory" in item for item in messages
        )
        assert (tree.store.max_coarsening > 1) == bool(count)


def test_unimportant_leaves_are_pruned_in_first_steps(data, monkeypatch):
    tree, pruned_after = make(data, steps=30, tune_steps=60, least_weight=0.1), []
    monkeypatch.setattr(tree, "prune_unimportant", pruned_after.append)
    for step in range(tree.finest_steps):
        tree.control_density(step)
    assert pruned_after == [7, 15, 23]
