"""The Capture Scene panel."""

from types import SimpleNamespace

import pytest


@pytest.fixture
def draw(bpy, lodgs, draw_panel, monkeypatch, tmp_path):
    """Return a function that draws the panel, with a trainer and the capture folder ``tmp_path/out``."""
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", "python")
    monkeypatch.setattr(lodgs("runs.background_capture"), "current", None)
    bpy.context.scene.lodgs_capture.folder = str(tmp_path / "out")
    return lambda: draw_panel("capture", "LODGS_PT_capture")


def test_import_is_offered_once_the_folder_holds_a_model(bpy, draw, tmp_path):
    settings = bpy.context.scene.lodgs_capture
    layout = draw()
    assert layout.operators == ["lodgs.show_coverage", "lodgs.capture_scene"]
    assert {"views_from", "views", "view_width", "show_views", "folder"} == set(layout.properties)
    settings.views_from = "CURVE"
    assert {"curve", "show_views"} < set(draw().properties)
    settings.views_from = "GRID"
    assert {"height", "show_views"} < set(draw().properties)
    settings.views_from = "CAMERAS"
    assert "show_views" not in draw().properties
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("C", bpy.data.cameras.new("C")))
    assert "1 camera" in draw().texts
    (tmp_path / "out" / "sparse").mkdir(parents=True)
    assert draw().operators == ["lodgs.show_coverage", "lodgs.capture_scene", "lodgs.import_capture"]
    settings.folder = ""
    assert any("not saved" in text for text in draw().texts)


def test_hint_counts_the_captured_objects(bpy, draw):
    settings = bpy.context.scene.lodgs_capture
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.light_add(type="SUN")  # the only selected object, without a surface
    for settings.views_from in ("DOME", "GRID"):
        assert "Views cover all objects." in draw().texts
    for obj in bpy.context.scene.objects:
        obj.select_set(True)
    assert "Views cover 1 selected object." in draw().texts
    settings.views_from = "CAMERAS"
    assert not any("Views cover" in text for text in draw().texts)


def test_noisy_render_settings_cause_a_warning(bpy, lodgs, draw, monkeypatch):
    scene, compat = bpy.context.scene, lodgs("compat")

    def warnings():
        return [text for text in draw().texts if "noise" in text or "denoiser" in text]

    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    assert "16 samples leave noise" in " ".join(warnings())
    scene.cycles.use_denoising = True
    monkeypatch.setattr(compat, "HAS_DENOISER", False)
    assert "This Blender has no denoiser" in " ".join(warnings())
    scene.cycles.samples = 256
    assert not warnings()
    scene.cycles.samples = 16
    monkeypatch.setattr(compat, "HAS_DENOISER", True)
    assert not warnings()
    scene.render.engine, scene.cycles.use_denoising = "BLENDER_WORKBENCH", False
    assert not warnings()


def test_progress_and_result_of_a_capture_are_shown(bpy, lodgs, draw, monkeypatch):
    work = SimpleNamespace(running=True, message="View 3 of 9", fraction=0.2, problem="")
    monkeypatch.setattr(lodgs("runs.background_capture"), "current", work)
    assert (draw().texts, draw().operators) == (["View 3 of 9"], ["lodgs.cancel_capture"])
    work.running, work.message, work.problem = False, "Stopped", "The disk is full."
    assert "The disk is full." in draw().texts and "lodgs.capture_scene" in draw().operators


def test_panel_is_hidden_while_a_splat_scene_is_active(bpy, lodgs, draw):
    panel = lodgs("panels.capture").LODGS_PT_capture
    assert panel.poll(bpy.context)
    with lodgs("data.importing").new_scene(bpy.context, "scene"):
        pass
    assert not panel.poll(bpy.context)


def test_without_a_trainer_its_installation_is_offered(bpy, draw, monkeypatch, tmp_path):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON")
    operators = draw().operators
    assert "lodgs.capture_scene" not in operators and "lodgs.make_environment" in operators
