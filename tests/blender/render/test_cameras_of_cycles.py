"""Cameras of Blender: splats stand where Cycles draws cubes, or a message says why not."""

import os
from pathlib import Path

import numpy as np
import pytest

from training.splats.bundle import write_bundle
from training.splats.gaussians import SH_C0, Splats
from training.splats.levels import Bundle, Level

pytestmark = pytest.mark.usefixtures("renderer")


def one_blender(*cases) -> list:
    """Mark further cases of a test, whose code paths in Blender other cases take too."""
    return [
        pytest.param(*case if isinstance(case, tuple) else (case,), marks=pytest.mark.one_blender)
        for case in cases
    ]


MARKS = {
    (1, 0, 0): (0, 0, 0),
    (0, 1, 0): (1, 0, 0.3),
    (0, 0, 1): (-0.8, 0.6, 0.5),
    (1, 1, 0): (0.2, -0.9, 0.8),
}
"""Positions of opaque marks by colour."""


@pytest.fixture
def scene(bpy):
    """A scene with a camera and an emissive cube at each mark, for Cycles."""
    from mathutils import Vector

    scene = bpy.context.scene
    camera = bpy.data.objects.new("cam", bpy.data.cameras.new("cam"))
    scene.collection.objects.link(camera)
    camera.location = (-2.5, 4.3, 2)
    camera.rotation_euler = (Vector((0, 0, 0.3)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.camera = camera
    render = scene.render
    render.resolution_x, render.resolution_y, render.dither_intensity = 96, 72, 0
    render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "Standard"
    scene.cycles.samples = 1
    for color, position in MARKS.items():
        bpy.ops.mesh.primitive_cube_add(size=0.15, location=position)
        material = bpy.data.materials.new("mark")
        material.use_nodes = True
        tree = material.node_tree
        tree.nodes.clear()
        emission = tree.nodes.new("ShaderNodeEmission")
        emission.inputs[0].default_value = (*color, 1)
        tree.links.new(emission.outputs[0], tree.nodes.new("ShaderNodeOutputMaterial").inputs[0])
        bpy.context.object.data.materials.append(material)
    return scene


@pytest.fixture
def root(bpy, lodgs, scene, tmp_path):
    """A small splat at each mark."""
    colors = np.array(list(MARKS), np.float32)
    count = len(colors)
    splats = Splats(
        means=np.array(list(MARKS.values()), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), -2.6, np.float32),
        opacity_logits=np.full(count, 8, np.float32),
        sh=((colors - 0.5) / SH_C0)[:, None],
    )
    path = tmp_path / "marks.ply"
    write_bundle(path, Bundle("", [Level(1, splats)]))
    return lodgs("data.importing").import_splats(bpy.context, path, upright=False)


def shear(bpy, scene):
    rig = bpy.data.objects.new("rig", None)
    scene.collection.objects.link(rig)
    rig.scale, rig.rotation_euler = (1.6, 0.8, 1.1), (0.1, 0.2, 0.5)
    scene.camera.parent = rig


def mirror(bpy, scene):
    scene.camera.scale = (-1, 1, 1)


def stereo(bpy, scene, mode="OFFAXIS"):
    scene.render.use_multiview = True
    scene.render.image_settings.views_format = "INDIVIDUAL"
    scene.camera.data.stereo.interocular_distance = 0.6
    scene.camera.data.stereo.convergence_distance = 4
    scene.camera.data.stereo.convergence_mode = mode


def toe_in(bpy, scene):
    stereo(bpy, scene, "TOE")
    scene.camera.data.sensor_fit = "VERTICAL"


def several_cameras(bpy, scene):
    stereo(bpy, scene)
    scene.render.views_format = "MULTIVIEW"
    for view, suffix in zip(scene.render.views, ("_L", "_R"), strict=True):
        view.camera_suffix = suffix
    scene.camera.name = "cam_L"
    right_camera = scene.camera.copy()
    right_camera.name, right_camera.location = "cam_R", (-3.5, 3.6, 2)
    scene.collection.objects.link(right_camera)


def orthographic(bpy, scene):
    data = scene.camera.data
    data.type, data.ortho_scale, data.shift_x, data.shift_y = "ORTHO", 4.5, 0.1, -0.05
    scene.render.pixel_aspect_y = 1.3


def stereo_orthographic(bpy, scene):
    orthographic(bpy, scene)
    stereo(bpy, scene)


def sheared_orthographic(bpy, scene):
    shear(bpy, scene)
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 4.5


def panorama(bpy, scene):
    scene.camera.data.type, scene.camera.data.panorama_type = "PANO", "EQUIRECTANGULAR"
    scene.camera.location = (-0.8, 1.3, 0.9)
    scene.render.resolution_x, scene.render.resolution_y = 240, 120


def part_of_a_panorama(bpy, scene):
    panorama(bpy, scene)
    data = scene.camera.data
    data.longitude_min, data.longitude_max = -1.2, 1.6
    data.latitude_min, data.latitude_max = -1.0, 0.7


def draw(bpy, engine, path: Path) -> dict[str, dict]:
    """Render with an engine. Return the centre of each mark in pixels, by file name."""
    scene = bpy.context.scene
    for obj in scene.objects:
        if obj.type == "MESH":
            obj.hide_render = engine == "LODGS"
        elif obj.type == "POINTCLOUD":  # Blender 5.3 draws splats in Cycles
            obj.driver_remove("hide_render")
            obj.hide_render = engine == "CYCLES"
    scene.render.engine = engine
    scene.render.filepath = str(path / "image.png")
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return {file.name: centres(bpy, file) for file in sorted(path.glob("*.png"))}


def centres(bpy, path: Path) -> dict:
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    values = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)[::-1, :, :3]
    bpy.data.images.remove(image)
    pixels = {}
    for color in MARKS:
        rows, columns = np.nonzero(((values > 0.4) == np.array(color, bool)).all(-1))
        pixels[color] = (np.median(columns), np.median(rows)) if len(rows) else None
    return pixels


@pytest.mark.parametrize(
    "change",
    [
        None, shear, mirror, stereo, orthographic, panorama,
        *one_blender(
            toe_in, several_cameras, stereo_orthographic, sheared_orthographic, part_of_a_panorama
        ),
    ],
)  # fmt: skip
def test_splats_stand_where_cycles_draws_cubes(bpy, scene, root, tmp_path, change):
    if change:
        change(bpy, scene)
    images = {}
    for engine in ("CYCLES", "LODGS"):
        (tmp_path / engine).mkdir()
        images[engine] = draw(bpy, engine, tmp_path / engine)
    views = 2 if scene.render.use_multiview else 1
    assert images["CYCLES"].keys() == images["LODGS"].keys() and len(images["CYCLES"]) == views
    for name, expected in images["CYCLES"].items():
        assert sum(pixel is not None for pixel in expected.values()) >= 3
        for color, pixel in expected.items():
            if pixel is not None:
                assert images["LODGS"][name][color] == pytest.approx(pixel, abs=1), (name, color)
    if views == 2:
        left, right = images["LODGS"].values()
        assert abs(left[1, 0, 0][0] - right[1, 0, 0][0]) > 0.3 or left[0, 0, 1] != right[0, 0, 1]


@pytest.mark.parametrize("change", [shear, mirror, stereo])
def test_viewport_quality_draws_the_same(bpy, lodgs, scene, root, tmp_path, change):
    quality = lodgs("render.viewport_quality")
    try:
        quality._require_graphics()
    except lodgs("training.errors").LodgsError as error:
        pytest.skip(str(error))
    change(bpy, scene)
    expected = draw(bpy, "LODGS", tmp_path)
    with lodgs("render.engine").use_renderer(quality._render_frame):
        drawn = draw(bpy, "LODGS", tmp_path)
    assert expected.keys() == drawn.keys()
    for name, pixels in expected.items():
        for color, pixel in pixels.items():
            if pixel is not None:
                assert drawn[name][color] == pytest.approx(pixel, abs=0.5), (name, color)


def spread(bpy, engine, path: Path) -> np.ndarray:
    """Render with an engine. Return the covariance (2, 2) in pixels of the light of the blue mark."""
    scene = bpy.context.scene
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    draw(bpy, engine, path)
    (file,) = path.glob("*.exr")
    image = bpy.data.images.load(str(file))
    light = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)[..., 2]
    bpy.data.images.remove(image)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
    return np.cov(columns.ravel(), rows.ravel(), aweights=light.ravel(), bias=True)


def blades(bpy, scene):
    """The mark is 2 in front of the focus of a wide anamorphic lens with a triangular opening."""
    dof = scene.camera.data.dof
    dof.use_dof, dof.focus_distance, dof.aperture_fstop = True, 2.5, 0.05
    dof.aperture_blades, dof.aperture_rotation, dof.aperture_ratio = 3, 0.4, 1.7


def focus_on_object(bpy, scene):
    blades(bpy, scene)
    target = bpy.data.objects.new("target", None)
    scene.collection.objects.link(target)
    target.location = (-0.6, 1.6, 0.9)
    scene.camera.data.dof.focus_object = target
    scene.camera.data.dof.focus_distance, scene.camera.data.dof.aperture_fstop = 0.1, 0.03


def focus(bpy, scene):
    dof = scene.camera.data.dof
    dof.use_dof, dof.focus_distance, dof.aperture_fstop = True, 2.5, 2.0


def moving_marks(bpy, scene):
    """Marks and splats turn and move while the shutter is open."""
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 0.8
    empty = bpy.data.objects.new("empty", None)
    scene.collection.objects.link(empty)
    for obj in [obj for obj in scene.objects if obj.type == "MESH"] + [bpy.data.objects["marks"]]:
        obj.parent = empty
    for frame, shift in ((0, -2.5), (2, 2.5)):
        empty.location, empty.rotation_euler = (0, 0.2 * shift, 0.1 * shift), (0, 0, 0.2 * shift)
        empty.keyframe_insert("location", frame=frame)
        empty.keyframe_insert("rotation_euler", frame=frame)


def moving_camera(bpy, scene):
    for frame, shift in ((0, -0.6), (2, 0.6)):
        scene.camera.location.z = 2 + shift
        scene.camera.keyframe_insert("location", frame=frame)
        scene.camera.data.lens = 50 - 15 * shift
        scene.camera.data.keyframe_insert("lens", frame=frame)
    scene.render.use_motion_blur, scene.render.motion_blur_position = True, "START"


@pytest.mark.parametrize(
    ("lens", "change"),
    [
        ("PERSP", blades), ("PERSP", moving_marks),
        *one_blender(("PERSP", focus_on_object), ("ORTHO", focus), ("PERSP", moving_camera)),
    ],
)  # fmt: skip
def test_light_is_spread_as_in_cycles(bpy, scene, root, tmp_path, lens, change):
    """Blur adds the same covariance to the light of a mark in both engines."""
    for obj in scene.objects:
        if obj.type == "MESH":
            obj.scale = (0.5,) * 3
    scene.camera.data.type, scene.camera.data.ortho_scale = lens, 4.5
    scene.cycles.samples, scene.lodgs_render.samples = 256, 100
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    images = {}
    for name in ("sharp", "blurred"):
        if name == "blurred":
            change(bpy, scene)
        scene.frame_set(1)
        images[name] = {
            engine: spread(bpy, engine, tmp_path / name / engine) for engine in ("CYCLES", "LODGS")
        }
    cycles, lodgs_blur = (
        images["blurred"][engine] - images["sharp"][engine] for engine in ("CYCLES", "LODGS")
    )
    assert np.linalg.eigvalsh(cycles)[-1] > 3
    np.testing.assert_allclose(lodgs_blur, cycles, atol=0.06 * np.abs(cycles).max())  # noise of both engines


def test_stereo_animation_in_viewport_quality_is_rejected(bpy, lodgs, scene, root):
    stereo(bpy, scene)
    with pytest.raises(lodgs("training.errors").LodgsError, match="animation is stereo or multi-view"):
        next(lodgs("render.viewport_quality").render_animation(bpy.context, [1]))


def test_depth_of_a_sheared_camera_matches_cycles(bpy, lodgs, scene, root):
    """Combine with Meshes compares both depths."""
    shear(bpy, scene)
    bpy.context.view_layer.update()
    scene.view_layers[0].use_pass_z = True
    depsgraph = bpy.context.evaluated_depsgraph_get()
    planes = lodgs("render.engine").render_frame(depsgraph, 96, 72, (0, 0, 96, 72)).planes
    colors = np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2)
    rows, columns = np.nonzero(((colors > 0.4) == np.array((1, 0, 0), bool)).all(-1))
    depth = planes["Depth.Z"][rows, columns].mean()
    world_to_camera = scene.camera.matrix_world.normalized().inverted()  # as in Cycles
    assert depth == pytest.approx(-world_to_camera.translation.z, abs=0.15)


@pytest.mark.parametrize("change", [shear, mirror])
def test_export_of_a_deformed_camera_names_the_scale(bpy, scene, root, tmp_path, change):
    change(bpy, scene)
    bpy.context.view_layer.objects.active = root
    with pytest.raises(RuntimeError, match=r"Cannot use camera 'cam': its scale .*\s+Apply the scale"):
        bpy.ops.lodgs.export_camera(filepath=str(tmp_path / "camera.json"))
    assert not (tmp_path / "camera.json").exists()


@pytest.mark.parametrize("scale", [(0, 0, 0), (1, 1, 0)])
def test_camera_with_scale_0_is_reported(bpy, scene, root, tmp_path, scale):
    scene.camera.scale = scale
    with pytest.raises(RuntimeError, match="the scale of camera 'cam' or of a parent is 0"):
        draw(bpy, "LODGS", tmp_path)
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e20])
@pytest.mark.parametrize("obj", ["cam", "marks", "level"])
def test_transform_that_is_not_finite_is_named(bpy, scene, root, tmp_path, obj, value):
    moved = bpy.data.objects.get(obj) or root.lodgs.levels[0].object
    moved.location.x = value
    splats = root.lodgs.levels[0].object.name
    with pytest.raises(
        RuntimeError, match=rf"transform of '{'cam' if obj == 'cam' else splats}'.*\s+Clear it"
    ):
        draw(bpy, "LODGS", tmp_path)
    assert not list(tmp_path.glob("*.png"))


def test_spherical_stereo_is_rejected(bpy, scene, root, tmp_path):
    stereo(bpy, scene)
    panorama(bpy, scene)
    scene.camera.data.stereo.use_spherical_stereo = True
    with pytest.raises(RuntimeError, match="camera 'cam' has Spherical Stereo"):
        draw(bpy, "LODGS", tmp_path)


def test_root_with_scale_0_renders_no_splats(bpy, scene, root, tmp_path):
    for frame, scale in ((1, 0), (3, 1)):
        root.scale = (scale,) * 3
        root.keyframe_insert("scale", frame=frame)
    scene.frame_start, scene.frame_end = 1, 3
    for obj in scene.objects:
        obj.hide_render |= obj.type == "MESH"
    scene.render.engine, scene.render.filepath = "LODGS", str(tmp_path / "f_####.png")
    bpy.ops.render.render(animation=True)
    files = sorted(tmp_path.glob("f_*.png"))
    assert [any(centres(bpy, file).values()) for file in files] == [False, True, True]


def test_splats_of_a_flattened_root_are_drawn(bpy, scene, root, tmp_path):
    root.scale = (1, 0, 1)
    assert any(draw(bpy, "LODGS", tmp_path)["image.png"].values())


def test_unexpected_error_is_reported(bpy, lodgs, scene, root, tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("a test")

    monkeypatch.setattr(lodgs("render.engine"), "_render_function", fail)
    with pytest.raises(RuntimeError, match=r"Cannot render frame 1: unexpected ZeroDivisionError \(a test\)"):
        draw(bpy, "LODGS", tmp_path)
    assert not list(tmp_path.glob("*.png"))


def test_holdout_in_stereo_is_rejected(bpy, scene, root, tmp_path):
    stereo(bpy, scene)
    scene.lodgs_render.holdout = str(tmp_path / "depth_####.exr")
    with pytest.raises(RuntimeError, match="Cannot hold out meshes in a stereo"):
        draw(bpy, "LODGS", tmp_path)


def test_folder_as_holdout_is_rejected(bpy, scene, root, tmp_path):
    scene.lodgs_render.holdout = os.sep
    with pytest.raises(RuntimeError, match="Cannot use the depth files"):
        draw(bpy, "LODGS", tmp_path)


def test_meshes_are_combined_for_the_same_views(bpy, lodgs, scene, root):
    several_cameras(bpy, scene)
    scene.render.views.new("third").camera_suffix = "_T"
    meshes = lodgs("render.compositing").combine_with_meshes(scene)
    assert meshes.render.use_multiview and meshes.render.views_format == "MULTIVIEW"
    views = [[(view.name, view.camera_suffix, view.use) for view in s.render.views] for s in (scene, meshes)]
    assert views[0] == views[1]
    with pytest.raises(
        lodgs("training.errors").LodgsError, match="Cannot render mesh depth: the scene has a stereo"
    ):
        next(lodgs("render.mesh_depth").render_mesh_depth(scene, [1]))
