"""What an artist has set of a rule's controls comes back from a bundle."""

import json

import numpy as np
import pytest

from training.lod.rule import rules


@pytest.fixture
def made(bpy, lodgs, tmp_path):
    """``made(rule, controls)``: a scene of two levels, imported from a bundle that records such values."""
    files, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    one = np.zeros((1, 3), np.float32)
    splats = gaussians.Splats(
        one, np.float32([[1, 0, 0, 0]]), one, one[:, 0], np.zeros((1, 1, 3), np.float32)
    )

    def make(rule, controls):
        facts = dict.fromkeys(rule.scene_facts, 1.0)
        levels = [files.Level(number, splats, dict.fromkeys(rule.level_facts, 1.0)) for number in (1, 2)]
        bundle = files.Bundle("any", levels, rule.name, facts, controls, rule.cumulative)
        files.write_bundle(tmp_path / "b.ply", bundle)
        return lodgs("data.scenes").import_splats(bpy.context, tmp_path / "b.ply")

    return make


def other_than_default(control):
    """A value that is possible, but not what the control begins with."""
    if control.flag:
        return not control.default
    if control.follows:
        return {"finest": 1, "coarsest": 2}[control.follows]
    return control.default + (3000 if control.step > 1 else 2 if control.whole else 0.5)


@pytest.mark.parametrize(
    ("rule", "control"), [(rule, control) for rule in rules().values() for control in rule.controls],
    ids=lambda each: each.name,
)  # fmt: skip
def test_a_bundle_gives_back_what_was_set(lodgs, made, rule, control):
    root = made(rule, {})
    setattr(root.lodgs.controls, control.name, other_than_default(control))
    set_ = lodgs("data.scenes").read_levels(root).controls
    assert set_[control.name] == other_than_default(control)
    again = made(rule, json.loads(json.dumps(set_)))
    assert getattr(again.lodgs.controls, control.name) == other_than_default(control)


def test_an_impossible_value_is_refused_and_leaves_nothing(bpy, lodgs, made):
    before = len(bpy.data.objects)
    with pytest.raises(lodgs("training.errors").LodgsError, match="offset = 99 is not possible"):
        made(rules()["octree"], {"offset": 99})
    assert len(bpy.data.objects) == before
