"""What the training panel says and offers, drawn into a layout that takes notes."""

from types import SimpleNamespace

import pytest

NONE_HELD_OUT = "No photographs are held out: quality will be of training views."


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
    """A run that the panel believes to be followed."""
    module, folder = lodgs("runs.watch"), lodgs("training.runs.folder")
    watch = module.Watch(folder.RunFolder(tmp_path), root.session_uid)
    module.watches[root.session_uid] = watch
    return watch


def test_before_training(root, draw, fake):
    notes = draw()
    assert (notes.operators, notes.buttons) == (["lodgs.train"], ["Train"])
    assert notes.properties == ["method", "preset", "image_scale"]
    assert "3,780 steps in 5 levels" in notes.texts
    assert NONE_HELD_OUT in notes.texts
    root.lodgs.training.test_every = 8
    assert NONE_HELD_OUT not in draw().texts
    root.lodgs.training.test_every = 1
    assert "All photographs would be held out: give 0, or at least 2." in draw().texts and not draw().buttons
    root.lodgs.training.test_every = 8
    root.lodgs.training.parameters.levels = 3
    assert "3,000 steps in 3 levels" in draw().texts
    root.lodgs.training.method = "3dgs"  # which has no levels
    assert "3,000 steps" in draw().texts


def test_a_farm_is_offered_where_there_is_one(lodgs, root, draw, fake):
    preferences = lodgs("extension").preferences()
    preferences.flamenco = "http://farm:8080"
    try:
        assert draw().operators == ["lodgs.train", "lodgs.submit_to_flamenco"]
        root.lodgs.scene_folder = ""
        assert "lodgs.submit_to_flamenco" not in draw().operators
    finally:
        preferences.flamenco = ""


def test_splats_alone_ask_for_views_of_them(bpy, lodgs, root, draw, fake):
    root.lodgs.scene_folder = ""
    assert draw().operators == [] and "Not imported from photographs: nothing to train on." in draw().texts
    level = lodgs("training.splats.bundle").Level
    lodgs("data.scenes").set_level(root, level(1, lodgs("training.splats.bundle").NO_SPLATS))
    assert "FLoD needs photographs, and these splats have none." in draw().texts and not draw().operators
    settings = root.lodgs.training
    settings.method = "lodge"
    begin = ["method", "preset", "image_scale", "views_from"]
    assert draw().properties == [*begin, "views", "view_width", "show_views"]
    assert draw().operators == ["lodgs.train"]
    assert any("There is no opaque splat to look at" in text for text in draw().texts)
    assert "2,400 steps in 3 levels" in draw().texts  # none of them are the finest level's
    settings.views_from = "CURVE"
    assert draw().properties == [*begin, "curve", "views", "view_width", "show_views"]
    settings.views_from = "CAMERAS"
    assert draw().properties == [*begin, "view_width"] and "0 cameras" in draw().texts
    advanced = draw("LODGS_PT_training_advanced").properties
    without = {"region", "model", "images", "use_depth_weight", "use_depth"}
    assert not without & set(advanced) and "seed" in advanced


def test_depth_in_the_loss_is_set_as_any_parameter(lodgs, root):
    job_settings = lodgs("runs.job_settings")
    settings = root.lodgs.training
    for settings.method in ("flod", "3dgs", "tree"):
        assert not job_settings.changed_parameters(settings)
        settings.parameters.use_depth_weight = True
        settings.parameters.depth_weight, settings.parameters.depth = 0.3, "points"
        assert job_settings.changed_parameters(settings) == {"depth_weight": 0.3, "depth": "points"}
        assert job_settings.current_parameters(settings).depth_weight == 0.3


def test_a_parameter_shows_the_presets_number_until_it_is_set(root, draw):
    settings = root.lodgs.training
    common = ["region", "seed", "use_test_every", "preset_test_every", "model", "images", "output"]
    depth = ["use_depth_weight", "preset_depth_weight", "use_depth", "preset_depth"]

    def shown():
        names = draw("LODGS_PT_training_advanced").properties
        assert [name for name in names if name in depth] == depth
        return [name for name in names if name not in common + depth]

    settings.preset = "standard"
    assert draw("LODGS_PT_training_advanced").operators == ["lodgs.add_region", "lodgs.open_run"]
    assert shown() == [
        "use_levels", "preset_levels", "use_footprint", "preset_footprint", "use_max_splats",
        "preset_max_splats",
    ]  # fmt: skip
    settings.parameters.use_max_splats = True
    assert shown()[-2:] == ["use_max_splats", "max_splats"]
    assert settings.parameters.max_splats == settings.parameters.preset_max_splats == 1_000_000
    settings.method = "3dgs"
    assert shown() == ["use_max_splats", "preset_max_splats"]


def test_distances_can_be_given_by_hand(bpy, lodgs, root, draw, fake):
    """For as many levels as there will be, as the job has them; and in the scene's own lengths, if known."""
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
    assert "In median depths: half of what photographs show is nearer than 1." in draw(panel).texts
    settings.median_depth, settings.parameters.levels, settings.distances[0] = 2.0, 4, 2.6
    root.scale = (0.75, 0.75, 0.75)
    bpy.context.view_layer.update()
    assert [name for name in draw(panel).properties if name.startswith("distances")] == [
        "distances[2] Level 1 From", "distances[1] Level 2 From", "distances[0] Level 3 From",
    ]  # fmt: skip
    assert draw(panel).texts[-1].endswith("is nearer than 1, which is 1.5 m.")
    assert lodgs("runs.job_settings").current_parameters(settings).distances == (12.0, 6.0, 2.6, 0.0)
    settings.distances[1] = 30.0
    assert any("Give falling numbers" in text for text in draw().texts)
    settings.distances[1] = 0.0  # which training finds
    assert not any("Give falling numbers" in text for text in draw().texts)


def test_what_training_starts_from_is_asked_where_a_method_can_choose(root, draw, fake):
    assert "start_from" not in draw().properties
    root.lodgs.training.method = "3dgs"
    assert "start_from" in draw().properties and "base" not in draw().properties
    root.lodgs.training.start_from = "FILE"
    assert draw().properties[-2:] == ["start_from", "base"]


def test_without_a_trainer_one_sentence_and_one_button(root, draw, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    notes = draw()
    assert notes.operators == ["lodgs.make_environment"]
    assert "The trainer is not installed." in notes.texts


def test_making_the_environment_is_shown_where_it_is_missing(lodgs, root, draw, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    setup = SimpleNamespace(running=True, message="Downloading torch", fraction=0.4, problem="")
    monkeypatch.setattr(lodgs("runs.environment_setup"), "current", setup)
    notes = draw()
    assert notes.operators == ["lodgs.cancel_environment"] and "Downloading torch" in notes.texts
    setup.running, setup.problem = False, "No network. Check it."
    notes = draw()
    assert notes.operators == ["lodgs.make_environment"] and "No network. Check it." in notes.texts


def test_while_training(draw, watch):
    assert "Starting the trainer" in draw().texts
    watch.message = "Preparing to train (the first time on a computer)"
    assert {"Preparing to train", "The first time on a computer"} <= set(draw().texts)
    watch.message, watch.share = "Level 2 of 5", 1500 / 4300
    watch.progress = {
        "level": 2, "levels": 5, "step": 1500, "of": 4300, "loss": 0.1234, "psnr": 21.5, "splats": 12345,
        "steps_per_s": 12.34, "eta_s": 227.0,
    }  # fmt: skip
    notes = draw()
    assert notes.operators == ["lodgs.cancel_training"]
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
    assert facts | {"Level 2 of 5 · 35%"} <= set(notes.texts)
    watch.last_event = 0
    assert any("has not answered" in text for text in draw().texts)
    watch.cancel_requested = True
    assert "Cancel again to end it at once" in draw().texts


def test_after_training(bpy, lodgs, root, draw, watch, fake):
    watch.state, watch.message = "done", "Finished"
    watch.levels = {1: {"level": 1, "splats": 1234, "psnr": 20.04}, 2: {"level": 2, "splats": 5}}
    levels = lodgs("training.splats.bundle")
    for number in (1, 2):
        lodgs("data.scenes").set_level(root, levels.Level(number, levels.NO_SPLATS))
    notes = draw()
    first = "Level 1: 1,234 splats, 20.0 dB"
    assert {"Finished", "On held-out views:", first, "Level 2: 5 splats"} <= set(notes.texts)
    assert notes.operators == ["lodgs.train"]
    bpy.data.objects.remove(root.lodgs.levels[0].object)
    notes = draw()
    assert first not in notes.texts and "Level 2: 5 splats" in notes.texts
    assert "The run has more than is here: level 1." in notes.texts
    assert notes.operators == ["lodgs.open_run", "lodgs.train"]
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
    assert "No views were held out: quality is of training views." in texts
    assert {"On training views:", "Level 1: 1,234 splats, 20.0 dB"} <= set(texts)
    watch.summary = {}
    nothing = draw().texts
    watch.summary = {"train_psnr": None, "veil": {"mean": "much"}, "worst": 3, "oversized": 0}
    assert draw().texts == nothing, "what is odd has no line"
    watch.state, watch.problem = "interrupted", "The trainer was killed."
    notes = draw()
    assert "The trainer was killed." in notes.texts
    assert notes.operators == ["lodgs.resume_training", "lodgs.show_log", "lodgs.train"]
    assert notes.buttons[-1] == "Train Anew", "beside Resume it must not look like that"


def test_where_an_unsaved_files_run_will_lie_is_said(bpy, root, draw, fake, tmp_path):
    assert any(f"not saved yet: the run's folder will lie in {tmp_path}" in text for text in draw().texts)
    root.lodgs.training.output = str(tmp_path)
    assert not any("not saved" in text for text in draw().texts)
    root.lodgs.training.output = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert not any("not saved" in text for text in draw().texts)


def test_a_run_that_is_not_followed_can_be_opened(root, draw, fake):
    root.lodgs.training.run = "/somewhere/run"
    assert draw().operators == ["lodgs.open_run", "lodgs.train"]
