"""What the training panel says and offers, drawn into a layout that takes notes."""

from types import SimpleNamespace

import pytest


class Notes:
    """A layout that remembers its texts and operators and is its own row, column and box."""

    def __init__(self):
        self.texts: list[str] = []
        self.operators: list[str] = []
        self.properties: list[str] = []

    def row(self, **_):
        return self

    column = box = grid_flow = row

    def label(self, text="", **_):
        self.texts.append(text)

    def progress(self, text, factor):
        assert 0 <= factor <= 1
        self.texts.append(text)

    def operator(self, name, **_):
        self.operators.append(name)
        return SimpleNamespace()

    def prop(self, owner, name, **_):
        assert hasattr(owner, name)
        self.properties.append(name)


@pytest.fixture
def root(bpy, tmp_path):
    collection = bpy.data.collections.new("tiny")
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new("tiny", None)
    collection.objects.link(root)
    root.lodgs.is_root, root.lodgs.scene_folder = True, str(tmp_path)
    return root


@pytest.fixture
def draw(bpy, lodgs, monkeypatch):
    module = lodgs("panels.training")
    monkeypatch.setattr(module, "say", lambda layout, text, icon: layout.label(text=text))

    def drawn(panel="LODGS_PT_training"):
        notes = Notes()
        getattr(module, panel).draw(SimpleNamespace(layout=notes), bpy.context)
        return notes

    return drawn


@pytest.fixture
def watch(lodgs, root, tmp_path):
    """A run that the panel believes to be followed."""
    jobs, folder = lodgs("jobs"), lodgs("training.runs.folder")
    watch = jobs.Watch(folder.RunFolder(tmp_path), root.session_uid)
    jobs._watches[root.session_uid] = watch
    return watch


def test_before_training(root, draw, fake):
    notes = draw()
    assert notes.operators == ["lodgs.train"]
    assert notes.properties == ["method", "preset", "image_scale"]
    assert "4,300 steps in 5 levels" in notes.texts
    root.lodgs.training.method, root.lodgs.training.levels = "3dgs", 3  # which is hidden
    assert "4,300 steps in 1 level" in draw().texts
    assert "footprint" not in draw("LODGS_PT_training_advanced").properties


def test_without_a_trainer_one_sentence_and_one_button(root, draw, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    notes = draw()
    assert notes.operators == ["lodgs.make_environment"]
    assert "Training and rendering need a Python with PyTorch, and none is set up." in notes.texts


def test_making_the_environment_is_shown_where_it_is_missing(lodgs, root, draw, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    making = SimpleNamespace(running=True, message="Downloading torch", fraction=0.4, problem="")
    monkeypatch.setattr(lodgs("environment"), "making", making)
    notes = draw()
    assert notes.operators == ["lodgs.cancel_environment"] and "Downloading torch" in notes.texts
    making.running, making.problem = False, "No network. Check it."
    notes = draw()
    assert notes.operators == ["lodgs.make_environment"] and "No network. Check it." in notes.texts


def test_while_training(draw, watch):
    assert "Starting the trainer" in draw().texts
    watch.message = "Preparing the kernels (the first time on a computer)"
    assert {"Preparing the kernels", "The first time on a computer"} <= set(draw().texts)
    watch.message = "Level 2 of 5"
    watch.progress = {
        "level": 2, "levels": 5, "step": 1500, "of": 4300, "loss": 0.1234, "psnr": 21.5, "splats": 12345,
        "steps_per_s": 12.34, "eta_s": 227.0,
    }  # fmt: skip
    notes = draw()
    assert notes.operators == ["lodgs.cancel_training"]
    facts = {"2 of 5", "1,500 of 4,300", "0.1234", "21.5 dB", "12,345", "12.3 steps/s", "4 min"}
    assert facts | {"Level 2 of 5 · 35%"} <= set(notes.texts)
    watch.heard = 0
    assert any("has not answered" in text for text in draw().texts)
    watch.asked = True
    assert "Cancel again to end it at once" in draw().texts


def test_after_training(draw, watch, fake):
    watch.state, watch.message = "done", "Finished"
    watch.levels = {1: {"level": 1, "splats": 1234, "psnr": 20.04}, 2: {"level": 2, "splats": 5}}
    notes = draw()
    assert {"Finished", "Level 1: 1,234 splats, 20.0 dB", "Level 2: 5 splats"} <= set(notes.texts)
    assert notes.operators == ["lodgs.train"]
    watch.state, watch.problem = "interrupted", "The trainer was killed."
    notes = draw()
    assert "The trainer was killed." in notes.texts
    assert notes.operators == ["lodgs.resume_training", "lodgs.show_log", "lodgs.train"]


def test_a_run_that_is_not_followed_can_be_opened(root, draw, fake):
    root.lodgs.training.run = "/somewhere/run"
    assert draw().operators == ["lodgs.open_run", "lodgs.train"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (89, "89 s"), (150, "2 min"), (3600, "1 h 00 min"), (7500, "2 h 05 min")],
)
def test_durations_read_well(lodgs, seconds, text):
    assert lodgs("panels.training").duration(seconds) == text
