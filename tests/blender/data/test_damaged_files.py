"""Files with raw values that the interface cannot set: they open without errors, and valid parts remain."""

import pytest

from tests.blender.fake_trainer import splats
from training.splats.levels import Bundle, Level


@pytest.fixture
def root(bpy, lodgs):
    """A scene with four levels."""
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_colmap(bpy.context, "examples/lantern_walk", photographs=False)
    scenes.set_bundle_facts(root, Bundle("flod", [], "bands"))
    for number in (1, 2, 3, 4):
        scenes.set_level(root, Level(number, splats(number), {"s_min": 0.4 - 0.1 * number}))
    return root


def raw(group):
    """Return a group's values without the checks of their declaration."""
    return group.bl_system_properties_get() if hasattr(group, "bl_system_properties_get") else group


def reopened(bpy, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "damaged.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "damaged.blend"))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    return root


def test_references_to_other_data_are_cleared(bpy, lodgs, root, tmp_path, capfd):
    raw(root.lodgs)["axes"] = bpy.context.scene
    raw(root.lodgs)["points"] = bpy.context.scene
    raw(root.lodgs.levels[1])["object"] = root.lodgs.levels[1].object.data
    assert lodgs("data.placement").axes_of(root) == root and not root.lodgs.levels[1].exists
    root = reopened(bpy, tmp_path)
    assert root.lodgs.axes is None and root.lodgs.points is None and root.lodgs.cameras is not None
    assert [item.number for item in root.lodgs.levels if item.exists] == [1, 3, 4]
    assert [level.number for level in lodgs("data.scenes").read_levels(root).levels] == [1, 3, 4]
    assert "Traceback" not in capfd.readouterr().err


def test_levels_are_sorted_and_share_nothing(bpy, lodgs, root, tmp_path, capfd):
    levels = root.lodgs.levels
    levels[0].number, levels[1].number = 3, 2  # now 3, 2, 3, 4
    levels[3].object = levels[1].object
    root = reopened(bpy, tmp_path)
    assert [item.number for item in root.lodgs.levels] == [2, 3]
    bundle = lodgs("data.scenes").read_levels(root)
    assert [len(level.splats) for level in bundle.levels] == [2, 1]
    lodgs("data.cleaning").remaining(root, bundle, bpy.context.evaluated_depsgraph_get())
    assert "Traceback" not in capfd.readouterr().err


def test_level_without_a_parent_is_replaced(bpy, lodgs, root):
    """After Object > Parent > Clear Parent (Alt P)."""
    obj = root.lodgs.levels[0].object
    obj.parent = None
    lodgs("data.scenes").set_level(root, Level(1, splats(9), {"s_min": 0.25}))
    item = root.lodgs.levels[0]
    assert item.object == obj and len(obj.data.points) == 9 and "0.25" in item.facts and obj.parent is None
