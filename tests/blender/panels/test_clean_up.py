"""The Clean Up panel and its menu."""

import numpy as np

from tests.training.editing.test_cleaning import bundle_of
from training.splats.bundle import write_bundle


def test_panel_shows_crops_selection_and_counts(bpy, lodgs, draw_panel, tmp_path):
    write_bundle(tmp_path / "in.ply", bundle_of("bands", np.random.default_rng(0)))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")
    layout = draw_panel("clean_up", "LODGS_PT_clean_up")
    assert "Level 1: 700 of 700 splats" in layout.texts
    assert layout.buttons.count("Floaters") == 1 and "lodgs.delete_hidden_splats" in layout.operators
    assert "keep" not in layout.properties

    assert {"Brush", "Lasso"} <= set(layout.buttons) and {"radius", "through"} <= set(layout.properties)
    assert "Deselect" not in layout.buttons
    assert bpy.ops.lodgs.select_all_splats(action="INVERT") == {"FINISHED"}
    layout = draw_panel("clean_up", "LODGS_PT_clean_up")
    assert {"Hide 4,200", "Deselect", "Invert"} <= set(layout.buttons)
    bpy.ops.lodgs.select_all_splats(action="DESELECT")

    bpy.ops.lodgs.add_crop(shape="SPHERE", keep="OUTSIDE")
    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.3)
    bpy.context.view_layer.update()
    layout = draw_panel("clean_up", "LODGS_PT_clean_up")
    assert {"use", "name", "keep"} <= set(layout.properties) and "lodgs.remove_crop" in layout.operators
    level = root.lodgs.levels[2].object
    root.lodgs.single_level = 3
    bpy.context.view_layer.update()
    visible = len(level.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.points)
    assert f"Level 3: {visible:,} of 2,100 splats" in layout.texts and visible < 2100

    lodgs("data.scenes").set_level(root, bundle_of("bands", np.random.default_rng(1)).levels[0])
    assert "level 1: " in " ".join(draw_panel("clean_up", "LODGS_PT_clean_up").texts)


def test_menus_list_the_clean_up_operators(bpy, lodgs):
    """F3 search finds operators that menus list."""
    menu = bpy.types.LODGS_MT_clean_up
    assert menu in lodgs("operators.clean_up").CLASSES
    for parent in (bpy.types.VIEW3D_MT_object, bpy.types.VIEW3D_MT_edit_pointcloud):
        assert lodgs("operators.clean_up")._menu in parent._dyn_ui_initialize()
