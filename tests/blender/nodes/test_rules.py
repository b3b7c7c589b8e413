"""Every rule's node group against the rule itself, splat by splat."""

import numpy as np
import pytest

from training.lod.rule import rules

RULES = sorted(rules())
RANGES = {
    "tau": (0.002, 0.02), "reference": (-3, 20), "sigma_d": (-0.5, 3), "s_v": (1, 4),
    "at_most": (-1500, 3000), "d_l": (1, 6), "coarser_d_l": (7, 14), "distance_scale": (0.7, 1.6),
}  # fmt: skip
"""Of facts, controls and columns for which the usual ones would show everything or nothing."""


def numbers(rule, rng):
    """Facts and values of a rule, drawn from what they may be."""
    facts = {"level": 2, "finer": 3, "coarser": 1, "levels": 4}
    names = [*rule.scene_facts, *rule.level_facts, *(f"coarser_{name}" for name in rule.level_facts)]
    facts |= {name: max(rng.uniform(*RANGES.get(name, (0.5, 6))), 0.0) for name in names}
    values = {}
    for control in rule.controls:
        low, high = RANGES.get(control.name) or control.soft or (control.low, min(control.high, 5))
        values[control.name] = (
            max(int(rng.integers(low, high + 1)), 0) if control.whole else rng.uniform(low, high)
        )
    return facts, values


@pytest.fixture
def level(bpy, lodgs):
    """``level(rule, count, facts, values, rng)``: an object with the rule's modifier, and its splats."""
    from training.splats.gaussians import Splats

    objects, groups, compat = lodgs("data.objects"), lodgs("nodes.rules"), lodgs("compat")

    def make(rule, count, facts, values, rng):
        names = [name for name in rule.columns if name != "opacity"]
        columns = {name: rng.uniform(*RANGES.get(name, (0.2, 2)), count).astype(np.float32) for name in names}
        splats = Splats(
            means=rng.normal(0, 4, (count, 3)).astype(np.float32),
            quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
            log_scales=rng.normal(-2, 0.5, (count, 3)).astype(np.float32),
            opacity_logits=rng.normal(0, 2, count).astype(np.float32),
            sh=np.zeros((count, 1, 3), np.float32),
            extras=columns | {"row": np.arange(count, dtype=np.int32)},
        )
        obj = objects.new_splats("level", splats)
        bpy.context.scene.collection.objects.link(obj)
        modifier = obj.modifiers.new("rule", "NODES")
        modifier.node_group = groups.rule_group(rule)
        for name, value in {**facts, **values}.items():
            kind = int if isinstance(compat.get_input(modifier, name), int) else float
            compat.set_input(modifier, name, kind(value))
        return obj, modifier, splats

    return make


@pytest.mark.parametrize("name", RULES)
def test_the_node_group_weights_every_splat_as_the_rule_does(bpy, lodgs, level, name):
    rule, weights = rules()[name], []
    compat, groups, selection = lodgs("compat"), lodgs("nodes.rules"), lodgs("data.selection")
    for seed in range(8):
        rng = np.random.default_rng(seed)
        facts, values = numbers(rule, rng)
        obj, modifier, splats = level(rule, 4000, facts, values, rng)
        eye = rng.normal(0, 4, 3).astype(np.float32)
        obj.location = (3, -2, 1)  # the object's place must not count
        place = {groups.EYE: 2, groups.EYE_POSITION: tuple(map(float, eye)), groups.FOCAL: 2.5}
        for socket, value in place.items():
            compat.set_input(modifier, socket, value)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = obj.evaluated_get(depsgraph)

        asked = selection.choice(evaluated, depsgraph)
        assert (asked.rule, asked.focal_px) == (name, 2.5)
        assert dict(asked.values) == pytest.approx(values) and dict(asked.facts) == pytest.approx(facts)
        columns = splats.extras | {"opacity": 1 / (1 + np.exp(-splats.opacity_logits))}
        wanted = rule.weights(splats.means, eye, 2.5, columns, dict(asked.facts), dict(asked.values))
        found, cloud = np.zeros(len(splats), np.float32), evaluated.data
        if len(cloud.points):
            rows = np.empty(len(cloud.points), np.int32)
            cloud.attributes["row"].data.foreach_get("value", rows)
            weight = lodgs("attributes").read_attribute(cloud, "lod_weight")
            found[rows] = 1 if weight is None else weight
        # float32 numbers are rounded elsewhere in nodes: a splat on a border may fall on its other side
        differ = np.abs(found - wanted) > 2e-4
        assert differ.sum() <= 2
        weights.append(wanted)
    weights = np.concatenate(weights)
    assert 0.1 < (weights > 0).mean() < 0.9


@pytest.fixture
def splat_scene(bpy, lodgs):
    """``splat_scene(name)``: the root of a scene whose few levels are chosen by that rule."""
    from training.splats.bundle import Bundle, Level
    from training.splats.gaussians import Splats

    def make(name):
        rule, rng, scenes = rules()[name], np.random.default_rng(1), lodgs("data.scenes")
        facts, _ = numbers(rule, rng)
        levels = []
        for number in range(1, 4 if rule.cumulative or rule.level_facts else 2):
            splats = Splats(
                rng.normal(0, 4, (9, 3)).astype(np.float32), np.ones((9, 4), np.float32),
                np.zeros((9, 3), np.float32), np.zeros(9, np.float32), np.zeros((9, 1, 3), np.float32),
            )  # fmt: skip
            levels.append(Level(number, splats, {fact: facts[fact] for fact in rule.level_facts}))
        bundle = Bundle("any", levels, name, {fact: facts[fact] for fact in rule.scene_facts})
        with scenes._new_scene(bpy.context, "any") as root:
            for one in bundle.levels:
                scenes._put_level(root, one)
            scenes.set_bundle_facts(root, bundle)
        return root

    return make


@pytest.mark.parametrize("name", RULES)
def test_an_older_group_is_renewed_and_whoever_used_it_gets_the_new_one(bpy, lodgs, splat_scene, name):
    groups, selection, root = lodgs("nodes.rules"), lodgs("data.selection"), splat_scene(name)
    used = root.lodgs.levels[0].object.modifiers[-1].node_group
    version = used["lodgs_version"]
    assert not selection.outdated(root)
    used["lodgs_version"] = 0
    assert selection.outdated(root)
    lodgs("data.older_files").bring_up_to_date(root)
    assert not selection.outdated(root)
    for item in root.lodgs.levels:
        groups_of_rules = [m.node_group for m in item.object.modifiers if groups.rule_of_group(m.node_group)]
        assert [group["lodgs_version"] for group in groups_of_rules] == [version]
    assert sum("lodgs_rule" in group for group in bpy.data.node_groups) == 1


@pytest.mark.parametrize("name", RULES)
def test_sockets_are_driven_by_bare_names(splat_scene, name):
    obj = splat_scene(name).lodgs.levels[0].object
    title = f'modifiers["LODGS {name.title()}"]'
    paths = {d.data_path: d.driver for d in obj.animation_data.drivers if d.data_path.startswith(title)}
    assert len(paths) == 2 + 4 + len(rules()[name].controls)
    for driver in paths.values():
        assert driver.expression.isidentifier()
        assert [variable.name for variable in driver.variables] == [driver.expression]


@pytest.mark.parametrize("name", RULES)
def test_a_scene_gives_its_bundle_back(bpy, lodgs, splat_scene, name, tmp_path):
    root, scenes = splat_scene(name), lodgs("data.scenes")
    bundle = scenes.read_levels(root)
    lodgs("training.splats.bundle").write_bundle(tmp_path / "bundle.ply", bundle)
    again = scenes.read_levels(scenes.import_splats(bpy.context, tmp_path / "bundle.ply"))
    assert (again.rule, again.facts, again.controls) == (name, bundle.facts, {})
    assert [level.facts for level in again.levels] == [level.facts for level in bundle.levels]


def test_an_unknown_rule_shows_the_finest_level_and_says_so(bpy, lodgs, splat_scene, tmp_path):
    scenes, said = lodgs("data.scenes"), []
    bundle = scenes.read_levels(splat_scene("bands"))
    bundle.rule = "telepathy"
    lodgs("training.splats.bundle").write_bundle(tmp_path / "bundle.ply", bundle)
    root = scenes.import_splats(bpy.context, tmp_path / "bundle.ply", warn=said.append)
    assert "telepathy" in said[0] and "Update LODGS" in said[0]
    root.lodgs.mode = "SELECTIVE"
    scenes.set_bundle_facts(root, bundle)
    bpy.context.view_layer.update()
    assert [item.object.visible_get() for item in root.lodgs.levels] == [False, False, True]
    assert scenes.read_levels(root).rule == "telepathy"  # it survives an export
