"""What the Detail panel offers for every rule, and says where there is none; and what it says of chunks."""

import json

import numpy as np
import pytest

from tests.training.lod.trees import random_leaves, tree_of
from training.lod.rule import rules
from training.lod.rules.chunks import member_columns
from training.splats.bundle import Bundle, Level
from training.splats.gaussians import Splats


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    """``root(rule)``: a scene of one splat whose rule has that name."""
    bundles, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    one = np.zeros((1, 3), np.float32)
    splats = gaussians.Splats(
        means=one, quats=np.float32([[1, 0, 0, 0]]), log_scales=one, opacity_logits=one[:, 0],
        sh=np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip

    def make(name):
        rule = rules().get(name)
        facts = (
            [dict.fromkeys(names, 1.0) for names in (rule.scene_facts, rule.level_facts)]
            if rule
            else ({}, {})
        )
        adds = bool(rule and rule.cumulative)
        bundle = bundles.Bundle("any", [bundles.Level(1, splats, facts[1])], name, facts[0], cumulative=adds)
        bundles.write_bundle(tmp_path / "b.ply", bundle)
        return lodgs("data.scenes").import_splats(bpy.context, tmp_path / "b.ply")

    return make


@pytest.fixture
def draw(draw_panel):
    return lambda: draw_panel("levels", "LODGS_PT_detail")


@pytest.mark.parametrize("name", sorted(rules()))
def test_every_control_is_offered_as_what_it_is(root, draw, name):
    made = root(name)
    made.lodgs.mode = "SELECTIVE"
    notes, controls = draw(), rules()[name].controls
    assert notes.properties == ["mode", *(control.name for control in controls), "eye", "freeze"]
    assert notes.sliders == [control.name for control in controls if control.soft]
    kinds = {p.identifier: p.type for p in made.lodgs.controls.bl_rna.properties}
    for control in controls:
        kind = "BOOLEAN" if control.flag else "INT" if control.whole else "FLOAT"
        assert kinds[control.name] == kind
        if control.whole and not control.flag:
            assert made.lodgs.controls.bl_rna.properties[control.name].step == control.step


@pytest.mark.parametrize("name", sorted(rules()))
def test_one_level_says_where_it_is_not_what_was_trained(root, draw, name):
    made = root(name)
    made.lodgs.mode = "SINGLE"
    notes = draw()
    assert notes.properties == ["mode", "single_level"]
    assert any("too opaque" in text for text in notes.texts) == rules()[name].always


def test_what_has_no_known_rule_is_shown_level_by_level_and_says_so(root, draw):
    root("")
    assert "These levels are not made for distances." in draw().texts
    root("weave")
    assert any("'weave', which this version does not know." in text for text in draw().texts)


@pytest.fixture
def town(bpy, lodgs):
    """A level of 1000 splats for all distances below 20, one for the rest, and two chunks."""
    scenes, sets = lodgs("data.scenes"), np.zeros((2, 1000), bool)
    sets[0, :100] = sets[1, 50:300] = True
    splats = Splats(
        means=np.zeros((1000, 3), np.float32), quats=np.ones((1000, 4), np.float32),
        log_scales=np.zeros((1000, 3), np.float32), opacity_logits=np.zeros(1000, np.float32),
        sh=np.zeros((1000, 1, 3), np.float32), extras=member_columns(sets),
    )  # fmt: skip
    levels = [Level(1, splats.select(slice(0, 10)), {"d_l": 20.0}), Level(2, splats, {"d_l": 0.0})]
    table = {"x": [0, 10], "y": [0, 0], "z": [0, 0], "radius": [10, 10]}
    table = {name: np.float32(values) for name, values in table.items()}
    with scenes.new_scene(bpy.context, "town") as root:
        for one in levels:
            scenes.put_level(root, one)
        scenes.set_bundle_facts(root, Bundle("lodge", levels, "chunks"))
        scenes.set_tables(root, {"chunks": table})
    root.lodgs.mode, root.lodgs.eye = "SELECTIVE", "TRAINING"
    return root


def test_chunks_are_told_with_what_is_loaded_and_what_is_drawn(bpy, lodgs, town, draw):
    def told(eye, **controls):
        town.lodgs.camera_center = eye
        for name, value in controls.items():
            setattr(town.lodgs.controls, name, value)
        bpy.context.view_layer.update()
        return draw().texts

    megabytes = lodgs("data.objects").megabytes
    size = sum(megabytes(item.object.data) for item in town.lodgs.levels)
    each = size / 1010
    texts = told((2.5, 0, 0))
    assert "Chunks 0 and 1, 25 %" in texts and "310 of 1,010 splats shown" in texts
    assert f"310 loaded, {310 * each:.1f} MB" in texts
    assert any("sets of chunks are fixed" in text for text in texts)
    texts = told((0, -11.25, 0))
    assert "Chunk 0, 50 % outside" in texts and f"1,010 loaded, {size:.1f} MB" in texts
    assert not any("fixed" in text for text in texts)
    texts = told((-1, 0, 0))
    assert "Chunk 0" in texts and "110 of 1,010 splats shown" in texts
    assert f"110 loaded, {110 * each:.1f} MB" in texts
    texts = told((-1, 0, 0), chunks=False)
    assert not any("Chunk" in text or "loaded" in text for text in texts)
    assert "Only chunks fade into each other." in texts


def test_what_is_loaded_is_counted_anew_when_the_splats_change(bpy, lodgs, town):
    loaded, cloud = lodgs("data.loaded"), town.lodgs.levels[1].object.data
    bpy.context.view_layer.update()
    choice = loaded.chosen(bpy.context, town)
    assert loaded.count_loaded(town, choice)[0] == 110
    lodgs("attributes").write_attribute(cloud, "chunks_0", "FLOAT", np.ones(1000, np.float32))
    cloud.update_tag()
    bpy.context.view_layer.update()
    assert loaded.count_loaded(town, choice)[0] == 1010


def test_the_chunks_can_be_shown_and_told_by_colour(town, draw, draw_panel, root):
    assert "hide_viewport" in draw().properties
    assert "tell CHUNKS" in draw_panel("viewport", "LODGS_PT_viewport").properties
    town.lodgs.tell = "CHUNKS"
    assert not draw_panel("viewport", "LODGS_PT_viewport").colors


def test_splats_without_chunks_say_so(bpy, root, draw):
    made = root("chunks")
    made.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    notes = draw()
    assert "These splats have no chunks." in notes.texts and "hide_viewport" not in notes.properties


def test_distances_and_what_they_cost_are_told_in_blenders_units(bpy, lodgs, draw_panel, tmp_path):
    from training.scenes.images import write_png

    collection = bpy.data.collections.new("town")
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new("town", None)
    collection.objects.link(root)
    root.lodgs.is_root, root.scale = True, (2, 2, 2)
    bundles, scenes = lodgs("training.splats.bundle"), lodgs("data.scenes")
    scenes.set_level(root, bundles.Level(1, bundles.NO_SPLATS))
    bpy.context.view_layer.update()
    panel = lodgs("panels.levels_costs").LODGS_PT_costs
    assert not panel.poll(bpy.context)
    meta = {"costs": [{"level": 2, "distances": [3, 7.1], "costs": [812, 301], "before": 900}]}
    root.lodgs.meta = json.dumps(meta)
    assert panel.poll(bpy.context)
    notes = draw_panel("levels_costs", "LODGS_PT_costs")
    assert notes.texts[1:] == ["Level 2 from 14.2 m: 900 → 301"] and not notes.operators
    with pytest.raises(RuntimeError, match="No run with a cost curve"):
        bpy.ops.lodgs.show_costs()
    root.lodgs.training.run = str(tmp_path)
    write_png(tmp_path / "costs.png", np.zeros((540, 960, 3), np.uint8))
    assert draw_panel("levels_costs", "LODGS_PT_costs").operators == ["lodgs.show_costs"]
    assert bpy.ops.lodgs.show_costs() == {"FINISHED"}
    assert tuple(bpy.data.images["costs.png"].size) == (960, 540)


@pytest.fixture
def tree(bpy, lodgs, tmp_path):
    """A scene of a small tree of splats."""
    bundle = tree_of(random_leaves(50, np.random.default_rng(1)))
    lodgs("training.splats.bundle").write_bundle(tmp_path / "tree.ply", bundle)
    return lodgs("data.scenes").import_splats(bpy.context, tmp_path / "tree.ply")


def test_panels_say_what_a_trees_coarser_level_is(tree, draw_panel):
    texts = draw_panel("levels", "LODGS_PT_levels").texts
    assert any("Splats of level 1 stand for groups of level 2's" in text for text in texts)
    tree.lodgs.tell = "LEVELS"
    notes = draw_panel("viewport", "LODGS_PT_viewport")
    assert not notes.colors and any("half as large" in text for text in notes.texts)


def test_what_is_read_from_a_file_is_told(bpy, lodgs, draw, draw_panel, tmp_path, monkeypatch):
    bundles, tree = lodgs("training.splats.bundle"), tree_of(random_leaves(3000, np.random.default_rng(0)))
    bundles.write_bundle(tmp_path / "town.ply", tree)
    panel = lodgs("panels.levels").LODGS_PT_stream
    whole = lodgs("data.scenes").import_splats(bpy.context, tmp_path / "town.ply")
    assert not panel.poll(bpy.context)
    lodgs("data.removal").remove(whole)
    root = lodgs("data.scenes").import_splats(bpy.context, tmp_path / "town.ply", budget=2000)
    assert panel.poll(bpy.context) and not any("splats shown" in text for text in draw().texts)

    def texts():
        return draw_panel("levels", "LODGS_PT_stream").texts

    views, streaming = lodgs("viewport.views"), lodgs("viewport.streaming")
    assert texts() == ["499 of 5,999 splats in memory", "Finer ones are read when drawn"]
    monkeypatch.setattr(streaming.Stream, "_open", lambda self: None)
    stream = streaming.Stream(lodgs("data.streams").source_of(root))
    monkeypatch.setitem(views._streams, root.session_uid, stream)
    assert texts()[1:] == ["Reading finer ones…"]
    stream.problem = "The disk is gone."
    assert "The disk is gone." in " ".join(texts())
    root.lodgs.mode = "SINGLE"
    assert "By Distance" in " ".join(texts())
    bpy.data.objects.remove(root.lodgs.levels[0].object)
    assert "drawn as they are" in " ".join(texts())
