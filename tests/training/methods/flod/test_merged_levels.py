"""Tests of FLoD's merged levels: order, counts, previews, gain by refinement and distances."""

from dataclasses import replace

import numpy as np
import torch

from training.evaluate.views import reduce_view
from training.lod.selection import resolve_controls, select
from training.methods.flod import METHOD, finish
from training.methods.flod.train import Method
from training.optimize.level_distances import choose_switch
from training.optimize.merging import merge
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize
from training.splats.levels import Bundle


def make(data, **values) -> Method:
    values = {"levels": 3, "steps": [20, 20, 20], "refine_steps": 10, "finish_share": 0.0, **values}
    return Method(data, override(METHOD.preset("draft"), values), seed=0, backend="cpu")


def train(flod):
    """Train all steps; yield step, level and the levels that the step finished."""
    for step in range(flod.steps):
        level = flod.level_at(step)
        flod.train_step(step)
        for finished in flod.levels_after(step):
            yield step + 1, level, finished


def error(flod, splats, factor: int = 1) -> float:
    """Return the mean squared error over the training views, reduced by a factor."""
    errors = []
    for camera in flod.data.train:
        view, target = reduce_view(camera, flod.data.images.target(camera), factor)
        with torch.no_grad():
            image = rasterize(Gaussians.of(splats), view, near=flod.data.near, antialias=True).image
        errors.append(float(((image - target.image) ** 2).mean()))
    return float(np.mean(errors))


def test_single_splat_is_merged_to_one(data):
    *_, coarse, middle, finest = (level for _, _, level in train(make(data, max_splats=1, margin=0.0)))
    assert len(coarse.splats) == len(middle.splats) == len(finest.splats) == 1


def test_finest_level_is_first_after_previews(data):
    flod = make(data, free_depth=0.0, largest=0.0)
    completed = [(step, trained, level.number, len(level.splats)) for step, trained, level in train(flod)]
    # the finest level has 60 - 10 - 7 steps, with previews after a third and two thirds
    assert [entry[:3] for entry in completed] == [
        *((15, 3, 1), (29, 3, 2), (43, 3, 3), (53, 2, 2)),
        *((60, 1, number) for number in (1, 2, 3)),  # final levels with distances
    ]
    coarse, middle, finest = (entry[3] for entry in completed[4:])
    assert middle == round(0.45 * finest), "as many as views by distance may draw"
    assert coarse == round(finest / 4)


def test_refined_levels_beat_merge(data):
    flod = make(data, margin=0.0, steps=[60, 60, 60], refine_steps=30, merge_ratio=0.3)
    levels = {level.number: level.splats for _, _, level in train(flod)}
    assert len(levels) == 3
    for number in (1, 2):
        merged = merge(levels[3], len(levels[number]))
        for factor in (1, 2, 4):
            assert error(flod, levels[number], factor) < 0.97 * error(flod, merged, factor)


def test_merge_drops_invisible_splats(data):
    """The second finest level has no splats that no training view sees."""
    flod = make(data, margin=0.0, steps=[2, 2, 2], refine_steps=1, drawn=0.6)
    rows = flod.model.read_rows(torch.arange(20))
    behind_cameras = torch.tensor(
        np.mean([c.center - 50 * c.world_to_camera[2, :3] for c in flod.data.train], axis=0)
    )
    flod.model.append(rows | {"means": rows["means"] * 0.01 + behind_cameras.float()})
    count = len(flod.model)
    flod._store(3, flod.model.splats())
    flod.start_level(2)
    assert len(flod.model) == round(count / 2)
    assert (flod.model["means"] - behind_cameras).norm(dim=1).min() > 1


def test_finest_level_has_full_images_after_its_own_share(data):
    """The schedule of the finest level counts its own steps, not those of the run, so that it densifies on
    almost full-size images.
    """
    flod = make(
        data, steps=[400] * 3, refine_steps=300, first_resolution=0.5, full_resolution=0.5, far_share=0.0
    )
    end = flod.stages.ends[0]
    factors = [flod.shrink(step) for step in range(end)]
    assert factors[0] > 1.4
    np.testing.assert_array_equal(factors[end // 2 :], 1)


def test_refinement_starts_with_small_images(data):
    """Images of each merged level grow from ``first_resolution`` to full size; some remain small."""
    flod = make(data, steps=[700] * 3, refine_steps=600, first_resolution=0.5, full_resolution=0.5)
    for begin, end in zip(flod.stages.ends, flod.stages.ends[1:], strict=False):
        middle = (begin + end) // 2
        factors, counts = np.unique([flod.shrink(step) for step in range(middle, end)], return_counts=True)
        np.testing.assert_array_equal(factors, [1, 2, 4])
        np.testing.assert_allclose(counts / (end - middle), [0.75, 0.125, 0.125], atol=0.08)
        assert min(flod.shrink(step) for step in range(begin, begin + 20)) > 1.4


def test_refinement_has_no_dropout(data):
    flod = make(data, dropout=0.5)
    weights = [flod.render_weights(flod.data.view(0), step)[0] is None for step in (0, 44, 54)]
    assert weights == [False, True, True]


def test_finishing_steps_keep_all_merged_splats(data):
    flod = make(data, refine_steps=15, finish_share=0.2, free_depth=0.0, largest=0.0)
    completed = [(step, level.number, len(level.splats)) for step, _, level in train(flod)]
    assert flod.steps == 63, "a fifth of the steps that refine the second finest level"
    assert [entry[:2] for entry in completed[-3:]] == [(63, 1), (63, 2), (63, 3)]
    counts = {number: count for _, number, count in completed[:-3]}
    assert {number: count for _, number, count in completed[-3:]} == counts


def test_switch_has_least_error_within_the_budget():
    rng = np.random.default_rng(1)
    errors, counts = rng.uniform(1, 2, (5, 2)), np.sort(rng.uniform(0, 1, (5, 2)))
    coarser, finest = counts.sum(0)
    for limit in np.linspace(coarser, finest, 6):
        choices = {}
        for switch in range(6):
            error, splats = (a[:switch, 1].sum() + a[switch:, 0].sum() for a in (errors, counts))
            if splats <= limit + 1e-9:
                choices[switch] = error
        best = min(choices, key=choices.__getitem__)
        assert choose_switch(errors, counts, (limit + 1e-9) / finest) == best
    assert choose_switch(np.array([[2.0, 1.0]] * 5), counts, 1) == 5


def test_second_finest_level_may_be_drawn_everywhere():
    """The level has the allowed share of all splats, but the views may see a slightly larger share."""
    errors, counts = np.array([[2.0, 1.0]] * 4), np.array([[46.0, 100.0]] * 4)
    assert choose_switch(errors, counts, 0.45) == 0
    assert choose_switch(errors, counts, 0.6) == 1, "one bin of the finest level"


def test_coarser_levels_begin_beyond_the_photos(data):
    """Only the two finest levels are drawn at distances that the training views show."""
    flod = make(data)
    for _ in train(flod):
        pass
    distances = [size * data.focal / flod.controls["gamma"] for size in flod.s_min]
    means = flod.completed[3]["means"].numpy()
    seen = [np.linalg.norm(means[c.sees(means, data.near)] - c.center, axis=1) for c in data.train]
    assert distances[1] <= np.median(np.concatenate(seen)) < distances[0]
    assert distances[0] > distances[1] > distances[2] == 0


def test_finishing_step_leaves_other_levels(data):
    """A finishing step of a single level changes only this level."""
    flod = make(
        data, levels=4, steps=[30] * 4, refine_steps=20, finish_share=0.2, finish_alone=1.0,
        free_depth=0.0, largest=0.0,
    )  # fmt: skip
    for step in range(flod.steps):
        if flod.is_finishing(step):
            drawn = flod._finishing_values(step)["last"]
            before = {level.number: level.splats for level in finish.split_levels(flod.model, flod.s_min)}
        flod.train_step(step)
        if flod.is_finishing(step):
            after = {level.number: level.splats for level in finish.split_levels(flod.model, flod.s_min)}
            changed = [n for n in after if not np.array_equal(before[n].means, after[n].means)]
            assert changed == [drawn]
        flod.levels_after(step)
    assert flod.is_finishing(flod.steps - 2), "a first step has no moments"


def test_distances_draw_at_most_the_share_of_splats(data):
    """The bundle's own rule counts the splats."""
    shares = []
    for drawn in (0.35, 0.6):
        flod = make(data, margin=0.0, merge_ratio=0.4, drawn=drawn, levels=4, steps=[15] * 4)
        levels = {level.number: level for _, _, level in train(flod)}
        bundle = Bundle("flod", [levels[number] for number in (1, 2, 3, 4)], "bands", controls=flod.controls)
        sizes = [level.facts["s_min"] for level in bundle.levels]
        assert sizes == flod.s_min and sizes == sorted(sizes, reverse=True) and sizes[2] > 0 == sizes[3]
        values = resolve_controls(bundle, flod.controls)
        switch = sizes[2] * data.focal / values["gamma"]
        counts = np.zeros(3)
        for camera in data.train:
            selected, _ = select(bundle, camera.center, camera.focal, values)
            means, finest = (s.means[camera.sees(s.means, data.near)] for s in (selected, levels[4].splats))
            beyond = np.linalg.norm(means - camera.center, axis=1) >= switch
            counts += len(means), beyond.sum(), len(finest)
        shares.append(counts[:2] / counts[2])
    # views may draw level 3 everywhere, but the finest level where it is nearer than all pixels
    assert 0.16 < shares[0][1] <= 0.35
    assert 0.38 < shares[1][0] <= 0.6


def test_resumed_run_keeps_distances(data, check_resumed):
    check_resumed(lambda: make(data, levels=4, steps=[9] * 4, finish_share=0.2, refine_steps=20), 28, 37)


def test_paper_trains_coarse_levels_first(data):
    assert [number for number, _ in METHOD.preset("paper").stages] == [1, 2, 3, 4, 5]
    assert [number for number, _ in METHOD.preset("draft").stages] == [5, 4, 3, 2, 1]
    assert METHOD.preset("draft").total_steps == METHOD.preset("draft").all_steps


def test_runs_of_some_levels_train_them():
    draft = METHOD.preset("draft")
    assert [number for number, _ in replace(draft, first_level=4).stages] == [4, 5]
    assert [number for number, _ in replace(draft, last_level=2).stages] == [1, 2]
