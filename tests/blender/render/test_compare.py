"""Comparison of views with their photos: PSNR, worst view, wipe and errors."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.blender.panels.conftest import RecordingLayout
from training.scenes.colmap import read_scene
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

pytestmark = pytest.mark.one_blender


GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def haze(color: float) -> Splats:
    """Large grey splats around the garden, visible from everywhere."""
    rng = np.random.default_rng(0)
    return Splats(
        means=rng.normal(0, 5, (300, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (300, 1)),
        log_scales=np.zeros((300, 3), np.float32),
        opacity_logits=np.zeros(300, np.float32),
        sh=np.full((300, 1, 3), (color - 0.5) / 0.28209479177387814, np.float32),
    )


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    """The views of the example with haze as splats."""
    write_bundle(tmp_path / "haze.ply", Bundle("flod", [Level(1, haze(0.4))]))
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    root.lodgs.training.image_scale = 1.0
    lodgs("data.scenes").set_level(root, Level(1, haze(0.4)))
    bpy.context.view_layer.update()
    return root


def read_photo(bpy, view) -> np.ndarray:
    """Read the photo of a view with Blender, (H, W, 3), rows from the top."""
    image = bpy.data.images.load(view.data.lodgs.photograph)
    image.colorspace_settings.name = "Non-Color"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]


def test_measuring_continues_in_another_blender_scene(bpy, lodgs, root, monkeypatch):
    """The user may show another scene meanwhile, which has no splats."""
    drawn = []
    monkeypatch.setattr(
        lodgs("render.renderer"), "draw_frame", lambda sets, view, on_progress: drawn.append(len(sets))
    )
    measurement = lodgs("render.compare").measure(bpy.context, root)
    camera = bpy.context.scene.camera
    measurement.step()
    bpy.context.window.scene = bpy.data.scenes.new("other")
    measurement.step()
    assert drawn == [1, 1]
    assert bpy.context.scene.camera is None and root.users_scene[0].camera == camera


def test_measuring_ends_with_the_extension(bpy, lodgs, root):
    compare = lodgs("render.compare")
    measurement = compare.measure(bpy.context, root)
    compare.unregister()
    try:
        assert not measurement.step() and measurement.done == 0
    finally:
        compare.register()


@pytest.mark.parametrize("drawn_by", ["LODGS", "BLENDER"])
def test_look_applies_once_to_splats_with_modifiers(bpy, lodgs, root, monkeypatch, drawn_by):
    """Where Blender draws viewports itself, modifiers apply the look as well."""
    if lodgs("compat").NATIVE_SPLATS is None:
        pytest.skip("Blender before 5.3 has no splats")
    group = bpy.data.node_groups.new("pass on", "GeometryNodeTree")
    for kind, direction in (("NodeGroupInput", "INPUT"), ("NodeGroupOutput", "OUTPUT")):
        group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
        group.nodes.new(kind)
    group.links.new(group.nodes[0].outputs[0], group.nodes[1].inputs[0])
    root.lodgs.levels[0].object.modifiers.new("mine", "NODES").node_group = group
    root.lodgs_look.exposure, bpy.context.scene.lodgs_viewport.drawn_by = 1.0, drawn_by
    drawn = []
    monkeypatch.setattr(
        lodgs("render.renderer"), "draw_frame", lambda sets, view, _: drawn.append(sets[0].read()[0].sh)
    )
    lodgs("render.compare").compare_view(bpy.context, root, lodgs("data.photographs").views(root)[0])
    np.testing.assert_allclose(drawn[0], haze(0.4).sh, atol=1e-6)
    assert bpy.context.scene.lodgs_viewport.drawn_by == drawn_by


def test_psnr_matches_a_render(bpy, lodgs, root, renderer, tmp_path):
    scene, view = bpy.context.scene, lodgs("data.photographs").views(root)[5]
    lodgs("data.photographs").use_view(bpy.context, view)
    comparison = lodgs("render.compare").compare_view(bpy.context, root, view)
    lodgs("render.engine").use(scene)
    scene.render.dither_intensity = 0
    scene.render.filepath = str(tmp_path / "view.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    rendered = values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]
    truth = read_photo(bpy, view)
    psnr = -10 * np.log10(((rendered.astype(float) - truth) ** 2).mean())
    assert 5 < psnr < 20
    assert comparison.psnr == pytest.approx(psnr, abs=0.02)
    assert view.data.lodgs.psnr == pytest.approx(comparison.psnr)
    np.testing.assert_allclose(comparison.photo, truth, atol=2.5 / 255)
    np.testing.assert_allclose(comparison.rendered, rendered, atol=0.6 / 255)


@pytest.fixture
def measured(bpy, lodgs, tmp_path):
    """``measured(index, scale)`` returns a root with levels by distance, a view and its PSNR by the trainer.

    Blender and the trainer's evaluation share only files.
    """
    pytest.importorskip("torch", reason="the evaluation needs torch")
    from training.evaluate.views import Evaluation
    from training.lod.selection import BundleSelector, resolve_controls
    from training.optimize.training_data import TrainingData
    from training.scenes.colmap import read_scene

    rng, levels = np.random.default_rng(3), []
    for number, (size, s_min) in enumerate([(-1.5, 0.025), (-2.2, 0.014), (-3.0, 0.0)], 1):
        splats = haze(0.4)
        splats.log_scales[:] = size
        splats.means[:] = rng.uniform((-4, -2, -4), (4, 2, 4), (300, 3))
        splats.sh[:] = rng.normal(0, 1, (300, 1, 3))
        levels.append(Level(number, splats, {"s_min": s_min}))
    bundle = Bundle("flod", levels, "bands", {})

    def measure(index, scale, folder=GARDEN):
        evaluation = Evaluation(TrainingData(read_scene(folder), scale, 8), backend="cpu")
        camera = evaluation.cameras[index]
        bundle.controls["gamma"] = 2.4 * scale
        selector, values = BundleSelector(bundle), resolve_controls(bundle, {})
        weights = selector.weights(camera.center, camera.focal, values)
        counts = np.unique(np.repeat([1, 2, 3], 300)[weights > 0], return_counts=True)
        assert min(counts[1]) > 20 and len(counts[0]) == 3  # every level is visible
        (psnr,) = evaluation.compare_views([camera], lambda camera: (selector.splats, weights))
        root = lodgs("data.importing").import_colmap(bpy.context, folder, photographs=False)
        lodgs("data.scenes").set_bundle_facts(root, bundle)
        for level in levels:
            lodgs("data.scenes").set_level(root, level)
        lodgs("data.scenes").set_bundle_facts(root, bundle)
        root.lodgs.mode, root.lodgs.training.image_scale = "SELECTIVE", scale
        view = next(v for v in lodgs("data.photographs").views(root) if v.name == camera.name)
        return root, view, psnr

    return measure


@pytest.mark.parametrize(
    ("rendered", "scale"), [((64, 1000), 0.7), pytest.param((4000, 100), 0.37, marks=pytest.mark.nightly)]
)
def test_psnr_of_levels_by_distance_matches_evaluate(bpy, lodgs, measured, renderer, rendered, scale):
    """Both agree within 0.01 dB for any size of the last render."""
    root, view, psnr = measured(2, scale)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = rendered
    render.resolution_percentage, render.pixel_aspect_x = 37, 1.5
    comparison = lodgs("render.compare").compare_view(bpy.context, root, view)
    assert comparison.psnr == pytest.approx(psnr, abs=0.01)
    assert (render.resolution_x, render.resolution_y) == rendered
    assert (render.resolution_percentage, render.pixel_aspect_x) == (37, 1.5)


def test_masks_and_transparency_count_as_in_evaluate(bpy, lodgs, measured, renderer, tmp_path):
    """Compare with the evaluation, and with a PSNR computed from the images of the wipe."""
    from PIL import Image

    (tmp_path / "sparse").symlink_to(GARDEN / "sparse")
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (320, 480, 4)).astype(np.uint8)
    counts = np.zeros((320, 480), np.uint8)
    counts[80:280, 120:360] = 255
    for file in (GARDEN / "images").iterdir():
        Image.fromarray(pixels).save(tmp_path / "images" / file.name, "PNG")
        Image.fromarray(counts).save(tmp_path / "masks" / f"{file.name}.png")
    root, view, psnr = measured(2, 1.0, tmp_path)
    comparison = lodgs("render.compare").compare_view(bpy.context, root, view)
    over_black = pixels[..., :3] * (pixels[..., 3:] / 255)
    np.testing.assert_allclose(255 * comparison.photo, over_black, atol=1e-3)
    rendered, truth = (np.rint(255 * np.clip(x, 0, 1)) for x in (comparison.rendered, comparison.photo))
    difference = (rendered - truth)[80:280, 120:360]
    assert comparison.psnr == pytest.approx(
        20 * np.log10(255) - 10 * np.log10((difference**2).mean()), abs=0.01
    )
    assert comparison.psnr == pytest.approx(psnr, abs=0.01)


def test_measuring_all_views_finds_the_worst(bpy, lodgs, root, renderer):
    compare, photographs = lodgs("render.compare"), lodgs("data.photographs")
    assert not bpy.ops.lodgs.compare_worst.poll()
    root.lodgs.training.image_scale = 0.1
    for view in photographs.views(root)[6:]:
        view.data.lodgs.photograph = ""
    camera = bpy.context.scene.camera
    assert bpy.ops.lodgs.measure_views() == {"FINISHED"}
    assert bpy.context.scene.camera == camera
    psnrs = {view: view.data.lodgs.psnr for view in photographs.views(root)}
    assert (
        compare.measurement.done == compare.measurement.total == 6 == sum(psnr > 0 for psnr in psnrs.values())
    )
    worst = min((view for view in psnrs if psnrs[view] > 0), key=psnrs.get)
    assert bpy.ops.lodgs.compare_worst() == {"FINISHED"}
    assert bpy.context.scene.camera == worst and lodgs("viewport.wipe").comparison.view == worst.session_uid
    assert bpy.context.scene.lodgs_render.show_comparison


def test_cancelling_a_measurement(bpy, lodgs, root, renderer):
    root.lodgs.training.image_scale = 0.1
    measurement = lodgs("render.compare").measure(bpy.context, root)
    assert measurement.step()
    with pytest.raises(RuntimeError, match="already being measured"):
        bpy.ops.lodgs.measure_views()
    assert bpy.ops.lodgs.cancel_measuring() == {"FINISHED"}
    assert not measurement.step() and measurement.done == 1


def recorded(bpy) -> dict[str, float]:
    """Return the PSNR of the measured views by name."""
    return {
        obj.name: round(obj.data.lodgs.psnr, 3)
        for obj in bpy.data.objects
        if obj.type == "CAMERA" and obj.data.lodgs.psnr > 0
    }


def test_undo_of_other_steps_loses_no_measurement(bpy, lodgs, root, renderer):
    """The steps are undone during and after the measurement."""
    root.lodgs.training.image_scale = 0.05
    for view in lodgs("data.photographs").views(root)[3:]:
        view.data.lodgs.photograph = ""
    bpy.ops.ed.undo_push(message="before")
    measurement = lodgs("render.compare").measure(bpy.context, root)
    assert measurement.step()
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
    bpy.ops.ed.undo_push(message="Add")
    assert measurement.step()
    bpy.ops.ed.undo()
    assert len(recorded(bpy)) < 2
    assert not measurement.step()
    psnr = recorded(bpy)
    assert len(psnr) == 3
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
    bpy.ops.ed.undo_push(message="Add")
    bpy.ops.ed.undo()
    assert "user object" not in bpy.data.objects and recorded(bpy) == psnr
    bpy.ops.ed.undo()
    assert not recorded(bpy)


@pytest.mark.parametrize("operator", ["compare_view", "compare_worst", "look_through"])
def test_looking_through_a_view_is_one_undo_step(bpy, lodgs, root, renderer, operator):
    """The render percentage stays unchanged, and undoing a later step keeps the camera."""
    root.lodgs.training.image_scale, render = 0.05, bpy.context.scene.render
    views = lodgs("data.photographs").views(root)
    views[4].data.lodgs.psnr = 1.0  # the worst
    render.resolution_percentage, render.resolution_x = 40, 77
    first = bpy.context.scene.camera.name
    bpy.ops.ed.undo_push(message="before")
    options = {"step": 1} if operator == "look_through" else {}
    run = getattr(bpy.ops.lodgs, operator)
    assert run("EXEC_DEFAULT", True, **options) == {"FINISHED"}  # True: with an undo step
    render = bpy.context.scene.render
    current = (bpy.context.scene.camera.name, render.resolution_x, render.resolution_percentage)
    assert current[1:] == (views[0].data.lodgs.width, 40)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
    bpy.ops.ed.undo_push(message="Add")
    bpy.ops.ed.undo()
    render = bpy.context.scene.render
    assert (bpy.context.scene.camera.name, render.resolution_x, render.resolution_percentage) == current
    bpy.ops.ed.undo()
    render = bpy.context.scene.render
    assert (bpy.context.scene.camera.name, render.resolution_x) == (first, 77)


def test_wipe_is_hidden_with_its_panel(bpy, lodgs, root):
    """Without the panel, the wipe could not be switched off."""
    wipe, panel = lodgs("viewport.wipe"), lodgs("panels.compare").LODGS_PT_compare
    black = np.zeros((2, 2, 3), np.float32)
    camera = bpy.context.scene.camera
    wipe.show(bpy.context, wipe.Comparison(camera.session_uid, black, black, 20.0))
    assert wipe.is_shown(bpy.context) and panel.poll(bpy.context)
    write_bundle(Path(bpy.app.tempdir) / "haze.ply", Bundle("flod", [Level(1, haze(0.4))]))
    second = lodgs("data.importing").import_splats(bpy.context, Path(bpy.app.tempdir) / "haze.ply")
    assert bpy.context.view_layer.objects.active == second and not panel.poll(bpy.context)
    assert not wipe.is_shown(bpy.context)
    bpy.context.view_layer.objects.active = root
    assert wipe.is_shown(bpy.context)
    bpy.context.scene.lodgs_render.show_comparison = False
    assert not wipe.is_shown(bpy.context)
    bpy.context.scene.lodgs_render.show_comparison = True
    root.lodgs.cameras.objects.unlink(camera)
    bpy.context.scene.collection.objects.link(camera)
    assert not wipe.is_shown(bpy.context)


@pytest.mark.parametrize(("validation", "remainders"), [(False, [0]), (True, [0, 4])])
def test_held_out_views_are_those_of_the_run(bpy, lodgs, root, validation, remainders):
    """They are the views that the run was not trained on, even after a view was deleted."""
    photographs, scene = lodgs("data.photographs"), read_scene(GARDEN)
    assert photographs.held_out(root) == []
    record = Bundle("flod", [], meta={"held_out": [*remainders, 8]})
    lodgs("data.scenes").set_bundle_facts(root, record)
    trained = {camera.name for camera in scene.split(8, validation)[0]}
    truth = [camera.name for camera in scene.cameras if camera.name not in trained]
    assert [view.name for view in photographs.held_out(root)] == truth
    bpy.data.objects.remove(photographs.views(root)[1])
    assert [view.name for view in photographs.held_out(root)] == [n for n in truth if n in bpy.data.objects]


def test_views_without_a_photo_count_for_held_out_views(bpy, lodgs, tmp_path):
    names = [camera.name for camera in read_scene(GARDEN).cameras]
    scene = shutil.copytree(GARDEN, tmp_path / "scene")
    (scene / "images" / names[3]).unlink()
    root = lodgs("data.importing").import_colmap(bpy.context, scene, warn=lambda message: None)
    lodgs("data.scenes").set_bundle_facts(root, Bundle("flod", [], meta={"held_out": [0, 8]}))
    held_out = [view.name.split(".jpg")[0] for view in lodgs("data.photographs").held_out(root)]
    assert held_out == [name.removesuffix(".jpg") for name in names[::8]]


def test_impossible_comparisons_are_reported(bpy, lodgs, root, renderer):
    view = bpy.context.scene.camera
    view.data.lodgs.distorted = True
    with pytest.raises(RuntimeError, match="lens distortion"):
        bpy.ops.lodgs.compare_view()
    view.data.lodgs.distorted, view.data.lodgs.photograph = False, "/nowhere/a.jpg"
    with pytest.raises(RuntimeError, match=r"a\.jpg"):
        bpy.ops.lodgs.compare_view()
    view.data.lodgs.photograph = ""
    with pytest.raises(RuntimeError, match="it has no photo"):
        bpy.ops.lodgs.compare_view()
    bpy.context.scene.camera = None
    with pytest.raises(RuntimeError, match="not a view"):
        bpy.ops.lodgs.compare_view()


def test_click_in_the_list_looks_through_the_view(bpy, lodgs, root):
    root.lodgs.active_view = 7
    assert bpy.context.scene.camera == root.lodgs.cameras.objects[7]


def test_list_follows_the_arrow_buttons(bpy, lodgs, root):
    for step in (1, 1, -1, -1, -1):
        assert bpy.ops.lodgs.look_through(step=step) == {"FINISHED"}
        assert root.lodgs.cameras.objects[root.lodgs.active_view] == bpy.context.scene.camera


def test_list_sorts_the_worst_view_first(bpy, lodgs, root):
    objects = root.lodgs.cameras.objects
    for index, psnr in ((3, 12.0), (5, 10.0), (9, 30.0)):
        objects[index].data.lodgs.psnr = psnr
    fake = SimpleNamespace(filter_name="", worst_first=True, bitflag_filter_item=1 << 30)
    filter_items = lodgs("panels.compare").LODGS_UL_views.filter_items
    _, order = filter_items(fake, bpy.context, root.lodgs.cameras, "objects")
    indices = np.argsort(order)
    assert indices[:3].tolist() == [5, 3, 9]
    fake.filter_name = "view_07"
    visible, _ = filter_items(fake, bpy.context, root.lodgs.cameras, "objects")
    assert sum(map(bool, visible)) == 1


def test_list_shows_names_alone_before_a_measurement(bpy, lodgs, root):
    view, layout = root.lodgs.cameras.objects[3], RecordingLayout()
    view.data.lodgs.held_out = False
    draw_item = lodgs("panels.compare").LODGS_UL_views.draw_item
    for psnr, texts in ((0.0, [view.name]), (20.0, [view.name, view.name, "20.0 dB"])):
        view.data.lodgs.psnr = psnr
        draw_item(None, bpy.context, layout, root.lodgs.cameras, view, 0, root.lodgs, "active_view")
        assert layout.texts == texts
