"""Node groups of all rules against the rules themselves, splat by splat."""

from types import ModuleType

import numpy as np
import pytest

from tests.checkout import recipe_code
from training.lod.rule import rules

RULES = sorted(rules())
RANGES = {
    "tau": (0.002, 0.02), "reference": (-3, 20), "sigma_d": (-0.5, 3), "s_v": (1, 4),
    "at_most": (-1500, 3000), "d_l": (1, 6), "coarser_d_l": (7, 14), "distance_scale": (0.7, 1.6),
    "chunks_0": (0, 2**24), "chunks_1": (0, 2**24), "chunks_2": (0, 2**24), "chunks_3": (0, 2**24),
    "node_size": (-0.05, 0.1), "parent_size": (0, 1.6), "parent_x": (-8, 8), "parent_y": (-8, 8),
    "parent_z": (-8, 8), "share": (0.1, 0.9), "splats": (2000, 4000), "prefix_rank": (0, 4000),
    "view_distance": (1, 9),
}  # fmt: skip
"""Value ranges of facts, controls and columns whose default range would show everything or nothing."""
FOCALS = {"cut": 300.0}
"""Focal lengths in pixels of rules for which 2.5 has no effect."""


def random_arguments(rule, rng):
    """Return random facts and control values of a rule."""
    facts = {"level": 2, "finer": 3, "coarser": 1, "levels": 4}
    if not (rule.cumulative or rule.level_facts):  # rules for a single level
        facts |= {"finer": 5, "levels": 2}
    names = [*rule.scene_facts, *rule.level_facts, *(f"coarser_{name}" for name in rule.level_facts)]
    facts |= {name: max(rng.uniform(*RANGES.get(name, (0.5, 6))), 0.0) for name in names}
    values = {}
    for control in rule.controls:
        low, high = RANGES.get(control.name) or control.soft or (control.low, min(control.high, 5))
        values[control.name] = (
            max(int(rng.integers(low, high + 1)), 0) if control.integer else rng.uniform(low, high)
        )
    return facts, values


def random_tables(rule, rng, count):
    """Return random tables of a rule with positions and radii, or no tables for a count of None."""
    if count is None:
        return {}
    column = {name: rng.normal(0, 4, count).astype(np.float32) for name in "xyz"}
    return {name: column | {"radius": rng.uniform(1, 6, count).astype(np.float32)} for name in rule.tables}


@pytest.fixture
def level(bpy, lodgs):
    """``level(rule, count, facts, values, rng, tables)``: return an object, its modifier and its splats."""
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
"""Rules with the number of rows of their tables."""


@pytest.mark.parametrize(("name", "count"), WITH_TABLES)
def test_node_group_gives_the_weights_of_the_rule(bpy, lodgs, level, name, count):
    compare_weights(bpy, lodgs, level, rules()[name], count)


def test_node_group_of_the_recipe_gives_the_weights_of_its_rule(bpy, lodgs, level, monkeypatch):
    groups, all_rules = lodgs("nodes.rules"), lodgs("training.lod.rule").rules()
    for package, text in (("training.lod.rules", "RULE = Rings()"), ("nodes.rules", "VERSION = 1")):
        module = ModuleType(f"{lodgs(package).__name__}.rings")
        module.__package__ = lodgs(package).__name__
        exec(recipe_code("Add a rule", text), vars(module))
        if package == "nodes.rules":
            monkeypatch.setitem(groups._modules(), "rings", module)
        else:
            monkeypatch.setitem(all_rules, "rings", module.RULE)
    monkeypatch.setitem(RANGES, "coarser_radius", (7, 14))
    compare_weights(bpy, lodgs, level, all_rules["rings"], None)


def compare_weights(bpy, lodgs, level, rule, count):
    """Compare the weights of a rule with those of its node group, for eight cameras and random values.

    Args:
        count: number of rows of the rule's tables, None without tables.
    """
    name, weights = rule.name, []
    compat, groups, selection = lodgs("compat"), lodgs("nodes.rules"), lodgs("data.selection")
    focal = FOCALS.get(name, 2.5)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        facts, values = random_arguments(rule, rng)
        rule_tables = random_tables(rule, rng, count)
        obj, modifier, splats = level(rule, 4000, facts, values, rng, rule_tables)
        camera = rng.normal(0, 4, 3).astype(np.float32)
        obj.location = (3, -2, 1)  # the object's transform must have no effect
        inputs = {
            groups.CAMERA_SOURCE: 2,
            groups.CAMERA_POSITION: tuple(map(float, camera)),
            groups.FOCAL: focal,
        }
        for socket, value in inputs.items():
            compat.set_input(modifier, socket, value)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = obj.evaluated_get(depsgraph)

        query = selection.evaluated_query(evaluated, depsgraph)
        assert (query.rule, query.focal_px) == (name, focal)
        assert dict(query.values) == pytest.approx(values) and dict(query.facts) == pytest.approx(facts)
        columns = splats.extras | {"opacity": 1 / (1 + np.exp(-splats.opacity_logits))}
        arguments = dict(query.facts), dict(query.values), rule_tables
        expected = rule.weights(splats.means, camera, focal, columns, *arguments)
        np.testing.assert_array_equal(query.weights(splats.means, columns), expected)
        actual, cloud = np.zeros(len(splats), np.float32), evaluated.data
        if len(cloud.points):
            rows = np.empty(len(cloud.points), np.int32)
            cloud.attributes["row"].data.foreach_get("value", rows)
            weight = lodgs("attributes").read_attribute(cloud, "lod_weight")
            actual[rows] = 1 if weight is None else weight
        # nodes round float32 differently, so splats at a border may differ
        differ = np.abs(actual - expected) > 2e-4
        assert differ.sum() <= 2
        weights.append(expected)
    drawn = (np.concatenate(weights) > 0).mean()
    assert 0.1 < drawn < 0.9, f"adapt RANGES or FOCALS: they draw {drawn:.0%} of the splats"


@pytest.fixture
def splat_scene(bpy, lodgs):
    """``splat_scene(name)``: return the root of a scene with levels of a rule."""
    from training.splats.gaussians import Splats
    from training.splats.levels import Bundle, Level

    def make(name):
        rule, rng, scenes = rules()[name], np.random.default_rng(1), lodgs("data.scenes")
        facts, _ = random_arguments(rule, rng)
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
        with lodgs("data.importing").new_scene(bpy.context, "any") as root:
            for level in bundle.levels:
                scenes.put_level(root, level)
            scenes.set_bundle_facts(root, bundle)
        return root

    return make


@pytest.mark.parametrize("name", RULES)
def test_older_group_is_replaced_for_all_users(bpy, lodgs, splat_scene, name):
    groups, selection, root = lodgs("nodes.rules"), lodgs("data.selection"), splat_scene(name)
    used = lodgs("data.selection").rule_modifier(root.lodgs.levels[0].object).node_group
    version = used["lodgs_version"]
    assert not selection.is_outdated(root)
    used["lodgs_version"] = 0
    assert selection.is_outdated(root)
    lodgs("data.older_files").upgrade_scene(root)
    assert not selection.is_outdated(root)
    for item in root.lodgs.levels:
        groups_of_rules = [m.node_group for m in item.object.modifiers if groups.rule_of_group(m.node_group)]
        assert [group["lodgs_version"] for group in groups_of_rules] == [version]
    assert sum("lodgs_rule" in group and group.users > 0 for group in bpy.data.node_groups) == 1


@pytest.fixture
def edit_group(bpy):
    """``edit_group(group)``: invert the selection of a group, as a user might."""

    def invert(group):
        keep = next(node for node in group.nodes if node.bl_idname == "GeometryNodeSeparateGeometry")
        end = next(node for node in group.nodes if node.bl_idname == "GeometryNodeSetMaterial")
        group.links.new(keep.outputs["Inverted"], end.inputs["Geometry"])
        bpy.context.view_layer.update()

    return invert


@pytest.fixture
def half_visible(bpy, lodgs, splat_scene):
    """``half_visible(name)``: return the root of a scene by distance that shows about half of its splats."""

    def make(name):
        root = splat_scene(name)
        rule, rng = rules()[name], np.random.default_rng(1)
        _, values = random_arguments(rule, rng)
        root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "TRAINING"
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

    return make


@pytest.mark.parametrize("name", RULES)
def test_edited_group_is_used_everywhere(bpy, lodgs, half_visible, edit_group, frame, name):
    """Viewports, renders and exports have the same splats with an original and with an edited group."""
    views, root = lodgs("viewport.views"), half_visible(name)
    views.clear()

    def compare_counts():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        exported = sum(
            len(item.object.evaluated_get(depsgraph).data.points) for item in root.lodgs.levels
            if item.object.visible_get()
        )  # fmt: skip
        rendered = sum(map(count_selected, lodgs("render.engine").placed_splats(depsgraph)))
        view, camera = views.ViewState(), bpy.context.scene.camera
        instances = lodgs("data.shown").splat_instances(depsgraph)
        drawn = []

        def draw():
            views.prepare(view, instances, depsgraph, camera.matrix_world.inverted(), 10**6, wait=True)
            drawn.append(view.arrangement.count)

        frame(8, draw)
        assert drawn == [exported] == [rendered]
        return exported

    def count_selected(placed):
        splats, _ = placed.read()
        if placed.query is None:
            return len(splats)
        columns = splats.extras | {"opacity": 1 / (1 + np.exp(-splats.opacity_logits))}
        return len(lodgs("training.lod.query").SplatSelector(splats.means, columns).select(placed.query)[0])

    def count_all():
        return sum(len(item.object.data.points) for item in root.lodgs.levels if item.object.visible_get())

    original = compare_counts()
    group = next(m.node_group for m in root.lodgs.levels[0].object.modifiers if "lodgs_rule" in m.node_group)
    assert not lodgs("nodes.building").is_edited(group)
    edit_group(group)
    assert lodgs("nodes.building").is_edited(group)
    assert compare_counts() == count_all() - original
    assert 0 < original < count_all()
    views.clear()


@pytest.mark.parametrize("name", RULES)
def test_edited_group_stays_in_use_and_is_kept_when_replaced(lodgs, splat_scene, edit_group, name):
    selection, root = lodgs("data.selection"), splat_scene(name)
    used = lodgs("data.selection").rule_modifier(root.lodgs.levels[0].object).node_group
    edit_group(used)
    selection.attach(root)
    assert not selection.is_outdated(root)
    assert {lodgs("data.selection").rule_modifier(item.object).node_group for item in root.lodgs.levels} == {
        used
    }
    used["lodgs_version"] = 0
    lodgs("data.older_files").upgrade_scene(root)
    assert used not in {
        lodgs("data.selection").rule_modifier(item.object).node_group for item in root.lodgs.levels
    }
    assert used.name == f"LODGS {name.title()} (older)" and used.use_fake_user


@pytest.mark.parametrize("name", RULES)
def test_edits_are_recognized_after_saving(bpy, lodgs, splat_scene, edit_group, tmp_path, name):
    splat_scene(name)
    path, group = str(tmp_path / "a.blend"), f"LODGS {name.title()}"
    for edited in (False, True):
        if edited:
            edit_group(bpy.data.node_groups[group])
        bpy.ops.wm.save_as_mainfile(filepath=path, check_existing=False)
        bpy.ops.wm.open_mainfile(filepath=path)
        assert lodgs("nodes.building").is_edited(bpy.data.node_groups[group]) == edited


@pytest.mark.parametrize("name", RULES)
def test_empty_group_causes_no_errors(bpy, lodgs, half_visible, name, capfd):
    root = half_visible(name)
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
    assert lodgs("data.selection").evaluated_query(evaluated, depsgraph) is None
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("name", RULES)
def test_drivers_are_single_variables(splat_scene, name):
    obj = splat_scene(name).lodgs.levels[0].object
    title = f'modifiers["LODGS {name.title()}"]'
    drivers = [d for d in obj.animation_data.drivers if d.data_path.startswith(title)]
    camera = [d for d in drivers if not d.driver.expression.isidentifier()]
    assert [(d.data_path, d.array_index) for d in camera] == [
        (camera[0].data_path, axis) for axis in range(3)
    ]
    simple = {d.data_path: d.driver for d in drivers if d not in camera}
    assert len(simple) == 2 + 4 + len(rules()[name].controls)
    for driver in simple.values():
        assert [variable.name for variable in driver.variables] == [driver.expression]


@pytest.mark.parametrize("name", RULES)
def test_scene_keeps_the_facts_of_its_bundle(bpy, lodgs, splat_scene, name, tmp_path):
    root, scenes = splat_scene(name), lodgs("data.scenes")
    bundle = scenes.read_levels(root)
    lodgs("training.splats.bundle").write_bundle(tmp_path / "bundle.ply", bundle)
    reread = scenes.read_levels(lodgs("data.importing").import_splats(bpy.context, tmp_path / "bundle.ply"))
    assert (reread.rule, reread.facts, reread.controls) == (name, bundle.facts, {})
    assert [level.facts for level in reread.levels] == [level.facts for level in bundle.levels]


def test_unknown_rule_shows_the_finest_level_with_a_warning(bpy, lodgs, splat_scene, tmp_path):
    scenes = lodgs("data.scenes")
    warnings = []
    bundle = scenes.read_levels(splat_scene("bands"))
    bundle.rule = "telepathy"
    lodgs("training.splats.bundle").write_bundle(tmp_path / "bundle.ply", bundle)
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "bundle.ply", warn=warnings.append)
    assert "telepathy" in warnings[0]
    root.lodgs.mode = "SELECTIVE"
    scenes.set_bundle_facts(root, bundle)
    bpy.context.view_layer.update()
    assert [item.object.visible_get() for item in root.lodgs.levels] == [False, False, True]
    assert scenes.read_levels(root).rule == "telepathy"  # exports keep the name
