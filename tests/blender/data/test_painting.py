"""Brush strokes paint every level and keep the trained colours. Numpy is the reference."""

from itertools import pairwise

import numpy as np
import pytest

from tests.blender.data.test_brush import (
    NAMES,
    project,
    scene_of,  # noqa: F401
    viewport,  # noqa: F401
)
from tests.training.editing.test_cleaning import bundle_of
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages
from training.color import linear_from_srgb
from training.editing.look import Look
from training.editing.paint import COLUMNS
from training.splats.bundle import read_bundle
from training.splats.gaussians import SH_C0
from training.splats.levels import Level
from training.splats.ply import read_ply

RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.3, 0.8)


def stroke(bpy, *path, **options):
    path = [{"name": "", "loc": pixel, "time": 0.0} for pixel in path]
    return bpy.ops.lodgs.paint_splats(path=path, through=True, **options)


def dab_weights(view, size, means, center, radius, hardness):
    """Return the weights (N,) of a dab by distances of pixel centres; NaN near the border of a pixel."""
    pixels, depth = project(view, size, means)
    t = np.linalg.norm(np.floor(pixels) + 0.5 - center, axis=1) / radius
    falloff = ((1 - t) / (1 - hardness)).clip(0, 1)
    weights = np.where(t <= hardness, 1, 3 * falloff**2 - 2 * falloff**3)
    weights[(np.abs(pixels - np.round(pixels)) < 1e-3).any(axis=1)] = np.nan
    return weights * (depth > 0.1)


def check(actual, expected, atol=5e-5):
    """Compare colours, except for splats on the border of a pixel."""
    clear = ~np.isnan(expected).any(axis=1)
    assert clear.mean() > 0.98
    np.testing.assert_allclose(actual[clear], expected[clear], atol=atol)


def colors_of(splats):
    return 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)


def mix(color, share, new):
    return (1 - share[:, None]) * color + share[:, None] * np.array(new)


@pytest.fixture
def painted(bpy, lodgs, scene_of, viewport):  # noqa: F811
    """``painted(bundle)``: a scene with two soft dabs and one erased dab.

    Return its root, the bundle, and the expected colours of each level without view dependence.
    """

    def make(bundle):
        for level in bundle.levels:
            level.splats.log_scales -= 12  # smaller than a pixel, so only means count
        root, bundle = scene_of(bundle)
        view, size = viewport
        middle = np.array(size) / 2
        stroke(bpy, tuple(middle), radius=180, color=RED, strength=0.8, hardness=0.3)
        stroke(bpy, (middle[0] + 60, middle[1]), radius=120, color=BLUE, strength=1.0, hardness=0.5)
        stroke(bpy, tuple(middle - (40, 30)), radius=60, strength=1.0, hardness=0.0, action="ERASE")
        colors = {}
        for level in bundle.levels:
            means, trained = level.splats.means, colors_of(level.splats)
            red = 0.8 * dab_weights(view, size, means, middle, 180, 0.3)
            blue = dab_weights(view, size, means, (middle[0] + 60, middle[1]), 120, 0.5)
            erased = dab_weights(view, size, means, middle - (40, 30), 60, 0.0)
            colors[level.number] = mix(mix(trained, red, RED), blue, BLUE)
            colors[level.number] = mix(colors[level.number], erased, (0, 0, 0)) + erased[:, None] * trained
            assert 10 < np.count_nonzero(red) < len(red) and blue.any() and erased.any()
        return root, bundle, colors

    return make


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.nightly] * (name in ("octree", "decay"))) for name in NAMES],
)
def test_strokes_paint_points_and_exports_of_every_level(bpy, lodgs, painted, tmp_path, name):
    root, bundle, colors = painted(bundle_of(name, np.random.default_rng(0)))
    root.lodgs_look.exposure, root.lodgs_look.tint = 0.3, (1.0, 0.8, 0.9)
    matrix = Look(0.3, tint=(1.0, 0.8, 0.9)).matrix
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    for level, original in zip(read_bundle(tmp_path / "out.ply").levels, bundle.levels, strict=True):
        check(colors_of(level.splats), colors[level.number] @ matrix.T)
        assert level.splats.extras.keys() == original.splats.extras.keys()
        for name_of_array in ("means", "quats", "log_scales"):
            np.testing.assert_array_equal(
                getattr(level.splats, name_of_array), getattr(original.splats, name_of_array)
            )
    bpy.context.scene.lodgs_viewport.splats = False  # points, which Blender draws
    root.lodgs.mode = "SINGLE"
    attributes = lodgs("attributes")
    for item, level in zip(root.lodgs.levels, bundle.levels, strict=True):
        root.lodgs.single_level = item.number
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = item.object.evaluated_get(depsgraph)
        rows = attributes.read_attribute(evaluated.data, "row")
        index_of_row = {row: i for i, row in enumerate(level.splats.extras["row"].tolist())}
        indices = [index_of_row[row] for row in rows.tolist()]
        expected = linear_from_srgb((colors[item.number][indices] @ matrix.T).clip(0, 1))
        actual = attributes.read_attribute(evaluated.data, attributes.COLOR)[:, :3]
        check(actual, expected)
        assert lodgs("data.selection").only_lodgs_modifiers(evaluated, depsgraph)


def test_exports_without_look_keep_paint_columns(bpy, lodgs, painted, tmp_path):
    root, bundle, colors = painted(bundle_of("bands", np.random.default_rng(1)))
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "trained.ply"), looked=False)
    for level, original in zip(read_bundle(tmp_path / "trained.ply").levels, bundle.levels, strict=True):
        np.testing.assert_array_equal(level.splats.sh, original.splats.sh)
    scenes = lodgs("data.scenes")
    reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / "trained.ply", upright=False)
    assert lodgs("data.looks").modifier_of(reimported.lodgs.levels[0].object) is not None
    for scene_root in (root, reimported):
        for level in scenes.read_levels(scene_root, looked=True).levels:
            check(colors_of(level.splats), colors[level.number])
    for source in ({"source": "SHOWN"}, {"source": "LEVEL", "level": 3}):
        reimported.lodgs.mode, reimported.lodgs.single_level = "SINGLE", 3
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "plain.ply"), **source)
        check(colors_of(read_ply(tmp_path / "plain.ply")), colors[3])


def test_strokes_are_undone_one_by_one_saved_and_removed(bpy, lodgs, scene_of, viewport, tmp_path):  # noqa: F811
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(2)))
    name, (_, size), scenes = root.name, viewport, lodgs("data.scenes")

    def colors():
        levels = scenes.read_levels(bpy.data.objects[name], looked=True).levels
        return np.concatenate([level.splats.sh[:, 0] for level in levels])

    assert not bpy.ops.lodgs.remove_paint.poll()
    states = [colors()]
    bpy.ops.ed.undo_push(message="start")
    for x in (0.3, 0.45, 0.6):
        stroke(bpy, (size[0] * x, size[1] / 2), radius=60, color=RED)
        bpy.ops.ed.undo_push(message="stroke")
        states.append(colors())
    assert all((state != next_state).any() for state, next_state in pairwise(states))
    for expected in states[-2::-1]:
        bpy.ops.ed.undo()
        np.testing.assert_array_equal(colors(), expected)
    bpy.ops.ed.redo()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    np.testing.assert_array_equal(colors(), states[1])
    assert bpy.ops.lodgs.remove_paint() == {"FINISHED"}
    np.testing.assert_array_equal(colors(), states[0])
    root = bpy.data.objects[name]
    for item in root.lodgs.levels:
        assert not set(COLUMNS) & set(item.object.data.attributes.keys())
        assert lodgs("data.looks").modifier_of(item.object) is None


def test_paint_stays_with_remaining_splats(bpy, lodgs, painted):
    changes = lodgs("data.changes")
    root, bundle, colors = painted(bundle_of("bands", np.random.default_rng(3)))
    clouds = [item.object.data for item in root.lodgs.levels]
    bpy.context.view_layer.update()
    versions, paint = [
        list(map(version_of, clouds)) for version_of in (changes.version, changes.paint_version)
    ]
    stroke(bpy, (3, 3), radius=2, color=RED)
    bpy.context.view_layer.update()
    assert versions == list(map(changes.version, clouds)) and paint != list(
        map(changes.paint_version, clouds)
    )

    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.4)
    bpy.ops.lodgs.delete_hidden_splats()
    for level, current in zip(
        bundle.levels, lodgs("data.scenes").read_levels(root, looked=True).levels, strict=True
    ):
        remaining = 1 / (1 + np.exp(-level.splats.opacity_logits)) >= 0.4
        assert 0 < remaining.sum() < len(remaining)
        check(colors_of(current.splats), colors[level.number][remaining])


@pytest.mark.parametrize("all_levels", [False, True])
def test_retrained_levels_take_over_paint_by_position(bpy, lodgs, scene_of, all_levels):  # noqa: F811
    """Half of the scene is painted, then one level or all levels are replaced."""
    scenes, painting = lodgs("data.scenes"), lodgs("data.painting")
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(4)))
    half = {level.number: (level.splats.means[:, 0] > 0).astype(np.float32) for level in bundle.levels}
    painting.write_paint(root, painting.blend(painting.read_paint(root), half, RED))
    rng, new_levels = np.random.default_rng(5), bundle_of("bands", np.random.default_rng(5)).levels
    finest = bundle.levels[2].splats.means
    if all_levels:
        scenes.prepare_refill(root, [1])
    for level in new_levels if all_levels else new_levels[2:]:
        rows = rng.integers(len(finest), size=len(level.splats))
        level.splats.means[:] = finest[rows] + rng.normal(0, 0.001, (len(rows), 3))
        scenes.set_level(root, level)
    levels = scenes.read_levels(root, looked=True).levels
    for level in levels if all_levels else levels[2:]:
        x, trained = level.splats.means[:, 0], colors_of(new_levels[level.number - 1].splats)
        expected = np.where((x > 0)[:, None], RED, trained)
        clear = np.abs(x) > 0.1
        assert 20 < (x > 0.1).sum() < len(x) - 20
        np.testing.assert_allclose(colors_of(level.splats)[clear], expected[clear], atol=1e-4)
    assert (root.lodgs.painted is not None) == all_levels
    bpy.ops.lodgs.remove_paint()
    assert root.lodgs.painted is None and not any(" paint" in cloud.name for cloud in bpy.data.pointclouds)


def test_paint_does_not_spread_between_runs(bpy, lodgs, scene_of):  # noqa: F811
    """A run with few splats follows, then one with the original levels."""
    scenes, painting = lodgs("data.scenes"), lodgs("data.painting")
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(4)))
    half = {level.number: (level.splats.means[:, 0] > 0).astype(np.float32) for level in bundle.levels}
    painting.write_paint(root, painting.blend(painting.read_paint(root), half, RED))
    before, coarse = painting.read_paint(root)[3], bundle.levels[2].splats.select(slice(0, 5))
    for levels in ([Level(1, coarse)], bundle.levels):
        scenes.prepare_refill(root, [1])
        for level in levels:
            level.splats.extras = {k: v for k, v in level.splats.extras.items() if k not in COLUMNS}
            scenes.set_level(root, level)
    np.testing.assert_array_equal(painting.read_paint(root)[3], before)
    painting.write_paint(root, painting.blend(painting.read_paint(root), half, BLUE))
    scenes.prepare_refill(root, [1])
    blue = painting.paint_of(root.lodgs.painted)[half[3] > 0, :3]
    np.testing.assert_allclose(blue, np.broadcast_to(BLUE, blue.shape), atol=1e-6)


def test_tree_is_painted_unless_it_is_partial(bpy, lodgs, painted, tmp_path, viewport):  # noqa: F811
    root, _, colors = painted(tree_of(random_leaves(2000, np.random.default_rng(6))))
    for level in lodgs("data.scenes").read_levels(root, looked=True).levels:
        check(colors_of(level.splats), colors[level.number])
    write_in_pages(tmp_path / "paged.ply", tree_of(random_leaves(3000, np.random.default_rng(7))))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "paged.ply", budget=1500)
    with pytest.raises(RuntimeError, match=r"most of its splats are in paged\.ply"):
        stroke(bpy, (100, 100), radius=50, color=RED)


def test_paint_reaches_visible_splats_only(bpy, lodgs, scene_of, viewport):  # noqa: F811
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(8)))
    _, size = viewport
    counts = []
    for through in (False, True):
        path = [{"name": "", "loc": (size[0] / 2, size[1] / 2), "time": 0.0}]
        bpy.ops.lodgs.paint_splats(path=path, radius=200, color=RED, through=through)
        painted = lodgs("data.painting").read_paint(root)
        counts.append(sum(int((paint[:, 3] > 0).sum()) for paint in painted.values()))
        bpy.ops.lodgs.remove_paint()
    assert 0 < counts[0] < counts[1]
