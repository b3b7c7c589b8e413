"""What the panel that captures a Blender scene says and offers."""

from types import SimpleNamespace

import pytest


@pytest.fixture
def drawn(bpy, lodgs, draw_panel, monkeypatch, tmp_path):
    """What the panel draws, with a trainer, of a scene that is to be captured to tmp_path/out."""
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", "python")
    monkeypatch.setattr(lodgs("runs.capturing"), "current", None)
    bpy.context.scene.lodgs_capture.folder = str(tmp_path / "out")
    return lambda: draw_panel("capture", "LODGS_PT_capture")


def test_it_asks_for_views_and_offers_import_once_there_is_a_model(bpy, drawn, tmp_path):
    settings = bpy.context.scene.lodgs_capture
    notes = drawn()
    assert notes.operators == ["lodgs.show_coverage", "lodgs.capture_scene"]
    assert {"views_from", "views", "view_width", "show_views", "folder"} == set(notes.properties)
    settings.views_from = "CURVE"
    assert {"curve", "show_views"} < set(drawn().properties)
    settings.views_from = "GRID"
    assert {"height", "show_views"} < set(drawn().properties)
    settings.views_from = "CAMERAS"
    assert "show_views" not in drawn().properties
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("C", bpy.data.cameras.new("C")))
    assert "1 cameras" in drawn().texts
    (tmp_path / "out" / "sparse").mkdir(parents=True)
    assert drawn().operators == ["lodgs.show_coverage", "lodgs.capture_scene", "lodgs.import_capture"]
    settings.folder = ""
    assert any("not saved yet" in text for text in drawn().texts)


def test_it_tells_what_views_are_placed_around(bpy, drawn):
    settings = bpy.context.scene.lodgs_capture
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.light_add(type="SUN")  # nothing to look at, and alone selected
    for settings.views_from in ("DOME", "GRID"):
        assert "Of everything: nothing is selected." in drawn().texts
    for obj in bpy.context.scene.objects:
        obj.select_set(True)
    assert "Of what is selected: 1 object." in drawn().texts
    settings.views_from = "CAMERAS"
    assert not any("selected" in text for text in drawn().texts)


def test_it_says_where_renders_will_be_noisy(bpy, lodgs, drawn, monkeypatch):
    scene, compat = bpy.context.scene, lodgs("compat")

    def said():
        return [text for text in drawn().texts if "noise" in text]

    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    assert "Without a denoiser 16 samples leave noise" in " ".join(said())
    scene.cycles.use_denoising = True
    monkeypatch.setattr(compat, "DENOISES", False)
    assert "This Blender has no denoiser" in " ".join(said())
    scene.cycles.samples = 256
    assert not said()
    scene.cycles.samples = 16
    monkeypatch.setattr(compat, "DENOISES", True)
    assert not said()
    scene.render.engine, scene.cycles.use_denoising = "BLENDER_WORKBENCH", False
    assert not said()


def test_it_tells_how_far_a_capture_is_and_how_it_ended(bpy, lodgs, drawn, monkeypatch):
    work = SimpleNamespace(running=True, message="View 3 of 9", fraction=0.2, problem="")
    monkeypatch.setattr(lodgs("runs.capturing"), "current", work)
    assert (drawn().texts, drawn().operators) == (["View 3 of 9"], ["lodgs.cancel_capture"])
    work.running, work.message, work.problem = False, "Stopped", "The disk is full."
    assert "The disk is full." in drawn().texts and "lodgs.capture_scene" in drawn().operators


def test_it_is_there_where_no_splat_scene_is(bpy, lodgs, drawn):
    panel = lodgs("panels.capture").LODGS_PT_capture
    assert panel.poll(bpy.context)
    with lodgs("data.scenes").new_scene(bpy.context, "scene"):
        pass
    assert not panel.poll(bpy.context)


def test_without_a_trainer_it_offers_to_make_one(bpy, drawn, monkeypatch, tmp_path):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON")
    assert "lodgs.capture_scene" not in drawn().operators
