"""Controls set by an artist survive a bundle round trip."""

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
        return lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")

    return make


def other_than_default(control):
    """A value that is possible, but not what the control begins with."""
    if control.flag:
        return not control.default
    if control.follows:
        return {"finest": 1, "coarsest": 2}[control.follows]
    return control.default + (3000 if control.step > 1 else 2 if control.integer else 0.5)


@pytest.mark.parametrize(
    ("rule", "control"), [(rule, control) for rule in rules().values() for control in rule.controls],
    ids=lambda each: each.name,
)  # fmt: skip
def test_bundle_restores_controls(lodgs, made, rule, control):
    root = made(rule, {})
    setattr(root.lodgs.controls, control.name, other_than_default(control))
    set_ = lodgs("data.scenes").read_levels(root).controls
    assert set_[control.name] == other_than_default(control)
    again = made(rule, json.loads(json.dumps(set_)))
    assert getattr(again.lodgs.controls, control.name) == other_than_default(control)


@pytest.fixture
def some(lodgs, tmp_path):
    """``some(count, controls)``: a bundle of so many levels, numbered with a gap, that records controls."""
    files, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    one = np.zeros((1, 3), np.float32)
    splats = gaussians.Splats(
        one, np.float32([[1, 0, 0, 0]]), one, one[:, 0], np.zeros((1, 1, 3), np.float32)
    )

    def make(count, controls):
        numbers = [*range(1, count), count + 1]
        levels = [files.Level(number, splats, {"s_min": 1.0 / number}) for number in numbers]
        return files.Bundle("flod", levels, "bands", {}, controls)

    return make


def in_use(root):
    return {name: getattr(root.lodgs.bands, name) for name in ("gamma", "first", "last")}


RECORDED = [{}, {"gamma": 2.0}, {"first": 1}, {"first": 2, "last": 3}]


@pytest.mark.parametrize("count", [1, 3, 5])
@pytest.mark.parametrize("controls", RECORDED, ids=str)
def test_initial_controls_match_the_trainer(bpy, lodgs, some, tmp_path, count, controls):
    """Imported at once, or level by level as they are trained."""
    scenes, bundle = lodgs("data.scenes"), some(count, controls)
    if any(not bundle.levels[0].number <= controls.get(name, 2) <= count + 1 for name in ("first", "last")):
        pytest.skip("there are no such levels")
    wanted = lodgs("training.lod.selection").resolve_controls(bundle, {})
    lodgs("training.splats.bundle").write_bundle(tmp_path / "b.ply", bundle)
    assert in_use(lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")) == wanted

    with lodgs("data.importing").new_scene(bpy.context, "trained") as root:
        for level in bundle.levels:
            scenes.set_level(root, level)
        scenes.set_bundle_facts(root, bundle)
    assert in_use(root) == wanted
    plain = lodgs("training.lod.selection").resolve_controls(some(count, {}), {})
    said = {name: value for name, value in controls.items() if value != plain[name]}
    assert scenes.read_levels(root).controls == said


def test_level_controls_follow_until_set(bpy, lodgs, some):
    scenes, bundle = lodgs("data.scenes"), some(6, {})
    with lodgs("data.importing").new_scene(bpy.context, "trained") as root:
        scenes.set_bundle_facts(root, lodgs("training.splats.levels").Bundle("flod", [], "bands"))
        for level in bundle.levels[:4]:
            scenes.set_level(root, level)
    assert in_use(root) == {"gamma": 1, "first": 2, "last": 4}
    root.lodgs.bands.first = 1
    for level in bundle.levels[4:]:
        scenes.set_level(root, level)
    assert in_use(root) == {"gamma": 1, "first": 1, "last": 7}
    assert scenes.read_levels(root).controls == {"first": 1}
    root.lodgs.bands.first = 4
    for item in list(root.lodgs.levels)[3:]:
        bpy.data.objects.remove(item.object)
    scenes.levels_changed(root)
    assert in_use(root) == {"gamma": 1, "first": 1, "last": 3}  # which was the rule's own again


@pytest.mark.parametrize("rule", rules().values(), ids=lambda rule: rule.name)
def test_levels_that_contradict_their_rule_are_rejected(bpy, lodgs, made, rule, tmp_path):
    files, made = lodgs("training.splats.bundle"), made(rule, {})
    bundle = files.read_bundle(tmp_path / "b.ply")
    bundle.cumulative = not rule.cumulative
    files.write_bundle(tmp_path / "other.ply", bundle)
    before = len(bpy.data.objects)
    with pytest.raises(lodgs("training.errors").LodgsError, match=f"rule '{rule.name}'"):
        lodgs("data.importing").import_splats(bpy.context, tmp_path / "other.ply")
    assert len(bpy.data.objects) == before


def test_invalid_value_is_rejected(bpy, lodgs, made):
    before = len(bpy.data.objects)
    with pytest.raises(lodgs("training.errors").LodgsError, match="offset = 99 is invalid"):
        made(rules()["octree"], {"offset": 99})
    assert len(bpy.data.objects) == before
