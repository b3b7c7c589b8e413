"""Find all kinds of clutter in one step. A square garden with its ground at z = 1 contains known clutter."""

from types import SimpleNamespace

import numpy as np
import pytest

from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import NO_SPLATS, Bundle, Level

COUNTS = REST, OVERSIZED, DISTANT, FLOATERS, BELOW, HALOS = 6000, 5, 6, 4, 8, 3


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    """A scene with two levels; the coarse one has the same splats as the fine one."""
    rng = np.random.default_rng(0)
    ground = np.stack(np.meshgrid(np.linspace(-4, 4, 64), np.linspace(-4, 4, 64), [0.0]), -1).reshape(-1, 3)
    objects = rng.uniform(-2, 2, (REST - len(ground), 3)) * (1, 1, 0.1) + (0, 0, 0.2)
    parts = [
        ground, objects, rng.uniform(0, 0.2, (OVERSIZED, 3)), np.full((DISTANT, 3), 1000.0),
        rng.normal((0, 0, 7), 0.01, (FLOATERS, 3)), rng.uniform(-3, 3, (BELOW, 3)) * (1, 1, 0) - (0, 0, 0.5),
        rng.uniform(0, 0.2, (HALOS, 3)),
    ]  # fmt: skip
    means = np.concatenate(parts).astype(np.float32)
    means[:, 2] += 1
    log_scales = np.full((len(means), 3), -3, np.float32)
    log_scales[REST : REST + OVERSIZED, 1] = np.log(5)
    log_scales[-HALOS:] = np.log(0.4)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    logits = np.full(len(means), 4, np.float32)
    logits[-HALOS:] = -3
    splats = Splats(means, quats, log_scales, logits, means[:, None] * 0)
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats), Level(2, splats)]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply", upright=False)
    root.scale = 2, 2, 2
    bpy.context.view_layer.update()
    return root


def clutter_counts(bpy, lodgs, root):
    """Numbers of matching splats of level 1 by test, with suggested limits."""
    cleanup_tests = lodgs("data.cleanup_tests")
    limits = SimpleNamespace(share=0.1, **cleanup_tests.suggest_clutter_limits(root))
    return {
        test.identifier: int(cleanup_tests.find_clutter(test, bpy.context, root, limits)[1].sum())
        for test in cleanup_tests.CLUTTER_TESTS
    }


def test_one_large_splat_is_no_clutter(bpy, lodgs, tmp_path):
    columns = np.ones((1, 3)), np.eye(1, 4), np.full((1, 3), 7.0), np.ones(1), np.zeros((1, 1, 3))
    splats = Splats(*(np.float32(column) for column in columns))
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats)]))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    [root] = lodgs("data.roots").roots(bpy.context.scene)
    assert set(lodgs("data.clutter").count_by_kind(root).values()) == {0}


def test_all_kinds_of_clutter_are_counted_coloured_and_hidden(bpy, lodgs, root):
    isolated = FLOATERS + BELOW  # distant ones are not near the subject
    counts = {"LARGE": OVERSIZED, "DISTANT": DISTANT, "FLOATERS": isolated, "BELOW": BELOW, "HALOS": HALOS}
    assert clutter_counts(bpy, lodgs, root) == counts
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    cleaning, clutter = lodgs("data.cleaning"), lodgs("data.clutter")
    assert root.lodgs_clutter.gap > 0
    del counts["BELOW"]  # disabled at first
    assert clutter.count_by_kind(root) == {name: 2 * count for name, count in counts.items()}
    cloud = root.lodgs.levels[1].object.data
    marks = cleaning.displayed_marks(cloud)
    names = ("", "max_size", "max_reach", "drop_floaters", "drop_floaters", "halo_opacity")
    expected = np.repeat(list(map(cleaning.mark_of, names)), COUNTS)
    np.testing.assert_array_equal(marks, expected)
    root.lodgs_clutter.use_below, root.lodgs_clutter.use_floaters = True, False
    assert cleaning.displayed_marks(cloud)[-HALOS - 1] == cleaning.mark_of("min_depth")
    assert bpy.ops.lodgs.hide_clutter() == {"FINISHED"}
    hidden = np.repeat([False, True, True, False, True, True], COUNTS)
    np.testing.assert_array_equal(cleaning.hidden_mask(cloud), hidden)
    assert not root.lodgs_clutter.preview and not cleaning.displayed_marks(cloud).any()


def test_limits_are_lengths_in_the_world(bpy, lodgs, root):
    """Floaters are 7 above the ground; the root doubles lengths."""
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    for reach, count in ((13, DISTANT + FLOATERS), (16, DISTANT)):
        root.lodgs_clutter.reach = reach
        assert lodgs("data.clutter").count_by_kind(root)["DISTANT"] == 2 * count


def test_limits_of_the_user_are_kept_and_cancelling_hides_nothing(bpy, lodgs, root):
    root.lodgs_clutter.size = 1000
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    assert root.lodgs_clutter.size == 1000 and lodgs("data.clutter").count_by_kind(root)["LARGE"] == 0
    assert bpy.ops.lodgs.cancel_clutter() == {"FINISHED"}
    cloud = root.lodgs.levels[1].object.data
    assert not lodgs("data.cleaning").displayed_marks(cloud).any()
    assert not lodgs("data.cleaning").hidden_mask(cloud).any()
    assert not bpy.ops.lodgs.hide_clutter.poll()


def test_clutter_is_searched_again_after_splats_change(bpy, lodgs, root):
    cleaning, clutter = lodgs("data.cleaning"), lodgs("data.clutter")
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    bpy.ops.lodgs.hide_splats(test="LARGE", size=8.0)
    bpy.context.view_layer.update()
    assert clutter.count_by_kind(root) is None
    clutter.refresh(bpy.context, root)
    assert clutter.count_by_kind(root)["LARGE"] == 0
    assert cleaning.displayed_marks(root.lodgs.levels[1].object.data)[REST] == cleaning.mark_of("")


def test_undo_ends_the_preview_in_viewports(bpy, lodgs, root):
    """The grey splats would remain, without a button that shows their colours."""
    cleaning, clutter, name = lodgs("data.cleaning"), lodgs("data.clutter"), root.name
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.lodgs.find_clutter("EXEC_DEFAULT", True) == {"FINISHED"}
    for step, is_shown in ((bpy.ops.ed.undo, False), (bpy.ops.ed.redo, True)):
        step()
        root = bpy.data.objects[name]
        assert root.lodgs_clutter.preview == is_shown
        clutter._refresh_all()
        assert cleaning.displayed_marks(root.lodgs.levels[1].object.data).any() == is_shown


def test_scene_without_ground_has_nothing_below(bpy, lodgs, tmp_path):
    rng = np.random.default_rng(1)
    means = rng.normal(size=(3000, 3)).astype(np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    splats = Splats(means, quats, means * 0 - 4, np.full(len(means), 4, np.float32), means[:, None] * 0)
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats)]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    assert clutter_counts(bpy, lodgs, root)["BELOW"] == 0


def test_large_background_matches_the_size_test_but_is_no_clutter(bpy, lodgs, root):
    cloud = root.lodgs.levels[0].object.data
    scales = np.array(lodgs("attributes").view_attribute(cloud, "scale"))
    scales[REST + OVERSIZED : REST + OVERSIZED + DISTANT] = 100
    lodgs("attributes").write_attribute(cloud, "scale", "FLOAT_VECTOR", scales)
    assert clutter_counts(bpy, lodgs, root)["LARGE"] == OVERSIZED
    assert bpy.ops.lodgs.hide_splats(test="LARGE", size=1.0, action="SELECT") == {"FINISHED"}
    assert lodgs("data.cleaning").count_selected(root) == {1: OVERSIZED + DISTANT, 2: OVERSIZED}


def test_preview_follows_the_rotation_and_ends_if_the_scene_is_stretched(bpy, lodgs, root):
    clutter = lodgs("data.clutter")
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    root.lodgs_clutter.use_below = True
    assert clutter.count_by_kind(root)["BELOW"] == 2 * BELOW
    root.rotation_euler.x = np.pi  # the ground is above all other splats
    bpy.context.view_layer.update()
    assert clutter.count_by_kind(root) is None
    clutter._refresh_all()
    assert clutter.count_by_kind(root)["BELOW"] != 2 * BELOW
    root.scale.x = 3
    bpy.context.view_layer.update()
    clutter._refresh_all()
    assert not root.lodgs_clutter.preview


def test_no_timer_remains_without_the_extension(bpy, lodgs):
    clutter = lodgs("data.clutter")
    clutter.refresh_later()
    clutter.unregister()
    try:
        assert not bpy.app.timers.is_registered(clutter._refresh_all)
    finally:
        clutter.register()


@pytest.mark.parametrize("operator", ["add_crop", "find_clutter", "tint_by_light"])
def test_levels_without_splats_are_reported(bpy, lodgs, root, operator):
    cloud = lodgs("compat").new_point_cloud("empty", np.zeros((0, 3)))
    for name, kind in (("scale", "FLOAT_VECTOR"), ("radiance:base", "FLOAT_COLOR")):
        lodgs("attributes").write_attribute(cloud, name, kind, np.zeros((0, 1)))
    root.lodgs.levels[-1].object.data = cloud
    with pytest.raises(RuntimeError, match=r"^Error: Cannot (measure|find clutter)"):
        getattr(bpy.ops.lodgs, operator)()


def test_clutter_of_levels_that_add_up_without_finest_splats(bpy, lodgs, root):
    root.lodgs.cumulative = True
    lodgs("data.scenes").set_level(root, Level(3, NO_SPLATS))
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    assert root.lodgs_clutter.gap > 0


def test_crops_of_scenes_that_the_view_layer_excludes(bpy, lodgs, root):
    collections = bpy.context.view_layer.layer_collection.children
    collections[root.users_collection[0].name].exclude = True
    assert bpy.ops.lodgs.add_crop() == {"FINISHED"}
    [crop] = lodgs("data.crops").crops_of(root)
    bpy.context.scene.collection.objects.link(crop)
    bpy.context.view_layer.objects.active = crop
    assert bpy.ops.lodgs.delete_hidden_splats() == {"FINISHED"}
