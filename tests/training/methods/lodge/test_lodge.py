"""Tests of LODGE: levels follow the rule and their filter, the finest level is frozen, runs resume."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.evaluate.views import reduce_view
from training.lod.selection import resolve_controls, select
from training.methods import create, method_info
from training.methods.lodge import ROUNDS, LodgeParameters
from training.methods.lodge.composite import IndexedLevel, LevelStack, gather_rows, visible_rows
from training.methods.lodge.thresholds import CANDIDATES, MAX_CURVES, Thresholds
from training.optimize.merging import merge
from training.optimize.parameters import override
from training.optimize.splat_method import PRUNE_AT
from training.rasterize import Gaussians, contributions, rasterize
from training.scenes.cameras import Camera
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import MAX_LEVELS, Bundle, Level
from training.splats.morton import spatial_order


def make(data, base=None, preset="draft", **values):
    values = {
        "steps": 12,
        "densify_until": 0.4,
        "prune_interval": 6,
        "tune_steps": 3,
        "margin": 0.0,
        "levels_from": "pruned",
        "keep": 1.0,
        **values,
    }
    return create("lodge", data, override(method_info("lodge").preset(preset), values), 0, "cpu", base)


def trained(lodge, begin=0, until=None):
    levels = []
    for step in range(begin, until or lodge.steps):
        lodge.train_step(step)
        levels += lodge.levels_after(step)
    return levels


def same(first: Splats, second: Splats) -> bool:
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


@pytest.fixture(scope="module")
def base(data) -> Splats:
    values = {"steps": 12, "margin": 0.0, "far_share": 0.0, "lr_final": 1.0}
    plain = create("3dgs", data, override(method_info("3dgs").preset("draft"), values), 0, "cpu")
    return trained(plain)[-1].splats


def test_levels_are_trained_finest_first(data):
    lodge = make(data, levels=3)
    assert lodge.steps == lodge.parameters.total_steps == 12 + 2 * 3 * 3
    levels = trained(lodge)
    assert [level.number for level in levels] == [3, 2, 1]
    d_l = [level.facts["d_l"] for level in levels]
    assert d_l[0] == 0 < d_l[1] < d_l[2]
    for level in levels[1:]:
        minimum = np.sqrt(0.2) * level.facts["d_l"] / data.focal
        assert np.exp(level.splats.log_scales).min() >= 0.9999 * minimum
        assert 0 < len(level.splats) <= len(levels[0].splats)


def test_base_is_the_finest_level(data, base):
    lodge = make(data, base)
    finest, *_ = levels = trained(lodge)
    ordered = base.select(spatial_order(base.means))
    assert finest.number == 3 and same(finest.splats, ordered)
    assert [level.number for level in levels] == [3, 2, 1] and lodge.steps == 18


def test_first_steps_are_3dgs(data):
    values = {"steps": 12, "densify_until": 0.4, "prune_interval": 6, "margin": 0.0}
    plain = create("3dgs", data, override(method_info("3dgs").preset("draft"), values), 0, "cpu")
    lodge = make(data, tune_steps=1)  # levels of three steps
    ends = [step for step in range(12) if lodge.ends_level(step)]
    assert ends == [step for step in range(12) if plain.ends_level(step)] == [11]
    for step in range(12):  # the last digits depend on the number of threads
        assert lodge.train_step(step).loss() == pytest.approx(plain.train_step(step).loss(), rel=1e-5)
    torch.testing.assert_close(lodge.model["means"], plain.model["means"])


def test_single_level_of_a_base_raises(data, base):
    with pytest.raises(LodgsError, match="single level"):
        make(data, base, levels=1)


def test_single_level_without_base_is_3dgs(data, base):
    lodge = make(data, levels=1)
    [level] = trained(lodge)
    assert (level.number, level.facts) == (1, {"d_l": 0.0})
    with pytest.raises(LodgsError, match="distances"):
        make(data, levels=2, distances=[1.0, 2.0])


def test_fixed_distances_are_used(data, base):
    lodge = make(data, base, distances=[3.0, 0.5, 0.0])
    d_l = {level.number: level.facts["d_l"] for level in trained(lodge)}
    assert d_l == pytest.approx({3: 0.0, 2: 0.5 * data.median_depth, 1: 3.0 * data.median_depth})
    assert lodge.costs == []


@pytest.mark.parametrize(
    "distances",
    [[0.7, 0.0, 0.0], pytest.param([0.7, 0.0, 0.0, 0.0], marks=pytest.mark.nightly), [0.7, 0.0, 0.6, 0.0]],
)
def test_chosen_distances_stay_below_fixed_ones(data, base, distances):
    lodge = make(data, base, levels=len(distances), distances=distances)
    trained(lodge)
    actual = [lodge.d_l[number] / data.median_depth for number in range(1, len(distances) + 1)]
    assert actual[0] == pytest.approx(0.7) and actual[-1] == 0
    assert all(coarser > finer for coarser, finer in pairwise(actual))


def test_training_selection_equals_bundle_selection(data, base):
    """Compare images of a step's blended levels with images of the bundle's selection."""
    lodge = make(data, base, distances=[1.3, 0.8, 0.0])
    levels = sorted(trained(lodge), key=lambda level: level.number)
    bundle, camera = Bundle("lodge", levels, "chunks"), data.train[2]
    drawn = {level.number: IndexedLevel.of(Gaussians.of(level.splats)) for level in reversed(levels)}
    for scale in (1.0, 1.4):
        splats, weights = select(
            bundle, camera.center, camera.focal, resolve_controls(bundle, {"distance_scale": scale})
        )
        assert weights is None
        rows = visible_rows(drawn, lodge.d_l, camera, 0.01, scale)
        assert sum(map(len, rows.values())) <= len(splats)
        first = rasterize(gather_rows(drawn, rows), camera, backend="reference").image
        second = rasterize(Gaussians.of(splats), camera, backend="reference").image
        torch.testing.assert_close(first, second)


def test_tuning_updates_only_its_level(data, base):
    lodge = make(data, base)
    trained(lodge, until=10)  # in the coarsest level
    initial = {n: [t.clone() for t in vars(level.gaussians).values()] for n, level in lodge.finished.items()}
    row = lodge.model["sh"].detach().clone()
    trained(lodge, 10, 12)
    assert sorted(initial) == [2, 3] and not torch.equal(row, lodge.model["sh"].detach())
    for number, tensors in initial.items():
        assert all(map(torch.equal, tensors, vars(lodge.finished[number].gaussians).values()))


def test_importance_equals_reference(data, base):
    """The reference weights are derivatives of an image of ones by each splat's own colour."""
    few = base.select(slice(0, 12))
    gaussians, camera = Gaussians.of(few), data.train[0]
    level = IndexedLevel.of(gaussians)
    stack = LevelStack({2: level, 1: level})
    assert stack.slices == {2: slice(0, 12), 1: slice(12, 24)}
    rows = {2: np.zeros(0, np.int32), 1: np.arange(12, dtype=np.int32)}
    actual = stack.importance([(camera, rows)], data.near, "cpu")
    assert (actual[:12] == 0).all()
    actual = actual[12 + 7 :]
    for row in range(7, 12):
        color = torch.zeros(12, 3)
        color[row] = 1.0
        single = Gaussians(
            gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits, color
        )
        image = rasterize(single, camera, near=data.near, backend="reference").image
        assert actual[row - 7] == pytest.approx(float(image.max()), abs=2e-5)


def test_paper_preset_matches_paper():
    p = method_info("lodge").preset("paper")
    assert isinstance(p, LodgeParameters)
    assert [round(share * p.steps) for share in PRUNE_AT] == [8000, 16_000, 24_000]  # A.2
    assert ROUNDS == (0.2, 0.6, 1.0) and p.level_steps == 3 * 1000


def test_antialiased_base_gives_antialiased_levels(data, base):
    """Importance and images use Mip-Splatting's filter for splats smaller than a pixel."""
    small = replace(base, log_scales=base.log_scales - np.float32(2))
    distances = {"distances": [1.2, 0.8, 0.0], "prune_weight": 0.0, "tune_alone": 0.0}
    lodge = make(data, small, antialias=True, **distances)
    trained(lodge, until=1)
    actual, levels = lodge.importance(2), {**lodge.finished, 2: lodge._smoothed_level(2)}
    for flag in (True, False):
        largest = torch.zeros(len(actual))
        for camera in data.train:
            rows = visible_rows(levels, lodge.d_l, camera, data.near)
            of_view = contributions(
                gather_rows(levels, rows), [camera], near=data.near, antialias=flag, backend="reference"
            ).largest
            rows_of_level = torch.from_numpy(rows[2]).long()
            largest[rows_of_level] = torch.maximum(
                largest[rows_of_level], of_view[len(of_view) - len(rows_of_level) :]
            )
        assert ((actual - largest).abs().max() < 1e-4) == flag
    assert lodge.meta()["antialias"] is True


def test_pruning_removes_unimportant_splats(data, base):
    unpruned = make(data, base, prune_weight=0.0, drawn=1.0, distances=[1.2, 0.8, 0.0])
    pruned = make(data, base, prune_weight=0.3, drawn=1.0, distances=[1.2, 0.8, 0.0])
    for lodge in (unpruned, pruned):
        trained(lodge, until=1)
    assert len(unpruned.model) == len(base)
    weights = unpruned.importance(2)
    assert len(pruned.model) < len(base)
    # the first of three prunings uses a fifth of the threshold; one step changes weights little
    assert len(pruned.model) == pytest.approx(int((weights >= 0.06).sum()), abs=2)


@pytest.mark.parametrize("drawn", [0.5, 0.8])
def test_views_by_distance_respect_drawn_limit(data, base, drawn):
    lodge = make(data, base, prune_weight=0.0, drawn=drawn, distances=[1.2, 0.6, 0.0])
    bundle = Bundle("lodge", sorted(trained(lodge), key=lambda level: level.number), "chunks")
    by_distance = finest = 0
    for camera in data.train:
        selected, _ = select(bundle, camera.center, camera.focal, resolve_controls(bundle, {}))
        by_distance += camera.sees(selected.means, data.near).sum()
        finest += camera.sees(base.means, data.near).sum()
    assert 0.8 * drawn < by_distance / finest <= drawn * 1.001


def test_levels_respect_keep_share(data, base):
    levels = trained(make(data, base, prune_weight=0.0, drawn=1.0, keep=0.4, distances=[1.2, 0.8, 0.0]))
    shares = {level.number: len(level.splats) / len(base) for level in levels}
    assert shares[2] == pytest.approx(0.4, abs=0.06) and shares[1] == pytest.approx(0.16, abs=0.06)


def test_cost_of_distances():
    """Two splats in front of a camera: a distance between them smooths the farther one."""
    pose = np.eye(4)
    camera = Camera("v", 64, 64, 64.0, 64.0, 32.0, 32.0, pose)
    means = np.float32([[0, 0, 2], [0, 0, 8]])
    splats = Splats(
        means, np.tile(np.float32([1, 0, 0, 0]), (2, 1)), np.log(np.float32([[0.02] * 3, [0.55] * 3])),
        np.full(2, 3.0, np.float32), np.zeros((2, 1, 3), np.float32),
    )  # fmt: skip
    thresholds = Thresholds([camera], 0.01, "cpu", prune_weight=0.001, std=lambda d: 0.5 * d / 64)
    levels, d_l = {2: IndexedLevel.of(Gaussians.of(splats))}, {2: 0.0}
    # both splats are small in the image and touch the corner of four of the 16 tiles
    assert thresholds.cost(levels, d_l, 5.0) == pytest.approx((4 + 4) / 16)
    assert thresholds.cost(levels, d_l, 20.0) == pytest.approx((4 + 4) / 16)
    # smoothed by 8 px, the far one touches all tiles
    wide = Thresholds([camera], 0.01, "cpu", prune_weight=0.0, std=lambda d: d / 5)
    assert wide.cost(levels, d_l, 5.0) == pytest.approx((4 + 16) / 16)
    assert thresholds.choose(levels, d_l)[1]["before"] == pytest.approx((4 + 4) / 16)
    # a pruned splat costs nothing
    pruned = Thresholds([camera], 0.01, "cpu", prune_weight=0.9, std=lambda d: d / 5)
    assert pruned.cost(levels, d_l, 5.0) == pytest.approx(4 / 16)


def test_splats_that_no_view_sees_have_distances():
    """Two splats behind a camera, at distances of 2 and 8."""
    camera = Camera("v", 64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    means = np.float32([[0, 0, -2], [0, 0, -8]])
    level = IndexedLevel.of(
        Gaussians.of(Splats(means, np.eye(4, dtype=np.float32)[:2], means, means[:, 0], means[:, None]))
    )
    _, report = Thresholds([camera], 0.01, "cpu", 0.02, lambda d: 0.0).choose({2: level}, {2: 0.0})
    assert 2 <= report["distances"][0] < report["distances"][-1] <= 8


def test_chosen_distance_has_least_cost(data, base):
    lodge = make(data, base)
    trained(lodge)
    assert [cost["level"] for cost in lodge.costs] == [2, 1]
    for cost in lodge.costs:
        assert len(cost["distances"]) == len(cost["costs"]) >= 1
        assert lodge.d_l[cost["level"]] == cost["distances"][int(np.argmin(cost["costs"]))]


@pytest.mark.parametrize("count", [MAX_CURVES, MAX_LEVELS])
def test_costs_fit_in_bundle_header(data, base, tmp_path, count):
    lodge = make(data, base, levels=count)
    numbers = [123.4] * CANDIDATES
    lodge.costs = [
        {"level": number, "distances": numbers, "costs": numbers, "before": 123.4}
        for number in range(1, count)
    ]
    splats = replace(base, extras={"chunks_0": np.zeros(len(base), np.float32)})
    levels = [Level(number, splats, {"d_l": 100 / 3 * number}) for number in range(1, count + 1)]
    meta = lodge.meta() | {"up_rotation": np.full((3, 3), -0.123456).tolist(), "seed": 1, "held_out": [0, 8]}
    tables = {"chunks": {"x": np.zeros(1, np.float32)}}
    write_bundle(tmp_path / "bundle.ply", Bundle("lodge", levels, "chunks", meta=meta, tables=tables))
    read = read_bundle(tmp_path / "bundle.ply").meta
    assert read.get("costs", []) == (lodge.costs if count == MAX_CURVES else [])


def test_resume_is_bit_identical(data, check_resumed):
    """Stop in the finest level, at its end, within a round, and at the ends of a round and a level."""
    check_resumed(lambda: make(data), 11, 12, 14, 15, 21)


def test_distances_vary_level_by_level_as_published(data, base):
    """A.2: U(0.7 d_l, 1.3 d_l) for each level; other presets have one factor for all."""
    lodge = make(data, base, preset="paper")
    lodge.d_l = {3: 0.0, 2: 1.0, 1: 1.5}
    drawn = [lodge.random_distances(step) for step in range(300)]
    assert {lodge.random_scale(step) for step in range(9)} == {1.0}
    first, second = (np.array([distances[number] for distances in drawn]) for number in (2, 1))
    assert {distances[3] for distances in drawn} == {0.0} and (second >= first).all()
    assert 0.7 <= first.min() < 0.72 and 1.28 < first.max() <= 1.3
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.5
    draft = make(data, base)
    draft.d_l = lodge.d_l
    scales = [draft.random_scale(step) for step in range(300)]
    assert draft.random_distances(0) == lodge.d_l and 1 / 1.3 <= min(scales) < max(scales) <= 1 / 0.7


@pytest.mark.parametrize("ratio", [1.3, 2.0])
def test_minimum_ratio_of_distances_is_a_parameter(data, base, ratio):
    level = IndexedLevel.of(make(data, base).model.gaussians)
    thresholds = Thresholds(data.train, data.near, "cpu", 0.02, lambda d: 0.0, min_ratio=ratio)
    near = 10 * data.median_depth  # beyond all splats, so that only the ratio counts
    assert thresholds._candidates(level, ratio * near, np.inf)[0] == pytest.approx(ratio * near, rel=1e-3)
    _, report = thresholds.choose({3: level}, {3: near})
    assert report["distances"][0] == pytest.approx(ratio * near, rel=1e-3)


def test_few_chunks_of_equation_5_are_made_in_preset_paper(data, base):
    """N = 4 / d_1 max |c_i - mean|, which is 3 here."""
    centers = np.array([camera.center for camera in data.train])
    reach = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    for preset, count in (("paper", 3), ("draft", 0)):
        lodge = make(data, base, preset=preset)
        lodge.d_l = {3: 0.0, 2: 4 * reach / 2.9}
        lodge._place_chunks()
        assert len(lodge.centers) == count


# -- merged levels ----------------------------------------------------------


def error(data, splats: Splats, factor: int) -> float:
    """Return the mean squared error over the training views, reduced by a factor."""
    errors = []
    for camera in data.train:
        view, target = reduce_view(camera, data.images.target(camera), factor)
        with torch.no_grad():
            image = rasterize(Gaussians.of(splats), view, near=data.near, antialias=True).image
        errors.append(float(((image - target.image) ** 2).mean()))
    return float(np.mean(errors))


def test_merged_levels_beat_merge_at_all_sizes(data, base):
    lodge = make(data, base, levels_from="merged", keep=0.5, tune_steps=15)
    assert lodge.steps == lodge.parameters.base_steps == 2 * 2 * 15
    levels = {level.number: level.splats for level in trained(lodge)}
    assert same(levels[3], base.select(spatial_order(base.means)))
    merged = base
    for number in (2, 1):
        assert 0 < len(levels[number]) <= len(levels[number + 1]) * 0.55
        merged = merge(merged, len(levels[number]))
        for factor in (1, 2, 4):
            assert error(data, levels[number], factor) < 0.97 * error(data, merged, factor)


def test_merged_levels_follow_the_rule_unsmoothed(data, base):
    lodge = make(data, base, levels_from="merged", distances=[1.3, 0.8, 0.0])
    coarse, middle, _ = sorted(trained(lodge), key=lambda level: level.number)
    d_l = [coarse.facts["d_l"], middle.facts["d_l"]]
    assert d_l == pytest.approx([1.3 * data.median_depth, 0.8 * data.median_depth])
    assert torch.equal(lodge._smoothed_level(1).gaussians.log_scales, lodge.model["log_scales"])
    assert len(coarse.splats) <= len(middle.splats) < len(base)


def test_merged_levels_train_on_all_sizes(data, base):
    lodge = make(data, base, levels_from="merged", tune_steps=200, tune_alone=0.6)
    lodge.train_step(0)
    factors, counts = np.unique([lodge.shrink(step) for step in range(400)], return_counts=True)
    np.testing.assert_array_equal(factors, [1, 2, 4])
    np.testing.assert_allclose(counts / 400, [0.85, 0.075, 0.075], atol=0.05)


def test_resumed_merged_levels_are_bit_identical(data, check_resumed):
    check_resumed(lambda: make(data, levels_from="merged", keep=0.5), 12, 14, 18)
