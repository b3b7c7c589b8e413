"""The Training panel, drawn into a layout that records texts and operators."""

from types import SimpleNamespace

import pytest

NONE_HELD_OUT = "No views are held out, so quality is measured on training views."


@pytest.fixture
def root(bpy, tmp_path):
    collection = bpy.data.collections.new("tiny")
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new("tiny", None)
    collection.objects.link(root)
    root.lodgs.is_root, root.lodgs.scene_folder = True, str(tmp_path)
    return root


@pytest.fixture
def draw(draw_panel):
    return lambda panel="LODGS_PT_training": draw_panel("training", panel)


@pytest.fixture
def watch(lodgs, root, tmp_path):
    """The watch of the run in the panel."""
    module, folder = lodgs("runs.watch"), lodgs("training.runs.folder")
    watch = module.Watch(folder.RunFolder(tmp_path), root.session_uid)
    module.watches[root.session_uid] = watch
    return watch


def test_settings_before_training(root, draw, fake):
    layout = draw()
    assert (layout.operators, layout.buttons) == (["lodgs.train", "lodgs.check_scene"], ["Train", ""])
    assert layout.properties == ["method", "preset", "image_scale"]
    assert "5,661 steps in 5 levels" in layout.texts
    assert NONE_HELD_OUT in layout.texts
    root.lodgs.training.test_every = 8
    assert NONE_HELD_OUT not in draw().texts
    root.lodgs.training.test_every = 1
    layout = draw()
    assert any("No views are left to train on" in text for text in layout.texts) and not layout.buttons
    root.lodgs.training.test_every = 8
    root.lodgs.training.parameters.levels = 3
    assert "5,011 steps in 3 levels" in draw().texts
    root.lodgs.training.method = "3dgs"  # has no levels
    assert "3,000 steps" in draw().texts


def test_flamenco_is_offered_if_the_preferences_name_a_manager(lodgs, root, draw, fake):
    preferences = lodgs("extension").preferences()
    preferences.flamenco = "http://farm:8080"
    try:
        assert draw().operators == ["lodgs.train", "lodgs.check_scene", "lodgs.submit_to_flamenco"]
        root.lodgs.scene_folder = ""
        assert "lodgs.submit_to_flamenco" not in draw().operators
    finally:
        preferences.flamenco = ""


def test_splats_without_photos_need_settings_of_views(bpy, lodgs, root, draw, fake):
    root.lodgs.scene_folder = ""
    assert draw().operators == [] and any("No photos to train on" in text for text in draw().texts)
    level = lodgs("training.splats.levels").Level
    lodgs("data.scenes").set_level(root, level(1, lodgs("training.splats.levels").NO_SPLATS))
    assert any("FLoD needs photos" in text for text in draw().texts) and not draw().operators
    settings = root.lodgs.training
    settings.method = "lodge"
    first = ["method", "preset", "image_scale", "views_from"]
    assert draw().properties == [*first, "views", "view_width", "show_views"]
    assert draw().operators == ["lodgs.train", "lodgs.check_scene"]
    assert any("opaque splat" in text for text in draw().texts)
    assert "1,200 steps in 3 levels" in draw().texts  # the finest level takes no steps
    settings.views_from = "CURVE"
    assert draw().properties == [*first, "curve", "views", "view_width", "show_views"]
    settings.views_from = "CAMERAS"
    assert draw().properties == [*first, "view_width"] and "0 cameras" in draw().texts
    advanced = draw("LODGS_PT_training_advanced").properties
    photo_settings = {"region", "model", "images", "use_depth_weight", "use_depth"}
    assert not photo_settings & set(advanced) and "seed" in advanced


def test_depth_loss_is_a_parameter_of_every_method(lodgs, root):
    job_settings = lodgs("runs.job_settings")
    settings = root.lodgs.training
    for settings.method in ("flod", "3dgs", "tree"):
        assert not job_settings.changed_parameters(settings)
        settings.parameters.use_depth_weight = True
        settings.parameters.depth_weight, settings.parameters.depth = 0.3, "points"
        assert job_settings.changed_parameters(settings) == {"depth_weight": 0.3, "depth": "points"}
        assert job_settings.current_parameters(settings).depth_weight == 0.3


def test_parameter_shows_the_presets_value_until_it_is_set(lodgs, root, draw):
    settings = root.lodgs.training
    common = ["region", "seed", "use_test_every", "preset_test_every", "model", "images", "output"]
    depth = ["use_depth_weight", "preset_depth_weight", "use_depth", "preset_depth"]

    def method_properties():
        names = draw("LODGS_PT_training_advanced").properties
        assert [name for name in names if name in depth] == depth
        return [name for name in names if name not in common + depth]

    settings.preset = "standard"
    assert draw("LODGS_PT_training_advanced").operators == ["lodgs.add_region", "lodgs.open_run"]
    assert method_properties() == [
        "use_levels", "preset_levels", "use_footprint", "preset_footprint", "use_max_splats",
        "preset_max_splats",
    ]  # fmt: skip
    settings.parameters.use_max_splats = True
    assert method_properties()[-2:] == ["use_max_splats", "max_splats"]
    assert settings.parameters.max_splats == settings.parameters.preset_max_splats == 1_000_000
    settings.method = "3dgs"
    names = lodgs("training.methods").METHODS["3dgs"].panel_parameters
    assert method_properties() == [f"{kind}_{name}" for name in names for kind in ("use", "preset")]


def test_level_distances_can_be_set(bpy, lodgs, root, draw, fake):
    """One distance per coarser level, in median depths, with the length in Blender units if it is known."""
    settings, panel = root.lodgs.training, "LODGS_PT_training_advanced"
    assert not any("distances" in name for name in draw(panel).properties)
    settings.method = "lodge"
    changes = lodgs("runs.job_settings").changed_parameters
    assert "find_distances" in draw(panel).properties and "distances" not in changes(settings)
    settings.find_distances = False
    assert [name for name in draw(panel).properties if name.startswith("distances")] == [
        "distances[1] Level 1 From", "distances[0] Level 2 From",
    ]  # fmt: skip
    assert changes(settings)["distances"] == (6.0, 3.0, 0.0)
    assert "Unit: median depth of the photos" in draw(panel).texts
    settings.median_depth, settings.parameters.levels, settings.distances[0] = 2.0, 4, 2.6
    root.scale = (0.75, 0.75, 0.75)
    bpy.context.view_layer.update()
    assert [name for name in draw(panel).properties if name.startswith("distances")] == [
        "distances[2] Level 1 From", "distances[1] Level 2 From", "distances[0] Level 3 From",
    ]  # fmt: skip
    assert draw(panel).texts[-1].endswith("median depth of the photos (1.5 m)")
    assert lodgs("runs.job_settings").current_parameters(settings).distances == (12.0, 6.0, 2.6, 0.0)
    settings.distances[1] = 30.0
    assert any("Give decreasing numbers" in text for text in draw().texts)
    settings.distances[1] = 0.0  # 0: training determines it
    assert not any("Give decreasing numbers" in text for text in draw().texts)


def test_start_from_is_offered_if_the_method_can_start_from_splats(root, draw, fake):
    assert "start_from" not in draw().properties
    root.lodgs.training.method = "3dgs"
    assert "start_from" in draw().properties and "base" not in draw().properties
    root.lodgs.training.start_from = "FILE"
    assert draw().properties[-2:] == ["start_from", "base"]


def test_without_a_trainer_its_installation_is_offered(root, draw, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    layout = draw()
    assert layout.operators == ["lodgs.make_environment"]
    assert "Cannot start the trainer: it is not installed." in layout.texts


def test_progress_of_the_trainers_installation_is_shown(lodgs, root, draw, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    setup = SimpleNamespace(running=True, message="Downloading torch", fraction=0.4, problem="")
    monkeypatch.setattr(lodgs("runs.environment_setup"), "current", setup)
    layout = draw()
    assert layout.operators == ["lodgs.cancel_environment"] and "Downloading torch" in layout.texts
    setup.running, setup.problem = False, "No network. Check it."
    layout = draw()
    assert layout.operators == ["lodgs.make_environment"] and "No network. Check it." in layout.texts


def test_progress_while_training(draw, watch):
    assert "Starting the trainer" in draw().texts
    watch.message = "Preparing to train (the first time on a computer)"
    assert {"Preparing to train", "The first time on a computer"} <= set(draw().texts)
    watch.message, watch.fraction = "Level 2 of 5", 1500 / 4300
    watch.progress = {
        "level": 2, "levels": 5, "step": 1500, "of": 4300, "loss": 0.1234, "psnr": 21.5, "splats": 12345,
        "steps_per_s": 12.34, "eta_s": 227.0,
    }  # fmt: skip
    layout = draw()
    assert layout.operators == ["lodgs.cancel_training"]
    facts = {
        "2 of 5",
        "1,500 of 4,300",
        "0.1234",
        "PSNR, training",
        "21.5 dB",
        "12,345",
        "12.3 steps/s",
        "4 min",
    }
    assert facts | {"Level 2 of 5 · 35%"} <= set(layout.texts)
    watch.last_event = 0
    assert any("not responding. Wait if the computer is busy" in text for text in draw().texts)
    watch.cancel_requested = True
    assert "Cancel again to stop immediately" in draw().texts


def test_results_after_training(bpy, lodgs, root, draw, watch, fake):
    watch.state, watch.message = "done", "Finished"
    watch.levels = {1: {"level": 1, "splats": 1234, "psnr": 20.04}, 2: {"level": 2, "splats": 5}}
    levels = lodgs("training.splats.bundle")
    for number in (1, 2):
        lodgs("data.scenes").set_level(root, levels.Level(number, levels.NO_SPLATS))
    layout = draw()
    first = "Level 1: 1,234 splats, 20.0 dB"
    assert {"Finished", "Quality on held-out views", first, "Level 2: 5 splats"} <= set(layout.texts)
    assert layout.operators == ["lodgs.train", "lodgs.check_scene"]
    bpy.data.objects.remove(root.lodgs.levels[0].object)
    layout = draw()
    assert first not in layout.texts and "Level 2: 5 splats" in layout.texts
    assert "Levels not loaded: 1" in layout.texts
    assert layout.operators == ["lodgs.open_run", "lodgs.train", "lodgs.check_scene"]
    lodgs("data.scenes").set_level(root, levels.Level(1, levels.NO_SPLATS))
    watch.summary = {
        "train_psnr": 35.8, "veil": {"mean": 0.1234, "max": 1.0}, "oversized": 1234,
        "worst": {"view": "a.jpg", "psnr": 16.75},
    }  # fmt: skip
    measured = [
        "Training views: 35.8 dB",
        "Worst held-out view: 16.8 dB (a.jpg)",
        "Between views: 12.3% veiled, 100.0% at worst",
        "Oversized opaque splats: 1,234",
    ]
    texts = draw().texts
    assert [text for text in texts if text in measured] == measured
    del watch.summary["worst"]
    watch.levels[1] = {"level": 1, "splats": 1234, "train_psnr": 20.04}
    texts = draw().texts
    assert "No held-out views: quality is measured on training views." in texts
    assert {"Quality on training views", "Level 1: 1,234 splats, 20.0 dB"} <= set(texts)
    watch.summary = {}
    empty = draw().texts
    watch.summary = {"train_psnr": None, "veil": {"mean": "much"}, "worst": 3, "oversized": 0}
    assert draw().texts == empty, "invalid values have no line"
    watch.state, watch.problem = "interrupted", "The trainer was killed."
    layout = draw()
    assert "The trainer was killed." in layout.texts
    assert layout.operators == ["lodgs.resume_training", "lodgs.show_log", "lodgs.train", "lodgs.check_scene"]
    assert layout.buttons[-2] == "Train Again", "distinct from Resume"


def test_unsaved_file_shows_the_folder_of_its_runs(bpy, root, draw, fake, tmp_path):
    assert any(f"not saved. The run is written to {tmp_path}" in text for text in draw().texts)
    root.lodgs.training.output = str(tmp_path)
    assert not any("not saved" in text for text in draw().texts)
    root.lodgs.training.output = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert not any("not saved" in text for text in draw().texts)


def test_previous_run_can_be_opened(root, draw, fake):
    root.lodgs.training.run = "/somewhere/run"
    assert draw().operators == ["lodgs.open_run", "lodgs.train", "lodgs.check_scene"]
