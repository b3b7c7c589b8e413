"""Trees of splats in Blender: cuts by distance, and the finest level alone. Other levels are incomplete."""

from functools import partial

import numpy as np
import pytest

from tests.training.lod.tree.trees import random_leaves, tree_of

LEAVES = 3000


@pytest.fixture
def tree():
    return tree_of(random_leaves(LEAVES, np.random.default_rng(1)))


@pytest.fixture
def root(bpy, lodgs, tree, tmp_path):
    lodgs("training.splats.bundle").write_bundle(tmp_path / "tree.ply", tree)
    return lodgs("data.importing").import_splats(bpy.context, tmp_path / "tree.ply")


def shown_rows(bpy, lodgs, root):
    """Return the rows of the visible splats of each level. All positions in these scenes differ."""
    bpy.context.view_layer.update()
    depsgraph, visible_rows = bpy.context.evaluated_depsgraph_get(), []
    read = lodgs("attributes").read_attribute
    for item in root.lodgs.levels:
        if not item.object.visible_get():
            visible_rows.append(np.zeros(0, int))
            continue
        positions = read(item.object.evaluated_get(depsgraph).data, "position")
        positions = np.zeros((0, 3)) if positions is None else positions
        rows = {tuple(position): row for row, position in enumerate(read(item.object.data, "position"))}
        visible_rows.append(np.sort([rows[tuple(position)] for position in positions]).astype(int))
    return visible_rows


def expected_rows(lodgs, tree, camera_center, focal, pixels):
    selector = lodgs("training.lod.selection").BundleSelector(tree)
    weights = selector.level_weights(np.float32(camera_center), focal, {"pixels": pixels})
    return [np.flatnonzero(level) for level in weights]


def test_distances_are_measured_in_scene_space(bpy, lodgs, tree, root):
    """The root's transform has no effect; the focal length is in pixels of the render."""
    assert (root.lodgs.mode, root.lodgs.single_level) == ("SELECTIVE", 2)
    root.location, root.rotation_euler, root.scale = (5, 6, 7), (1, 2, 3), (3, 3, 3)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.view_layer.update()
    counts = []
    for center, lens, pixels in (
        ((0, 0, 20), 50, 20),
        ((0, 0, 20), 50, 60),
        ((0, 0, 20), 25, 30),
        ((60, 3, 9), 50, 20),
    ):
        camera.location = root.lodgs.axes.matrix_world @ camera.location.__class__(center)
        camera.data.lens, root.lodgs.controls.pixels = lens, pixels
        bpy.context.view_layer.update()
        visible = shown_rows(bpy, lodgs, root)
        focal = lens * bpy.context.scene.render.resolution_x / 36
        local_center = root.lodgs.axes.matrix_world.inverted() @ camera.matrix_world.translation
        expected = expected_rows(lodgs, tree, local_center, focal, pixels)
        # rounding may move a splat on a border to its other side
        assert sum(len(np.setxor1d(a, b)) for a, b in zip(visible, expected, strict=True)) <= 4
        counts.append([len(rows) for rows in visible])
    assert counts[0][1] > counts[1][1] and counts[1] == pytest.approx(counts[2], abs=4)
    assert counts[3][1] < counts[0][1] and all(
        0 < sum(counts_of_levels) < LEAVES for counts_of_levels in counts
    )


def test_incomplete_level_cannot_be_shown_or_exported_alone(bpy, lodgs, root, tmp_path):
    scenes, LodgsError = lodgs("data.scenes"), lodgs("training.errors").LodgsError
    root.lodgs.single_level = 1
    assert root.lodgs.single_level == 2
    root.lodgs.mode = "SINGLE"
    assert [len(rows) for rows in shown_rows(bpy, lodgs, root)] == [0, LEAVES]
    for function in (scenes.show_only, scenes.read_level):
        with pytest.raises(LodgsError, match=r"Cannot use level 1 on its own.* Choose level 2"):
            function(root, 1)
    scenes.show_only(root, 2)
    assert len(scenes.read_level(root, 2)) == LEAVES
    with pytest.raises(RuntimeError, match="level 1 on its own"):
        bpy.ops.lodgs.show_only_level(level=1)
    with pytest.raises(RuntimeError, match="level 1 on its own"):
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "a.ply"), source="LEVEL", level=1)
    with pytest.raises(RuntimeError, match="coarsest level first"):
        bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "a.ply"), order="stream")
    assert [path.name for path in tmp_path.iterdir()] == ["tree.ply"]


def test_folder_has_complete_levels(bpy, lodgs, tree, root, tmp_path):
    assert bpy.ops.lodgs.export_folder(directory=str(tmp_path / "levels")) == {"FINISHED"}
    exported = lodgs("training.splats.level_folder").read_folder(tmp_path / "levels")
    counts = [len(level.splats) for level in exported.levels]
    assert exported.rule == "bands" and counts[-1] == LEAVES and 500 <= counts[0] <= LEAVES / 4
    levels = lodgs("data.importing").import_splats(bpy.context, tmp_path / "levels").lodgs.levels
    assert len(levels) == len(counts) == 2


def test_bundle_round_trip_keeps_the_tree(bpy, lodgs, tree, root, tmp_path):
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "again.ply"))
    exported = lodgs("training.splats.bundle").read_bundle(tmp_path / "again.ply")
    assert (exported.rule, exported.method) == ("cut", "tree")
    for level, exported_level in zip(tree.levels, exported.levels, strict=True):
        for name, column in level.splats.extras.items():
            np.testing.assert_array_equal(exported_level.splats.extras[name], column)
        np.testing.assert_array_equal(exported_level.splats.means, level.splats.means)


def test_coarse_nodes_of_a_tree_are_imported_within_a_budget(bpy, lodgs, tree, root, tmp_path):
    """The imported nodes are a smaller tree with complete cuts."""
    messages, budget = [], 2000
    root = lodgs("data.importing").import_splats(
        bpy.context, tmp_path / "tree.ply", budget=budget, warn=messages.append
    )
    counts = [len(item.object.data.points) for item in root.lodgs.levels]
    assert 400 < sum(counts) <= budget / 4 and counts[1] == counts[0] + 1  # a binary tree
    assert messages == [
        f"Imported the coarsest {sum(counts):,} of {2 * LEAVES - 1:,} splats. Viewports and renders of LODGS "
        "stream finer ones from tree.ply."
    ]
    root.lodgs.mode = "SINGLE"
    assert [len(rows) for rows in shown_rows(bpy, lodgs, root)] == [0, counts[1]]
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "tree.ply"), budget=budget)
    second_root = lodgs("data.roots").active_root(bpy.context)
    assert [len(item.object.data.points) for item in second_root.lodgs.levels] == counts
    full_root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "tree.ply", budget=10**6)
    assert [len(item.object.data.points) for item in full_root.lodgs.levels] == [LEAVES - 1, LEAVES]


def test_colours_show_node_sizes(bpy, lodgs):
    """Colours are numbered by octaves of node size. Leaves have the last number."""
    rule = lodgs("training.lod.rule").rules()["cut"]
    splat_level = partial(rule.splat_level, facts={"level": 1.0})
    sizes = np.float32([0, 1, 1.9, 2, 4, 0.5, 0.3, 2.0**10, 2.0**11])
    assert splat_level({"node_size": sizes}).tolist() == [12, 1, 1, 11, 10, 2, 3, 2, 1]
    means = np.float32([[0, 0, d] for d in (31.9, 32, 64, 128)])
    target_levels = rule.target_level(means, np.zeros(3, np.float32), 64.0, {"level": 1.0}, {"pixels": 2.0})
    assert target_levels.tolist() == [2, 1, 11, 10]
