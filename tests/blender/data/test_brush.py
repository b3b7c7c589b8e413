"""Brush strokes and lassos select the splats under them on every level. Numpy is the reference."""

import numpy as np
import pytest

from tests.blender.data.test_cleaning import ROOT_MATRIX, shown_rows, to_blender
from tests.training.editing.test_cleaning import bundle_of
from tests.training.lod.tree.trees import random_leaves, tree_of
from training.splats.bundle import read_bundle, write_bundle

NAMES = ["bands", "octree", "chunks", "decay"]


@pytest.fixture
def scene_of(bpy, lodgs, tmp_path):
    def make(bundle):
        write_bundle(tmp_path / "in.ply", bundle)
        root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply", upright=False)
        root.matrix_world = to_blender(ROOT_MATRIX)
        bpy.context.view_layer.objects.active = root
        bpy.context.view_layer.update()
        return root, read_bundle(tmp_path / "in.ply")

    return make


@pytest.fixture
def viewport(bpy):
    """The initial 3D viewport, which looks at the world's origin, and its size."""
    area = next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    view = area.spaces.active.region_3d
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=area, region=region):
        yield view, (region.width, region.height)


def project(view, size, means):
    """Return the pixels (N, 2) and depths (N,) of means in the viewport."""
    world = np.c_[means, np.ones(len(means))].astype(np.float64) @ ROOT_MATRIX.T
    clip = world @ (np.array(view.window_matrix) @ np.array(view.view_matrix)).T
    return (clip[:, :2] / clip[:, 3:] + 1) / 2 * np.array(size), clip[:, 3]


def near(view, size, means, center, radius):
    """Return two masks (N,): splats within a radius of a pixel, and splats not close to its circle."""
    pixels, depth = project(view, size, means)
    distances = np.linalg.norm(pixels - center, axis=1)
    return (distances <= radius) & (depth > 0.1), np.abs(distances - radius) > 1.5


def selected_masks(lodgs, root):
    return {item.number: lodgs("data.cleaning").selected_mask(item.object.data) for item in root.lodgs.levels}


def stroke(bpy, *path, **options):
    path = [{"name": "", "loc": pixel, "time": 0.0} for pixel in path]
    return bpy.ops.lodgs.select_splats(path=path, **options)


@pytest.mark.parametrize("name", NAMES)
def test_brush_in_xray_selects_splats_of_every_level(bpy, lodgs, scene_of, viewport, name):
    root, bundle = scene_of(bundle_of(name, np.random.default_rng(0)))
    view, size = viewport
    middle = (size[0] / 2, size[1] / 2)
    assert stroke(bpy, middle, radius=150, through=True) == {"FINISHED"}
    for level, mask in zip(bundle.levels, selected_masks(lodgs, root).values(), strict=True):
        expected, clear = near(view, size, level.splats.means, middle, 150)
        np.testing.assert_array_equal(mask[clear], expected[clear])
        assert 10 < expected.sum() < len(expected) / 2
    before = selected_masks(lodgs, root)

    stroke(bpy, middle, radius=70, through=True, action="REMOVE")
    for level, previous, mask in zip(
        bundle.levels, before.values(), selected_masks(lodgs, root).values(), strict=True
    ):
        removed, clear = near(view, size, level.splats.means, middle, 70)
        np.testing.assert_array_equal(mask[clear], (previous & ~removed)[clear])

    counts = lodgs("data.cleaning").count_selected(root)
    assert counts == {number: mask.sum() for number, mask in selected_masks(lodgs, root).items()}
    assert bpy.ops.lodgs.hide_splats(test="SELECTED") == {"FINISHED"}
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 3
    bpy.context.view_layer.update()
    remaining = ~selected_masks(lodgs, root)[3]
    np.testing.assert_array_equal(
        shown_rows(bpy, lodgs, root.lodgs.levels[2].object), np.flatnonzero(remaining).astype(np.int32)
    )


def test_lasso_selects_no_hidden_or_cropped_splats(bpy, lodgs, scene_of, viewport):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(1)))
    view, size = viewport
    bpy.ops.lodgs.add_crop(shape="SPHERE")
    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.3)
    bpy.context.view_layer.objects.active = root
    low, high = np.array(size) * 0.35, np.array(size) * 0.7
    corners = [tuple(low), (low[0], high[1]), tuple(high), (high[0], low[1])]
    assert stroke(bpy, *corners, shape="LASSO", through=True) == {"FINISHED"}
    cleaning, depsgraph = lodgs("data.cleaning"), bpy.context.evaluated_depsgraph_get()
    crops = lodgs("data.crops").evaluated_crops(root, depsgraph)
    for level, item in zip(bundle.levels, root.lodgs.levels, strict=True):
        pixels, depth = project(view, size, level.splats.means)
        expected = ((pixels > low) & (pixels < high)).all(axis=1) & (depth > 0.1)
        clear = (np.abs(pixels - low) > 1.5).all(axis=1) & (np.abs(pixels - high) > 1.5).all(axis=1)
        expected &= ~cleaning.hidden_mask(item.object.data) & crops[0].contains(level.splats.means)
        np.testing.assert_array_equal(cleaning.selected_mask(item.object.data)[clear], expected[clear])
        assert 10 < expected.sum() < len(expected) / 2

    before = selected_masks(lodgs, root)
    bpy.ops.lodgs.select_all_splats(action="INVERT")
    for item, previous in zip(root.lodgs.levels, before.values(), strict=True):
        mask = cleaning.selected_mask(item.object.data)
        np.testing.assert_array_equal(mask, ~previous & ~cleaning.hidden_mask(item.object.data))
    bpy.ops.lodgs.select_all_splats(action="DESELECT")
    assert not any(mask.any() for mask in selected_masks(lodgs, root).values())


def test_only_the_front_wall_is_selected_on_every_level(bpy, lodgs, scene_of, viewport):
    """Level 3 is visible and occludes splats of the other levels too."""
    rng, bundle = np.random.default_rng(2), bundle_of("bands", np.random.default_rng(2))
    view, size = viewport
    to_world = np.linalg.inv(np.array(view.view_matrix, np.float64))
    to_scene = np.linalg.inv(ROOT_MATRIX) @ to_world
    for level in bundle.levels:
        count = len(level.splats)
        local = np.c_[rng.uniform(-9, 9, (count, 2)), np.where(rng.random(count) < 0.7, -20.0, -40.0)]
        level.splats.means[:] = (np.c_[local, np.ones(count)] @ to_scene.T)[:, :3]
        level.splats.log_scales[:] = np.log(0.5)
        level.splats.opacity_logits[:] = 3.0
        level.splats.extras["back"] = (local[:, 2] < -30).astype(np.int32)
    root, bundle = scene_of(bundle)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 3
    bpy.context.view_layer.update()
    middle = (size[0] / 2, size[1] / 2)
    stroke(bpy, middle, radius=200)
    for level, mask in zip(bundle.levels, selected_masks(lodgs, root).values(), strict=True):
        under, clear = near(view, size, level.splats.means, middle, 200)
        expected = under & (level.splats.extras["back"] == 0)
        assert expected.sum() > 20 and (under & ~expected).sum() > 20
        np.testing.assert_array_equal(mask[clear], expected[clear])


def test_tree_nodes_are_selected_with_all_their_leaves(bpy, lodgs, scene_of, viewport):
    bundle = tree_of(random_leaves(2000, np.random.default_rng(5)))
    root, bundle = scene_of(bundle)
    view, size = viewport
    middle, cleaning = (size[0] / 2, size[1] / 2), lodgs("data.cleaning")
    stroke(bpy, (0, 0), radius=1, through=True)
    family = cleaning._relations(root)
    all_rows = {level.number: np.ones(len(level.splats), bool) for level in bundle.levels}
    stroke(bpy, middle, (middle[0] + 40, middle[1]), radius=150, through=True)
    stroke(bpy, (middle[0] - 80, middle[1]), radius=150, through=True)
    masks, leaves, selected_leaves = selected_masks(lodgs, root), family.testable(all_rows), 0
    for level in bundle.levels:
        under, clear = near(view, size, level.splats.means, (middle[0] - 80, middle[1]), 150)
        # a capsule around the first stroke: two discs and the box between them
        for x in np.linspace(0, 40, 200):
            disc, clear_of_disc = near(view, size, level.splats.means, (middle[0] + x, middle[1]), 150)
            under, clear = under | disc, clear & (clear_of_disc | disc)
        compared = leaves[level.number] & clear
        np.testing.assert_array_equal(masks[level.number][compared], under[compared])
        selected_leaves += int(under[compared].sum())
    assert selected_leaves > 20
    remaining = family.completed({number: ~mask for number, mask in masks.items()})
    for number, mask in masks.items():
        np.testing.assert_array_equal(mask, ~remaining[number])
    assert sum(int((mask & ~leaves[number]).sum()) for number, mask in masks.items()) > 0


def test_strokes_are_undone_one_by_one_and_saved(bpy, lodgs, scene_of, viewport, tmp_path):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(3)))
    name, (_, size) = root.name, viewport
    counts = [0]
    bpy.ops.ed.undo_push(message="start")
    for x in (0.3, 0.45, 0.6):
        stroke(bpy, (size[0] * x, size[1] / 2), radius=60, through=True)
        bpy.ops.ed.undo_push(message="stroke")
        counts.append(sum(lodgs("data.cleaning").count_selected(bpy.data.objects[name]).values()))
    assert counts == sorted(set(counts)), counts
    for count in counts[-2::-1]:
        bpy.ops.ed.undo()
        assert sum(lodgs("data.cleaning").count_selected(bpy.data.objects[name]).values()) == count
    bpy.ops.ed.redo()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert sum(lodgs("data.cleaning").count_selected(bpy.data.objects[name]).values()) == counts[1]


def test_selecting_updates_viewport_marks_but_not_splats(bpy, lodgs, scene_of, viewport):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(4)))
    clouds = [item.object.data for item in root.lodgs.levels]
    store = lodgs("viewport.resident").PoolReader(clouds).advance(clouds)
    changes = lodgs("data.changes")
    store.update_marks(clouds)
    assert store.marks is None
    _, size = viewport
    stroke(bpy, (1, 1), radius=1)
    bpy.context.view_layer.update()
    versions, selection = [changes.version(cloud) for cloud in clouds], changes.selection_version()
    stroke(bpy, (size[0] / 2, size[1] / 2), radius=100)
    bpy.context.view_layer.update()
    assert (
        versions == [changes.version(cloud) for cloud in clouds] and selection != changes.selection_version()
    )
    store.update_marks(clouds)
    np.testing.assert_array_equal(store.marks, np.concatenate(list(selected_masks(lodgs, root).values())))


def test_operator_needs_levels_and_tools_are_registered(bpy, lodgs, viewport):
    from bl_ui.space_toolsystem_common import ToolSelectPanelHelper

    assert not bpy.ops.lodgs.select_splats.poll()
    tools = ToolSelectPanelHelper._tool_class_from_space_type("VIEW_3D")._tools["OBJECT"]
    names = {tool.idname for tool in ToolSelectPanelHelper._tools_flatten(tools) if tool is not None}
    assert {"lodgs.brush", "lodgs.lasso"} <= names
