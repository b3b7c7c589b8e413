"""Views compared with their photographs: PSNR, the worst, the wipe, and what cannot be compared."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from training.scenes.colmap import read_scene
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def haze(color: float) -> Splats:
    """Large grey splats around the garden, seen from everywhere."""
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
    """The example's views with haze for splats."""
    write_bundle(tmp_path / "haze.ply", Bundle("flod", [Level(1, haze(0.4))]))
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    root.lodgs.training.image_scale = 1.0
    lodgs("data.scenes").set_level(root, Level(1, haze(0.4)))
    bpy.context.view_layer.update()
    return root


def photograph(bpy, view) -> np.ndarray:
    """(H, W, 3) as Blender reads it, rows from the top."""
    image = bpy.data.images.load(view.data.lodgs.photograph)
    image.colorspace_settings.name = "Non-Color"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]


def test_psnr_is_that_of_the_f12_picture(bpy, lodgs, root, renderer, tmp_path):
    scene, view = bpy.context.scene, lodgs("data.photographs").views(root)[5]
    lodgs("data.photographs").through(bpy.context, view)
    found = lodgs("render.compare").compare_view(bpy.context, root, view)
    lodgs("render.engine").use(scene)
    scene.render.dither_intensity = 0
    scene.render.filepath = str(tmp_path / "view.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    rendered = values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]
    truth = photograph(bpy, view)
    psnr = -10 * np.log10(((rendered.astype(float) - truth) ** 2).mean())
    assert 5 < psnr < 20
    assert found.psnr == pytest.approx(psnr, abs=0.02)
    assert view.data.lodgs.psnr == pytest.approx(found.psnr)
    np.testing.assert_allclose(found.photograph, truth, atol=2.5 / 255)
    np.testing.assert_allclose(found.rendered, rendered, atol=0.6 / 255)


@pytest.fixture
def measured(bpy, lodgs, tmp_path):
    """``measured(name, scale)``: the root of levels by distance over the garden's views, and the PSNR of a
    view as the trainer's evaluation finds it: only their files are shared."""
    pytest.importorskip("torch", reason="the evaluation runs beside Blender here")
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

    def made(index, scale, folder=GARDEN):
        evaluation = Evaluation(TrainingData(read_scene(folder), scale, 8), backend="cpu")
        camera = evaluation.cameras[index]
        bundle.controls["gamma"] = 2.4 * scale
        choice, values = BundleSelector(bundle), resolve_controls(bundle, {})
        weights = choice.weights(camera.center, camera.focal, values)
        counts = np.unique(np.repeat([1, 2, 3], 300)[weights > 0], return_counts=True)
        assert min(counts[1]) > 20 and len(counts[0]) == 3  # every level has its part
        (psnr,) = evaluation.compare_views([camera], lambda camera: (choice.splats, weights))
        root = lodgs("data.importing").import_colmap(bpy.context, folder, photographs=False)
        lodgs("data.scenes").set_bundle_facts(root, bundle)
        for level in levels:
            lodgs("data.scenes").set_level(root, level)
        lodgs("data.scenes").set_bundle_facts(root, bundle)
        root.lodgs.mode, root.lodgs.training.image_scale = "SELECTIVE", scale
        view = next(v for v in lodgs("data.photographs").views(root) if v.name == camera.name)
        return root, view, psnr

    return made


@pytest.mark.parametrize(("rendered", "scale"), [((64, 1000), 0.7), ((4000, 100), 0.37)])
def test_by_distance_it_is_what_evaluate_measures(bpy, lodgs, measured, renderer, rendered, scale):
    """To a hundredth of a dB, whatever the size of the last render."""
    root, view, psnr = measured(2, scale)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = rendered
    render.resolution_percentage, render.pixel_aspect_x = 37, 1.5
    found = lodgs("render.compare").compare_view(bpy.context, root, view)
    assert found.psnr == pytest.approx(psnr, abs=0.01)
    assert (render.resolution_x, render.resolution_y) == rendered
    assert (render.resolution_percentage, render.pixel_aspect_x) == (37, 1.5)


def test_what_is_masked_out_or_transparent_counts_as_in_evaluate(bpy, lodgs, measured, renderer, tmp_path):
    """By the evaluation, and by hand from the pictures that the wipe shows."""
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
    found = lodgs("render.compare").compare_view(bpy.context, root, view)
    over_black = pixels[..., :3] * (pixels[..., 3:] / 255)
    np.testing.assert_allclose(255 * found.photograph, over_black, atol=1e-3)
    rendered, truth = (np.rint(255 * np.clip(x, 0, 1)) for x in (found.rendered, found.photograph))
    apart = (rendered - truth)[80:280, 120:360]
    assert found.psnr == pytest.approx(20 * np.log10(255) - 10 * np.log10((apart**2).mean()), abs=0.01)
    assert found.psnr == pytest.approx(psnr, abs=0.01)


def test_measuring_all_finds_the_worst(bpy, lodgs, root, renderer):
    compare, photographs = lodgs("render.compare"), lodgs("data.photographs")
    assert not bpy.ops.lodgs.compare_worst.poll()
    root.lodgs.training.image_scale = 0.1
    for view in photographs.views(root)[6:]:
        view.data.lodgs.photograph = ""
    before = bpy.context.scene.camera
    assert bpy.ops.lodgs.measure_views() == {"FINISHED"}
    assert bpy.context.scene.camera == before
    psnrs = {view: view.data.lodgs.psnr for view in photographs.views(root)}
    assert (
        compare.measurement.done == compare.measurement.total == 6 == sum(psnr > 0 for psnr in psnrs.values())
    )
    worst = min((view for view in psnrs if psnrs[view] > 0), key=psnrs.get)
    assert bpy.ops.lodgs.compare_worst() == {"FINISHED"}
    assert bpy.context.scene.camera == worst and lodgs("viewport.wipe").comparison.view == worst.session_uid
    assert bpy.context.scene.lodgs_render.show_comparison


def test_measuring_is_cancelled(bpy, lodgs, root, renderer):
    root.lodgs.training.image_scale = 0.1
    measurement = lodgs("render.compare").measure(bpy.context, root)
    assert measurement.step()
    with pytest.raises(RuntimeError, match="being measured"):
        bpy.ops.lodgs.measure_views()
    assert bpy.ops.lodgs.cancel_measuring() == {"FINISHED"}
    assert not measurement.step() and measurement.done == 1


def recorded(bpy) -> dict[str, float]:
    return {
        obj.name: round(obj.data.lodgs.psnr, 3)
        for obj in bpy.data.objects
        if obj.type == "CAMERA" and obj.data.lodgs.psnr > 0
    }


def test_undoing_something_else_loses_no_measure(bpy, lodgs, root, renderer):
    """Neither what follows measuring, nor what is done and undone while it goes on."""
    root.lodgs.training.image_scale = 0.05
    for view in lodgs("data.photographs").views(root)[3:]:
        view.data.lodgs.photograph = ""
    bpy.ops.ed.undo_push(message="before")
    measurement = lodgs("render.compare").measure(bpy.context, root)
    assert measurement.step()
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("the artist's", None))
    bpy.ops.ed.undo_push(message="Add")
    assert measurement.step()
    bpy.ops.ed.undo()
    assert len(recorded(bpy)) < 2
    assert not measurement.step()
    found = recorded(bpy)
    assert len(found) == 3
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("the artist's", None))
    bpy.ops.ed.undo_push(message="Add")
    bpy.ops.ed.undo()
    assert "the artist's" not in bpy.data.objects and recorded(bpy) == found
    bpy.ops.ed.undo()
    assert not recorded(bpy)


@pytest.mark.parametrize("look", ["compare_view", "compare_worst", "look_through"])
def test_looking_is_a_step_of_its_own(bpy, lodgs, root, renderer, look):
    """It leaves the render's percentage alone, and undoing what follows leaves the camera that was looked
    through."""
    root.lodgs.training.image_scale, render = 0.05, bpy.context.scene.render
    views = lodgs("data.photographs").views(root)
    views[4].data.lodgs.psnr = 1.0  # the worst
    render.resolution_percentage, render.resolution_x = 40, 77
    first = bpy.context.scene.camera.name
    bpy.ops.ed.undo_push(message="before")
    given = {"step": 1} if look == "look_through" else {}
    assert getattr(bpy.ops.lodgs, look)("EXEC_DEFAULT", True, **given) == {"FINISHED"}  # True: as by hand
    render = bpy.context.scene.render
    looked = (bpy.context.scene.camera.name, render.resolution_x, render.resolution_percentage)
    assert looked[1:] == (views[0].data.lodgs.width, 40)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("the artist's", None))
    bpy.ops.ed.undo_push(message="Add")
    bpy.ops.ed.undo()
    render = bpy.context.scene.render
    assert (bpy.context.scene.camera.name, render.resolution_x, render.resolution_percentage) == looked
    bpy.ops.ed.undo()
    render = bpy.context.scene.render
    assert (bpy.context.scene.camera.name, render.resolution_x) == (first, 77)


def test_the_wipe_goes_with_its_panel(bpy, lodgs, root):
    """Where the panel is gone nothing could switch it off: another scene selected, the view taken out."""
    wipe, panel = lodgs("viewport.wipe"), lodgs("panels.compare").LODGS_PT_compare
    nothing, camera = np.zeros((2, 2, 3), np.float32), bpy.context.scene.camera
    wipe.show(bpy.context, wipe.Comparison(camera.session_uid, nothing, nothing, 20.0))
    assert wipe.shown(bpy.context) and panel.poll(bpy.context)
    write_bundle(Path(bpy.app.tempdir) / "haze.ply", Bundle("flod", [Level(1, haze(0.4))]))
    other = lodgs("data.importing").import_splats(bpy.context, Path(bpy.app.tempdir) / "haze.ply")
    assert bpy.context.view_layer.objects.active == other and not panel.poll(bpy.context)
    assert not wipe.shown(bpy.context)
    bpy.context.view_layer.objects.active = root
    assert wipe.shown(bpy.context)
    bpy.context.scene.lodgs_render.show_comparison = False
    assert not wipe.shown(bpy.context)
    bpy.context.scene.lodgs_render.show_comparison = True
    root.lodgs.cameras.objects.unlink(camera)
    bpy.context.scene.collection.objects.link(camera)
    assert not wipe.shown(bpy.context)


@pytest.mark.parametrize(("validation", "rests"), [(False, [0]), (True, [0, 4])])
def test_held_out_views_are_those_of_the_run(bpy, lodgs, root, validation, rests):
    """Those that the trainer did not train on, also where the artist has deleted a view."""
    photographs, scene = lodgs("data.photographs"), read_scene(GARDEN)
    assert photographs.held_out(root) == []
    record = Bundle("flod", [], meta={"held_out": [*rests, 8]})
    lodgs("data.scenes").set_bundle_facts(root, record)
    trained = {camera.name for camera in scene.split(8, validation)[0]}
    truth = [camera.name for camera in scene.cameras if camera.name not in trained]
    assert [view.name for view in photographs.held_out(root)] == truth
    bpy.data.objects.remove(photographs.views(root)[1])
    assert [view.name for view in photographs.held_out(root)] == [n for n in truth if n in bpy.data.objects]


def test_views_without_a_photograph_are_counted_among_those_held_out(bpy, lodgs, tmp_path):
    names = [camera.name for camera in read_scene(GARDEN).cameras]
    scene = shutil.copytree(GARDEN, tmp_path / "scene")
    (scene / "images" / names[3]).unlink()
    root = lodgs("data.importing").import_colmap(bpy.context, scene, warn=lambda message: None)
    lodgs("data.scenes").set_bundle_facts(root, Bundle("flod", [], meta={"held_out": [0, 8]}))
    held_out = [view.name.split(".jpg")[0] for view in lodgs("data.photographs").held_out(root)]
    assert held_out == [name.removesuffix(".jpg") for name in names[::8]]


def test_what_cannot_be_compared_is_reported(bpy, lodgs, root, renderer):
    view = bpy.context.scene.camera
    view.data.lodgs.distorted = True
    with pytest.raises(RuntimeError, match="bends lines"):
        bpy.ops.lodgs.compare_view()
    view.data.lodgs.distorted, view.data.lodgs.photograph = False, "/nowhere/a.jpg"
    with pytest.raises(RuntimeError, match=r"a\.jpg"):
        bpy.ops.lodgs.compare_view()
    view.data.lodgs.photograph = ""
    with pytest.raises(RuntimeError, match="has no photograph"):
        bpy.ops.lodgs.compare_view()
    bpy.context.scene.camera = None
    with pytest.raises(RuntimeError, match="not a view"):
        bpy.ops.lodgs.compare_view()


def test_a_click_in_the_list_looks_through(bpy, lodgs, root):
    root.lodgs.active_view = 7
    assert bpy.context.scene.camera == root.lodgs.cameras.objects[7]


def test_the_list_goes_along_with_the_arrows(bpy, lodgs, root):
    for step in (1, 1, -1, -1, -1):
        assert bpy.ops.lodgs.look_through(step=step) == {"FINISHED"}
        assert root.lodgs.cameras.objects[root.lodgs.active_view] == bpy.context.scene.camera


def test_the_list_sorts_the_worst_first(bpy, lodgs, root):
    objects = root.lodgs.cameras.objects
    for index, psnr in ((3, 12.0), (5, 10.0), (9, 30.0)):
        objects[index].data.lodgs.psnr = psnr
    fake = SimpleNamespace(filter_name="", worst_first=True, bitflag_filter_item=1 << 30)
    filter_items = lodgs("panels.compare").LODGS_UL_views.filter_items
    _, order = filter_items(fake, bpy.context, root.lodgs.cameras, "objects")
    by_place = np.argsort(order)
    assert by_place[:3].tolist() == [5, 3, 9]
    fake.filter_name = "view_07"
    shown, _ = filter_items(fake, bpy.context, root.lodgs.cameras, "objects")
    assert sum(map(bool, shown)) == 1
