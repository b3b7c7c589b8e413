"""Looks change colours and opacities of every level, in Blender and in exports. Numpy is the reference."""

import numpy as np
import pytest

from tests.blender.data.test_cleaning import ROOT_MATRIX, inside, scene_of, to_blender, transform  # noqa: F401
from tests.training.editing.test_cleaning import bundle_of
from training.color import linear_from_srgb
from training.editing.look import Look
from training.splats.bundle import read_bundle
from training.splats.gaussians import SH_C0
from training.splats.ply import read_ply

EVERYWHERE = Look(0.4, 5000, (1.0, 0.9, 0.7), 0.6, 0.8)
REGIONS = (
    (transform((3, 0, 2), (0.2, 0.5, 0.9), (6, 5, 7)), "BOX", Look(saturation=0.0, opacity=0.5)),
    (transform((2, -1, 3), (0, 1, 0), (3, 4, 3)), "SPHERE", Look(-1.0, 9000, (0.3, 1.0, 1.0), 1.5)),
)


def apply_look(settings, look):
    for name, value in vars(look).items():
        setattr(settings, name, value)


def expected_look(means, sh):
    """Return sRGB colours (N, 3) without view dependence, and factors (N,) of opacities."""
    color, factor = 0.5 + SH_C0 * sh[:, 0].astype(np.float64), np.full(len(means), EVERYWHERE.opacity)
    color = color @ EVERYWHERE.matrix.T
    for matrix, shape, look in REGIONS:
        mask, clear = inside(matrix, means, shape == "SPHERE")
        mask ^= shape == "SPHERE"  # the region is outside the sphere
        assert clear.all() and 0 < mask.sum() < len(mask)
        color[mask] = color[mask] @ look.matrix.T
        factor[mask] *= look.opacity
    return color, factor


@pytest.fixture
def scene_with_look(bpy, lodgs, scene_of):  # noqa: F811
    """``scene_with_look(rule)``: return root and bundle of a scene with a look and two regions."""

    def make(name):
        root, bundle = scene_of(bundle_of(name, np.random.default_rng(3)))
        apply_look(root.lodgs_look, EVERYWHERE)
        for matrix, shape, look in REGIONS:
            obj = lodgs("data.crops").new_crop(root, shape, to_blender(matrix))
            obj.lodgs_crop.keep = "ALL"
            obj.lodgs_look.outside = shape == "SPHERE"
            apply_look(obj.lodgs_look, look)
        bpy.context.view_layer.update()
        return root, bundle

    return make


def evaluated_look(bpy, lodgs, obj):
    """Return rows, linear colours (N, 3) and opacity factors of a level as Blender evaluates it."""
    cloud = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    attributes = lodgs("attributes")
    color = attributes.read_attribute(cloud, attributes.COLOR)[:, :3]
    return (
        attributes.read_attribute(cloud, "row"), color,
        attributes.read_attribute(cloud, attributes.LOOK_OPACITY),
    )  # fmt: skip


def check(bpy, lodgs, obj, splats):
    rows, color, factor = evaluated_look(bpy, lodgs, obj)
    index_of_row = {row: i for i, row in enumerate(splats.extras["row"].tolist())}
    indices = [index_of_row[row] for row in rows.tolist()]
    display, opacity = expected_look(splats.means[indices], splats.sh[indices])
    np.testing.assert_allclose(color, linear_from_srgb(display.clip(0, 1)), atol=2e-5)
    np.testing.assert_allclose(factor, opacity, rtol=1e-5)


@pytest.mark.parametrize(
    "name",
    ["bands", "chunks", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("octree", "decay"))],
)
def test_node_groups_match_numpy_at_every_level(bpy, lodgs, scene_with_look, name):
    root, bundle = scene_with_look(name)
    bpy.context.scene.lodgs_viewport.splats = False  # points, which Blender draws
    root.lodgs.mode = "SINGLE"
    for item, level in zip(root.lodgs.levels, bundle.levels, strict=True):
        root.lodgs.single_level = item.number
        bpy.context.view_layer.update()
        check(bpy, lodgs, item.object, level.splats)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        assert lodgs("data.selection").only_lodgs_modifiers(item.object.evaluated_get(depsgraph), depsgraph)
    bpy.context.scene.lodgs_viewport.splats = True  # LODGS applies the look itself
    bpy.context.view_layer.update()
    obj = root.lodgs.levels[2].object
    assert evaluated_look(bpy, lodgs, obj)[2] is None
    for engine in ("CYCLES", "LODGS"):
        bpy.context.scene.render.engine = engine
        bpy.context.view_layer.update()
        assert lodgs("data.looks").modifier_of(obj).show_render == (engine == "CYCLES")


def test_look_is_animated_and_applies_to_new_levels(bpy, lodgs, scene_with_look):
    root, bundle = scene_with_look("bands")
    bpy.context.scene.lodgs_viewport.splats = False
    root.lodgs.single_level = 3
    look, obj = root.lodgs_look, root.lodgs.levels[2].object
    for frame, exposure in ((1, 0.4), (11, -1.6)):
        look.exposure = exposure
        look.keyframe_insert("exposure", frame=frame)
    bpy.context.scene.frame_set(11)
    dark_colors = evaluated_look(bpy, lodgs, obj)[1]
    bpy.context.scene.frame_set(1)
    check(bpy, lodgs, obj, bundle.levels[2].splats)
    assert dark_colors.mean() < 0.5 * evaluated_look(bpy, lodgs, obj)[1].mean()

    new_level = bundle_of("bands", np.random.default_rng(6)).levels[2]
    lodgs("data.scenes").set_level(root, new_level)
    bpy.context.view_layer.update()
    check(bpy, lodgs, root.lodgs.levels[2].object, new_level.splats)


@pytest.mark.parametrize("placed", [False, True])
def test_exported_look_round_trip(bpy, lodgs, scene_with_look, tmp_path, placed):
    root, bundle = scene_with_look("bands")
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"), placed=placed)
    exported = read_bundle(tmp_path / "out.ply")
    for level, original in zip(exported.levels, bundle.levels, strict=True):
        color, factor = expected_look(original.splats.means, original.splats.sh)
        np.testing.assert_allclose(0.5 + SH_C0 * level.splats.sh[:, 0], color, atol=2e-5)
        opacity, original_opacity = (
            1 / (1 + np.exp(-s.opacity_logits)) for s in (level.splats, original.splats)
        )
        np.testing.assert_allclose(opacity, factor * original_opacity, rtol=1e-4, atol=1e-6)
        assert level.splats.extras.keys() == original.splats.extras.keys()
    reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    for level, exported_again in zip(
        exported.levels, lodgs("data.scenes").read_levels(reimported, looked=True).levels, strict=True
    ):
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            np.testing.assert_array_equal(getattr(exported_again.splats, name), getattr(level.splats, name))
    bpy.context.view_layer.objects.active = root
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "trained.ply"), looked=False)
    for level, original in zip(read_bundle(tmp_path / "trained.ply").levels, bundle.levels, strict=True):
        np.testing.assert_array_equal(level.splats.sh, original.splats.sh)


@pytest.mark.parametrize("points", [False, True])
def test_visible_export_applies_the_look_once(bpy, lodgs, scene_with_look, tmp_path, points):
    root, bundle = scene_with_look("bands")
    bpy.context.scene.lodgs_viewport.splats = not points
    root.lodgs.single_level = 2
    bpy.context.view_layer.update()
    splats = bundle.levels[1].splats
    color, factor = expected_look(splats.means, splats.sh)
    for source in ({"source": "SHOWN"}, {"source": "LEVEL", "level": 2}):
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "plain.ply"), **source)
        exported = read_ply(tmp_path / "plain.ply")
        np.testing.assert_allclose(0.5 + SH_C0 * exported.sh[:, 0], color, atol=2e-5)
        opacity, original_opacity = (1 / (1 + np.exp(-s.opacity_logits)) for s in (exported, splats))
        np.testing.assert_allclose(opacity, factor * original_opacity, rtol=1e-4, atol=2e-6)
        assert exported.extras.keys() == splats.extras.keys()


def test_look_survives_undo_saving_and_duplication(bpy, lodgs, scene_with_look, tmp_path):
    root, bundle = scene_with_look("octree")
    looks, name = lodgs("data.looks"), root.name
    scene = bpy.context.scene
    scene.lodgs_viewport.splats = False
    root.lodgs.single_level = 1

    def evaluated_looks():
        root = bpy.data.objects[name]
        bpy.context.view_layer.update()
        looks_of_root = looks.looks_of(root, bpy.context.evaluated_depsgraph_get(), to_blender(np.eye(4)))
        return [look for _, look in looks_of_root]

    before = evaluated_looks()
    assert len(before) == 3
    np.testing.assert_allclose(before[0].matrix, EVERYWHERE.matrix, atol=1e-5)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lodgs.reset_look("EXEC_DEFAULT", True)
    assert evaluated_looks() == before[1:]
    bpy.ops.ed.undo()
    assert evaluated_looks() == before
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert evaluated_looks() == before
    root = bpy.data.objects[name]
    check(bpy, lodgs, root.lodgs.levels[0].object, bundle.levels[0].splats)

    for obj in (root, *root.children_recursive):
        obj.hide_set(False)
        obj.select_set(True)
    bpy.ops.object.duplicate()
    copy = next(obj for obj in bpy.context.selected_objects if obj.lodgs.is_root)
    copy.location.x += 5
    apply_look(bpy.data.objects[name].lodgs_look, Look(exposure=-2.0))
    bpy.context.view_layer.update()
    bpy.context.view_layer.update()
    splats, obj = bundle.levels[0].splats, copy.lodgs.levels[0].object
    assert obj != root.lodgs.levels[0].object
    check(bpy, lodgs, obj, splats)

    bpy.context.view_layer.objects.active = copy
    regions = looks.regions_of(copy)
    bpy.ops.lodgs.reset_look()
    bpy.ops.lodgs.reset_look(name=regions[0].name)
    assert looks.modifier_of(obj)  # regions may get a look
    for region in regions:
        bpy.ops.lodgs.remove_crop(name=region.name)
    bpy.context.view_layer.update()
    assert looks.modifier_of(obj) is None and looks.modifier_of(root.lodgs.levels[0].object)
    with pytest.raises(RuntimeError, match="has no crop"):
        bpy.ops.lodgs.reset_look(name="nobody")


def test_look_of_a_crop_survives_deletion(bpy, lodgs, scene_with_look):
    root, _ = scene_with_look("bands")
    root.lodgs.single_level = 3
    bpy.ops.lodgs.add_crop(shape="BOX", keep="INSIDE")
    crop = bpy.context.active_object
    crop.lodgs_look.exposure = 1.0
    bpy.context.view_layer.update()
    depsgraph, crops = bpy.context.evaluated_depsgraph_get(), lodgs("data.crops")
    assert crops.removing_crops(root) == [crop] and len(crops.crops_of(root)) == 3
    assert len(crops.evaluated_crops(root, depsgraph)) == 1
    assert len(lodgs("data.looks").looks_of(root, depsgraph, to_blender(np.eye(4)))) == 4
    bpy.ops.lodgs.delete_hidden_splats()
    assert crop.lodgs_crop.keep == "ALL" and not crops.removing_crops(root)
    crop.lodgs_crop.use = False
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    assert len(lodgs("data.looks").looks_of(root, depsgraph, to_blender(np.eye(4)))) == 3
