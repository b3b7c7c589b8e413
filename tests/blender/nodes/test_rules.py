"""Every rule's node group against the rule itself, splat by splat."""

import numpy as np
import pytest

from training.lod.rule import rules

RULES = sorted(rules())
RANGES = {
    "tau": (0.002, 0.02), "reference": (-3, 20), "sigma_d": (-0.5, 3), "s_v": (1, 4),
    "at_most": (-1500, 3000), "d_l": (1, 6), "coarser_d_l": (7, 14), "distance_scale": (0.7, 1.6),
    "chunks_0": (0, 2**24), "chunks_1": (0, 2**24), "chunks_2": (0, 2**24), "chunks_3": (0, 2**24),
    "node_size": (-0.05, 0.1), "parent_size": (0, 1.6), "parent_x": (-8, 8), "parent_y": (-8, 8),
    "parent_z": (-8, 8),
}  # fmt: skip
"""Of facts, controls and columns for which the usual ones would show everything or nothing."""
FOCALS = {"cut": 300.0}
"""Focal lengths in pixels of rules for which 2.5 would not count."""


def numbers(rule, rng):
    """Facts and values of a rule, drawn from what they may be."""
    facts = {"level": 2, "finer": 3, "coarser": 1, "levels": 4}
    if not (rule.cumulative or rule.level_facts):  # made for one level
        facts |= {"finer": 5, "levels": 2}
    names = [*rule.scene_facts, *rule.level_facts, *(f"coarser_{name}" for name in rule.level_facts)]
    facts |= {name: max(rng.uniform(*RANGES.get(name, (0.5, 6))), 0.0) for name in names}
    values = {}
    for control in rule.controls:
        low, high = RANGES.get(control.name) or control.soft or (control.low, min(control.high, 5))
        values[control.name] = (
            max(int(rng.integers(low, high + 1)), 0) if control.whole else rng.uniform(low, high)
        )
    return facts, values


def tables(rule, rng, count):
    """Tables of a rule, of places with a radius; None: there are none."""
    if count is None:
        return {}
    column = {name: rng.normal(0, 4, count).astype(np.float32) for name in "xyz"}
    return {name: column | {"radius": rng.uniform(1, 6, count).astype(np.float32)} for name in rule.tables}


@pytest.fixture
def level(bpy, lodgs):
    """``level(rule, count, facts, values, rng, tables)``: an object with the modifier, and its splats."""
    from training.splats.gaussians import Splats

    objects, groups, compat = lodgs("data.objects"), lodgs("nodes.rules"), lodgs("compat")

    def make(rule, count, facts, values, rng, tables=None):
        names = [name for name in rule.columns if name != "opacity"]
        columns = {name: rng.uniform(*RANGES.get(name, (0.2, 2)), count).astype(np.float32) for name in names}
        columns |= {name: np.floor(columns[name]) for name in names if name.startswith("chunks_")}  # bits
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
        root = bpy.data.objects.new("root", None)
        bpy.context.scene.collection.objects.link(root)
        lodgs("data.tables").set_tables(root, tables or {})
        for item in root.lodgs.tables:
            compat.set_input(modifier, groups.table_socket(item.name), item.object)
        return obj, modifier, splats

    return make


WITH_TABLES = [
    (name, count) for name in RULES for count in ((None, 0, 1, 2, 3, 96) if rules()[name].tables else (None,))
]
"""Each rule, and how many rows its tables have."""


@pytest.mark.parametrize(("name", "count"), WITH_TABLES)
def test_the_node_group_weights_every_splat_as_the_rule_does(bpy, lodgs, level, name, count):
    rule, weights = rules()[name], []
    compat, groups, selection = lodgs("compat"), lodgs("nodes.rules"), lodgs("data.selection")
    focal = FOCALS.get(name, 2.5)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        facts, values = numbers(rule, rng)
        known = tables(rule, rng, count)
        obj, modifier, splats = level(rule, 4000, facts, values, rng, known)
        eye = rng.normal(0, 4, 3).astype(np.float32)
        obj.location = (3, -2, 1)  # the object's place must not count
        place = {groups.EYE: 2, groups.EYE_POSITION: tuple(map(float, eye)), groups.FOCAL: focal}
        for socket, value in place.items():
            compat.set_input(modifier, socket, value)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = obj.evaluated_get(depsgraph)

        asked = selection.choice(evaluated, depsgraph)
        assert (asked.rule, asked.focal_px) == (name, focal)
        assert dict(asked.values) == pytest.approx(values) and dict(asked.facts) == pytest.approx(facts)
        columns = splats.extras | {"opacity": 1 / (1 + np.exp(-splats.opacity_logits))}
        wanted = rule.weights(splats.means, eye, focal, columns, dict(asked.facts), dict(asked.values), known)
        np.testing.assert_array_equal(asked.weights(splats.means, columns), wanted)
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
            names = [name for name in rule.columns if name != "opacity"]
            splats = Splats(
                rng.normal(0, 4, (60, 3)).astype(np.float32), np.ones((60, 4), np.float32),
                np.zeros((60, 3), np.float32), np.zeros(60, np.float32), np.zeros((60, 1, 3), np.float32),
                {name: rng.uniform(*RANGES.get(name, (0.2, 2)), 60).astype(np.float32) for name in names},
            )  # fmt: skip
            levels.append(Level(number, splats, {fact: facts[fact] for fact in rule.level_facts}))
        scene = {fact: facts[fact] for fact in rule.scene_facts}
        bundle = Bundle("any", levels, name, scene, cumulative=rule.cumulative)
        with scenes.new_scene(bpy.context, "any") as root:
            for one in bundle.levels:
                scenes.put_level(root, one)
            scenes.set_bundle_facts(root, bundle)
        return root

    return make


@pytest.mark.parametrize("name", RULES)
def test_an_older_group_is_renewed_and_whoever_used_it_gets_the_new_one(bpy, lodgs, splat_scene, name):
    groups, selection, root = lodgs("nodes.rules"), lodgs("data.selection"), splat_scene(name)
    used = lodgs("data.selection").rule_modifier(root.lodgs.levels[0].object).node_group
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


@pytest.fixture
def change(bpy):
    """``change(group)``: what an artist may do: a group's last choice is turned round."""

    def changed(group):
        keep = next(node for node in group.nodes if node.bl_idname == "GeometryNodeSeparateGeometry")
        end = next(node for node in group.nodes if node.bl_idname == "GeometryNodeSetMaterial")
        group.links.new(keep.outputs["Inverted"], end.inputs["Geometry"])
        bpy.context.view_layer.update()

    return changed


@pytest.fixture
def half(bpy, lodgs, splat_scene):
    """``half(name)``: a scene by distance of which about half is shown, seen from its scene's camera."""

    def made(name):
        root = splat_scene(name)
        rule, rng = rules()[name], np.random.default_rng(1)
        _, values = numbers(rule, rng)
        root.lodgs.mode, root.lodgs.eye = "SELECTIVE", "TRAINING"
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.data.clip_start, camera.location = 0.01, (0, 0, 40)
        bpy.context.scene.collection.objects.link(camera)
        bpy.context.scene.camera = camera
        for control in rule.controls:
            if not control.follows:
                setattr(root.lodgs.controls, control.name, values[control.name])
        root.lodgs.camera_center = (0.5, 0.5, 0.5)
        bpy.context.scene.render.resolution_percentage = 1
        bpy.context.view_layer.update()
        return root

    return made


@pytest.mark.parametrize("name", RULES)
def test_a_group_that_an_artist_has_changed_is_followed_by_all(bpy, lodgs, half, change, frame, name):
    """The viewport's splats are those that F12 and exports have, with the rule's group and with a changed
    one; and it is changed again once it is changed back."""
    views, root = lodgs("viewport.views"), half(name)
    views.clear()

    def agree():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        exported = sum(
            len(item.object.evaluated_get(depsgraph).data.points) for item in root.lodgs.levels
            if item.object.visible_get()
        )  # fmt: skip
        rendered = sum(map(chosen, lodgs("render.engine").placed_splats(depsgraph)))
        view, camera = views.ViewState(), bpy.context.scene.camera
        instances = lodgs("data.shown").splat_instances(depsgraph)
        drawn = []

        def draw():
            views.prepare(view, instances, depsgraph, camera.matrix_world.inverted(), 10**6, wait=True)
            drawn.append(view.arrangement.count)

        frame(8, draw)
        assert drawn == [exported] == [rendered]
        return exported

    def chosen(placed):
        splats, _ = placed.read()
        if placed.choice is None:
            return len(splats)
        columns = splats.extras | {"opacity": 1 / (1 + np.exp(-splats.opacity_logits))}
        return len(lodgs("training.lod.choice").Chooser(splats.means, columns).chosen(placed.choice)[0])

    def everything():
        return sum(len(item.object.data.points) for item in root.lodgs.levels if item.object.visible_get())

    as_ruled = agree()
    group = next(m.node_group for m in root.lodgs.levels[0].object.modifiers if "lodgs_rule" in m.node_group)
    assert not lodgs("nodes.building").edited(group)
    change(group)
    assert lodgs("nodes.building").edited(group)
    assert agree() == everything() - as_ruled
    assert 0 < as_ruled < everything()
    views.clear()


@pytest.mark.parametrize("name", RULES)
def test_a_changed_group_stays_in_use_and_is_kept_when_it_is_renewed(lodgs, splat_scene, change, name):
    selection, root = lodgs("data.selection"), splat_scene(name)
    used = lodgs("data.selection").rule_modifier(root.lodgs.levels[0].object).node_group
    change(used)
    selection.attach(root)
    assert not selection.outdated(root)
    assert {lodgs("data.selection").rule_modifier(item.object).node_group for item in root.lodgs.levels} == {
        used
    }
    used["lodgs_version"] = 0
    lodgs("data.older_files").bring_up_to_date(root)
    assert used not in {
        lodgs("data.selection").rule_modifier(item.object).node_group for item in root.lodgs.levels
    }
    assert used.name == f"LODGS {name.title()} (older)" and used.use_fake_user


@pytest.mark.parametrize("name", RULES)
def test_a_group_is_as_made_after_saving(bpy, lodgs, splat_scene, change, tmp_path, name):
    splat_scene(name)
    path, group = str(tmp_path / "a.blend"), f"LODGS {name.title()}"
    for changed in (False, True):
        if changed:
            change(bpy.data.node_groups[group])
        bpy.ops.wm.save_as_mainfile(filepath=path, check_existing=False)
        bpy.ops.wm.open_mainfile(filepath=path)
        assert lodgs("nodes.building").edited(bpy.data.node_groups[group]) == changed


@pytest.mark.parametrize("name", RULES)
def test_an_emptied_group_stops_nothing(bpy, lodgs, half, name, capfd):
    root = half(name)
    group = lodgs("data.selection").rule_modifier(root.lodgs.levels[0].object).node_group
    group.interface.clear()
    group.nodes.clear()
    bpy.context.view_layer.update()
    root.lodgs.camera_center = (1, 2, 3)
    root.lodgs.freeze = True
    lodgs("data.selection").attach(root)
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = root.lodgs.levels[0].object.evaluated_get(depsgraph)
    assert lodgs("data.selection").choice(evaluated, depsgraph) is None
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("name", RULES)
def test_sockets_are_driven_by_bare_names(splat_scene, name):
    obj = splat_scene(name).lodgs.levels[0].object
    title = f'modifiers["LODGS {name.title()}"]'
    drivers = [d for d in obj.animation_data.drivers if d.data_path.startswith(title)]
    eyes = [d for d in drivers if not d.driver.expression.isidentifier()]
    assert [(d.data_path, d.array_index) for d in eyes] == [(eyes[0].data_path, axis) for axis in range(3)]
    bare = {d.data_path: d.driver for d in drivers if d not in eyes}
    assert len(bare) == 2 + 4 + len(rules()[name].controls)
    for driver in bare.values():
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
