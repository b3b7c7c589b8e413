"""Blender 5.3's own Gaussian splats have the same attribute names, values and levels as those of LODGS.

The tests of attribute names, of old files and of *Add to LODGS Scene* run in every Blender, on clouds like
those of Blender's importer. The tests of Blender's drawing need Blender 5.3.
"""

import numpy as np
import pytest

from training.splats.gaussians import SH_C0
from training.splats.ply import read_ply, write_ply

HIGHER = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}
"""Coefficients above degree 0 by degree."""


@pytest.fixture
def make(lodgs):
    """``make(count, degree)``: return random splats with an extra column."""
    Splats = lodgs("training.splats.gaussians").Splats

    def make_splats(count=300, degree=3, seed=0):
        random = np.random.default_rng(seed)

        def normal(*shape):
            return random.standard_normal(shape).astype(np.float32)

        return Splats(
            normal(count, 3), normal(count, 4), normal(count, 3) * 0.4 - 1.6, 2 * normal(count),
            0.3 * normal(count, (degree + 1) ** 2, 3), {"confidence": np.arange(count, dtype="f4")},
        )  # fmt: skip

    return make_splats


@pytest.fixture
def native(bpy, lodgs):
    """``native(splats)``: return an object with the attributes of Blender 5.3's importer only."""

    def make_object(splats, first=0, name="cloud"):
        attributes, compat = lodgs("attributes"), lodgs("compat")
        cloud = compat.new_point_cloud(name, splats.means)
        base = np.column_stack([splats.sh[:, 0], 1 / (1 + np.exp(-splats.opacity_logits))])
        attributes.write_attribute(cloud, "radiance:base", compat.WIDE_TYPE, base)
        attributes.write_attribute(cloud, "scale", "FLOAT_VECTOR", np.exp(splats.log_scales))
        unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
        attributes.write_attribute(cloud, "rotation", "QUATERNION", unit)
        for k in range(1, splats.sh.shape[1]):
            attributes.write_attribute(cloud, f"radiance:sh_{first + k - 1}", "FLOAT_VECTOR", splats.sh[:, k])
        attributes.write_attribute(cloud, "confidence", "FLOAT", splats.extras["confidence"])
        compat.make_native(cloud)
        obj = bpy.data.objects.new(name, cloud)
        bpy.context.scene.collection.objects.link(obj)
        for selected in bpy.context.selected_objects:
            selected.select_set(False)
        bpy.context.view_layer.objects.active = obj
        obj.select_set(True)
        bpy.context.view_layer.update()
        return obj

    return make_object


@pytest.fixture
def with_splats(lodgs):
    """Skip a test if this Blender has no native splats."""
    if lodgs("compat").NATIVE_SPLATS is None:
        pytest.skip("no native splats before Blender 5.3")


def attribute(lodgs, obj, name, evaluated=None):
    return lodgs("attributes").read_attribute((evaluated or obj).data, name)


def evaluated(bpy, obj):
    bpy.context.view_layer.update()
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get())


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_coefficients_are_numbered_from_0_as_in_blender(lodgs, make, degree):
    splats = make(20, degree)
    obj = lodgs("data.objects").new_splats("s", splats)
    names = {a.name for a in obj.data.attributes if a.name.startswith("radiance:sh_")}
    assert names == {f"radiance:sh_{k}" for k in range(HIGHER[degree])}
    for k in range(HIGHER[degree]):
        np.testing.assert_array_equal(attribute(lodgs, obj, f"radiance:sh_{k}"), splats.sh[:, k + 1])
    assert lodgs("data.objects").sh_degree(obj.data) == degree


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_both_coefficient_namings_are_read(lodgs, make, native, first, degree):
    splats = make(50, degree)
    obj = native(splats, first)
    read = lodgs("data.objects").read_splats(obj)
    np.testing.assert_array_equal(read.sh, splats.sh)
    assert set(read.extras) == {"confidence"}
    drawn = lodgs("data.shown").read(obj.data)
    np.testing.assert_array_equal(drawn.sh, splats.sh)
    records = lodgs("viewport.resident").read_records(obj.data, np.arange(50), HIGHER[degree])
    np.testing.assert_array_equal(
        records[:, 14 : 14 + 3 * HIGHER[degree]].reshape(50, -1, 3), splats.sh[:, 1:]
    )


def test_opening_old_files_renames_coefficients(bpy, lodgs, make, native, tmp_path):
    splats = make(30, 3)
    native(splats, first=1)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "old.blend"))
    obj = bpy.data.objects["cloud"]
    assert "radiance:sh_15" not in obj.data.attributes
    for k in range(15):
        np.testing.assert_array_equal(attribute(lodgs, obj, f"radiance:sh_{k}"), splats.sh[:, k + 1])


def test_levels_of_another_blender_get_current_modifiers(bpy, lodgs, make, tmp_path):
    """A file saved before Blender 5.3 has plain clouds, the points' material and one display modifier."""
    write_ply(tmp_path / "s.ply", make(40, 1))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "s.ply")
    obj, display = root.lodgs.levels[0].object, lodgs("nodes.display")
    expected = [modifier.name for modifier in obj.modifiers]
    if lodgs("compat").NATIVE_SPLATS:
        obj.data.type = "POINTS"
    obj.modifiers[0].node_group["lodgs_version"] = 0
    obj.data.materials.clear()
    obj.data.materials.append(display.points_material())
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "old.blend"))
    obj = next(o for o in bpy.data.objects if o.lodgs.is_root).lodgs.levels[0].object
    assert [modifier.name for modifier in obj.modifiers] == expected
    assert obj.modifiers[display.NAME].node_group.get("lodgs_version") != 0
    if lodgs("compat").NATIVE_SPLATS:
        assert obj.data.type == "GAUSSIAN_SPLAT" and not obj.data.materials
    else:
        assert [material.name for material in obj.data.materials] == ["LODGS Points"]


def test_loose_cloud_becomes_a_scene_in_place(bpy, lodgs, make, native, tmp_path):
    splats = make(60, 3)
    obj = native(splats)
    obj.location, obj.rotation_euler, obj.scale = (1, 2, 3), (0.1, 0.2, 0.3), (2, 2, 2)
    bpy.context.view_layer.update()
    world, cloud = np.array(obj.matrix_world), obj.data
    assert bpy.ops.lodgs.add_to_scene() == {"FINISHED"}
    root = lodgs("data.objects").root_of(obj)
    bpy.context.view_layer.update()
    assert [item.object for item in root.lodgs.levels] == [obj] and obj.data == cloud
    np.testing.assert_allclose(np.array(obj.matrix_world), world, atol=1e-6)
    np.testing.assert_allclose(np.array(root.matrix_world), world, atol=1e-6)
    assert root.lodgs.training.method in ("lodge", "tree")  # these train from splats without photos
    assert not bpy.ops.lodgs.add_to_scene.poll()

    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "out.ply"), source="LEVEL", level=1)
    exported = read_ply(tmp_path / "out.ply")
    np.testing.assert_array_equal(exported.means, splats.means)
    np.testing.assert_array_equal(exported.sh, splats.sh)
    np.testing.assert_allclose(exported.log_scales, splats.log_scales, atol=1e-6)
    np.testing.assert_allclose(exported.opacity_logits, splats.opacity_logits, atol=1e-5)
    np.testing.assert_array_equal(exported.extras["confidence"], splats.extras["confidence"])


def test_several_clouds_become_levels_ordered_by_splat_count(bpy, lodgs, make, native):
    fine, coarse = native(make(90), name="fine"), native(make(30), name="coarse")
    fine.select_set(True)
    assert bpy.ops.lodgs.add_to_scene(as_levels=True) == {"FINISHED"}
    root = lodgs("data.objects").root_of(fine)
    assert [item.object for item in root.lodgs.levels] == [coarse, fine]
    assert root.lodgs.single_level == 2


def test_unsuitable_cloud_stays_unchanged(bpy, lodgs, make, native):
    good, bad = native(make(20), name="good"), native(make(30), name="bad")
    bad.scale = (1, 2, 1)
    good.select_set(True)
    bpy.context.view_layer.update()
    objects = len(bpy.data.objects)
    with pytest.raises(RuntimeError, match=r"'bad': its scale \(1, 2, 1\)"):
        bpy.ops.lodgs.add_to_scene()
    assert len(bpy.data.objects) == objects
    assert good.parent is None and "log_scale" not in good.data.attributes


def test_import_by_blender_and_export_keep_values(bpy, lodgs, make, with_splats, tmp_path):
    splats = make(200, 3)
    write_ply(tmp_path / "in.ply", splats)
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "in.ply"))
    assert bpy.ops.lodgs.add_to_scene() == {"FINISHED"}
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "out.ply"), source="LEVEL", level=1)
    exported = read_ply(tmp_path / "out.ply")
    np.testing.assert_array_equal(exported.means, splats.means)
    np.testing.assert_array_equal(exported.sh, splats.sh)
    np.testing.assert_allclose(exported.log_scales, splats.log_scales, atol=1e-6)
    np.testing.assert_allclose(exported.opacity_logits, splats.opacity_logits, atol=1e-5)
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(exported.quats, unit, atol=1e-6)


def test_cycles_draws_a_level_like_blenders_own_import(bpy, lodgs, make, with_splats, tmp_path):
    """Images are equal to the bit, as attributes and material are Blender's."""
    write_ply(tmp_path / "s.ply", make(300, 3))

    def render_import(load):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        load()
        scene = bpy.context.scene
        scene.render.engine, scene.cycles.samples, scene.cycles.seed = "CYCLES", 4, 3
        scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
        render = scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = 96, 64, 100
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.location = (0, 0, 9)
        scene.collection.objects.link(camera)
        scene.camera = camera
        render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
        render.filepath = str(tmp_path / "out.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(render.filepath)
        pixels = np.array(image.pixels[:])
        bpy.data.images.remove(image)
        return pixels.reshape(64, 96, 4)

    path = str(tmp_path / "s.ply")
    blender_image = render_import(lambda: bpy.ops.wm.ply_import(filepath=path))
    lodgs_image = render_import(
        lambda: lodgs("data.importing").import_splats(bpy.context, path, upright=False)
    )
    assert blender_image[..., :3].std() > 0.1
    np.testing.assert_array_equal(lodgs_image, blender_image)


def test_appended_points_material_does_not_replace_colours(lodgs, make, native, with_splats):
    """Blender numbers the material of an older file if this file has one."""
    display, obj = lodgs("nodes.display"), native(make())
    obj.data.materials.append(display.points_material().copy())
    assert obj.data.materials[0].name == "LODGS Points.001"
    display.attach(obj)
    assert not obj.data.materials


def test_blender_and_lodgs_draw_the_same_selection(bpy, lodgs, make, with_splats, tmp_path):
    bundles = lodgs("training.splats.bundle")
    levels_module = lodgs("training.splats.levels")
    levels = [levels_module.Level(n, make(100 * n, 1, seed=n), {"s_min": s}) for n, s in ((1, 0.5), (2, 0.0))]
    bundles.write_bundle(
        tmp_path / "b.ply", levels_module.Bundle("flod", levels, "bands", {}, {"gamma": 1.0})
    )
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    root.lodgs.mode, root.lodgs.camera_choice, root.lodgs.camera_center = "SELECTIVE", "TRAINING", (0, 0, -1)
    settings = bpy.context.scene.lodgs_viewport
    positions, types = {}, {}
    for drawn_by in ("LODGS", "BLENDER"):
        settings.drawn_by = drawn_by
        bpy.context.view_layer.update()
        visible = lodgs("data.shown").splat_instances(bpy.context.evaluated_depsgraph_get())
        clouds = [instance.evaluated.data for instance in visible]
        types[drawn_by] = {cloud.type for cloud in clouds if len(cloud.points)}
        positions[drawn_by] = [lodgs("attributes").read_attribute(cloud, "position") for cloud in clouds]
        by_blender = {lodgs("nodes.display").is_drawn_by_blender(instance.evaluated) for instance in visible}
        assert by_blender == {drawn_by == "BLENDER"}
    assert types == {"LODGS": {"POINTS"}, "BLENDER": {"GAUSSIAN_SPLAT"}}
    counts = [0 if values is None else len(values) for values in positions["LODGS"]]
    assert 0 < sum(counts) < 300
    for by_lodgs, by_blender in zip(positions["LODGS"], positions["BLENDER"], strict=True):
        np.testing.assert_array_equal(by_lodgs, by_blender)
    settings.splats = False
    bpy.context.view_layer.update()
    obj = root.lodgs.levels[1].object
    assert evaluated(bpy, obj).data.type == "POINTS"
    assert attribute(lodgs, obj, "radius", evaluated(bpy, obj)).min() > 0


def test_blender_draws_looks_paint_and_weights(bpy, lodgs, make, with_splats, tmp_path):
    """Blender draws the look of ``training.editing.look``, and exports apply it once."""
    splats = make(80, 3)
    write_ply(tmp_path / "s.ply", splats)
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "s.ply", upright=False)
    obj = root.lodgs.levels[0].object
    look = root.lodgs_look
    look.exposure, look.tint, look.saturation, look.opacity = -1.0, (1.0, 0.5, 0.7), 0.6, 0.5
    weights = np.linspace(0.1, 1, 80, dtype=np.float32)
    lodgs("attributes").write_attribute(obj.data, "lod_weight", "FLOAT", weights)
    paint = np.random.default_rng(5).uniform(0, 0.5, (80, 4)).astype(np.float32)
    names = lodgs("training.editing.paint").COLUMNS
    for name, column in zip(names, paint.T, strict=True):
        lodgs("attributes").write_attribute(obj.data, name, "FLOAT", column)
    names = [modifier.name for modifier in obj.modifiers]
    assert names.index("LODGS Native Splats") > next(i for i, name in enumerate(names) if "Look" in name)
    lodgs("data.selection").follow_crops(root)
    bpy.context.scene.lodgs_viewport.drawn_by = "BLENDER"
    drawn_object = evaluated(bpy, obj)

    Look = lodgs("training.editing.look").Look
    matrix = Look(exposure=look.exposure, tint=tuple(look.tint), saturation=look.saturation).matrix
    amount = paint[:, 3, None].astype(float)
    base = (1 - amount) * (0.5 + SH_C0 * splats.sh[:, 0].astype(float)) + paint[:, :3]
    higher = (1 - amount[..., None]) * splats.sh[:, 1:]
    drawn = attribute(lodgs, obj, "radiance:base", drawn_object)
    np.testing.assert_allclose(0.5 + SH_C0 * drawn[:, :3], base @ matrix.T, atol=1e-5)
    opacity = 0.5 * weights / (1 + np.exp(-splats.opacity_logits.astype(float)))
    np.testing.assert_allclose(drawn[:, 3], opacity, atol=1e-6)
    for k in range(15):
        np.testing.assert_allclose(
            attribute(lodgs, obj, f"radiance:sh_{k}", drawn_object), higher[:, k] @ matrix.T, atol=1e-5
        )

    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "out.ply"), source="SHOWN")
    exported = read_ply(tmp_path / "out.ply")
    np.testing.assert_allclose(0.5 + SH_C0 * exported.sh[:, 0], base @ matrix.T, atol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-exported.opacity_logits)), opacity, atol=1e-6)
    assert bpy.context.scene.lodgs_viewport.drawn_by == "BLENDER"


def test_blender_imports_our_spz_upright(bpy, lodgs, make, with_splats, tmp_path):
    """By the specification of SPZ y is up, which Blender turns to z; -y is up in a PLY."""
    splats = make(60)
    lodgs("training.splats.spz").write_spz(tmp_path / "a.spz", splats, {})
    bpy.ops.wm.spz_import(filepath=str(tmp_path / "a.spz"))
    obj = bpy.context.object
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    means = attribute(lodgs, obj, "position") @ np.array(obj.matrix_world)[:3, :3].T
    np.testing.assert_allclose(means, splats.means @ turn.T, atol=1e-5)
    np.testing.assert_allclose(
        attribute(lodgs, obj, "radiance:base")[:, 3], 1 / (1 + np.exp(-splats.opacity_logits)), atol=0.003
    )
