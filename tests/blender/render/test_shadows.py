"""Shadows of splats on meshes and of meshes on splats, in images combined with Cycles."""

from __future__ import annotations

import numpy as np
import pytest

from training.splats.bundle import write_bundle
from training.splats.gaussians import SH_C0, Splats
from training.splats.levels import Bundle, Level

SUN = np.array([0.6, 0.3, -1.0]) / np.linalg.norm([0.6, 0.3, -1.0])


def splats(means: np.ndarray, sizes, color: float, opacity: float) -> Splats:
    count = len(means)
    return Splats(
        means=np.asarray(means, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.tile(np.log(np.float32(sizes)), (count, 1)),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        sh=np.full((count, 1, 3), (color - 0.5) / SH_C0, np.float32),
    )


def import_level(bpy, lodgs, path, level: Splats):
    write_bundle(path, Bundle("", [Level(1, level)]))
    return lodgs("data.importing").import_splats(bpy.context, path, upright=False)


@pytest.fixture
def scene(bpy, lodgs):
    """A scene with a sun along SUN, and a camera of 160x120 pixels that looks down at the origin."""
    from mathutils import Vector

    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = (0, -7, 6)
    camera.rotation_euler = (-camera.location).to_track_quat("-Z", "Y").to_euler()
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.rotation_euler = Vector(SUN).to_track_quat("-Z", "Y").to_euler()
    sun.data.angle, sun.data.energy = 0.0, 2.0
    for obj in (camera, sun):
        scene.collection.objects.link(obj)
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = 160, 120
    scene.render.dither_intensity = 0
    return scene


def ground_points(bpy, scene, height: float = 0.0) -> np.ndarray:
    """Return the points (H, W, 3) at a height that the pixels show, rows from the top."""
    camera = scene.camera
    bpy.context.view_layer.update()
    matrix, side = np.array(camera.matrix_world), camera.data.sensor_width / camera.data.lens / 160
    x, y = np.meshgrid((np.arange(160) - 79.5) * side, (59.5 - np.arange(120)) * side)
    directions = np.stack([x, y, -np.ones_like(x)], 2) @ matrix[:3, :3].T
    origin = matrix[:3, 3]
    return origin + (height - origin[2]) / directions[..., 2:] * directions


def rendered(bpy, scene, path) -> np.ndarray:
    """Render a Blender scene; return its linear values (H, W, 4), rows from the top."""
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGBA"
    scene.render.filepath = str(path)
    assert bpy.ops.render.render(write_still=True, scene=scene.name) == {"FINISHED"}
    image = bpy.data.images.load(str(path))
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def use_cycles(meshes, samples: int) -> None:
    meshes.cycles.samples, meshes.cycles.device, meshes.cycles.use_denoising = samples, "CPU", False
    meshes.render.dither_intensity = 0


def test_splat_casts_its_transmittance_as_a_shadow(bpy, lodgs, scene, tmp_path):
    """Sunlight that passes a round splat at a distance of d standard deviations loses opacity * exp(-d²/2).

    The splat itself stays invisible in the image of the meshes.
    """
    center, size, opacity = np.array([-0.9, -0.2, 1.5]), 0.35, 0.9
    import_level(bpy, lodgs, tmp_path / "one.ply", splats(center[None], (size,) * 3, 0.0, opacity))
    bpy.ops.mesh.primitive_plane_add(size=30)
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    meshes = scene.lodgs_render.meshes
    use_cycles(meshes, 16)
    lit = rendered(bpy, meshes, tmp_path / "lit.exr")
    scene.lodgs_render.shadows = True
    assert meshes.cycles.min_transparent_bounces < 10, "bounced light passes all splats, ten times slower"
    shadowed = rendered(bpy, meshes, tmp_path / "shadowed.exr")

    offsets = ground_points(bpy, scene) - center
    distance = np.linalg.norm(np.cross(offsets, SUN), axis=2) / size
    expected = 1 - np.where(distance < 3, opacity * np.exp(-(distance**2) / 2), 0)
    assert expected.min() < 0.15
    np.testing.assert_allclose(shadowed[..., 3], 1)
    np.testing.assert_allclose(shadowed[..., 0] / lit[..., 0], expected, atol=0.02)

    scene.lodgs_render.shadows = False
    np.testing.assert_array_equal(rendered(bpy, meshes, tmp_path / "again.exr"), lit)


def test_mesh_casts_a_shadow_on_the_ground_of_splats(bpy, lodgs, scene, renderer, tmp_path):
    """Pixels of the ground are black where the ray to the sun hits the cube, and unchanged elsewhere."""
    x, y = np.meshgrid(np.linspace(-8, 8, 81), np.linspace(-8, 8, 81))
    means = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    lodgs("render.engine").use(scene)
    root = import_level(bpy, lodgs, tmp_path / "ground.ply", splats(means, (0.2, 0.2, 0.002), 0.6, 0.95))
    bpy.context.view_layer.objects.active = root
    bpy.ops.mesh.primitive_cube_add(size=1, location=(-1, 0.5, 1.6))
    bpy.context.view_layer.objects.active = root
    alone = rendered(bpy, scene, tmp_path / "alone.exr")
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    assert bpy.ops.lodgs.add_shadow_catcher() == {"FINISHED"}
    use_cycles(scene.lodgs_render.meshes, 4)
    scene.lodgs_render.meshes.cycles.max_bounces = 0
    combined = image = rendered(bpy, scene, tmp_path / "combined.exr")

    points = ground_points(bpy, scene)
    low, high = np.array([-1.5, 0, 1.1]), np.array([-0.5, 1, 2.1])

    def hits(origins, directions):
        with np.errstate(divide="ignore"):
            first, last = np.sort([(low - origins) / directions, (high - origins) / directions], axis=0)
        return (first.max(-1) < last.min(-1)) & (last.min(-1) > 0)

    eye = np.array(scene.camera.matrix_world)[:3, 3]
    cube, shadow = hits(eye, points - eye), hits(points, np.broadcast_to(-SUN, points.shape))
    clear = ~near_outline(cube, 2) & ~near_outline(shadow, 2) & ~cube
    assert (shadow & clear).sum() > 100
    assert image[shadow & clear][:, 0].max() < 0.1 * alone[shadow & clear][:, 0].min()
    lit = ~shadow & clear
    np.testing.assert_allclose(image[lit], alone[lit], atol=0.01)
    # splats that shadow meshes do not shadow the catcher, nor does an instance between it and the sun
    instance = bpy.data.objects.new("instance", None)
    instance.instance_type, instance.location = "COLLECTION", -20 * SUN
    instance.instance_collection = root.lodgs.levels[0].object.users_collection[0]
    scene.collection.objects.link(instance)
    scene.lodgs_render.shadows = True
    image = rendered(bpy, scene, tmp_path / "with_splat_shadows.exr")
    assert image[shadow & clear][:, 0].max() < 0.1 * alone[shadow & clear][:, 0].min()
    np.testing.assert_allclose(image[lit], alone[lit], atol=0.01)
    scene.lodgs_render.shadows = False
    np.testing.assert_array_equal(rendered(bpy, scene, tmp_path / "again.exr"), combined)
    # the catcher holds out no splats
    assert bpy.ops.lodgs.render_mesh_depth() == {"FINISHED"}
    held = rendered(bpy, scene, tmp_path / "held.exr")
    np.testing.assert_allclose(held[lit], alone[lit], atol=0.01)


def near_outline(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return the pixels near the outline of a mask."""
    moves = [(dy, dx) for dy in range(-reach, reach + 1) for dx in range(-reach, reach + 1)]
    return np.any([np.roll(mask, move, (0, 1)) != mask for move in moves], axis=0)


def test_scene_without_ground_gets_no_catcher(bpy, lodgs, scene, tmp_path):
    means = np.random.default_rng(0).normal(size=(50, 3)) * (0.01, 0.01, 3)  # a pole
    import_level(bpy, lodgs, tmp_path / "pole.ply", splats(means, (0.05,) * 3, 0.6, 0.95))
    with pytest.raises(RuntimeError, match="Cannot find the ground"):
        bpy.ops.lodgs.add_shadow_catcher()
    assert "Shadow Catcher" not in bpy.data.objects
