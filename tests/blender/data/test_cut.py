"""A tree of splats in Blender: a cut by distance, the finest level alone, no coarser one by itself."""

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
    """Which splats of each level are shown, by their places in the level: none repeats in these scenes."""
    bpy.context.view_layer.update()
    depsgraph, found = bpy.context.evaluated_depsgraph_get(), []
    read = lodgs("attributes").read_attribute
    for item in root.lodgs.levels:
        if not item.object.visible_get():
            found.append(np.zeros(0, int))
            continue
        places = read(item.object.evaluated_get(depsgraph).data, "position")
        places = np.zeros((0, 3)) if places is None else places
        rows = {tuple(place): row for row, place in enumerate(read(item.object.data, "position"))}
        found.append(np.sort([rows[tuple(place)] for place in places]).astype(int))
    return found


def wanted_rows(lodgs, tree, eye, focal, pixels):
    choice = lodgs("training.lod.selection").BundleSelector(tree)
    return [np.flatnonzero(w) for w in choice.level_weights(np.float32(eye), focal, {"pixels": pixels})]


def test_distances_are_measured_in_scene_space(bpy, lodgs, tree, root):
    """Wherever the root stands, and by the focal length of the camera in pixels of the render."""
    assert (root.lodgs.mode, root.lodgs.single_level) == ("SELECTIVE", 2)
    root.location, root.rotation_euler, root.scale = (5, 6, 7), (1, 2, 3), (3, 3, 3)
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.view_layer.update()
    counts = []
    for eye, lens, pixels in (
        ((0, 0, 20), 50, 20),
        ((0, 0, 20), 50, 60),
        ((0, 0, 20), 25, 30),
        ((60, 3, 9), 50, 20),
    ):
        camera.location = root.lodgs.axes.matrix_world @ camera.location.__class__(eye)
        camera.data.lens, root.lodgs.controls.pixels = lens, pixels
        bpy.context.view_layer.update()
        found = shown_rows(bpy, lodgs, root)
        focal = lens * bpy.context.scene.render.resolution_x / 36
        own = root.lodgs.axes.matrix_world.inverted() @ camera.matrix_world.translation
        wanted = wanted_rows(lodgs, tree, own, focal, pixels)
        # a splat on a border may fall on its other side, where numbers are rounded elsewhere
        assert sum(len(np.setxor1d(a, b)) for a, b in zip(found, wanted, strict=True)) <= 4
        counts.append([len(rows) for rows in found])
    assert counts[0][1] > counts[1][1] and counts[1] == pytest.approx(counts[2], abs=4)
    assert counts[3][1] < counts[0][1] and all(0 < sum(each) < LEAVES for each in counts)


def test_incomplete_level_is_neither_shown_nor_exported_alone(bpy, lodgs, root, tmp_path):
    scenes, LodgsError = lodgs("data.scenes"), lodgs("training.errors").LodgsError
    root.lodgs.single_level = 1
    assert root.lodgs.single_level == 2
    root.lodgs.mode = "SINGLE"
    assert [len(rows) for rows in shown_rows(bpy, lodgs, root)] == [0, LEAVES]
    for refused in (scenes.show_only, scenes.read_level):
        with pytest.raises(LodgsError, match=r"Cannot use level 1 on its own.* Choose level 2"):
            refused(root, 1)
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
    again = lodgs("training.splats.level_folder").read_folder(tmp_path / "levels")
    counts = [len(level.splats) for level in again.levels]
    assert again.rule == "bands" and counts[-1] == LEAVES and 500 <= counts[0] <= LEAVES / 4
    levels = lodgs("data.importing").import_splats(bpy.context, tmp_path / "levels").lodgs.levels
    assert len(levels) == len(counts) == 2


def test_bundle_round_trip_keeps_the_tree(bpy, lodgs, tree, root, tmp_path):
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "again.ply"))
    again = lodgs("training.splats.bundle").read_bundle(tmp_path / "again.ply")
    assert (again.rule, again.method) == ("cut", "tree")
    for one, other in zip(tree.levels, again.levels, strict=True):
        for name, column in one.splats.extras.items():
            np.testing.assert_array_equal(other.splats.extras[name], column)
        np.testing.assert_array_equal(other.splats.means, one.splats.means)


def test_the_top_of_a_tree_can_be_imported(bpy, lodgs, tree, root, tmp_path):
    """As a smaller tree: of each leaf and the nodes above it one is there, whatever the eye."""
    said, budget = [], 2000
    root = lodgs("data.importing").import_splats(
        bpy.context, tmp_path / "tree.ply", budget=budget, warn=said.append
    )
    counts = [len(item.object.data.points) for item in root.lodgs.levels]
    assert 400 < sum(counts) <= budget / 4 and counts[1] == counts[0] + 1  # a binary tree
    assert said == [
        f"Imported the coarsest {sum(counts):,} of {2 * LEAVES - 1:,} splats. Viewports and renders of LODGS "
        "stream finer ones from tree.ply."
    ]
    root.lodgs.mode = "SINGLE"
    assert [len(rows) for rows in shown_rows(bpy, lodgs, root)] == [0, counts[1]]
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "tree.ply"), budget=budget)
    again = lodgs("data.roots").active_root(bpy.context)
    assert [len(item.object.data.points) for item in again.lodgs.levels] == counts
    everything = lodgs("data.importing").import_splats(bpy.context, tmp_path / "tree.ply", budget=10**6)
    assert [len(item.object.data.points) for item in everything.lodgs.levels] == [LEAVES - 1, LEAVES]


def test_colours_show_node_sizes(bpy, lodgs):
    """Each colour is an octave of what a splat stands for, leaves have the last."""
    rule = lodgs("training.lod.rule").rules()["cut"]
    told = partial(rule.splat_level, facts={"level": 1.0})
    sizes = np.float32([0, 1, 1.9, 2, 4, 0.5, 0.3, 2.0**10, 2.0**11])
    assert told({"node_size": sizes}).tolist() == [12, 1, 1, 11, 10, 2, 3, 2, 1]
    means = np.float32([[0, 0, d] for d in (31.9, 32, 64, 128)])
    wanted = rule.target_level(means, np.zeros(3, np.float32), 64.0, {"level": 1.0}, {"pixels": 2.0})
    assert wanted.tolist() == [2, 1, 11, 10]
