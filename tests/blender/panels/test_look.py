"""The Look panel: the scene, its regions and a selected crop."""

import numpy as np

from tests.training.editing.test_cleaning import bundle_of
from training.editing.look import LOOK_SETTINGS
from training.splats.bundle import write_bundle


def test_panel_shows_looks_of_scene_regions_and_selected_crop(bpy, lodgs, draw_panel, tmp_path):
    write_bundle(tmp_path / "in.ply", bundle_of("bands", np.random.default_rng(0)))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")
    layout = draw_panel("look", "LODGS_PT_look")
    assert layout.properties == list(LOOK_SETTINGS) and "lodgs.reset_look" in layout.operators

    def draw_regions():
        return draw_panel("look", "LODGS_PT_look_regions")

    assert not draw_regions().properties and draw_regions().operators == ["lodgs.add_crop"] * 2
    bpy.ops.lodgs.add_crop(shape="BOX", keep="ALL")
    assert draw_regions().properties == ["use", "name", *LOOK_SETTINGS, "outside"]
    bpy.ops.lodgs.add_crop(shape="SPHERE", keep="INSIDE")
    assert draw_regions().properties.count("exposure") == 2
    bpy.context.view_layer.objects.active = root
    assert draw_regions().properties.count("exposure") == 1
    assert "lodgs.tint_by_light" not in draw_panel("look", "LODGS_PT_look").operators
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))
    bpy.context.scene.collection.objects.link(lamp)
    assert "lodgs.tint_by_light" in draw_panel("look", "LODGS_PT_look").operators
    assert "lodgs.tint_by_light" in draw_regions().operators
