"""Every verb is in a menu, the status bar tells of what is at work, and runs can be switched between."""

from pathlib import Path
from types import SimpleNamespace

import pytest

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
ELSEWHERE = {
    # File's menus
    "lodgs.import_colmap", "lodgs.find_cameras", "lodgs.import_splats", "lodgs.export_bundle",
    "lodgs.export_plain", "lodgs.export_folder", "lodgs.export_streamed",
    # Object's and View's
    "lodgs.set_ground", "lodgs.set_scale", "lodgs.camera_path", "lodgs.turntable", "lodgs.frame_scene",
    "lodgs.add_crop", "lodgs.hide_splats", "lodgs.show_hidden_splats", "lodgs.delete_left_out",
    "lodgs.select_all_splats",
    # strokes of the toolbar's tools
    "lodgs.select_splats", "lodgs.paint_splats",
}  # fmt: skip


def test_every_verb_is_in_a_menu(bpy, lodgs):
    operators = lodgs("operators")
    ours = {
        cls.bl_idname
        for module in operators.MODULES
        for cls in getattr(module, "CLASSES", ())
        if "_OT_" in cls.__name__ and "INTERNAL" not in getattr(cls, "bl_options", ())
    }
    listed = [name for group in lodgs("panels.verbs").VERBS for name in group]
    assert len(listed) == len(set(listed)) and not set(listed) & ELSEWHERE
    assert set(listed) | ELSEWHERE == ours
    labels = [name_of(bpy, name) for name in listed]
    assert len(labels) == len(set(labels)), "none is called as another"
    assert all(" " in label for label in labels), "each says what is done to what"


def name_of(bpy, operator):
    group, name = operator.split(".")
    return getattr(getattr(bpy.ops, group), name).get_rna_type().name


class Notes:
    def __init__(self):
        self.texts, self.operators = [], []

    def row(self, **_):
        return self

    def label(self, text="", icon=""):
        self.texts.append((text, icon))

    def progress(self, text, factor):
        self.texts.append((text, factor))

    def operator(self, name, text="", icon=""):
        self.operators.append((name, text, icon, chosen := SimpleNamespace()))
        return chosen


@pytest.fixture
def work(lodgs, monkeypatch):
    work = SimpleNamespace(message="Photographs placed: 3 of 6", fraction=0.5, problem="", running=True)
    monkeypatch.setattr(lodgs("runs.photo_preparation"), "current", work)
    return work


def test_one_step_is_open_at_a_time(bpy, lodgs, draw_panel, tmp_path, fake):
    """What an artist who begins is not to do yet, or has done, is folded."""
    panels = [
        cls
        for module in lodgs("panels").MODULES
        for cls in getattr(module, "CLASSES", ())
        if getattr(cls, "bl_category", "") == "LODGS" and not hasattr(cls, "bl_parent_id")
    ]

    def begin_open():
        return {
            cls.bl_label
            for cls in panels
            if "DEFAULT_CLOSED" not in getattr(cls, "bl_options", ())
            and (not hasattr(cls, "poll") or cls.poll(bpy.context))
        }

    assert begin_open() == {"Scene"} and draw_panel("scene", "LODGS_PT_scene").folded == []
    fake()
    root = lodgs("data.scenes").import_colmap(bpy.context, GARDEN, photographs=False)
    assert begin_open() == {"Scene", "Training"}
    assert draw_panel("training", "LODGS_PT_training").folded == []
    root.lodgs.training.output = str(tmp_path / "runs")
    assert bpy.ops.lodgs.train() == {"FINISHED"}
    assert begin_open() == {"Scene", "Training", "Levels", "Detail", "Viewport"}
    assert draw_panel("training", "LODGS_PT_training").folded == ["LODGS_train_anew"]
    assert draw_panel("scene", "LODGS_PT_scene").folded == ["LODGS_import_another"]


def test_the_status_bar_tells_of_work_and_for_a_while_of_its_end(bpy, lodgs, work, monkeypatch):
    status, timers = lodgs("panels.status"), []
    monkeypatch.setattr(
        bpy.app.timers, "register", lambda do, first_interval, persistent: timers.append((do, first_interval))
    )
    (now,) = status.visible_work(100.0)
    assert now.running and (now.text, now.share) == ("Photographs placed: 3 of 6", 0.5)
    work.running, work.message = False, "All 6 photographs found their place."
    assert (
        [each.text for each in status.visible_work(110.0)]
        == [work.message]
        == [each.text for each in status.visible_work(111.0)]
    )
    assert timers == [(status.extension.redraw, status.NOTICE)], "it goes by itself"
    assert status.visible_work(110.0 + status.NOTICE - 1) and not status.visible_work(
        110.0 + status.NOTICE + 1
    )
    work.running, work.message, work.fraction = True, "Again", 0.1
    monkeypatch.setattr(status.time, "monotonic", lambda: 300.0)
    notes = Notes()
    status._draw(SimpleNamespace(layout=notes), None)
    assert notes.texts == [("Again", 0.1)]
    work.running, work.problem = False, "No."
    notes = Notes()
    status._draw(SimpleNamespace(layout=notes), None)
    assert notes.texts == [("Again", "ERROR")]


def test_what_ended_before_it_was_seen_is_no_news(lodgs, work):
    work.running = False
    assert lodgs("panels.status").shown(0.0) == []


def test_another_work_at_the_place_of_one_that_is_gone_is_another(lodgs, work):
    """An object that is gone leaves its identity to the next."""
    status, photo_preparation = lodgs("panels.status"), lodgs("runs.photo_preparation")
    state = {**vars(work), "running": False}
    for _ in range(20):
        photo_preparation.current = SimpleNamespace(**{**state, "running": True})
        assert len(status.visible_work(0.0)) == 1
        photo_preparation.current = None
        photo_preparation.current = SimpleNamespace(**state)
        assert status.visible_work(1.0) == []


def test_runs_of_a_scene_are_listed_and_opened(bpy, lodgs, tmp_path, fake):
    fake()
    root = lodgs("data.scenes").import_colmap(bpy.context, GARDEN, photographs=False)
    jobs = lodgs("runs.jobs")
    run_folders = lodgs("runs.run_folders")
    root.lodgs.training.output = str(tmp_path / "runs")
    assert run_folders.find_runs(root) == []
    for _ in range(2):
        jobs.follow(jobs.start(root))
    other = tmp_path / "runs" / "other"
    other.mkdir()
    (other / "job.toml").write_text('scene = "/nowhere"\nout = "."\nmethod = "flod"\n')
    (tmp_path / "runs" / "broken").mkdir()
    (tmp_path / "runs" / "broken" / "job.toml").write_text("]")
    first, second = run_folders.find_runs(root)
    assert first.state == second.state == "done" and second.folder.path == run_folders.run_folder(root).path
    notes = Notes()
    lodgs("panels.verbs").LODGS_MT_runs.draw(SimpleNamespace(layout=notes), bpy.context)
    (name, text, icon, chosen), (_, _, icon_of_second, _) = notes.operators
    assert name == "lodgs.open_run" and "FLoD" in text and "done" in text
    assert (icon, icon_of_second) == ("RADIOBUT_OFF", "RADIOBUT_ON")
    assert bpy.ops.lodgs.open_run(directory=chosen.directory) == {"FINISHED"}
    assert run_folders.run_folder(root).path == first.folder.path and any(
        item.exists for item in root.lodgs.levels
    )
