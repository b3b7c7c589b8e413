"""The Clean Up panel and its menu."""

import numpy as np

from tests.training.editing.test_cleaning import bundle_of
from training.splats.bundle import write_bundle


def test_crops_tests_and_counts_are_there(bpy, lodgs, draw_panel, tmp_path):
    write_bundle(tmp_path / "in.ply", bundle_of("bands", np.random.default_rng(0)))
    root = lodgs("data.scenes").import_splats(bpy.context, tmp_path / "in.ply")
    seen = draw_panel("clean_up", "LODGS_PT_clean_up")
    assert "Level 1: 700 of 700 left" in seen.texts
    assert seen.buttons.count("Floaters") == 1 and "lodgs.delete_left_out" in seen.operators
    assert "keep" not in seen.properties

    assert {"Brush", "Lasso"} <= set(seen.buttons) and {"radius", "through"} <= set(seen.properties)
    assert "Deselect" not in seen.buttons
    assert bpy.ops.lodgs.select_all_splats(action="INVERT") == {"FINISHED"}
    seen = draw_panel("clean_up", "LODGS_PT_clean_up")
    assert {"Hide 4,200", "Deselect", "Invert"} <= set(seen.buttons)
    bpy.ops.lodgs.select_all_splats(action="DESELECT")

    bpy.ops.lodgs.add_crop(shape="SPHERE", keep="OUTSIDE")
    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.3)
    bpy.context.view_layer.update()
    seen = draw_panel("clean_up", "LODGS_PT_clean_up")
    assert {"use", "name", "keep"} <= set(seen.properties) and "lodgs.remove_crop" in seen.operators
    level = root.lodgs.levels[2].object
    root.lodgs.single_level = 3
    bpy.context.view_layer.update()
    left = len(level.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.points)
    assert f"Level 3: {left:,} of 2,100 left" in seen.texts and left < 2100

    lodgs("data.scenes").set_level(root, bundle_of("bands", np.random.default_rng(1)).levels[0])
    assert "level 1: " in " ".join(draw_panel("clean_up", "LODGS_PT_clean_up").texts)


def test_every_verb_is_in_a_menu(bpy, lodgs):
    """Blender's search finds what menus show."""
    menu = bpy.types.LODGS_MT_clean_up
    assert menu in lodgs("operators.clean_up").CLASSES
    for where in (bpy.types.VIEW3D_MT_object, bpy.types.VIEW3D_MT_edit_pointcloud):
        assert lodgs("operators.clean_up")._menu in where._dyn_ui_initialize()
