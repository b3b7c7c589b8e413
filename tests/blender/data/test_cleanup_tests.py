"""All kinds of clutter in one step, planted around a square garden with the ground at z = 1."""

from types import SimpleNamespace

import numpy as np
import pytest

from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

REST, OVERSIZED, DISTANT, FLOATERS, BELOW = 6000, 5, 6, 4, 8


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    """A scene with two levels; the coarse one has the same splats as the fine one."""
    rng = np.random.default_rng(0)
    ground = np.stack(np.meshgrid(np.linspace(-4, 4, 64), np.linspace(-4, 4, 64), [0.0]), -1).reshape(-1, 3)
    things = rng.uniform(-2, 2, (REST - len(ground), 3)) * (1, 1, 0.1) + (0, 0, 0.2)
    parts = [
        ground, things, rng.uniform(0, 0.2, (OVERSIZED, 3)), np.full((DISTANT, 3), 1000.0),
        rng.normal((0, 0, 7), 0.01, (FLOATERS, 3)), rng.uniform(-3, 3, (BELOW, 3)) * (1, 1, 0) - (0, 0, 0.5),
    ]  # fmt: skip
    means = np.concatenate(parts).astype(np.float32)
    means[:, 2] += 1
    log_scales = np.full((len(means), 3), -3, np.float32)
    log_scales[REST : REST + OVERSIZED, 1] = np.log(5)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    splats = Splats(means, quats, log_scales, np.full(len(means), 4, np.float32), means[:, None] * 0)
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats), Level(2, splats)]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply", upright=False)
    root.scale = 2, 2, 2
    bpy.context.view_layer.update()
    return root


def clutter_counts(bpy, lodgs, root):
    """Numbers of matching splats of level 1 by test, with suggested limits."""
    cleanup_tests = lodgs("data.cleanup_tests")
    limits = SimpleNamespace(**cleanup_tests.suggest_clutter_limits(root))
    return {
        test.identifier: int(cleanup_tests.find_clutter(test, bpy.context, root, limits)[1].sum())
        for test in cleanup_tests.CLUTTER_TESTS
    }


def test_every_kind_is_counted_selected_and_hidden(bpy, lodgs, root):
    isolated = FLOATERS + BELOW  # distant ones are not near the subject
    expected = {"LARGE": OVERSIZED, "DISTANT": DISTANT, "FLOATERS": isolated, "BELOW": BELOW}
    assert clutter_counts(bpy, lodgs, root) == expected
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}
    count = OVERSIZED + DISTANT + isolated
    cleaning = lodgs("data.cleaning")
    assert cleaning.count_selected(root) == {1: count, 2: count}
    assert bpy.ops.lodgs.find_clutter(below=True, floaters=False) == {"FINISHED"}
    assert cleaning.count_selected(root)[2] == OVERSIZED + DISTANT + BELOW
    assert bpy.ops.lodgs.hide_splats(test="SELECTED") == {"FINISHED"}
    hidden = np.flatnonzero(cleaning.hidden_mask(root.lodgs.levels[1].object.data))
    begin = REST + OVERSIZED + DISTANT
    expected = [*range(REST, begin), *range(begin + FLOATERS, begin + FLOATERS + BELOW)]
    np.testing.assert_array_equal(hidden, expected)


def test_limits_are_lengths_in_the_world(bpy, lodgs, root):
    """Splats 7 above the ground; the root doubles lengths."""
    for reach, count in ((13, DISTANT + FLOATERS), (16, DISTANT)):
        assert bpy.ops.lodgs.find_clutter(large=False, floaters=False, reach=reach) == {"FINISHED"}
        assert lodgs("data.cleaning").count_selected(root)[2] == count


def test_dialog_lists_the_counts(bpy, lodgs, root):
    texts, operator = [], lodgs("operators.find_clutter").LODGS_OT_find_clutter

    class Layout:
        def __getattr__(self, name):
            return lambda *args, **options: texts.append(options.get("text", "")) or self

    tests = lodgs("data.cleanup_tests").CLUTTER_TESTS
    values = {test.identifier.lower(): test.identifier != "BELOW" for test in tests}
    counts = {f"{name}_count": 1234 for name in values}
    operator.draw(SimpleNamespace(layout=Layout(), **values, **counts), bpy.context)
    assert texts.count("1,234 splats") == 3


def test_scene_without_ground_has_nothing_below(bpy, lodgs, tmp_path):
    rng = np.random.default_rng(1)
    means = rng.normal(size=(3000, 3)).astype(np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    splats = Splats(means, quats, means * 0 - 4, np.full(len(means), 4, np.float32), means[:, None] * 0)
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats)]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    assert clutter_counts(bpy, lodgs, root)["BELOW"] == 0


def test_large_background_matches_the_test_but_is_no_clutter(bpy, lodgs, root):
    cloud = root.lodgs.levels[0].object.data
    scales = np.array(lodgs("attributes").view_attribute(cloud, "scale"))
    scales[REST + OVERSIZED : REST + OVERSIZED + DISTANT] = 100
    lodgs("attributes").write_attribute(cloud, "scale", "FLOAT_VECTOR", scales)
    assert clutter_counts(bpy, lodgs, root)["LARGE"] == OVERSIZED
    assert bpy.ops.lodgs.hide_splats(test="LARGE", size=1.0, action="SELECT") == {"FINISHED"}
    assert lodgs("data.cleaning").count_selected(root) == {1: OVERSIZED + DISTANT, 2: OVERSIZED}
