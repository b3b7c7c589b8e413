"""What the Detail panel offers for every rule, and says where there is none."""

import json

import numpy as np
import pytest

from training.lod.rule import rules


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
