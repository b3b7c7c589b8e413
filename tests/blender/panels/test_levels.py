"""The Levels, Detail, Distances and Streaming panels, for every rule and without a rule."""

import json

import numpy as np
import pytest

from tests.blender.panels.conftest import RecordingLayout
from tests.training.lod.tree.trees import random_leaves, tree_of
from training.lod.rule import rules
from training.lod.rules.chunks import member_columns
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    """Return a function that imports a scene of one splat with a rule of the given name."""
    bundles, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    zeros = np.zeros((1, 3), np.float32)
    splats = gaussians.Splats(
        means=zeros, quats=np.float32([[1, 0, 0, 0]]), log_scales=zeros, opacity_logits=zeros[:, 0],
        sh=np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip

    def make(name):
        rule = rules().get(name)
        facts = (
            [dict.fromkeys(names, 1.0) for names in (rule.scene_facts, rule.level_facts)]
            if rule
            else ({}, {})
        )
        cumulative = bool(rule and rule.cumulative)
        bundle = bundles.Bundle(
            "any", [bundles.Level(1, splats, facts[1])], name, facts[0], cumulative=cumulative
        )
        bundles.write_bundle(tmp_path / "b.ply", bundle)
        return lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")

    return make


@pytest.fixture
def draw(draw_panel):
    return lambda: draw_panel("levels", "LODGS_PT_detail")


@pytest.mark.parametrize("name", sorted(rules()))
def test_every_control_of_a_rule_has_a_property_of_its_type(root, draw, name):
    scene_root = root(name)
    scene_root.lodgs.mode = "SELECTIVE"
    layout, controls = draw(), rules()[name].controls
    assert layout.properties == ["mode", *(control.name for control in controls), "camera_choice", "freeze"]
    assert layout.sliders == [control.name for control in controls if control.soft]
    properties = scene_root.lodgs.controls.bl_rna.properties
    for control in controls:
        kind = "BOOLEAN" if control.flag else "INT" if control.integer else "FLOAT"
        assert properties[control.name].type == kind
        if control.integer and not control.flag:
            assert properties[control.name].step == control.step


@pytest.mark.parametrize("name", sorted(rules()))
def test_one_level_warns_if_splats_are_trained_for_distances(root, draw, name):
    root(name).lodgs.mode = "SINGLE"
    layout = draw()
    assert layout.properties == ["mode", "single_level"]
    assert any("too opaque" in text for text in layout.texts) == rules()[name].weights_full_detail


def test_levels_without_a_known_rule_cause_a_hint(root, draw):
    root("")
    assert "These levels cannot be selected by distance." in draw().texts
    root("weave")
    assert any("'weave'" in text for text in draw().texts)


@pytest.fixture
def town(bpy, lodgs):
    """A scene with a level of 1000 splats for distances below 20, a level of 10 beyond, and two chunks."""
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
    with lodgs("data.importing").new_scene(bpy.context, "town") as root:
        for level in levels:
            scenes.put_level(root, level)
        scenes.set_bundle_facts(root, Bundle("lodge", levels, "chunks"))
        scenes.set_tables(root, {"chunks": table})
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "TRAINING"
    return root


def test_missing_object_for_distances_is_reported(bpy, root, draw):
    scene_root = root("bands")
    scene_root.lodgs.mode, scene_root.lodgs.camera_choice = "SELECTIVE", "OBJECT"
    assert "No object" in draw().texts
    scene_root.lodgs.camera_object = bpy.data.objects.new("actor", None)
    assert "No object" not in draw().texts


def test_chunk_of_the_camera_and_loaded_splats_are_shown(bpy, lodgs, town, draw):
    def draw_at(camera, **controls):
        town.lodgs.camera_center = camera
        for name, value in controls.items():
            setattr(town.lodgs.controls, name, value)
        bpy.context.view_layer.update()
        return draw().texts

    megabytes = lodgs("data.objects").megabytes
    size = sum(megabytes(item.object.data) for item in town.lodgs.levels)
    per_splat = size / 1010
    texts = draw_at((2.5, 0, 0))
    assert "Chunks 0 and 1, 25 %" in texts and "310 of 1,010 splats shown" in texts
    assert f"310 loaded, {310 * per_splat:.1f} MB" in texts
    assert any("sets of chunks are fixed" in text for text in texts)
    texts = draw_at((0, -11.25, 0))
    assert "Chunk 0, 50 % outside" in texts and f"1,010 loaded, {size:.1f} MB" in texts
    assert not any("fixed" in text for text in texts)
    texts = draw_at((-1, 0, 0))
    assert "Chunk 0" in texts and "110 of 1,010 splats shown" in texts
    assert f"110 loaded, {110 * per_splat:.1f} MB" in texts
    texts = draw_at((-1, 0, 0), chunks=False)
    assert not any("Chunk" in text or "loaded" in text for text in texts)
    assert "Only chunks fade." in texts


def test_loaded_splats_are_counted_again_when_splats_change(bpy, lodgs, town):
    detail, cloud = lodgs("data.detail"), town.lodgs.levels[1].object.data
    bpy.context.view_layer.update()
    query = detail.current_query(bpy.context, town)
    assert detail.count_loaded(town, query)[0] == 110
    lodgs("attributes").write_attribute(cloud, "chunks_0", "FLOAT", np.ones(1000, np.float32))
    cloud.update_tag()
    bpy.context.view_layer.update()
    assert detail.count_loaded(town, query)[0] == 1010


def test_chunks_can_be_shown_as_spheres_and_colours(town, draw, draw_panel, root):
    assert "hide_viewport" in draw().properties
    assert "colors CHUNKS" in draw_panel("viewport", "LODGS_PT_viewport").properties
    town.lodgs.colors = "CHUNKS"
    assert not draw_panel("viewport", "LODGS_PT_viewport").colors


def test_splats_without_chunks_cause_a_hint(bpy, root, draw):
    root("chunks").lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    layout = draw()
    assert "These splats have no chunks." in layout.texts and "hide_viewport" not in layout.properties


def test_distances_and_costs_are_shown_in_blender_units(bpy, lodgs, draw_panel, tmp_path):
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
    layout = draw_panel("levels_costs", "LODGS_PT_costs")
    assert layout.texts[1:] == ["Level 2 from 14.2 m: 900 → 301"] and not layout.operators
    with pytest.raises(RuntimeError, match="cost curve"):
        bpy.ops.lodgs.show_costs()
    root.lodgs.training.run = str(tmp_path)
    write_png(tmp_path / "costs.png", np.zeros((540, 960, 3), np.uint8))
    assert draw_panel("levels_costs", "LODGS_PT_costs").operators == ["lodgs.show_costs"]
    assert bpy.ops.lodgs.show_costs() == {"FINISHED"}
    assert tuple(bpy.data.images["costs.png"].size) == (960, 540)


@pytest.fixture
def tree(bpy, lodgs, tmp_path):
    """A scene with a small tree of splats."""
    bundle = tree_of(random_leaves(50, np.random.default_rng(1)))
    lodgs("training.splats.bundle").write_bundle(tmp_path / "tree.ply", bundle)
    return lodgs("data.importing").import_splats(bpy.context, tmp_path / "tree.ply")


def test_panels_explain_the_coarse_level_of_a_tree(tree, draw_panel):
    texts = draw_panel("levels", "LODGS_PT_levels").texts
    assert any("Only level 2 is a complete scene" in text for text in texts)
    tree.lodgs.colors = "LEVELS"
    layout = draw_panel("viewport", "LODGS_PT_viewport")
    assert not layout.colors and any("half the size" in text for text in layout.texts)


def test_state_of_streaming_is_shown(bpy, lodgs, draw, draw_panel, tmp_path, monkeypatch):
    bundles, tree = lodgs("training.splats.bundle"), tree_of(random_leaves(3000, np.random.default_rng(0)))
    bundles.write_bundle(tmp_path / "town.ply", tree)
    panel = lodgs("panels.levels").LODGS_PT_stream
    in_memory = lodgs("data.importing").import_splats(bpy.context, tmp_path / "town.ply")
    assert not panel.poll(bpy.context)
    lodgs("data.removal").remove(in_memory)
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "town.ply", budget=2000)
    assert panel.poll(bpy.context) and not any("splats shown" in text for text in draw().texts)

    def texts():
        return draw_panel("levels", "LODGS_PT_stream").texts

    sources, streaming = lodgs("viewport.sources"), lodgs("viewport.streaming")
    assert texts() == ["499 of 5,999 splats in memory", "Streams when the viewport draws splats"]
    monkeypatch.setattr(streaming.Stream, "_open", lambda self: None)
    stream = streaming.Stream(lodgs("data.streams").source_of(root))
    monkeypatch.setitem(sources._streams, root.session_uid, stream)
    assert texts()[1:] == ["Loading finer splats…"]
    monkeypatch.setattr(streaming.Stream, "splats", 5999)
    stream.ready = True
    assert texts()[0] == "5,999 of 5,999 splats in memory"
    stream.problem = "The disk is gone."
    assert "The disk is gone." in " ".join(texts())
    root.lodgs.mode = "SINGLE"
    assert "By Distance" in " ".join(texts())
    bpy.data.objects.remove(root.lodgs.levels[0].object)
    assert "no longer match the file" in " ".join(texts())


@pytest.mark.parametrize(("width", "count"), [(292, 4), (240, 3), (200, 2), (132, 1)])
def test_narrow_table_has_fewer_columns(lodgs, monkeypatch, width, count):
    levels = lodgs("panels.levels")
    monkeypatch.setattr(levels, "sidebar_width", lambda: width)
    layout = RecordingLayout()
    levels._columns(layout, *"1234")
    assert layout.texts == [*"1234"][:count]


def test_by_distance_shows_its_savings_and_offers_to_reduce_detail(bpy, lodgs, draw):
    """Two levels surround the camera. The fine one covers all distances until gamma is increased."""
    rng = np.random.default_rng(0)
    scenes = lodgs("data.scenes")

    def splats(count):
        return Splats(
            means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
            quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
            log_scales=np.full((count, 3), -5, np.float32), opacity_logits=np.zeros(count, np.float32),
            sh=np.zeros((count, 1, 3), np.float32),
        )  # fmt: skip

    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    with lodgs("data.importing").new_scene(bpy.context, "two") as root:
        for number, count, s_min in ((1, 100, 0.01), (2, 1000, 0.0)):
            scenes.set_level(root, Level(number, splats(count), {"s_min": s_min}))
        scenes.set_bundle_facts(root, Bundle("flod", [], "bands"))
    root.lodgs.mode, root.lodgs.bands.gamma = "SELECTIVE", 1
    bpy.context.view_layer.update()
    layout = draw()
    assert "0% fewer than the finest level" in layout.texts and "lodgs.reduce_detail" in layout.operators
    assert bpy.ops.lodgs.reduce_detail(share=0.4) == {"FINISHED"}
    visible, _ = scenes.count_visible(bpy.context, root)
    savings = 1 - visible / 1000
    assert root.lodgs.bands.gamma > 2 and 0.4 <= savings < 0.42
    layout = draw()
    assert f"{savings:.0%} fewer than the finest level" in layout.texts
    assert "lodgs.reduce_detail" not in layout.operators
    gamma = root.lodgs.bands.gamma
    assert bpy.ops.lodgs.reduce_detail(share=0.3) == {"FINISHED"}  # already saved
    assert root.lodgs.bands.gamma == gamma
    camera.location = (0, 0, 1e-3)
    root.lodgs.levels[0].object.scale = (1, 1, 1)
    root.lodgs.bands.first = 2  # only the finest level is in use
    bpy.context.view_layer.update()
    gamma = root.lodgs.bands.gamma
    root.lodgs.mode = "SINGLE"
    with pytest.raises(RuntimeError, match="Cannot save splats"):
        bpy.ops.lodgs.reduce_detail()
    assert root.lodgs.bands.gamma == gamma and root.lodgs.mode == "SINGLE"


@pytest.mark.parametrize(("width", "count"), [(292, 4), (220, 2)])
def test_narrow_sidebars_list_fewer_columns(lodgs, monkeypatch, width, count):
    panel, layout = lodgs("panels.levels"), RecordingLayout()
    monkeypatch.setattr(panel, "sidebar_width", lambda: width)
    panel._columns(layout, "1", "1,926", "0.5", "all")
    assert layout.texts == ["1", "1,926", "0.5", "all"][:count]
