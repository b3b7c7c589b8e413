"""Levels that are prefixes of an ordered set: single levels, budgets, and saved files that keep the order."""

import numpy as np
import pytest

from tests.training.lod.test_prefix import ordered
from training.splats.bundle import read_bundle, write_bundle


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "in.ply", ordered())
    return lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply", upright=False)


def drawn_ranks(bpy, root):
    """Return the ranks of all points that the node groups keep."""
    bpy.context.view_layer.update()
    depsgraph, ranks = bpy.context.evaluated_depsgraph_get(), []
    for item in root.lodgs.levels:
        if item.object.visible_get():
            cloud = item.object.evaluated_get(depsgraph).data
            values = np.empty(len(cloud.points), np.float32)
            if len(values):
                cloud.attributes["prefix_rank"].data.foreach_get("value", values)
            ranks.append(values)
    return sorted(np.concatenate(ranks).astype(int).tolist())


def test_one_level_shows_a_prefix(bpy, root):
    for number, count in ((1, 120), (2, 500), (3, 1000)):
        root.lodgs.mode, root.lodgs.single_level = "SINGLE", number
        assert drawn_ranks(bpy, root) == list(range(count))


@pytest.mark.parametrize("count", [1, 121, 640])
def test_budget_is_exact(bpy, root, count):
    root.lodgs.mode = "SELECTIVE"
    root.lodgs.controls.at_most = count
    assert drawn_ranks(bpy, root) == list(range(count))


def test_saved_levels_keep_the_order(bpy, lodgs, root, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bundle = lodgs("data.scenes").read_levels(lodgs("data.roots").roots(bpy.context.scene)[0])
    write_bundle(tmp_path / "out.ply", bundle)
    for level, original in zip(read_bundle(tmp_path / "out.ply").levels, ordered().levels, strict=True):
        np.testing.assert_array_equal(level.splats.means, original.splats.means)
        for name in ("prefix_rank", "view_distance"):
            np.testing.assert_array_equal(level.splats.extras[name], original.splats.extras[name])
