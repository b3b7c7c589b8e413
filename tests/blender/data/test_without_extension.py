"""Without the extension, Blender shows the finest level of a file as points."""

import json
import subprocess
import sys

import pytest

from tests.blender.fake_trainer import splats
from tools.blender_module import EXTENSION
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level

COUNTS = {1: 5, 2: 20, 3: 9}
LIST_CLOUDS = """
import bpy, json, sys
import numpy as np
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
depsgraph, result = bpy.context.evaluated_depsgraph_get(), {}
for obj in bpy.data.objects:
    if obj.type == "POINTCLOUD" and obj.visible_get():
        cloud = obj.evaluated_get(depsgraph).data
        radii = np.zeros(len(cloud.points), np.float32)
        cloud.attributes["radius"].data.foreach_get("value", radii)
        result[obj.name] = [len(radii), float(radii.min()), obj.hide_render]
assert not hasattr(bpy.types.Object, "lodgs")
result["text"] = bpy.data.texts["About these splats"].as_string()
sys.stdout.write("\\nRESULT" + json.dumps(result))
sys.stdout.flush()
import os
os._exit(0)
"""


@pytest.mark.parametrize("cumulative", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_finest_level_appears_as_points(bpy, lodgs, tmp_path, cumulative):
    s_min = {1: 0.1, 2: 0.05, 3: 0.0}
    levels = [Level(number, splats(count), {"s_min": s_min[number]}) for number, count in COUNTS.items()]
    rule, facts = ("octree", {"d_max": 9.0, "d_max_focal": 500.0}) if cumulative else ("bands", {})
    write_bundle(tmp_path / "b.ply", Bundle("made", levels, rule, facts, cumulative=cumulative))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    root.lodgs.mode, root.lodgs.levels[2].show = "SELECTIVE", False
    bpy.context.view_layer.update()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    command = [sys.executable, "-c", LIST_CLOUDS, str(tmp_path / "b.blend")]
    out = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout
    clouds = json.loads(out.rpartition("RESULT")[2])
    assert "extension LODGS" in clouds.pop("text")
    expected = COUNTS if cumulative else {3: COUNTS[3]}
    assert {name: cloud[0] for name, cloud in clouds.items()} == {
        f"b level {number}": count for number, count in expected.items()
    }
    assert all(radius > 0 and not hidden for _, radius, hidden in clouds.values())


def test_enabling_the_extension_restores_the_open_file(bpy, lodgs, tmp_path):
    """Drivers that were evaluated without their properties stay invalid in Blender until they are edited."""
    import addon_utils

    levels = [Level(number, splats(count), {"s_min": 0.1 / number}) for number, count in COUNTS.items()]
    write_bundle(tmp_path / "b.ply", Bundle("made", levels, "bands"))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    addon_utils.disable(EXTENSION)
    try:
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
        bpy.context.view_layer.update()
    finally:
        addon_utils.enable(EXTENSION)
    older_files = lodgs("data.older_files")
    assert bpy.app.timers.is_registered(older_files._upgrade_open_file)  # timers do not run in background
    assert bpy.app.timers.is_registered(lodgs("runs.jobs").reattach)
    older_files._upgrade_open_file()
    root, level = bpy.data.objects["b"], bpy.data.objects["b level 2"]
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    assert level.visible_get() and level.modifiers["LODGS Bands"].show_viewport
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 1
    bpy.context.view_layer.update()
    assert not level.visible_get() and not level.modifiers["LODGS Bands"].show_viewport
    assert all(curve.driver.is_valid for obj in (root, level) for curve in obj.animation_data.drivers)
