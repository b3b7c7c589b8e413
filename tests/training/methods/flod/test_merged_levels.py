"""Tests of FLoD's merged levels: order, counts, previews and gain by refinement."""

from dataclasses import replace

import numpy as np
import torch

from training.methods.flod import METHOD
from training.methods.flod.train import Method
from training.optimize.merging import merge
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize


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


def error(flod, splats) -> float:
    """Return the mean squared error over the training views."""
    errors = []
    for camera in flod.data.train:
        with torch.no_grad():
            image = rasterize(Gaussians.of(splats), camera, near=flod.data.near, antialias=True).image
        errors.append(float(((image - flod.data.images.target(camera).image) ** 2).mean()))
    return float(np.mean(errors))


def test_finest_level_is_first_after_previews(data):
    flod = make(data, free_depth=0.0, largest=0.0)
    handed = [(step, trained, level.number, len(level.splats)) for step, trained, level in train(flod)]
    # the finest has 60 - 10 - 8 steps; a third and two thirds of them
    assert [entry[:3] for entry in handed] == [(14, 3, 1), (28, 3, 2), (42, 3, 3), (52, 2, 2), (60, 1, 1)]
    finest, middle, coarse = (entry[3] for entry in handed[2:])
    assert middle == round(finest / 2) and coarse == round(middle / 2)


def test_refined_levels_beat_merge(data):
    flod = make(data, margin=0.0, steps=[60, 60, 60], refine_steps=30, merge_ratio=0.3)
    levels = {level.number: level.splats for _, _, level in train(flod)}
    assert len(levels) == 3
    for number in (1, 2):
        assert error(flod, levels[number]) < 0.97 * error(flod, merge(levels[3], len(levels[number])))


def test_merge_drops_invisible_splats(data):
    """Splats that no training view sees take no room in the second finest level."""
    flod = make(data, margin=0.0, steps=[2, 2, 2], refine_steps=1)
    rows = flod.model.read_rows(torch.arange(20))
    behind = torch.tensor(
        np.mean([c.center - 50 * c.world_to_camera[2, :3] for c in flod.data.train], axis=0)
    )
    flod.model.append(rows | {"means": rows["means"] * 0.01 + behind.float()})
    count = len(flod.model)
    flod.start_level(2)
    assert len(flod.model) == round(count / 2)
    assert (flod.model["means"] - behind).norm(dim=1).min() > 1


def test_refinement_starts_with_small_images(data):
    """Images of each merged level grow from ``first_resolution`` to full size."""
    flod = make(data, first_resolution=0.5, full_resolution=0.5)
    assert [flod.shrink(step) for step in (42, 47, 51)] == [2, 1, 1]
    assert [flod.shrink(step) for step in (52, 56, 59)] == [2, 1, 1]


def test_finishing_steps_keep_all_merged_splats(data):
    flod = make(data, finish_share=0.2, free_depth=0.0, largest=0.0)
    handed = [(step, level.number, len(level.splats)) for step, _, level in train(flod)]
    assert flod.steps == 63, "a third as many as refine the second finest level"
    assert [entry[:2] for entry in handed[-3:]] == [(63, 1), (63, 2), (63, 3)]
    counts = {number: count for _, number, count in handed[:-3]}
    assert {number: count for _, number, count in handed[-3:]} == counts


def test_paper_trains_coarse_levels_first(data):
    assert [number for number, _ in METHOD.preset("paper").stages] == [1, 2, 3, 4, 5]
    assert [number for number, _ in METHOD.preset("draft").stages] == [5, 4, 3, 2, 1]
    assert METHOD.preset("draft").total_steps == METHOD.preset("draft").all_steps


def test_runs_of_some_levels_train_them():
    draft = METHOD.preset("draft")
    assert [number for number, _ in replace(draft, first_level=4).stages] == [4, 5]
    assert [number for number, _ in replace(draft, last_level=2).stages] == [1, 2]
