"""Strokes over a viewport select on every level what lies under them, as undoable steps: against numpy."""

import numpy as np
import pytest

from tests.blender.data.test_cleaning import PLACE, blender, shown_rows
from tests.training.editing.test_cleaning import bundle_of
from tests.training.lod.tree.trees import random_leaves, tree_of
from training.splats.bundle import read_bundle, write_bundle

NAMES = ["bands", "octree", "chunks", "decay"]


@pytest.fixture
def scene_of(bpy, lodgs, tmp_path):
    def make(bundle):
        write_bundle(tmp_path / "in.ply", bundle)
        root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply", upright=False)
        root.matrix_world = blender(PLACE)
        bpy.context.view_layer.objects.active = root
        bpy.context.view_layer.update()
        return root, read_bundle(tmp_path / "in.ply")

    return make


@pytest.fixture
def viewport(bpy):
    """The 3D viewport as Blender begins, which looks at the middle of the world, and its size."""
    area = next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    looks = area.spaces.active.region_3d
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=area, region=region):
        yield looks, (region.width, region.height)


def pixels_of(looks, size, means):
    """(N, 2) where means are in the viewport, and how deep."""
    world = np.c_[means, np.ones(len(means))].astype(np.float64) @ PLACE.T
    clip = world @ (np.array(looks.window_matrix) @ np.array(looks.view_matrix)).T
    return (clip[:, :2] / clip[:, 3:] + 1) / 2 * np.array(size), clip[:, 3]


def near(looks, size, means, place, radius):
    """(N,) bool, which lie within a radius of a place, and which clearly do or do not."""
    pixels, depth = pixels_of(looks, size, means)
    away = np.linalg.norm(pixels - place, axis=1)
    return (away <= radius) & (depth > 0.1), np.abs(away - radius) > 1.5


def selected(lodgs, root):
    return {item.number: lodgs("data.cleaning").selected_mask(item.object.data) for item in root.lodgs.levels}


def stroke(bpy, *path, **options):
    path = [{"name": "", "loc": place, "time": 0.0} for place in path]
    return bpy.ops.lodgs.select_splats(path=path, **options)


@pytest.mark.parametrize("name", NAMES)
def test_a_brush_through_all_selects_every_levels_splats_under_it(bpy, lodgs, scene_of, viewport, name):
    root, bundle = scene_of(bundle_of(name, np.random.default_rng(0)))
    looks, size = viewport
    middle = (size[0] / 2, size[1] / 2)
    assert stroke(bpy, middle, radius=150, through=True) == {"FINISHED"}
    for level, mask in zip(bundle.levels, selected(lodgs, root).values(), strict=True):
        wanted, clear = near(looks, size, level.splats.means, middle, 150)
        np.testing.assert_array_equal(mask[clear], wanted[clear])
        assert 10 < wanted.sum() < len(wanted) / 2
    before = selected(lodgs, root)

    stroke(bpy, middle, radius=70, through=True, action="REMOVE")
    for level, was, mask in zip(bundle.levels, before.values(), selected(lodgs, root).values(), strict=True):
        gone, clear = near(looks, size, level.splats.means, middle, 70)
        np.testing.assert_array_equal(mask[clear], (was & ~gone)[clear])

    counts = lodgs("data.cleaning").count_selected(root)
    assert counts == {number: mask.sum() for number, mask in selected(lodgs, root).items()}
    assert bpy.ops.lodgs.hide_splats(test="SELECTED") == {"FINISHED"}
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 3
    bpy.context.view_layer.update()
    stays = ~selected(lodgs, root)[3]
    np.testing.assert_array_equal(
        shown_rows(bpy, lodgs, root.lodgs.levels[2].object), np.flatnonzero(stays).astype(np.int32)
    )


def test_a_lasso_selects_what_it_encloses_but_neither_hidden_nor_cropped_splats(
    bpy, lodgs, scene_of, viewport
):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(1)))
    looks, size = viewport
    bpy.ops.lodgs.add_crop(shape="SPHERE")
    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.3)
    bpy.context.view_layer.objects.active = root
    low, high = np.array(size) * 0.35, np.array(size) * 0.7
    corners = [tuple(low), (low[0], high[1]), tuple(high), (high[0], low[1])]
    assert stroke(bpy, *corners, shape="LASSO", through=True) == {"FINISHED"}
    cleaning, depsgraph = lodgs("data.cleaning"), bpy.context.evaluated_depsgraph_get()
    crops = lodgs("data.crops").evaluated_crops(root, depsgraph)
    for level, item in zip(bundle.levels, root.lodgs.levels, strict=True):
        pixels, depth = pixels_of(looks, size, level.splats.means)
        wanted = ((pixels > low) & (pixels < high)).all(axis=1) & (depth > 0.1)
        clear = (np.abs(pixels - low) > 1.5).all(axis=1) & (np.abs(pixels - high) > 1.5).all(axis=1)
        wanted &= ~cleaning.hidden_mask(item.object.data) & crops[0].contains(level.splats.means)
        np.testing.assert_array_equal(cleaning.selected_mask(item.object.data)[clear], wanted[clear])
        assert 10 < wanted.sum() < len(wanted) / 2

    before = selected(lodgs, root)
    bpy.ops.lodgs.select_all_splats(action="INVERT")
    for item, was in zip(root.lodgs.levels, before.values(), strict=True):
        mask = cleaning.selected_mask(item.object.data)
        np.testing.assert_array_equal(mask, ~was & ~cleaning.hidden_mask(item.object.data))
    bpy.ops.lodgs.select_all_splats(action="DESELECT")
    assert not any(mask.any() for mask in selected(lodgs, root).values())


def test_only_the_nearer_of_two_walls_is_selected_at_every_level(bpy, lodgs, scene_of, viewport):
    """Level 3 is shown; what of the others lies behind it is not selected either."""
    rng, bundle = np.random.default_rng(2), bundle_of("bands", np.random.default_rng(2))
    looks, size = viewport
    to_world = np.linalg.inv(np.array(looks.view_matrix, np.float64))
    to_own = np.linalg.inv(PLACE) @ to_world
    for level in bundle.levels:
        count = len(level.splats)
        local = np.c_[rng.uniform(-9, 9, (count, 2)), np.where(rng.random(count) < 0.7, -20.0, -40.0)]
        level.splats.means[:] = (np.c_[local, np.ones(count)] @ to_own.T)[:, :3]
        level.splats.log_scales[:] = np.log(0.5)
        level.splats.opacity_logits[:] = 3.0
        level.splats.extras["back"] = (local[:, 2] < -30).astype(np.int32)
    root, bundle = scene_of(bundle)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 3
    bpy.context.view_layer.update()
    middle = (size[0] / 2, size[1] / 2)
    stroke(bpy, middle, radius=200)
    for level, mask in zip(bundle.levels, selected(lodgs, root).values(), strict=True):
        under, clear = near(looks, size, level.splats.means, middle, 200)
        wanted = under & (level.splats.extras["back"] == 0)
        assert wanted.sum() > 20 and (under & ~wanted).sum() > 20
        np.testing.assert_array_equal(mask[clear], wanted[clear])


def test_of_a_tree_leaves_are_selected_and_nodes_that_stand_for_nothing_else(bpy, lodgs, scene_of, viewport):
    bundle = tree_of(random_leaves(2000, np.random.default_rng(5)))
    root, bundle = scene_of(bundle)
    looks, size = viewport
    middle, cleaning = (size[0] / 2, size[1] / 2), lodgs("data.cleaning")
    stroke(bpy, (0, 0), radius=1, through=True)
    family = cleaning._relations(root)
    every = {level.number: np.ones(len(level.splats), bool) for level in bundle.levels}
    stroke(bpy, middle, (middle[0] + 40, middle[1]), radius=150, through=True)
    stroke(bpy, (middle[0] - 80, middle[1]), radius=150, through=True)
    masks, leaves, some = selected(lodgs, root), family.testable(every), 0
    for level in bundle.levels:
        one, clear = near(looks, size, level.splats.means, (middle[0] - 80, middle[1]), 150)
        # a capsule around the first stroke: two discs and the box between them
        for x in np.linspace(0, 40, 200):
            disc, far_off = near(looks, size, level.splats.means, (middle[0] + x, middle[1]), 150)
            one, clear = one | disc, clear & (far_off | disc)
        asked = leaves[level.number] & clear
        np.testing.assert_array_equal(masks[level.number][asked], one[asked])
        some += int(one[asked].sum())
    assert some > 20
    stays = family.completed({number: ~mask for number, mask in masks.items()})
    for number, mask in masks.items():
        np.testing.assert_array_equal(mask, ~stays[number])
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
    for wanted in counts[-2::-1]:
        bpy.ops.ed.undo()
        assert sum(lodgs("data.cleaning").count_selected(bpy.data.objects[name]).values()) == wanted
    bpy.ops.ed.redo()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert sum(lodgs("data.cleaning").count_selected(bpy.data.objects[name]).values()) == counts[1]


def test_selecting_is_no_change_of_the_splats_and_viewports_see_it(bpy, lodgs, scene_of, viewport):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(4)))
    clouds = [item.object.data for item in root.lodgs.levels]
    of, changes = lodgs("viewport.resident").read_pool(clouds), lodgs("data.changes")
    of.update_marks(clouds)
    assert of.marks is None
    _, size = viewport
    stroke(bpy, (1, 1), radius=1)
    bpy.context.view_layer.update()
    versions, selection = [changes.version(cloud) for cloud in clouds], changes.selection_version()
    stroke(bpy, (size[0] / 2, size[1] / 2), radius=100)
    bpy.context.view_layer.update()
    assert (
        versions == [changes.version(cloud) for cloud in clouds] and selection != changes.selection_version()
    )
    of.update_marks(clouds)
    np.testing.assert_array_equal(of.marks, np.concatenate(list(selected(lodgs, root).values())))


def test_strokes_ask_for_levels_and_tools_are_there(bpy, lodgs, viewport):
    from bl_ui.space_toolsystem_common import ToolSelectPanelHelper

    assert not bpy.ops.lodgs.select_splats.poll()
    tools = ToolSelectPanelHelper._tool_class_from_space_type("VIEW_3D")._tools["OBJECT"]
    names = {tool.idname for tool in ToolSelectPanelHelper._tools_flatten(tools) if tool is not None}
    assert {"lodgs.brush", "lodgs.lasso"} <= names
