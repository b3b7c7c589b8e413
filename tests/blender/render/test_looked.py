"""F12, comparisons and viewports draw a look as what it exports, and the picture is the colour-mapped one."""

import numpy as np
import pytest

from tests.blender.data.test_looks import give
from tests.blender.render.test_cropped import camera  # noqa: F401
from tests.training.editing.test_cleaning import bundle_of
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages
from training.editing.look import Look
from training.scenes.color import srgb_from_linear
from training.splats.bundle import write_bundle

EVERYWHERE, THERE = Look(0.4, 5000, (1.0, 0.9, 0.7), 0.6, 0.8), Look(-0.8, tint=(0.3, 1.0, 1.0), opacity=0.7)


@pytest.fixture
def seen(bpy, lodgs):
    """``seen()``: what F12 draws, (64, 96, 3) display-coded; ``seen(quickly)``: the viewport's shaders."""

    def drawn(draw=None):
        bpy.context.view_layer.update()
        draw = draw or lodgs("render.engine").render_frame
        planes = draw(bpy.context.evaluated_depsgraph_get(), 96, 64, (0, 0, 96, 64), lambda *_: True).planes
        return srgb_from_linear(np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2))

    return drawn


def file_of(tmp_path, name="bands"):
    """A bundle of splats that are never darker than black."""
    bundle = bundle_of(name, np.random.default_rng(0))
    for level in bundle.levels:
        level.splats.sh[:] *= 0.2
    write_bundle(tmp_path / "in.ply", bundle)
    return tmp_path / "in.ply"


def with_looks(bpy, root):
    """A look everywhere and one in a ball that cuts nothing."""
    give(root.lodgs_look, EVERYWHERE)
    bpy.ops.lodgs.add_crop(shape="SPHERE", keep="ALL")
    ball = bpy.context.active_object
    ball.location, ball.scale = (1, -1, 0.5), (4, 5, 3)
    give(ball.lodgs_look, THERE)
    return ball


@pytest.mark.usefixtures("renderer", "camera")
@pytest.mark.parametrize("mode", ["SINGLE", "SELECTIVE"])
@pytest.mark.parametrize("moved", [False, True])
def test_frames_show_what_is_exported(bpy, lodgs, seen, tmp_path, mode, moved):
    importing = lodgs("data.importing")

    def imported(path):
        root = importing.import_splats(bpy.context, path, upright=False)
        root.lodgs.mode, root.lodgs.single_level = mode, 3
        root.location, root.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
        if moved:  # each set by itself
            root.lodgs.levels[2].object.location.z = 0.5
        return root

    root = imported(file_of(tmp_path))
    before = seen()
    ball = with_looks(bpy, root)
    looked = seen()
    ball.lodgs_crop.use = False
    without = seen()
    ball.lodgs_crop.use = True
    np.testing.assert_array_equal(seen(), looked)
    assert np.abs(before - looked).max() > 0.05 and np.abs(without - looked).max() > 0.02
    if moved:  # an export is of what has not been moved by itself
        return
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    lodgs("data.removal").remove(root)
    imported(tmp_path / "out.ply")
    np.testing.assert_allclose(seen(), looked, atol=1e-4)


@pytest.mark.usefixtures("renderer", "camera")
def test_the_frame_is_the_colour_mapped_frame(bpy, lodgs, seen, tmp_path):
    root = lodgs("data.importing").import_splats(bpy.context, file_of(tmp_path), upright=False)
    before, look = seen(), Look(0.3, 5000, (1.0, 0.9, 0.7), 0.6)
    give(root.lodgs_look, look)
    np.testing.assert_allclose(seen(), before @ look.matrix.T, atol=2e-4)


@pytest.mark.usefixtures("camera", "frame")
def test_viewports_draw_what_is_exported(bpy, lodgs, seen, tmp_path):
    quick, importing = lodgs("render.viewport_quality")._render_frame, lodgs("data.importing")
    root = importing.import_splats(bpy.context, file_of(tmp_path), upright=False)
    root.location, root.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
    before = seen(quick)
    ball, views = with_looks(bpy, root), lodgs("viewport.views")
    looked = seen(quick)
    read = views.reads
    assert np.abs(before - looked).max() > 0.05
    ball.lodgs_look.exposure += 1
    assert np.abs(seen(quick) - looked).max() > 0.02 and views.reads == read  # no splat is read anew
    ball.lodgs_look.exposure -= 1
    ball.empty_display_type = "CUBE"
    box = seen(quick)
    ball.lodgs_look.outside = True
    around = seen(quick)
    for shape, outside, picture in (("SPHERE", False, looked), ("CUBE", False, box), ("CUBE", True, around)):
        ball.empty_display_type, ball.lodgs_look.outside = shape, outside
        bpy.context.view_layer.objects.active = root
        bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
        root.hide_viewport = True
        for item in root.lodgs.levels:
            item.show = False
        alone = importing.import_splats(bpy.context, tmp_path / "out.ply", upright=False)
        alone.location, alone.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
        np.testing.assert_allclose(seen(quick), picture, atol=0.01)
        lodgs("data.removal").remove(alone)
        root.hide_viewport = False
        for item in root.lodgs.levels:
            item.show = True
    assert np.abs(box - looked).max() > 0.02 and np.abs(box - around).max() > 0.05


def half_painted(lodgs, root, share=0.7):
    """Half of the scene in green."""
    painting = lodgs("data.painting")
    half = {
        item.number: share * (lodgs("data.objects").read_splats(item.object).means[:, 0] > 0)
        for item in root.lodgs.levels
    }
    return painting.over(painting.read(root), half, (0.1, 0.8, 0.2))


@pytest.mark.usefixtures("renderer", "camera")
@pytest.mark.parametrize("mode", ["SINGLE", "SELECTIVE"])
def test_frames_show_paint_as_what_is_exported_with_it(bpy, lodgs, seen, tmp_path, mode):
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_splats(bpy.context, file_of(tmp_path), upright=False)
    root.lodgs.mode, root.lodgs.single_level = mode, 3
    before = seen()
    lodgs("data.painting").write(root, half_painted(lodgs, root))
    painted = seen()
    assert np.abs(before - painted).max() > 0.05
    copy = scenes.shown_splats(bpy.context, root, looked=True)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    lodgs("data.removal").remove(root)
    again = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    again.lodgs.mode, again.lodgs.single_level = mode, 3
    np.testing.assert_allclose(seen(), painted, atol=1e-4)
    np.testing.assert_allclose(scenes.shown_splats(bpy.context, again).sh, copy.sh, atol=1e-6)


@pytest.mark.usefixtures("camera", "frame")
@pytest.mark.parametrize("modifier", [False, True])
def test_viewports_show_paint_at_once_and_read_no_splat_anew(bpy, lodgs, seen, tmp_path, modifier):
    """But of those that a modifier of somebody's own changes."""
    quick, importing, views = (
        lodgs("render.viewport_quality")._render_frame,
        lodgs("data.importing"),
        lodgs("viewport.views"),
    )
    root = importing.import_splats(bpy.context, file_of(tmp_path), upright=False)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 3
    if modifier:
        nodes = bpy.data.node_groups.new("own", "GeometryNodeTree")
        for kind in ("INPUT", "OUTPUT"):
            nodes.interface.new_socket("Geometry", in_out=kind, socket_type="NodeSocketGeometry")
        there = [nodes.nodes.new(name) for name in ("NodeGroupInput", "NodeGroupOutput")]
        nodes.links.new(there[0].outputs[0], there[1].inputs[0])
        root.lodgs.levels[2].object.modifiers.new("own", "NODES").node_group = nodes
    before, painting, there = seen(quick), lodgs("data.painting"), half_painted(lodgs, root)
    read = views.reads
    painting.show(root, there)  # as long as a stroke lasts
    during = seen(quick)
    painting.show(root, {})
    np.testing.assert_array_equal(seen(quick), before)
    painting.write(root, there)
    painted = seen(quick)
    assert np.abs(before - painted).max() > 0.05 and (views.reads == read) == (not modifier)
    np.testing.assert_array_equal(during, before if modifier else painted)
    painting.write(root, painting.over(there, {n: np.full(len(x), 0.5) for n, x in there.items()}, None))
    half = seen(quick)
    assert np.abs(before - half).max() > 0.02 and np.abs(painted - half).max() > 0.02
    painting.write(root, there)
    np.testing.assert_array_equal(seen(quick), painted)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    painting.write(root, {number: 0 * each for number, each in there.items()})
    np.testing.assert_array_equal(seen(quick), before)
    lodgs("data.removal").remove(root)
    again = importing.import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    again.lodgs.mode, again.lodgs.single_level = "SINGLE", 3
    np.testing.assert_allclose(seen(quick), painted, atol=0.01)


@pytest.mark.usefixtures("renderer", "camera")
def test_a_tree_that_is_read_from_its_file_has_its_look(bpy, lodgs, seen, tmp_path):
    write_in_pages(tmp_path / "tree.ply", tree_of(random_leaves(6000, np.random.default_rng(3), degree=1)))
    pictures = []
    for budget in (3000, 0):
        root = lodgs("data.importing").import_splats(
            bpy.context, tmp_path / "tree.ply", budget=budget, upright=False
        )
        assert bool(lodgs("data.streams").file_of(root)) == bool(budget)
        root.lodgs.controls.pixels = 0.1  # leaves
        before = seen()
        with_looks(bpy, root)
        pictures.append(seen())
        assert np.abs(before - pictures[-1]).max() > 0.05
        lodgs("data.removal").remove(root)
    np.testing.assert_allclose(*pictures, atol=2e-3)


def test_ellipsoids_have_the_look_s_colour_and_opacity(bpy, lodgs, tmp_path):
    """One splat, seen by Cycles: as what is exported of it."""
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
    pictures = []
    for first in (True, False):
        path = tmp_path / ("in.ply" if first else "out.ply")
        if first:
            write_bundle(path, Bundle("", [Level(1, splats())]))
        root = lodgs("data.importing").import_splats(bpy.context, path, upright=False)
        if first:
            give(root.lodgs_look, EVERYWHERE)
        pictures.append(rendered(bpy, tmp_path / "picture.png"))
        if first:
            bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
            lodgs("data.removal").remove(root)
    assert 0.5 < pictures[0][..., 3].max() < 0.7  # 0.8 of one that is 0.82
    np.testing.assert_allclose(*pictures, atol=0.02)
