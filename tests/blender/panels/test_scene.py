"""The Scene, Compare, Viewport and Rendering panels."""

import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from tests.blender.panels.conftest import RecordingLayout
from training.splats.bundle import write_bundle
from training.splats.level_colors import level_color
from training.splats.levels import Bundle, Level

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy, lodgs):
    """The example scene with two levels."""
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    scenes.set_bundle_facts(root, Bundle("flod", [], "bands"))
    for number in (1, 2):
        scenes.set_level(root, Level(number, splats(5), {"s_min": 0.1 if number == 1 else 0.0}))
    return root


def test_held_out_views_have_a_separate_mean(bpy, lodgs, root, draw_panel):
    photographs = lodgs("data.photographs")
    views = photographs.views(root)
    for number, view in enumerate(views):
        view.data.lodgs.psnr = 20.0 if number % 8 == 0 else 30.0 + number % 2
    trained = [30.0 + n % 2 for n in range(len(views)) if n % 8]
    measured = trained + [20.0] * (len(views) - len(trained))
    texts = draw_panel("compare", "LODGS_PT_compare").texts
    assert f"Mean: {np.mean(measured):.1f} dB ({len(measured)} views)" in texts
    lodgs("data.scenes").set_bundle_facts(root, Bundle("flod", [], "bands", meta={"held_out": [0, 8]}))
    texts = draw_panel("compare", "LODGS_PT_compare").texts
    assert f"Held out: 20.0 dB ({len(views) - len(trained)} views)" in texts
    assert f"Training: {np.mean(trained):.1f} dB ({len(trained)} views)" in texts


def test_heat_map_of_evidence_is_shown_and_hidden(bpy, lodgs, root, draw_panel):
    """The splats of the levels stand at the origin of the scene, or far outside of every frame."""
    cleaning = lodgs("data.cleaning")
    cloud = root.lodgs.existing_levels[-1].object.data
    assert bpy.ops.lodgs.show_evidence() == {"FINISHED"}
    marks = cleaning.displayed_marks(cloud)
    assert len(set(marks) - {0, 1}) >= 1 and (marks > 1).all()
    texts = draw_panel("compare", "LODGS_PT_compare").texts
    shares = [int(text.split(": ")[1].rstrip("%")) for text in texts if text.startswith("Seen ")]
    assert len(shares) == 4 and sum(shares) == pytest.approx(100, abs=2)
    root.lodgs_clutter.preview = False
    assert bpy.ops.lodgs.find_clutter() == {"FINISHED"}  # replaces the heat map
    assert lodgs("data.evidence").grade_shares(root) is None
    assert bpy.ops.lodgs.show_evidence() == {"FINISHED"}
    assert not root.lodgs_clutter.preview and lodgs("data.evidence").grade_shares(root) is not None
    assert bpy.ops.lodgs.show_evidence() == {"FINISHED"}  # hides it
    assert not cleaning.displayed_marks(cloud).any()


def test_heat_map_of_evidence_stays_after_undo(bpy, lodgs, root):
    evidence, cleaning = lodgs("data.evidence"), lodgs("data.cleaning")
    bpy.ops.lodgs.show_evidence()
    bpy.ops.ed.undo_push(message="before")
    bpy.context.scene.frame_end = 7
    bpy.ops.ed.undo_push(message="Change")
    assert bpy.ops.ed.undo() == {"FINISHED"}
    root = bpy.context.view_layer.objects.active
    cloud = root.lodgs.existing_levels[-1].object.data
    assert (cleaning.displayed_marks(cloud) > 1).all() and evidence.grade_shares(root) is not None
    bpy.ops.lodgs.show_evidence()
    assert not cleaning.displayed_marks(cloud).any()


def test_evidence_hides_the_comparison_that_covers_it(bpy, root):
    bpy.context.scene.lodgs_render.show_comparison = True
    bpy.ops.lodgs.show_evidence()
    assert not bpy.context.scene.lodgs_render.show_comparison


def test_progress_of_a_comparison_is_shown_in_full(lodgs, monkeypatch):
    message = "Training FLoD on garden (1 of 2, about 12 min left), step 30 of 40"
    work = SimpleNamespace(running=True, message=message, fraction=0.75)
    monkeypatch.setattr(lodgs("runs.method_comparison"), "current", work)
    said, layout = [], RecordingLayout()
    monkeypatch.setattr(lodgs("panels.compare"), "say", lambda layout, text, icon: said.append(text))
    lodgs("panels.compare")._draw_methods(layout)
    assert said == [message] and layout.texts == ["75%"]


def test_result_of_an_import_is_shown_until_the_next_import(bpy, lodgs, draw_panel, monkeypatch, tmp_path):
    photo_preparation = lodgs("runs.photo_preparation")
    write_bundle(tmp_path / "splats.ply", Bundle("flod", [Level(1, splats(5), {})], "bands"))
    imports = (
        lambda: bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "splats.ply")),
        lambda: bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False),
    )
    for next_import in imports:
        work = SimpleNamespace(running=False, message="All 9 found their place", problem="", root=None)
        monkeypatch.setattr(photo_preparation, "current", work)
        assert "All 9 found their place" in draw_panel("scene", "LODGS_PT_scene").texts
        assert next_import() == {"FINISHED"}
        assert "All 9 found their place" not in draw_panel("scene", "LODGS_PT_scene").texts


def test_colours_have_a_legend(root, draw_panel):
    assert draw_panel("viewport", "LODGS_PT_viewport").colors == []
    root.lodgs.colors = "LEVELS"
    layout = draw_panel("viewport", "LODGS_PT_viewport")
    assert layout.colors == [(*level_color(1), 1), (*level_color(2), 1)] and layout.texts[:3] == [
        "Colours",
        "1",
        "2",
    ]


def test_without_a_trainer_only_viewport_quality_is_offered(bpy, lodgs, root, draw_panel, fake, monkeypatch):
    lodgs("render.engine").use(bpy.context.scene)
    fake()
    layout = draw_panel("rendering", "LODGS_PT_rendering")
    assert {"render.render", "lodgs.render_quick"} <= set(layout.operators)
    assert "use_pass_levels" in layout.properties
    monkeypatch.delenv("LODGS_TRAINER_PYTHON")
    layout = draw_panel("rendering", "LODGS_PT_rendering")
    assert layout.operators[:3] == ["lodgs.make_environment", "lodgs.render_quick", "lodgs.render_quick"]
    assert "render.render" not in layout.operators and "use_pass_levels" not in layout.properties


def test_combining_with_meshes_is_shown_and_can_be_removed(bpy, lodgs, root, draw_panel, fake):
    fake()
    lodgs("render.engine").use(bpy.context.scene)
    assert "lodgs.separate_meshes" not in draw_panel("rendering", "LODGS_PT_rendering").operators
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    layout = draw_panel("rendering", "LODGS_PT_rendering")
    assert "Meshes: 'Scene Meshes'" in layout.texts and {"samples", "shadows"} <= set(layout.properties)
    assert "lodgs.add_shadow_catcher" in layout.operators
    assert "lodgs.separate_meshes" in layout.operators


@pytest.mark.parametrize(("instance", "splats"), [(True, False), (True, True), (False, False)])
def test_linked_scene_can_be_rendered_but_not_changed(
    bpy, lodgs, root, draw_panel, tmp_path, instance, splats
):
    roots = lodgs("data.roots")
    name = (roots.levels_collection if splats else roots.collection_of)(root).name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "garden.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    roots, scene = lodgs("data.roots"), bpy.context.scene
    panels = [lodgs("panels.viewport").LODGS_PT_viewport, lodgs("panels.rendering").LODGS_PT_rendering]
    assert not any(panel.poll(bpy.context) for panel in panels)
    with bpy.data.libraries.load(str(tmp_path / "garden.blend"), link=True) as (_, linked):
        linked.collections = [name]
    if instance:
        empty = bpy.data.objects.new("instance", None)
        empty.instance_type = "COLLECTION"
        empty.instance_collection = linked.collections[0]
        scene.collection.objects.link(empty)
        bpy.context.view_layer.objects.active = empty
    else:
        scene.collection.children.link(linked.collections[0])
    bpy.context.view_layer.update()
    assert all(panel.poll(bpy.context) for panel in panels)
    layout = draw_panel("scene", "LODGS_PT_scene")
    assert roots.LINKED in layout.texts
    for operator in ("remove_scene", "show_only_level", "train"):
        assert not getattr(bpy.ops.lodgs, operator).poll()
    assert "splats" in draw_panel("viewport", "LODGS_PT_viewport").properties


def test_library_override_cannot_be_changed(bpy, lodgs, root, draw_panel, tmp_path):
    """Blender does not save settings of extensions in overrides, and the points remain linked."""
    roots = lodgs("data.roots")
    name = roots.collection_of(root).name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "garden.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "garden.blend"), link=True) as (_, linked):
        linked.collections = [name]
    scene, [collection] = bpy.context.scene, linked.collections
    scene.collection.children.link(collection)
    collection.override_hierarchy_create(scene, bpy.context.view_layer)
    scene.collection.children.unlink(collection)
    [override] = roots.roots(scene)
    bpy.context.view_layer.objects.active = override
    assert override.is_editable and roots.LINKED in draw_panel("scene", "LODGS_PT_scene").texts
    for operator in ("remove_scene", "show_only_level", "train", "set_ground"):
        assert not getattr(bpy.ops.lodgs, operator).poll()
    for obj in scene.objects:
        obj.select_set(True)
    assert bpy.ops.object.make_local(type="ALL") == {"FINISHED"}
    bpy.context.view_layer.objects.active = scene.objects[name]
    assert roots.is_local(scene.objects[name]) and bpy.ops.lodgs.remove_scene.poll()


def test_local_scene_has_no_hint_about_linking(lodgs, root, draw_panel):
    layout = draw_panel("scene", "LODGS_PT_scene")
    assert lodgs("data.roots").LINKED not in layout.texts and "lodgs.remove_scene" in layout.operators


def test_import_reports_the_imported_objects(bpy, lodgs, capfd, tmp_path):
    """Background Blender prints the operator's report."""
    write_bundle(tmp_path / "b.ply", Bundle("flod", [Level(1, splats(1)), Level(2, splats(1234))]))
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "b.ply")) == {"FINISHED"}
    assert "'b': 2 levels, 1,235 splats" in capfd.readouterr().out
    assert bpy.ops.lodgs.import_colmap(directory=str(GARDEN)) == {"FINISHED"}
    scene = lodgs("training.scenes.colmap").read_scene(GARDEN)
    counts = f"{len(scene.cameras)} photos, {len(scene.points):,} points"
    assert f"'lantern_garden': {counts}" in capfd.readouterr().out


def test_panels_for_splats_are_hidden_until_a_scene_has_levels(bpy, lodgs):
    scenes = lodgs("data.scenes")
    panels = [getattr(lodgs(f"panels.{name}"), f"LODGS_PT_{name}") for name in ("viewport", "rendering")]
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    assert not any(panel.poll(bpy.context) for panel in panels)
    scenes.set_level(root, Level(1, splats(5)))
    assert all(panel.poll(bpy.context) for panel in panels)


def test_estimate_is_above_train_until_settings_change(bpy, lodgs, root, draw_panel, monkeypatch):
    lines = "warning: Two photos are missing. Add them.\nestimate: About 3 min.\nestimate: Use draft.\n"
    commands = []

    def answer(python, *arguments, **_):
        commands.append((arguments[0], arguments[2], Path(arguments[1]).read_text()))
        return SimpleNamespace(returncode=0, stdout=lines)

    monkeypatch.setattr(lodgs("runs.environment"), "run_module", answer)
    root.lodgs.training.image_scale = 0.25
    draw_training = partial(draw_panel, "training", "LODGS_PT_training")
    assert "lodgs.check_scene" in draw_training().operators
    assert bpy.ops.lodgs.check_scene() == {"FINISHED"}
    ((command, option, job),) = commands
    assert (command, option) == ("train", "--check") and "image_scale = 0.25" in job
    texts = " ".join(draw_training().texts)
    assert "About 3 min." in texts and "Use draft." in texts
    texts = " ".join(draw_panel("scene", "LODGS_PT_scene").texts)
    assert "Two photos are missing. Add them." in texts and "About 3 min." not in texts
    for name, value, restored in (("preset", "standard", "draft"), ("columns", 2, 1)):
        setattr(root.lodgs.training, name, value)
        assert "About 3 min." not in draw_training().texts
        assert "lodgs.check_scene" in draw_training().operators
        setattr(root.lodgs.training, name, restored)
        assert "About 3 min." in draw_training().texts
    lodgs("extension").preferences().backend = "cpu"  # the time depends on the device
    assert "About 3 min." not in draw_training().texts


def test_splats_without_photos_have_an_estimate(bpy, lodgs, draw_panel, monkeypatch, tmp_path):
    """The trainer gets the splats and the views, which are removed afterwards."""
    folders = []

    def answer(python, command, file, *_, **options):
        job = lodgs("training.runs.job").Job.from_file(Path(file))
        assert len(lodgs("training.splats.bundle").read_bundle(job.base).levels[-1].splats) == 9
        assert len(list(Path(job.capture).glob("*.json"))) == 4
        folders.append(Path(file).parent)
        return SimpleNamespace(returncode=0, stdout="estimate: About 3 min.\n")

    monkeypatch.setattr(lodgs("runs.environment"), "run_module", answer)
    monkeypatch.setattr(lodgs("runs.environment"), "trainer_python", lambda: Path("python"))
    opaque = replace(splats(9), opacity_logits=np.full(9, 4, np.float32))
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, opaque)]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    bpy.ops.curve.primitive_bezier_circle_add(radius=5)
    settings = root.lodgs.training
    settings.views_from, settings.views, settings.curve = "CURVE", 4, bpy.context.object
    bpy.context.view_layer.objects.active = root
    draw_training = partial(draw_panel, "training", "LODGS_PT_training")
    assert "lodgs.check_scene" in draw_training().operators
    assert bpy.ops.lodgs.check_scene() == {"FINISHED"}
    assert "About 3 min." in draw_training().texts and not folders[0].exists()
    settings.views = 5
    assert "About 3 min." not in draw_training().texts


def test_panel_states_a_running_estimate(bpy, lodgs, root, draw_panel, monkeypatch):
    """A second press would start a second measurement."""
    finish = threading.Event()

    def answer(*_, **options):
        assert finish.wait(20)
        return SimpleNamespace(returncode=0, stdout="estimate: About 3 min.\n")

    monkeypatch.setattr(lodgs("runs.environment"), "run_module", answer)
    operator = lodgs("operators.check_scene").LODGS_OT_check_scene
    steps = operator.work(SimpleNamespace(), bpy.context)
    next(steps)
    assert "Estimating time and memory…" in draw_panel("training", "LODGS_PT_training").texts
    assert not bpy.ops.lodgs.check_scene.poll()
    finish.set()
    assert all(step is None for step in steps)
    texts = draw_panel("training", "LODGS_PT_training").texts
    assert "Estimating time and memory…" not in texts and "About 3 min." in texts
    assert bpy.ops.lodgs.check_scene.poll()


def test_stopping_the_estimate_ends_the_trainer(bpy, lodgs, root, monkeypatch):
    """The trainer would otherwise take the computer's cores for minutes, and keep Blender from quitting."""
    environment, started = lodgs("runs.environment"), []
    original = environment.subprocess.Popen

    def start(command, **options):
        started.append(original([command[0], "-c", "import time; time.sleep(60)"], **options))
        return started[-1]

    monkeypatch.setattr(environment.subprocess, "Popen", start)
    monkeypatch.setattr(environment, "trainer_python", lambda: Path(sys.executable))
    steps = lodgs("operators.check_scene").LODGS_OT_check_scene.work(SimpleNamespace(), bpy.context)
    while not started:
        next(steps)
    assert started[0].poll() is None
    steps.close()
    started[0].wait(20)
    assert bpy.ops.lodgs.check_scene.poll()


def test_events_pass_to_blender_during_the_estimate(bpy, lodgs, root, monkeypatch):
    """The user orbits and changes settings meanwhile, but cannot start a second estimate."""
    modal = lodgs("operators.modal")
    events = [SimpleNamespace(type=name) for name in ("MIDDLEMOUSE", "TIMER", "TIMER0")]

    def states(base):
        operator = type("Operator", (base, lodgs("operators.base").SceneOperator), {})()
        operator.poll_message_set = type(operator).poll_message_set = lambda *_: None
        operator.cancel(context)  # a cancelled File Browser
        operator.work = lambda _: (None for _ in events)
        operator.status_text = lambda *_: "Waiting"
        operator.start_modal(context)
        results = [operator.modal(context, event) for event in events]
        polls = type(operator).poll(bpy.context)
        operator.cancel(context)
        return results, polls, type(operator).poll(bpy.context)

    context = MagicMock()
    assert states(modal.WaitingOperator) == ([{"PASS_THROUGH"}] * 3, False, True)
    assert states(modal.SteppedOperator)[0] == [{"RUNNING_MODAL"}] * 3


def test_check_lists_its_findings(bpy, lodgs, root, draw_panel, tmp_path, monkeypatch):
    environment, errors = lodgs("runs.environment"), lodgs("training.errors")

    def no_trainer():
        raise errors.LodgsError("No trainer.")

    monkeypatch.setattr(environment, "trainer_python", no_trainer)
    assert "Nothing found that lowers the quality" not in draw_panel("scene", "LODGS_PT_scene").texts
    assert bpy.ops.lodgs.check_scene() == {"FINISHED"}
    assert "Nothing found that lowers the quality" in draw_panel("scene", "LODGS_PT_scene").texts
    root.lodgs.training.image_scale = 0.25
    root.lodgs.scene_folder = str(GARDEN)
    assert bpy.ops.lodgs.check_scene() == {"FINISHED"}
    assert "48 of 48 photos have fewer than 200" in " ".join(draw_panel("scene", "LODGS_PT_scene").texts)
    root.lodgs.scene_folder = str(tmp_path)
    assert bpy.ops.lodgs.check_scene() == {"FINISHED"}
    assert "holds no COLMAP model" in " ".join(draw_panel("scene", "LODGS_PT_scene").texts)
    root.lodgs.scene_folder = ""
    with pytest.raises(RuntimeError, match="it has no photos"):
        bpy.ops.lodgs.check_scene()


def test_panel_shows_the_local_origin(bpy, lodgs, draw_panel, tmp_path):
    meta = {"origin": [500_000.0, 4_200_000.0, 300.5]}
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats(9))], meta=meta))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    assert "Local origin 500000  4200000  300.5" in " ".join(draw_panel("scene", "LODGS_PT_scene").texts)


@pytest.mark.parametrize("meta", ['{"origin": "a"}', '{"view": [1]}', '{"georeference": 1}'])
def test_damaged_meta_is_ignored(bpy, lodgs, root, draw_panel, meta):
    root.lodgs.meta = meta
    assert "Local origin" not in " ".join(draw_panel("scene", "LODGS_PT_scene").texts)
    lodgs("data.photographs").look_at_scene(bpy.context, root)
    assert lodgs("data.scenes").read_levels(root).meta == {}
