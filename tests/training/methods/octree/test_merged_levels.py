"""Tests of Octree-GS's merged levels: order, counts, distances and resumed runs."""

import io

import numpy as np
import torch

from training.lod.selection import resolve_controls, select, standalone_levels
from training.methods.octree import METHOD
from training.methods.octree.train import Method
from training.optimize.merging import merge
from training.optimize.parameters import override
from training.rasterize import Gaussians, rasterize
from training.runs import train as training_loop
from training.runs.job import Job
from training.splats.bundle import read_bundle
from training.splats.levels import Bundle


def make(data, **values) -> Method:
    values = {
        "levels": 3, "coarser_levels": 0, "footprint": 12.0, "steps": 40, "grow_interval": 5, "margin": 0.0,
        "merged_levels": 2, "refine_steps": 10, **values,
    }  # fmt: skip
    return Method(data, override(METHOD.preset("draft"), values), seed=0, backend="cpu")


def train(octree):
    """Train all steps; yield step, level and the levels that the step finished."""
    for step in range(octree.steps):
        level = octree.level_at(step)
        octree.train_step(step)
        for finished in octree.levels_after(step):
            yield step + 1, level, finished


def error(octree, splats) -> float:
    """Return the mean squared error over the training views."""
    errors = []
    for view in range(len(octree.data.train)):
        camera, target = octree.data.train[view], octree.data.target(view)
        with torch.no_grad():
            image = rasterize(Gaussians.of(splats), camera, near=octree.data.near, antialias=True).image
        errors.append(float(((image - target.image) ** 2).mean()))
    return float(np.mean(errors))


def test_anchors_are_the_finest_level(data):
    """The finest level has the anchors of all levels, and is the same as without merged levels."""
    octree, anchors = make(data), make(data, levels_from="anchors")
    completed = list(train(octree))
    assert [(step, trained, level.number) for step, trained, level in completed] == [
        *((8, 3, 3), (40, 3, 3), (50, 2, 2)),  # all anchors have joined, are trained; a refined level
        *((57, 1, number) for number in (1, 2, 3)),  # all levels with distances
    ]
    coarse, middle, finest = (level.splats for _, _, level in completed[-3:])
    assert (len(middle), len(coarse)) == (round(0.45 * len(finest)), round(len(finest) / 4))
    expected = np.concatenate([level.splats.means for step, _, level in train(anchors) if step == 40])
    np.testing.assert_array_equal(np.unique(finest.means, axis=0), np.unique(expected, axis=0))
    assert (METHOD.rule_for(octree.parameters), octree.facts) == ("bands", {})
    assert METHOD.rule_for(anchors.parameters) == "octree" and anchors.facts.keys() == {
        "d_max",
        "d_max_focal",
    }


def test_refined_levels_beat_merge(data):
    octree = make(data, steps=60, refine_steps=30)
    levels = {level.number: level.splats for _, _, level in train(octree)}
    for number in (1, 2):
        merged = merge(levels[3], len(levels[number]))
        assert error(octree, levels[number]) < 0.97 * error(octree, merged)


def test_views_draw_at_most_the_share_of_splats(data):
    octree = make(data, drawn=0.4)
    levels = {level.number: level for _, _, level in train(octree)}
    bundle = Bundle("octree", [levels[number] for number in (1, 2, 3)], "bands")
    sizes = [level.facts["s_min"] for level in bundle.levels]
    assert sizes == octree.s_min and sizes == sorted(sizes, reverse=True) and sizes[1] > 0 == sizes[2]
    values = resolve_controls(bundle, octree.controls)
    switch = sizes[1] * data.focal / values["gamma"]
    counts = np.zeros(2)
    for camera in data.train:
        selected, _ = select(bundle, camera.center, camera.focal, values)
        means, finest = (s.means[camera.sees(s.means, data.near)] for s in (selected, levels[3].splats))
        beyond = np.linalg.norm(means - camera.center, axis=1) >= switch
        counts += beyond.sum(), len(finest)
    assert 0.1 < counts[0] / counts[1] <= 0.45


def test_bundle_has_the_rule_of_merged_levels(tiny_scene, tmp_path):
    parameters = {
        "levels": 3, "steps": 20, "merged_levels": 1, "refine_steps": 4, "max_splats": 200, "margin": 0.0
    }  # fmt: skip
    keys = {
        "scene": str(tiny_scene), "out": str(tmp_path / "run"), "image_scale": 1.0, "test_every": 4,
        "method": "octree", "parameters": parameters,
    }  # fmt: skip
    assert training_loop.train(Job.from_dict(keys), io.StringIO()) == 0
    bundle = read_bundle(tmp_path / "run" / "bundle.ply")
    assert (bundle.rule, bundle.cumulative, bundle.facts) == ("bands", False, {})
    assert [level.number for level in standalone_levels(bundle)] == [1, 2]


def test_resumed_run_is_identical(data, check_resumed):
    check_resumed(lambda: make(data), 30, 40, 55)


def test_few_photos_refine_levels_in_fewer_steps(data):
    octree = make(data, refine_steps=3000)
    steps = 100 * len(data.train)
    assert steps < 3000 and octree.steps == 40 + steps + int(0.7 * steps)


def test_presets():
    draft = METHOD.preset("draft")
    assert draft.total_steps == 3000 + 4000 + 2800 + 1959 + 1371
    assert draft.for_photos(40) == draft
    assert draft.for_photos(20).total_steps == 3000 + 2000 + 1400 + 979 + 685
    paper = METHOD.preset("paper")
    assert not paper.merges and paper.total_steps == paper.steps
