"""Renders of looks and paint: equal to renders of the exported splats."""

import numpy as np
import pytest

from tests.blender.data.test_looks import apply_look
from tests.blender.render.test_crops import camera  # noqa: F401
from tests.training.editing.test_cleaning import bundle_of
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages
from training.color import srgb_from_linear
from training.editing.look import Look
from training.render.image import RenderedImage
from training.splats.bundle import write_bundle

GLOBAL_LOOK = Look(0.4, 5000, (1.0, 0.9, 0.7), 0.6, 0.8)
LOCAL_LOOK = Look(-0.8, tint=(0.3, 1.0, 1.0), opacity=0.7)


@pytest.fixture
def image(bpy, lodgs):
    """``image()`` renders an sRGB image (64, 96, 3); ``image(function)`` renders with another function."""

    def render(draw=None):
        bpy.context.view_layer.update()
        draw = draw or lodgs("render.engine").render_frame
        planes = draw(bpy.context.evaluated_depsgraph_get(), 96, 64, (0, 0, 96, 64), lambda *_: True).planes
        return srgb_from_linear(np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2))

    return render


def write_splats(tmp_path, name="bands"):
    """Write a bundle whose colours are not negative."""
    bundle = bundle_of(name, np.random.default_rng(0))
    for level in bundle.levels:
        level.splats.sh[:] *= 0.2
    write_bundle(tmp_path / "in.ply", bundle)
    return tmp_path / "in.ply"


def add_looks(bpy, root):
    """Set a global look, and a local one in a sphere that crops nothing. Return the sphere."""
    apply_look(root.lodgs_look, GLOBAL_LOOK)
    bpy.ops.lodgs.add_crop(shape="SPHERE", keep="ALL")
    sphere = bpy.context.active_object
    sphere.location, sphere.scale = (1, -1, 0.5), (4, 5, 3)
    apply_look(sphere.lodgs_look, LOCAL_LOOK)
    return sphere


@pytest.mark.usefixtures("renderer", "camera")
@pytest.mark.parametrize("mode", ["SINGLE", "SELECTIVE"])
@pytest.mark.parametrize("moved", [False, True])
def test_frames_equal_those_of_the_export(bpy, lodgs, image, tmp_path, mode, moved):
    importing = lodgs("data.importing")

    def imported(path):
        root = importing.import_splats(bpy.context, path, upright=False)
        root.lodgs.mode, root.lodgs.single_level = mode, 3
        root.location, root.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
        if moved:  # the level is rendered as a separate set
            root.lodgs.levels[2].object.location.z = 0.5
        return root

    root = imported(write_splats(tmp_path))
    original = image()
    sphere = add_looks(bpy, root)
    looked = image()
    sphere.lodgs_crop.use = False
    without = image()
    sphere.lodgs_crop.use = True
    np.testing.assert_array_equal(image(), looked)
    assert np.abs(original - looked).max() > 0.05 and np.abs(without - looked).max() > 0.02
    if moved:  # an export ignores transforms of levels
        return
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    lodgs("data.removal").remove(root)
    imported(tmp_path / "out.ply")
    np.testing.assert_allclose(image(), looked, atol=1e-4)


@pytest.mark.usefixtures("renderer", "camera")
def test_look_maps_the_colours_of_the_frame(bpy, lodgs, image, tmp_path):
    root = lodgs("data.importing").import_splats(bpy.context, write_splats(tmp_path), upright=False)
    original, look = image(), Look(0.3, 5000, (1.0, 0.9, 0.7), 0.6)
    apply_look(root.lodgs_look, look)
    np.testing.assert_allclose(image(), original @ look.matrix.T, atol=2e-4)


@pytest.mark.usefixtures("camera", "frame")
def test_viewports_equal_the_export(bpy, lodgs, image, tmp_path):
    viewport_quality = lodgs("render.viewport_quality")._render_frame
    importing = lodgs("data.importing")
    root = importing.import_splats(bpy.context, write_splats(tmp_path), upright=False)
    root.location, root.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
    original = image(viewport_quality)
    sphere, sources = add_looks(bpy, root), lodgs("viewport.sources")
    looked = image(viewport_quality)
    read = sources.reads
    assert np.abs(original - looked).max() > 0.05
    sphere.lodgs_look.exposure += 1
    assert (
        np.abs(image(viewport_quality) - looked).max() > 0.02 and sources.reads == read
    )  # no splat is read again
    sphere.lodgs_look.exposure -= 1
    sphere.empty_display_type = "CUBE"
    box = image(viewport_quality)
    sphere.lodgs_look.outside = True
    inverted = image(viewport_quality)
    for shape, outside, expected in (
        ("SPHERE", False, looked),
        ("CUBE", False, box),
        ("CUBE", True, inverted),
    ):
        sphere.empty_display_type, sphere.lodgs_look.outside = shape, outside
        bpy.context.view_layer.objects.active = root
        bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
        root.hide_viewport = True
        for item in root.lodgs.levels:
            item.show = False
        exported = importing.import_splats(bpy.context, tmp_path / "out.ply", upright=False)
        exported.location, exported.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
        np.testing.assert_allclose(image(viewport_quality), expected, atol=0.01)
        lodgs("data.removal").remove(exported)
        root.hide_viewport = False
        for item in root.lodgs.levels:
            item.show = True
    assert np.abs(box - looked).max() > 0.02 and np.abs(box - inverted).max() > 0.05


def half_painted(lodgs, root, share=0.7):
    """Return green paint on half of the scene."""
    painting = lodgs("data.painting")
    half = {
        item.number: share * (lodgs("data.objects").read_splats(item.object).means[:, 0] > 0)
        for item in root.lodgs.levels
    }
    return painting.blend(painting.read_paint(root), half, (0.1, 0.8, 0.2))


@pytest.mark.usefixtures("renderer", "camera")
@pytest.mark.parametrize("mode", ["SINGLE", "SELECTIVE"])
def test_frames_with_paint_equal_those_of_the_export(bpy, lodgs, image, tmp_path, mode):
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_splats(bpy.context, write_splats(tmp_path), upright=False)
    root.lodgs.mode, root.lodgs.single_level = mode, 3
    original = image()
    lodgs("data.painting").write_paint(root, half_painted(lodgs, root))
    painted = image()
    assert np.abs(original - painted).max() > 0.05
    copy = scenes.visible_splats(bpy.context, root, looked=True)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    lodgs("data.removal").remove(root)
    reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    reimported.lodgs.mode, reimported.lodgs.single_level = mode, 3
    np.testing.assert_allclose(image(), painted, atol=1e-4)
    np.testing.assert_allclose(scenes.visible_splats(bpy.context, reimported).sh, copy.sh, atol=1e-6)


@pytest.mark.usefixtures("camera", "frame")
@pytest.mark.parametrize("modifier", [False, True])
def test_painting_does_not_read_splats_again_in_viewports(bpy, lodgs, image, tmp_path, modifier):
    """Splats with a modifier of the user are read again."""
    viewport_quality = lodgs("render.viewport_quality")._render_frame
    importing = lodgs("data.importing")
    sources = lodgs("viewport.sources")
    root = importing.import_splats(bpy.context, write_splats(tmp_path), upright=False)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 3
    if modifier:
        nodes = bpy.data.node_groups.new("own", "GeometryNodeTree")
        for kind in ("INPUT", "OUTPUT"):
            nodes.interface.new_socket("Geometry", in_out=kind, socket_type="NodeSocketGeometry")
        ends = [nodes.nodes.new(name) for name in ("NodeGroupInput", "NodeGroupOutput")]
        nodes.links.new(ends[0].outputs[0], ends[1].inputs[0])
        root.lodgs.levels[2].object.modifiers.new("own", "NODES").node_group = nodes
    original = image(viewport_quality)
    painting = lodgs("data.painting")
    paint = half_painted(lodgs, root)
    read = sources.reads
    painting.preview_paint(root, paint)  # during a stroke
    during = image(viewport_quality)
    painting.preview_paint(root, {})
    np.testing.assert_array_equal(image(viewport_quality), original)
    painting.write_paint(root, paint)
    painted = image(viewport_quality)
    assert np.abs(original - painted).max() > 0.05 and (sources.reads == read) == (not modifier)
    np.testing.assert_array_equal(during, original if modifier else painted)
    painting.write_paint(
        root, painting.blend(paint, {n: np.full(len(x), 0.5) for n, x in paint.items()}, None)
    )
    half = image(viewport_quality)
    assert np.abs(original - half).max() > 0.02 and np.abs(painted - half).max() > 0.02
    painting.write_paint(root, paint)
    np.testing.assert_array_equal(image(viewport_quality), painted)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    painting.write_paint(root, {number: 0 * values for number, values in paint.items()})
    np.testing.assert_array_equal(image(viewport_quality), original)
    lodgs("data.removal").remove(root)
    reimported = importing.import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    reimported.lodgs.mode, reimported.lodgs.single_level = "SINGLE", 3
    np.testing.assert_allclose(image(viewport_quality), painted, atol=0.01)


@pytest.mark.usefixtures("renderer", "camera")
def test_streamed_tree_has_its_look(bpy, lodgs, image, tmp_path):
    write_in_pages(tmp_path / "tree.ply", tree_of(random_leaves(6000, np.random.default_rng(3), degree=1)))
    images = []
    for budget in (3000, 0):
        root = lodgs("data.importing").import_splats(
            bpy.context, tmp_path / "tree.ply", budget=budget, upright=False
        )
        assert bool(lodgs("data.streams").file_of(root)) == bool(budget)
        root.lodgs.controls.pixels = 0.1  # leaves
        original = image()
        add_looks(bpy, root)
        images.append(image())
        assert np.abs(original - images[-1]).max() > 0.05
        lodgs("data.removal").remove(root)
    np.testing.assert_allclose(*images, atol=2e-3)


def test_ellipsoids_have_the_colour_and_opacity_of_the_look(bpy, lodgs, tmp_path):
    """Render one splat and its export with Cycles."""
    from tests.blender.nodes.test_ellipsoids import rendered, splats
    from training.splats.levels import Bundle, Level

    scene, camera = bpy.context.scene, bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))  # noqa: F811
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0, -5, 0), (np.pi / 2, 0, 0)
    scene.camera, scene.render.engine = camera, "CYCLES"
    scene.cycles.samples, scene.cycles.device, scene.cycles.use_denoising = 16, "CPU", False
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    scene.render.film_transparent, scene.render.dither_intensity = True, 0
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.color_mode = "RGBA"
    scene.lodgs_render.ellipsoids = True
    images = []
    for first in (True, False):
        path = tmp_path / ("in.ply" if first else "out.ply")
        if first:
            write_bundle(path, Bundle("", [Level(1, splats())]))
        root = lodgs("data.importing").import_splats(bpy.context, path, upright=False)
        if first:
            apply_look(root.lodgs_look, GLOBAL_LOOK)
        images.append(rendered(bpy, tmp_path / "image.png"))
        if first:
            bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
            lodgs("data.removal").remove(root)
    assert 0.5 < images[0][..., 3].max() < 0.7  # 0.8 * 0.82
    np.testing.assert_allclose(*images, atol=0.02)


@pytest.mark.usefixtures("camera")
def test_animated_regions_change_in_an_animation(bpy, lodgs, tmp_path, monkeypatch):
    """Renders evaluate animations in a depsgraph of their own."""
    root = lodgs("data.importing").import_splats(bpy.context, write_splats(tmp_path))
    bpy.context.view_layer.objects.active = root
    sphere, scene = add_looks(bpy, root), bpy.context.scene
    for frame, use, size in ((1, True, 1.0), (2, True, 2.0), (3, False, 2.0)):
        sphere.lodgs_crop.use, sphere.empty_display_size = use, size
        sphere.lodgs_crop.keyframe_insert("use", frame=frame)
        sphere.keyframe_insert("empty_display_size", frame=frame)
    scene.frame_set(1)
    lodgs("render.engine").use(scene)
    scene.render.filepath, scene.frame_start, scene.frame_end = str(tmp_path / "frame_"), 1, 3
    renderer, looks = lodgs("render.renderer"), []

    def draw_frame(sets, view, on_progress):
        looks.append(sets[0].looks)
        image = RenderedImage.empty(view.camera.width, view.camera.height, None)
        return renderer.RenderedFrame(image.passes(), float("nan"))

    monkeypatch.setattr(renderer, "draw_frame", draw_frame)
    assert bpy.ops.render.render(animation=True) == {"FINISHED"}
    assert [len(frame) for frame in looks] == [2, 2, 1]
    first, second = (np.array(frame[1].crop.to_local)[:, :3] for frame in looks[:2])
    np.testing.assert_allclose(first, 2 * second, rtol=1e-5, atol=1e-8)
