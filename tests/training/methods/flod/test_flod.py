"""Tests of FLoD: scale constraint, level changes, overlap pruning, schedules and finishing steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.lod.blocks import SIZE
from training.lod.rule import all_controls
from training.lod.selection import resolve_controls, select
from training.methods.flod import METHOD, finish
from training.methods.flod.train import Method, well_separated
from training.optimize.initialize import from_splats
from training.optimize.model import NAMES
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.rasterize import Gaussians, contributions, rasterize
from training.scenes.colmap import read_scene
from training.splats.levels import Bundle, Level
from training.splats.morton import spatial_order


def make(data, **values) -> Method:
    values = {
        "levels_from": "trained",
        "finish_share": 0.0,
        "levels": 3,
        "steps": [6, 6, 6],
        "footprint": 6.0,
        "overlap_interval": 0,
        **values,
    }
    return Method(data, override(METHOD.preset("draft"), values), seed=0, backend="cpu")


def test_footprint_is_in_pixels_at_the_median_depth(data):
    flod = make(data)
    assert flod.s_min[0] * data.focal / data.median_depth == pytest.approx(6.0)
    assert flod.s_min == pytest.approx([flod.s_min[0], flod.s_min[0] / 4, 0])


def test_absolute_minimum_size_is_used(data):
    assert make(data, s_min_1=0.125).s_min == pytest.approx([0.125, 0.03125, 0])


@pytest.mark.parametrize(
    "values",
    [{}, {"footprint": 40.0}, {"s_min_1": 0.125}, {"levels": 7, "rho": 3.0}, {"footprint": 4.0, "levels": 4}],
)
def test_finest_level_reach_is_independent_of_footprint(data, values):
    """In the paper: 40 pixels at the median depth, a ratio of 4 between levels, gamma 1 (Eq. 3, 8)."""
    flod = make(data, **({"levels": 5, "steps": 6, "footprint": 16.0} | values))
    (gamma,) = flod.controls.values()
    reach = flod.s_min[-2] / gamma * data.focal / data.median_depth
    assert reach == pytest.approx(40 / 4**3, rel=1e-5)


def test_gamma_of_presets(data):
    for preset, gamma in (("draft", 0.4), ("standard", 0.4), ("paper", 1.0)):
        flod = Method(data, METHOD.preset(preset), seed=0, backend="cpu")
        assert flod.controls == {"gamma": pytest.approx(gamma, rel=1e-5)}


@pytest.mark.parametrize("s_min_1, expected", [(1e-9, 0.01), (1e9, 1)])
def test_gamma_is_clamped(data, s_min_1, expected):
    assert make(data, s_min_1=s_min_1).controls == {"gamma": expected}
    assert all_controls()["gamma"].validate(expected) == expected
    assert make(data, levels=1, steps=[4]).controls == {}


@pytest.mark.slow
def test_splats_respect_minimum_size_of_ordered_levels(data):
    flod, finished = make(data, footprint=40.0), []  # larger than the distances of the points
    for step in range(flod.steps):
        assert flod.level_at(step) == step // 6 + 1
        flod.train_step(step)
        finished += flod.levels_after(step)
    assert [level.number for level in finished] == [1, 2, 3]
    for level in finished[:2]:
        assert np.exp(level.splats.log_scales).min() >= level.facts["s_min"] * (1 - 1e-6)
    assert np.exp(finished[0].splats.log_scales).min() < finished[0].facts["s_min"] * 1.2


def test_image_is_continuous_between_levels(data):
    flod = make(data, rejoin_points=False)

    def render_level(level):
        with torch.no_grad():
            return rasterize(
                flod.model.gaussians, data.train[0], min_scale=flod.s_min[level - 1], near=data.near
            ).image

    for step in range(6):
        flod.train_step(step)
    before = render_level(1)
    assert len(flod.levels_after(5)) == 1
    difference = (render_level(2) - before).abs().amax(-1)
    assert difference.max() < 1 / 255, "a splat may cross the minimum opacity of a pixel"
    assert (difference > 2e-5).float().mean() < 1e-3
    # with the constraint of level 1, the changed splats are larger
    assert (render_level(1) - before).abs().max() > 0.01


def test_points_rejoin_at_next_level(data):
    flod = make(data, min_opacity=0.0, densify_interval=100)
    points = torch.from_numpy(np.unique(data.scene.points, axis=0))
    flod.model.keep(torch.arange(len(points)) % 2 == 0)  # simulate pruning
    remaining = flod.model["means"].detach().clone()
    flod.start_level(2)
    distances = torch.cdist(points, remaining).min(1).values
    expected = points[distances >= flod.s_min[1] / 2]
    assert 0 < len(expected) < len(points)
    assert torch.equal(flod.model["means"].detach(), torch.cat([remaining, expected]))


def test_rejoining_points_are_sampled_to_budget(data):
    """The sample fills the budget, spreads over the scene and depends on the seed only."""
    models = []
    for _ in range(2):
        flod = make(data, min_opacity=0.0, densify_interval=100, max_splats=50, budget_ratio=0.8)
        points = flod.points
        flod.model.keep(torch.arange(len(flod.model)) < 10)
        flod.start_level(2)
        assert len(flod.model) == 36  # nine tenths of 50 x 0.8; margins get the rest
        models.append(flod.model["means"].detach())
    assert torch.equal(*models)
    joined = {tuple(mean) for mean in models[0][10:].tolist()}
    assert len(joined) == 26 and joined <= {tuple(point) for point in np.float32(points).tolist()}
    assert {tuple(point) for point in np.float32(points[10:36]).tolist()} != joined


def test_initial_points_are_limited_to_max_splats(data):
    flod = make(data, max_splats=20)
    assert len(flod.points) == 18  # a tenth is reserved for margins
    assert len(flod.model) == 7 == int(20 * 0.6**2)
    all_points = {tuple(point) for point in data.scene.points.tolist()}
    assert {tuple(point) for point in flod.points.tolist()} < all_points


def test_overlap_pruning_equals_brute_force():
    means = torch.from_numpy(np.random.default_rng(3).normal(size=(300, 3)).astype(np.float32))
    distances = torch.cdist(means.double(), means.double())
    mean_of_three = distances.sort(1).values[:, 1:4].mean(1)
    assert torch.equal(well_separated(means, 0.35), mean_of_three >= 0.35)
    assert 0 < well_separated(means, 0.35).sum() < 300


def test_overlap_pruning_skips_last_level(data):
    flod = make(data, overlap_interval=1, s_min_1=1e6, steps=[1, 1, 4], densify_until=1.0)
    with pytest.raises(LodgsError, match="footprint"):  # prunes all splats of level 1
        flod.train_step(0)
    last = make(data, overlap_interval=1, levels=1, steps=[4], densify_until=1.0)
    count = len(last.model)
    last.train_step(0)
    assert len(last.model) == count


@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_levels_respect_their_budgets(data, margin):
    flod = make(
        data, margin=margin, s_min_1=1e-3, steps=[12, 12, 12], densify_interval=2, densify_until=1.0,
        grad_threshold=0.0, max_splats=200, budget_ratio=0.5, min_opacity=0.0, rejoin_points=False,
    )  # fmt: skip
    counts = []
    for step in range(flod.steps):
        flod.train_step(step)
        counts += [len(level.splats) for level in flod.levels_after(step)]
    if not margin:
        assert counts == [50, 100, 200]
    # a tenth of each budget is reserved for margins
    assert 45 <= counts[0] <= 50 and 90 <= counts[1] <= 100 and 180 <= counts[2] <= 200


def test_gradients_are_averaged_over_visible_views(data):
    flod = make(data, densify_interval=100, prune_interval=100)
    for step in range(3):
        flod.train_step(step)
    visible, gradient_sum = flod.model.stats["seen"], flod.model.stats["gradient_sum"]
    assert 0 < visible.max() <= 3
    assert (gradient_sum[visible == 0] == 0).all()
    assert torch.equal(flod.model.mean_gradient(), gradient_sum / visible.clamp_min(1))


def test_duplicate_points_train_and_too_few_raise(data, tiny_scene, tmp_path):
    from dataclasses import replace

    scene = read_scene(tiny_scene)
    double = replace(
        scene, points=np.repeat(scene.points, 2, 0), point_colors=np.repeat(scene.point_colors, 2, 0)
    )
    assert len(make(TrainingData(double)).model) == len(np.unique(scene.points, axis=0))
    few = replace(scene, points=scene.points[:3], point_colors=scene.point_colors[:3])
    with pytest.raises(LodgsError, match="at least 4"):
        make(TrainingData(few))


def train_until_finishing(data, **values) -> tuple[Method, list[Level]]:
    """Return a run before its first finishing step, and its completed levels."""
    values = {"finish_share": 0.5, "footprint": 40.0, "random_background": False, **values}
    flod, levels = make(data, **values), []
    for step in range(18):
        flod.train_step(step)
        levels += flod.levels_after(step)
    return flod, levels


def test_finishing_starts_from_completed_levels(data):
    flod, completed = train_until_finishing(data, levels=4, steps=[3, 5, 5, 5])
    assert flod.steps == 27 and [level.number for level in completed] == [1, 2, 3, 4]
    starting = finish.split_levels(flod.model, flod.s_min)
    assert [level.number for level in starting] == [2, 3, 4], "the three finest levels"
    for level, starting_level in zip(completed[1:], starting, strict=True):
        assert level.facts == starting_level.facts
        for name in NAMES:
            np.testing.assert_array_equal(getattr(level.splats, name), getattr(starting_level.splats, name))


def projected_area(scales: np.ndarray) -> np.ndarray:
    """Return the root mean square area (N,) of projections of ellipsoids (N, 3) in all directions."""
    bases, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(300, 3, 2)))
    squares = [np.linalg.det(np.einsum("mki,k,mkj->mij", bases, axes**2, bases)).mean() for axes in scales]
    return np.sqrt(squares)


def test_fine_levels_restart_from_important_splats(data):
    """The reference rasterizer gives the weights; views include the margins."""
    flod, completed = train_until_finishing(data, footprint=1.0, drawn=0.6, margin=0.25)
    finest, (*coarser, last) = completed[-1].splats, finish.split_levels(flod.model, flod.s_min)
    assert_same(last.splats, finest)
    widened = [camera.widened(0.25) for camera in data.train]
    shares = contributions(
        Gaussians.of(finest), widened, near=data.near, antialias=True, backend="reference"
    ).largest.numpy()
    assert [level.number for level in coarser] == [1, 2]
    for level in coarser:
        row_of_mean = {tuple(mean): row for row, mean in enumerate(finest.means.tolist())}
        rows = [row_of_mean[tuple(mean)] for mean in level.splats.means.tolist()]
        assert len(set(rows)) == len(rows)
        assert shares[rows].min() >= np.delete(shares, rows).max() - 1e-4
        np.testing.assert_array_equal(level.splats.sh, finest.sh[rows])
        scales = np.exp(level.splats.log_scales)
        assert scales.min() >= level.facts["s_min"] * (1 - 1e-6)
        unconstrained = scales > level.facts["s_min"] * (1 + 1e-6)
        # the remaining splats of a block grow to cover the area of removed ones
        enlargement = (scales / np.exp(finest.log_scales[rows]))[unconstrained]
        assert enlargement.min() >= 1 - 1e-6 and 1.02 < enlargement.max() <= 2 + 1e-6
        assert len(np.unique(enlargement.round(3))) <= -(-len(finest) // SIZE)
    first, second = (len(level.splats) for level in coarser)
    assert first == pytest.approx(0.8 * second, abs=1)


@pytest.mark.nightly
def test_enlarged_splats_become_fainter(data):
    """Applies to the antialiasing filter; without it small splats are already drawn enlarged."""
    flod, completed = train_until_finishing(data, footprint=1.0, drawn=0.6)
    levels = {level.number: from_splats(level.splats, 3, torch.device("cpu")) for level in completed}
    finest = levels[3]
    finest["log_scales"] -= torch.tensor([6.0, 5.0, 7.0])
    for antialias in (True, False):
        p = replace(flod.parameters, antialias=antialias)
        gamma = flod.controls["gamma"]
        limits = {1: 10**6, 2: 10**6}
        restarted = finish.restart_levels(levels, limits, flod.s_min, data, p, p.drawn, gamma, "cpu")[2]
        row_of_mean = {tuple(mean): row for row, mean in enumerate(finest["means"].tolist())}
        rows = [row_of_mean[tuple(mean)] for mean in restarted["means"].tolist()]
        trained_scales, enlarged_scales = (
            finest["log_scales"][rows].exp().numpy(),
            restarted["log_scales"].exp().numpy(),
        )
        ratio = (restarted["opacity_logits"].sigmoid() / finest["opacity_logits"][rows].sigmoid()).numpy()
        if not antialias:
            np.testing.assert_array_equal(ratio, 1)
            continue
        expected = projected_area(trained_scales) / projected_area(enlarged_scales)
        assert np.median(expected) < 0.1
        # the remaining splats of a block also cover the area of removed ones, at most four times theirs
        growth, block = ratio / expected, np.argsort(spatial_order(finest["means"].numpy()))[rows] // SIZE
        for number in set(block):
            assert np.ptp(growth[block == number]) < 0.05 * growth[block == number].max() <= 0.25


def test_restarted_levels_respect_their_budgets(data):
    flod, _ = train_until_finishing(data, footprint=1.0, drawn=1.0, budget_ratio=0.5, max_splats=60)
    counts = [len(level.splats) for level in finish.split_levels(flod.model, flod.s_min)]
    assert counts[:2] == [15, 30] and counts[2] > 45


@pytest.mark.parametrize("drawn", [0.5, pytest.param(0.8, marks=pytest.mark.nightly)])
def test_views_by_distance_respect_drawn_limit(data, drawn):
    flod, completed = train_until_finishing(data, footprint=1.0, drawn=drawn)
    levels = finish.split_levels(flod.model, flod.s_min)
    bundle, by_distance, finest = Bundle("flod", levels, "bands"), 0, 0
    for camera in data.train:
        values = resolve_controls(bundle, flod.controls)
        selected, _ = select(bundle, camera.center, camera.focal, values)
        by_distance += camera.sees(selected.means, data.near).sum()
        finest += camera.sees(completed[-1].splats.means, data.near).sum()
    assert 0.9 * drawn < by_distance / finest <= drawn


@pytest.mark.parametrize("alone_share", [0.0, 1.0])
def test_finishing_steps_render_rule_selection(data, alone_share):
    flod, completed = train_until_finishing(data, finish_alone=alone_share)
    bundle, gammas = Bundle("flod", completed, "bands"), set()
    for step in range(18, 27):
        view, values = flod.choose_view(step), flod._finishing_values(step)
        assert (values["first"] == values["last"]) == bool(alone_share)
        gammas.add(values["gamma"])
        assert 1 / 1.3 <= values["gamma"] / flod.controls["gamma"] <= 1.3
        splats, weights = select(bundle, view.camera.center, view.camera.focal, values)
        with torch.no_grad():
            drawn = flod.draw(view, step)[0].rendering.image
            expected = rasterize(
                Gaussians.of(splats), view.camera, near=data.near, sh_degree=flod.sh_degree(step),
                antialias=True,
            )  # fmt: skip
        assert weights is None and 0 < len(splats) < sum(len(level.splats) for level in completed)
        torch.testing.assert_close(drawn, expected.image)
    last_levels = {flod._finishing_values(step)["last"] for step in range(18, 60)}
    assert len(gammas) == 9 and last_levels == ({1, 2, 3} if alone_share else {3})


def test_finest_level_is_rendered_alone_twice_as_often(data):
    flod, _ = train_until_finishing(data)
    rng = np.random.default_rng(0)
    values = [finish.random_values(rng, 1.0, flod.model, 0.5) for _ in range(8000)]
    alone_levels = [item["last"] for item in values if item["first"] == item["last"]]
    ranges = {(item["first"], item["last"]) for item in values if item["first"] != item["last"]}
    assert ranges == {(1, 3)}
    assert len(alone_levels) / 8000 == pytest.approx(0.5, abs=0.03)
    assert [alone_levels.count(n) / len(alone_levels) for n in (1, 2, 3)] == pytest.approx(
        [0.25, 0.25, 0.5], abs=0.03
    )


def test_finishing_keeps_minimum_sizes_and_counts(data):
    flod, completed = train_until_finishing(data, finish_alone=1.0, finish_share=1.0)
    for step in range(18, 36):
        flod.train_step(step)
        final = flod.levels_after(step)
        assert bool(final) == (step == 35) and flod.level_at(step) == 3
    for level, finished_level in zip(completed, final, strict=True):
        assert (level.number, len(level.splats), level.facts) == (
            finished_level.number,
            len(finished_level.splats),
            finished_level.facts,
        )
        assert not np.array_equal(level.splats.sh, finished_level.splats.sh)
        assert np.exp(finished_level.splats.log_scales).min() >= finished_level.facts["s_min"] * (1 - 1e-6)


def test_single_level_has_no_finishing(data):
    flod = make(data, levels=1, steps=[4], finish_share=1.0)
    assert flod.steps == 4


def test_resume_is_bit_identical(data, check_resumed):
    """Stops before the last level, after it, and in the finishing steps."""
    check_resumed(lambda: make(data, finish_share=0.5, footprint=1.0), 8, 18, 21)


# -- runs of some levels ----------------------------------------------------


def trained(flod) -> list[Level]:
    finished = []
    for step in range(flod.steps):
        flod.train_step(step)
        finished += flod.levels_after(step)
    return finished


def assert_same(first, second):
    for name in NAMES:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_coarse_levels_alone_equal_full_run(data):
    """Constraint, budgets and schedules stay the same if the finest level is trained separately."""
    values = {"levels": 4, "steps": [4, 5, 6, 7], "sh_interval": 3, "finish_share": 0.2, "max_splats": 90}
    full_run, coarse = make(data, **values), make(data, **values, last_level=2)
    assert coarse.steps == 9 and full_run.steps == 26
    levels = trained(coarse)
    for step in range(9):
        full_run.train_step(step)
        for level in full_run.levels_after(step):
            coarse_level = levels.pop(0)
            assert (coarse_level.number, coarse_level.facts) == (level.number, level.facts)
            assert_same(coarse_level.splats, level.splats)
    assert not levels and coarse.controls == full_run.controls


def test_fine_levels_continue_from_coarse_level(data):
    values = {
        "levels": 4,
        "steps": [4, 5, 6, 7],
        "sh_interval": 3,
        "rejoin_points": False,
        "min_opacity": 0.0,
    }
    base = trained(make(data, **values, last_level=2))[-1].splats
    parameters = override(METHOD.preset("draft"), values | {"first_level": 3, "footprint": 6.0})
    fine = Method(data, parameters, seed=0, backend="cpu", base=base)
    np.testing.assert_array_equal(fine.model["means"].detach(), base.means)
    allowed = np.maximum(np.exp(base.log_scales), fine.s_min[2] * 1.05)
    drawn = fine.model["log_scales"].detach().exp().numpy() + fine.s_min[2]
    np.testing.assert_allclose(drawn, allowed, rtol=1e-5)
    assert [fine.level_at(step) for step in (0, 5, 6, 12)] == [3, 3, 4, 4]
    assert fine.sh_degree(0) == 9 // 3, "the degree of harmonics continues"
    full_run = make(data, **values, finish_share=0.2)
    assert [fine.shrink(step) for step in range(13)] == [full_run.shrink(step) for step in range(9, 22)]
    levels = trained(fine)
    assert [level.number for level in levels] == [3, 4, 2, 3, 4], "finishing steps include level 2"
    assert [level.facts["s_min"] for level in levels[:2]] == full_run.s_min[2:]


@pytest.mark.parametrize("first, last", [(3, 2), (1, 5), (5, 0)])
def test_invalid_level_range_raises(first, last):
    with pytest.raises(LodgsError, match="Cannot train levels"):
        override(METHOD.preset("draft"), {"levels": 4, "first_level": first, "last_level": last})


def test_cells_train_the_two_finest_levels():
    coarse, fine = METHOD.split_parameters(METHOD.preset("draft"))
    assert (coarse.first_level, coarse.end, fine.first_level, fine.end) == (1, 3, 4, 5)
    trained = replace(METHOD.preset("draft"), levels_from="trained")
    assert coarse.total_steps + fine.total_steps == trained.total_steps
    assert METHOD.split_parameters(override(METHOD.preset("draft"), {"levels": 2})) is None
    draft = METHOD.preset("draft")
    assert draft.max_trained_splats == pytest.approx(draft.max_splats * (1 + draft.drawn + 0.25))
    assert trained.max_trained_splats == pytest.approx(draft.max_splats * (1 + 0.6 + 0.36))
    assert coarse.max_trained_splats == pytest.approx(draft.max_splats * 0.36)
