"""Controls set by an artist survive a bundle round trip."""

import json

import numpy as np
import pytest

from training.lod.rule import rules


@pytest.fixture
def import_scene(bpy, lodgs, tmp_path):
    """``import_scene(rule, controls)``: import a bundle of two levels with these controls."""
    files, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    zeros = np.zeros((1, 3), np.float32)
    splats = gaussians.Splats(
        zeros, np.float32([[1, 0, 0, 0]]), zeros, zeros[:, 0], np.zeros((1, 1, 3), np.float32)
    )

    def make(rule, controls):
        facts = dict.fromkeys(rule.scene_facts, 1.0)
        levels = [files.Level(number, splats, dict.fromkeys(rule.level_facts, 1.0)) for number in (1, 2)]
        bundle = files.Bundle("any", levels, rule.name, facts, controls, rule.cumulative)
        files.write_bundle(tmp_path / "b.ply", bundle)
        return lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")

    return make


def changed_value(control):
    """Return a valid value other than the control's default."""
    if control.flag:
        return not control.default
    if control.follows:
        return {"finest": 1, "coarsest": 2}[control.follows]
    return control.default + (3000 if control.step > 1 else 2 if control.integer else 0.5)


@pytest.mark.parametrize(
    ("rule", "control"), [(rule, control) for rule in rules().values() for control in rule.controls],
    ids=lambda value: value.name,
)  # fmt: skip
def test_bundle_restores_controls(lodgs, import_scene, rule, control):
    root = import_scene(rule, {})
    setattr(root.lodgs.controls, control.name, changed_value(control))
    controls = lodgs("data.scenes").read_levels(root).controls
    assert controls[control.name] == changed_value(control)
    reimported = import_scene(rule, json.loads(json.dumps(controls)))
    assert getattr(reimported.lodgs.controls, control.name) == changed_value(control)


@pytest.fixture
def bundle_of(lodgs, tmp_path):
    """``bundle_of(count, controls)``: a bundle with some levels, numbered with a gap, and controls."""
    files, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    zeros = np.zeros((1, 3), np.float32)
    splats = gaussians.Splats(
        zeros, np.float32([[1, 0, 0, 0]]), zeros, zeros[:, 0], np.zeros((1, 1, 3), np.float32)
    )

    def make(count, controls):
        numbers = [*range(1, count), count + 1]
        levels = [files.Level(number, splats, {"s_min": 1.0 / number}) for number in numbers]
        return files.Bundle("flod", levels, "bands", {}, controls)

    return make


def current_controls(root):
    return {name: getattr(root.lodgs.bands, name) for name in ("gamma", "first", "last")}


RECORDED = [{}, {"gamma": 2.0}, {"first": 1}, {"first": 2, "last": 3}]


@pytest.mark.parametrize("count", [1, 3, 5])
@pytest.mark.parametrize("controls", RECORDED, ids=str)
def test_initial_controls_match_the_trainer(bpy, lodgs, bundle_of, tmp_path, count, controls):
    """After an import, and after levels arrive one by one while training."""
    scenes, bundle = lodgs("data.scenes"), bundle_of(count, controls)
    if any(not bundle.levels[0].number <= controls.get(name, 2) <= count + 1 for name in ("first", "last")):
        pytest.skip("the bundle has no such levels")
    expected = lodgs("training.lod.selection").resolve_controls(bundle, {})
    lodgs("training.splats.bundle").write_bundle(tmp_path / "b.ply", bundle)
    assert (
        current_controls(lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")) == expected
    )

    with lodgs("data.importing").new_scene(bpy.context, "trained") as root:
        for level in bundle.levels:
            scenes.set_level(root, level)
        scenes.set_bundle_facts(root, bundle)
    assert current_controls(root) == expected
    defaults = lodgs("training.lod.selection").resolve_controls(bundle_of(count, {}), {})
    changed = {name: value for name, value in controls.items() if value != defaults[name]}
    assert scenes.read_levels(root).controls == changed


def test_level_controls_follow_until_set(bpy, lodgs, bundle_of):
    scenes, bundle = lodgs("data.scenes"), bundle_of(6, {})
    with lodgs("data.importing").new_scene(bpy.context, "trained") as root:
        scenes.set_bundle_facts(root, lodgs("training.splats.levels").Bundle("flod", [], "bands"))
        for level in bundle.levels[:4]:
            scenes.set_level(root, level)
    assert current_controls(root) == {"gamma": 1, "first": 2, "last": 4}
    root.lodgs.bands.first = 1
    for level in bundle.levels[4:]:
        scenes.set_level(root, level)
    assert current_controls(root) == {"gamma": 1, "first": 1, "last": 7}
    assert scenes.read_levels(root).controls == {"first": 1}
    root.lodgs.bands.first = 4
    for item in list(root.lodgs.levels)[3:]:
        bpy.data.objects.remove(item.object)
    scenes.levels_changed(root)
    assert current_controls(root) == {"gamma": 1, "first": 1, "last": 3}  # 1 was the default again


@pytest.mark.parametrize("rule", rules().values(), ids=lambda rule: rule.name)
def test_levels_that_contradict_their_rule_are_rejected(bpy, lodgs, import_scene, rule, tmp_path):
    files = lodgs("training.splats.bundle")
    import_scene(rule, {})
    bundle = files.read_bundle(tmp_path / "b.ply")
    bundle.cumulative = not rule.cumulative
    files.write_bundle(tmp_path / "other.ply", bundle)
    before = len(bpy.data.objects)
    with pytest.raises(lodgs("training.errors").LodgsError, match=f"rule '{rule.name}'"):
        lodgs("data.importing").import_splats(bpy.context, tmp_path / "other.ply")
    assert len(bpy.data.objects) == before


def test_invalid_value_is_rejected(bpy, lodgs, import_scene):
    before = len(bpy.data.objects)
    with pytest.raises(lodgs("training.errors").LodgsError, match="offset = 99 is invalid"):
        import_scene(rules()["octree"], {"offset": 99})
    assert len(bpy.data.objects) == before
