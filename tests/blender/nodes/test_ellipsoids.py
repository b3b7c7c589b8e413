"""Ellipsoids for Cycles: a splat looks as in the rasterizer, and LODGS ignores the modifier."""

from __future__ import annotations

import numpy as np
import pytest

from training.splats.gaussians import Splats


def splats(**changes) -> Splats:
    """Return one elongated, rotated splat."""
    values = {
        "means": [[0.1, 0, 0.05]], "quats": [[0.9, 0.1, 0.35, 0.2]], "log_scales": np.log([[0.5, 0.15, 0.3]]),
        "opacity_logits": [1.5], "sh": np.full((1, 1, 3), (0.7 - 0.5) / 0.28209479177387814),
    } | changes  # fmt: skip
    return Splats(**{name: np.asarray(value, np.float32) for name, value in values.items()})


@pytest.fixture
def scene(bpy, lodgs):
    """One splat in front of a camera, rendered by Cycles with transparent film at 64x48 pixels."""
    scene = bpy.context.scene
    collection = bpy.data.collections.new("one")
    scene.collection.children.link(collection)
    root = bpy.data.objects.new("one", None)
    root.lodgs.is_root = True
    collection.objects.link(root)
    from training.splats.levels import Level

    lodgs("data.scenes").set_level(root, Level(1, splats(), 0.0))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.rotation_euler = (0, -5, 0), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.device, scene.cycles.use_denoising = 16, "CPU", False
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    scene.render.film_transparent = True
    scene.render.dither_intensity = 0
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.color_mode = "RGBA"
    return scene


def rendered(bpy, path) -> np.ndarray:
    """Render to a file. Return its pixels, (H, W, 4)."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)


@pytest.mark.nightly
def test_cycles_matches_the_rasterizer(bpy, lodgs, scene, renderer, tmp_path):
    scene.lodgs_render.ellipsoids = True
    cycles = rendered(bpy, tmp_path / "cycles.png")
    scene.render.engine = "LODGS"  # ellipsoids stay enabled for other engines
    drawn = rendered(bpy, tmp_path / "lodgs.png")
    assert drawn[..., 3].max() > 0.7
    difference = np.abs(cycles[..., 3] - drawn[..., 3])
    assert difference.max() < 0.06 and difference.mean() < 0.01
    visible = drawn[..., 3] > 0.2
    np.testing.assert_allclose(cycles[visible][:, :3], 0.7, atol=0.02)


@pytest.mark.parametrize(("depth", "visible"), [(1.0, True), (-1.0, False)])
def test_splat_around_the_camera_is_visible_if_its_centre_is_in_front(
    bpy, lodgs, scene, tmp_path, depth, visible
):
    """At distance d from the centre of this splat, alpha is opacity * exp(-d²/8)."""
    from training.splats.levels import Level

    splat = splats(means=[[0, -5 + depth, 0]], quats=[[1, 0, 0, 0]], log_scales=np.log([[2.0, 2.0, 2.0]]))
    lodgs("data.scenes").set_level(bpy.data.objects["one"], Level(1, splat, 0.0))
    scene.lodgs_render.ellipsoids = True
    alpha = rendered(bpy, tmp_path / "cycles.png")[..., 3]
    x, y = np.meshgrid(np.arange(64) - 31.5, np.arange(48) - 23.5)
    size = scene.camera.data.sensor_width / scene.camera.data.lens / 64
    tangent = np.hypot(x, y) * size  # of the angle between the ray and the axis
    distance = depth * tangent / np.hypot(1, tangent)
    expected = np.exp(-(distance**2) / 8) / (1 + np.exp(-1.5)) if visible else np.zeros((48, 64))
    np.testing.assert_allclose(alpha, expected, atol=0.015)


def test_rays_pass_many_ellipsoids(bpy, lodgs, scene, tmp_path):
    """Thirty faint splats in a row have an alpha of 1 - (1 - 0.1)^30 without noise.

    With the default settings, Cycles would end most rays on the way.
    """
    row = np.zeros((30, 3))
    row[:, 1] = np.arange(30) * 0.1
    many = splats(
        means=row, quats=np.tile([1.0, 0, 0, 0], (30, 1)), log_scales=np.log(np.full((30, 3), 3.0)),
        opacity_logits=np.full(30, np.log(0.1 / 0.9)), sh=np.zeros((30, 1, 3)),
    )  # fmt: skip
    from training.splats.levels import Level

    lodgs("data.scenes").set_level(bpy.data.objects["one"], Level(1, many, 0.0))
    scene.camera.location.y = -30
    scene.lodgs_render.ellipsoids, scene.cycles.samples = True, 1
    alpha = rendered(bpy, tmp_path / "cycles.png")[22:26, 30:34, 3]
    np.testing.assert_allclose(alpha, 1 - 0.9**30, atol=0.02)


def test_ellipsoids_are_on_only_if_enabled(bpy, lodgs, scene):
    obj = bpy.data.objects["one level 1"]
    scene.lodgs_render.ellipsoids = True
    scene.lodgs_render.ellipsoids = True  # enabling twice adds one modifier
    assert [modifier.name for modifier in obj.modifiers].count("LODGS Ellipsoids") == 1
    assert scene.cycles.transparent_max_bounces >= 256
    modifier = obj.modifiers["LODGS Ellipsoids"]
    for enabled, engine, expected in (
        (True, "CYCLES", True), (False, "CYCLES", False), (True, "LODGS", False), (True, "CYCLES", True),
    ):  # fmt: skip
        scene.lodgs_render.ellipsoids, scene.render.engine = enabled, engine
        bpy.context.view_layer.update()
        assert modifier.show_render == expected
    # new levels have the modifier too
    from training.splats.levels import Level

    lodgs("data.scenes").set_level(bpy.data.objects["one"], Level(2, splats(), 0.0))
    assert "LODGS Ellipsoids" in bpy.data.objects["one level 2"].modifiers
    assert bpy.data.objects["one level 2"].modifiers[-1].name == "LODGS Ellipsoids"


def test_linked_scenes_keep_ellipsoids_when_a_file_is_opened(bpy, lodgs, scene, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, linked):
        linked.collections = ["one"]
    bpy.context.scene.collection.children.link(linked.collections[0])
    bpy.context.scene.lodgs_render.ellipsoids = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "file.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "file.blend"))
    modifiers = bpy.context.scene.objects["one level 1"].modifiers
    assert [modifier.name for modifier in modifiers].count("LODGS Ellipsoids") == 1


def test_ellipsoids_end_at_an_alpha_of_one_percent(bpy, lodgs, scene):
    """At d standard deviations alpha is opacity * exp(-d²/2); fainter splats have no ellipsoid."""
    opacities = np.array([0.9, 0.3, 0.05, 0.005])
    logits = np.log(opacities / (1 - opacities))
    four = splats(
        means=[[x, 0, 0] for x in range(4)], quats=np.tile([1.0, 0, 0, 0], (4, 1)),
        log_scales=np.log(np.tile([0.5, 0.2, 0.1], (4, 1))), opacity_logits=logits,
        sh=np.zeros((4, 1, 3)),
    )  # fmt: skip
    from training.splats.levels import Level

    root = bpy.data.objects["one"]
    lodgs("data.scenes").set_level(root, Level(1, four, 0.0))
    scene.lodgs_render.ellipsoids = True
    root.lodgs.levels[0].object.modifiers["LODGS Ellipsoids"].show_viewport = True
    instances = bpy.context.evaluated_depsgraph_get().object_instances
    scales = [
        np.array(i.matrix_world.to_scale()) for i in instances if i.is_instance and i.object.type == "MESH"
    ]
    reach = np.sqrt(2 * np.log(opacities[:3] / 0.0111))
    np.testing.assert_allclose(scales, reach[:, None] * [0.5, 0.2, 0.1], rtol=2e-3)


def test_files_with_an_older_material_keep_it(bpy, lodgs, scene):
    """Its alpha fits the spheres of older groups only."""
    older = bpy.data.materials.new("LODGS Ellipsoids")
    scene.lodgs_render.ellipsoids = True
    assert older.name == "LODGS Ellipsoids (older)"
    current = bpy.data.materials["LODGS Ellipsoids"]
    assert lodgs("nodes.ellipsoids").falloff() == current != older
