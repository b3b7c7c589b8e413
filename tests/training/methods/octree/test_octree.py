"""Tests of Octree-GS with explicit anchors: drawn levels, join steps, growth and pruning."""

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.methods.octree import METHOD
from training.methods.octree.train import Method
from training.optimize.method import Drawing
from training.optimize.parameters import override
from training.rasterize import Target, photometric_loss, rasterize


def make(data, **values) -> Method:
    values = {
        "levels": 4, "coarser_levels": 0, "nearest": 0.0, "farthest": 1.0, "footprint": 12.0, "steps": 40,
        "far_share": 0.0, "full_share": 0.0, "candidates": 1, "levels_from": "anchors", **values,
    }  # fmt: skip
    return Method(data, override(METHOD.preset("draft"), values), seed=0, backend="cpu")


def test_levels_join_at_decreasing_intervals(data):
    octree = make(data, levels=6, steps=1000, coarse_share=0.5, coarse_factor=2.0)
    # half of the levels start at 0; then intervals of 8, 4, 2, 1 fifteenths of the first 500 steps
    assert octree.schedule.join_steps == [0, 0, 0, 267, 400, 467]
    assert [octree.level_at(step) for step in (0, 266, 267, 466, 467, 999)] == [3, 3, 4, 5, 6, 6]


def test_step_draws_needed_joined_levels(data):
    octree = make(data, steps=400, coarse_share=0.5)
    camera = data.train[0]
    distance = np.linalg.norm(octree.model["means"].detach().numpy() - camera.center, axis=1)
    level = octree.model.columns["level"].numpy()
    for step, joined in ((0, 2), (399, 4)):
        target = np.clip(np.round(np.log2(octree.schedule.tree.d_max / distance)), 0, 3) + 1  # Eq. 5, rounded
        expected = level <= np.minimum(target, joined)
        weights = octree.schedule.weights(camera, octree.model, step, full=True).numpy()
        close = np.abs(np.log2(octree.schedule.tree.d_max / distance) % 1 - 0.5) < 1e-4
        assert ((weights > 0) == expected)[~close].all()
        assert 0 < expected.sum() < len(expected)


def test_half_size_image_needs_one_level_less(data):
    octree = make(data, far_share=1.0)
    near = octree.schedule.weights(data.train[0], octree.model, 39, full=False)
    half_size = octree.schedule.weights(data.camera(0, 2), octree.model, 39, full=False)
    octree.model.columns["bias"] += 1  # compensates for the smaller image
    assert torch.equal(octree.schedule.weights(data.camera(0, 2), octree.model, 39, full=False), near)
    assert 0 < half_size.mean() < near.mean() < 1


def test_image_size_matches_joined_levels(data, monkeypatch):
    monkeypatch.setattr("training.optimize.anchors.schedule.MIN_SIDE", 4)
    octree = make(data, levels=4, steps=400, coarse_share=0.5, far_share=1e-9)
    schedule = octree.schedule
    assert schedule.join_steps[2:] == [95, 158]
    assert schedule.shrink(0) == 4  # two of four levels: two halvings of size
    assert [schedule.shrink(step) for step in (94, 95, 157, 158, 399)] == [4, 2, 2, 1, 1]
    monkeypatch.setattr("training.optimize.anchors.schedule.MIN_SIDE", 20)  # allows one halving of 48 pixels
    assert schedule.shrink(0) == 2
    assert make(data, levels=4, steps=400, coarse_share=0.5, far_share=0.0).schedule.shrink(0) == 1


def test_gradients_are_independent_of_image_size(data, monkeypatch):
    """A splat of equal size in pixels, at an edge in a half-size image, has the same growth score."""
    camera, sums = data.train[data.training_view(0, 0)], []
    x, y = (camera.width / 2 - camera.cx) / camera.fx, (camera.height / 2 - camera.cy) / camera.fy
    pose = np.linalg.inv(camera.world_to_camera)
    center = pose[:3, :3] @ (np.array([x, y, 1.0]) * data.median_depth) + pose[:3, 3]
    for shrink in (1, 2):
        octree = make(data, steps=40, ssim_weight=0.0)
        height, width = camera.height // shrink, camera.width // shrink
        edge = torch.zeros(height, width, 3)
        edge[:, width // 2 :] = 1
        monkeypatch.setattr(data, "target", lambda *_, edge=edge: Target(edge))
        monkeypatch.setattr(octree.schedule, "shrink", lambda step, shrink=shrink: shrink)
        only_first = torch.zeros(len(octree.model))
        only_first[0] = 1
        monkeypatch.setattr(octree.schedule, "weights", lambda *_, only_first=only_first, **__: only_first)
        octree.schedule.join_steps = [0, 39]
        octree.model["means"].data[0] = torch.from_numpy(center)
        octree.model["log_scales"].data[0] = float(np.log(1.5 * shrink * data.median_depth / camera.fx))
        octree.train_step(0)
        sums.append(float(octree.model.stats["gradient_sum"].sum()))
    assert sums[0] > 0
    assert sums[1] == pytest.approx(sums[0], rel=0.02)


def test_random_far_and_full_steps(data, monkeypatch):
    octree = make(data, far_share=0.5, full_share=0.5, steps=400, coarse_share=0.0)
    assert {octree.schedule.shrink(step) for step in range(400)} == {1}  # 24 pixels would be too few
    monkeypatch.setattr("training.optimize.anchors.schedule.MIN_SIDE", 12)
    shrink_factors = np.array([octree.schedule.shrink(step) for step in range(400)])
    assert set(shrink_factors) == {1, 2, 4}
    assert 0.4 < (shrink_factors == 1).mean() < 0.6
    assert 0.4 < (shrink_factors[shrink_factors > 1] == 2).mean() < 0.6
    drawn = [octree.schedule.weights(data.train[0], octree.model, step, full=True) for step in range(200)]
    assert 60 < sum(weights.mean() == 1 for weights in drawn) < 140
    drawn = [octree.schedule.weights(data.train[0], octree.model, step) for step in range(20)]
    assert not any(weights.mean() == 1 for weights in drawn)


def test_new_anchors_are_in_free_voxels(data):
    octree = make(data, steps=400, footprint=6.0, max_splats=10_000, coarse_share=0.0, min_opacity=0.0)
    initial = octree.schedule.tree.keys(
        octree.model["means"].detach().double().numpy(), octree.model.columns["level"].long().numpy()
    )
    count = len(octree.model)
    octree.model.stats["seen"] += 1
    octree.model.stats["gradient_sum"] += 1  # far above every threshold: all grow into the next level
    levels = octree.model.columns["level"].clone()
    octree.grow(200)
    added, level = octree.model["means"][count:], octree.model.columns["level"][count:]
    assert len(added) > 0
    keys = octree.schedule.tree.keys(added.detach().double().numpy(), level.long().numpy())
    assert len(set(keys)) == len(keys) and not set(keys) & set(initial)
    assert level.min() == 2 and set(level.tolist()) <= set((levels + 1).tolist())
    scales = octree.model["log_scales"].detach().exp()[:, 0]
    assert torch.isclose(scales[count:, None] * 1.6, scales[None, :count]).any(1).all()
    assert (octree.model.columns["bias"][:count] == octree.parameters.bias_rate).all()


def test_finest_level_grows_in_itself(data):
    octree = make(data, steps=400, coarse_share=0.0, max_splats=10_000, min_opacity=0.0)
    octree.model.columns["level"][:] = 4
    count = len(octree.model)
    octree.model.stats["seen"] += 1
    octree.model.stats["gradient_sum"] += 1
    octree.grow(200)
    assert len(octree.model) > count
    assert (octree.model.columns["level"][count:] == 4).all()


def test_new_anchors_hardly_change_images(data):
    octree = make(data, steps=400, footprint=6.0, max_splats=10_000, min_opacity=0.0)
    octree.model["opacity_logits"].data[::2] = 3.0
    octree.model["opacity_logits"].data[1::2] = -4.0
    count = len(octree.model)
    octree.model.stats["seen"] += 1
    octree.model.stats["gradient_sum"] += 1
    octree.grow(200)
    opacity = octree.model["opacity_logits"].detach().sigmoid()
    assert set(opacity[count:].numpy().round(3)) == {np.float32(0.1), np.float32(0.018)}
    assert opacity[:count].max() > 0.9


@pytest.mark.parametrize(("coarser", "times"), [(0, 4), (1, 2), (2, 1)])
def test_growth_threshold_increases_with_level(data, coarser, times):
    """Sec. 4.2: the threshold of a level is tau 2^(beta (l - 1)).

    Below it, nothing grows; below the threshold of the next level, new anchors are in the same level. Levels
    for views from farther away than any photo do not count.
    """
    for factor, expected in ((0.99, None), (1.01, 0), (2.01, 1)):
        octree = make(
            data, steps=400, footprint=6.0, coarse_share=0.0, grow_harder=1.0, min_opacity=0.0,
            max_splats=999, levels=4, coarser_levels=coarser,
        )  # fmt: skip
        count, level = len(octree.model), octree.model.columns["level"]
        subset = level == 3
        threshold = octree.parameters.grad_threshold * data.threshold_scale * times
        octree.model.stats["seen"] += 1
        octree.model.stats["gradient_sum"] += threshold * factor * subset
        octree.grow(200)
        grown = octree.model.columns["level"][count:]
        assert set(grown.tolist()) == (set() if expected is None else {3.0 + expected})


def test_learning_rates_fall_after_growth(data):
    octree = make(data, steps=100, grow_until=0.6, lr_end=0.01, coarse_share=0.0)
    for step, share in ((0, 1.0), (60, 1.0), (80, 0.1), (100, 0.01)):  # exponential over 40 steps
        octree.set_learning_rates(step)
        p, lr = octree.parameters, octree.model.adam.lr
        assert lr["log_scales"] == pytest.approx(p.lr_scales * share)
        torch.testing.assert_close(lr["sh"][:2, 0], torch.tensor([p.lr_sh, p.lr_sh / 20]) * share)


def test_learning_rates_are_constant_during_growth(data):
    octree = make(data, steps=100, grow_until=1.0, lr_end=0.01)
    octree.set_learning_rates(99)
    assert octree.model.adam.lr["log_scales"] == octree.parameters.lr_scales


def test_unseen_splats_are_pruned_after_growth_and_at_the_end(data, monkeypatch):
    octree, pruned_after = make(data, steps=12, grow_until=0.5, grow_interval=3), []
    monkeypatch.setattr(octree, "prune_unseen", pruned_after.append)
    for step in range(12):
        octree.train_step(step)
    assert pruned_after == [5, 11]


def test_growth_into_next_level_waits_for_all_levels(data):
    octree = make(data, steps=400, footprint=6.0, coarse_share=0.9, max_splats=10_000, min_opacity=0.0)
    count, levels = len(octree.model), octree.model.columns["level"].clone()
    octree.model.stats["seen"][levels == 1] += 1
    octree.model.stats["gradient_sum"][levels == 1] += 1
    octree.grow(200)
    assert len(octree.model) > count
    assert (octree.model.columns["level"][count:] == 1).all()
    assert (octree.model.columns["bias"] == 0).all()


def test_faint_anchors_are_removed_unless_unseen(data):
    octree = make(data, grad_threshold=1e9, min_opacity=0.01)
    stats = octree.model.stats
    stats["seen"][:10] = 4
    stats["opacity_sum"][:5] = 4 * 0.02
    stats["opacity_sum"][5:10] = 4 * 0.005
    remaining = octree.model["means"].detach().clone()
    octree.grow(20)
    assert torch.equal(octree.model["means"].detach(), torch.cat([remaining[:5], remaining[10:]]))
    octree.model.stats["seen"] += 1
    with pytest.raises(LodgsError, match="no splats remain"):
        octree.grow(20)


def test_invisible_anchors_are_removed(data):
    """Views do not count invisible anchors as drawn."""
    octree = make(data, grad_threshold=1e9)
    octree.model["opacity_logits"].data[:5] = -5.55  # opacity 1/258, below 1/255
    remaining = octree.model["means"].detach()[5:].clone()
    rendering = octree.rasterize_model(data.train[0], 0)
    assert (rendering.radii[:5] == 0).all()
    octree.grow(20)
    assert torch.equal(octree.model["means"].detach(), remaining)


@pytest.mark.parametrize("far_share", [0.0, 0.1])
def test_splats_of_low_weight_are_pruned(data, far_share, monkeypatch):
    """The reference renders weights as features, one column per splat.

    Distant views draw coarse splats that finer ones hide in near views.
    """
    monkeypatch.setattr("training.optimize.anchors.schedule.MIN_SIDE", 12)
    octree = make(data, far_share=far_share, least_weight=0.3)
    octree.model["opacity_logits"].data.fill_(2.0)
    model, level, largest = octree.model, octree.model.columns["level"], torch.zeros(len(octree.model))
    for view in range(len(data.train)):
        for shrink in (1, 2, 4) if far_share else (1,):
            camera = data.camera(view, shrink)
            distances = (model["means"].detach() - torch.as_tensor(camera.center)).norm(dim=1)
            distances *= octree.schedule.tree.focal_px / camera.fx
            expected = (octree.schedule.tree.d_max / distances).log2().clip(0, 3) + 1
            drawn = (level <= (expected + 0.5)).float()
            splats = model.gaussians.detach()
            for column in range(0, len(model), 100):
                first = torch.eye(len(model))[:, column : column + 100].contiguous()
                blended = rasterize(splats, camera, weights=drawn, near=data.near, features=first).features
                columns = largest[column : column + 100]
                torch.maximum(columns, blended.amax((0, 1)), out=columns)
    clear = (largest - 0.3).abs() > 1e-3
    means = model["means"].detach().clone()
    octree.prune_unseen(39)
    remaining = (means[:, None] == octree.model["means"].detach()[None]).all(2).any(1)
    assert torch.equal(remaining[clear], (largest > 0.3)[clear])
    assert 0.1 < remaining.float().mean() < 0.9


def test_invalid_least_weight_raises(data):
    with pytest.raises(LodgsError, match=r"no splats remain at step 40.*'least_weight'"):
        make(data, least_weight=1.0).prune_unseen(39)


@pytest.mark.parametrize(("coarser", "finest"), [(3, 4), (1, 2)])
def test_narrow_splats_move_to_finer_level(data, coarser, finest):
    octree = make(data, narrowest=0.5, widest=8.0, coarse_share=0.5, coarser_levels=coarser)
    level = octree.model.columns["level"]
    level[:], level[1], level[3] = 1, 2, 4
    tree = octree.schedule.tree
    pixel = tree.d_max / tree.focal_px  # size at the distance where level 1 starts; 1/8 for level 4
    widths = torch.tensor([0.5 / 4 * 1.01, 0.5 / 4 * 0.99, 0.51, 0.01])
    octree.model["log_scales"].detach()[:4] = (pixel * widths).log()[:, None] - torch.tensor(
        [1.0, 0.001, 3.0]  # only the widest counts
    )
    for step, joined in ((octree.schedule.join_steps[-1] - 1, 3), (octree.schedule.join_steps[-1], 4)):
        octree.reassign_levels(step)
        expected = [min(3, finest), min(joined, finest), 1, 4]
        assert octree.model.columns["level"][:4].tolist() == expected


def test_narrow_splats_stay_if_no_photo_needs_finer_level(data):
    octree = make(data, narrowest=0.5, coarse_share=0.0, coarser_levels=3)
    level, means = octree.model.columns["level"], octree.model["means"].data
    level[:2] = 1
    octree.model["log_scales"].data[:2] = -20.0
    means[0] = torch.from_numpy(data.train[0].center) + 3 * octree.schedule.tree.d_max
    octree.reassign_levels(octree.schedule.join_steps[-1])
    assert octree.model.columns["level"][:2].tolist() == [1, 4]


def test_wide_splats_move_to_coarser_level(data):
    octree = make(data, narrowest=0.0, widest=2.0)
    octree.model.columns["level"][:] = 4
    octree.model.columns["level"][3] = 2
    tree = octree.schedule.tree
    pixel = tree.d_max / tree.focal_px  # size at the distance where level 1 starts; 1/8 for level 4
    widths = torch.tensor([1 / 8, 1 / 3, 1.1, 1 / 8])
    octree.model["log_scales"].detach()[:4] = (2 * pixel * widths).log()[:, None] - torch.tensor(
        [1.0, 0.001, 3.0]  # only the widest counts
    )
    octree.reassign_levels(0)
    assert octree.model.columns["level"][:4].tolist() == [4, 2, 1, 2]


def test_volume_uses_median_depths(data):
    octree = make(data, volume_weight=2.0)
    rendering, view = octree.rasterize_model(data.train[0], 0), data.view(0)
    drawn = rendering.radii > 0
    expected = 2 * (octree.model["log_scales"][drawn].double().exp() / data.median_depth).prod(1).mean()
    total = octree.loss([Drawing(rendering)], view, 0)
    without = photometric_loss(rendering.image, view.target, octree.parameters.ssim_weight)
    assert float(total.detach()) == pytest.approx(float((without + expected).detach()), rel=1e-5)


def test_view_without_splats_has_a_finite_loss(data):
    octree = make(data, volume_weight=2.0)
    octree.model["opacity_logits"].data[:] = -30
    assert octree.train_step(0).loss() > 0


def test_levels_add_up_to_all_splats_with_their_bias(data):
    octree = make(data, steps=8, coarse_share=0.5)
    completed = {}
    for step in range(octree.steps):
        octree.train_step(step)
        if levels := octree.levels_after(step):
            completed[step + 1] = levels
    assert list(completed) == [octree.schedule.join_steps[-1], 8]
    levels = completed[8]
    assert [level.number for level in levels] == [1, 2, 3, 4]
    assert sum(len(level.splats) for level in levels) == len(octree.model)
    for level in levels:
        assert (level.splats.extras["lod_level"] == level.number).all()
        assert "lod_bias" in level.splats.extras
