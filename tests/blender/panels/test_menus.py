"""The menus list every operator, the status bar shows background work, and the runs menu switches runs."""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.blender.panels.conftest import RecordingLayout

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
OTHER_MENUS = {
    # File menu
    "lodgs.import_colmap", "lodgs.find_cameras", "lodgs.import_splats", "lodgs.export_bundle",
    "lodgs.export_compressed", "lodgs.export_plain", "lodgs.export_folder", "lodgs.export_streamed",
    "lodgs.export_levels", "lodgs.export_tiles", "lodgs.export_page",
    # Object and View menus
    "lodgs.set_ground", "lodgs.set_scale", "lodgs.camera_path", "lodgs.turntable", "lodgs.frame_scene",
    "lodgs.add_crop", "lodgs.hide_splats", "lodgs.show_hidden_splats", "lodgs.delete_hidden_splats",
    "lodgs.select_all_splats", "lodgs.find_clutter",
    # toolbar tools
    "lodgs.select_splats", "lodgs.paint_splats",
}  # fmt: skip


def test_menus_list_every_operator(bpy, lodgs):
    operators = lodgs("operators")
    public = {
        cls.bl_idname
        for module in operators.MODULES
        for cls in getattr(module, "CLASSES", ())
        if "_OT_" in cls.__name__ and "INTERNAL" not in getattr(cls, "bl_options", ())
    }
    listed = [name for group in lodgs("panels.menus").OPERATORS for name in group]
    assert len(listed) == len(set(listed)) and not set(listed) & OTHER_MENUS
    assert set(listed) | OTHER_MENUS == public
    labels = [label_of(bpy, name) for name in listed]
    assert len(labels) == len(set(labels)), "labels are unique"
    assert all(" " in label for label in labels), "labels have a verb and an object"
    assert not [label for label in labels if label.endswith("…")], "buttons add it; it is no part of a title"


def label_of(bpy, operator):
    group, name = operator.split(".")
    return getattr(getattr(bpy.ops, group), name).get_rna_type().name


class StatusLayout:
    """A layout that records texts with their icon or progress, and operators."""

    def __init__(self):
        self.texts, self.operators = [], []

    def row(self, **_):
        return self

    def label(self, text="", icon=""):
        self.texts.append((text, icon))

    def progress(self, text, factor):
        self.texts.append((text, factor))

    def operator(self, name, text="", icon=""):
        self.operators.append((name, text, icon, properties := SimpleNamespace()))
        return properties


@pytest.fixture
def work(lodgs, monkeypatch):
    work = SimpleNamespace(message="Photos placed: 3 of 6", fraction=0.5, problem="", running=True)
    monkeypatch.setattr(lodgs("runs.photo_preparation"), "current", work)
    return work


def test_labels_fit_the_button_of_the_file_browser(lodgs):
    """Blender shows the operator's label there, in a button that is as wide as about 18 letters."""
    modules = lodgs("operators").MODULES
    operators = [cls for module in modules for cls in getattr(module, "CLASSES", ())]
    with_browser = [cls for cls in operators if {"filepath", "directory"} & {*dir(cls), *_annotations(cls)}]
    assert len(with_browser) > 10
    assert [cls.bl_label for cls in with_browser if len(cls.bl_label) > 18] == []


def _annotations(cls):
    return {name for base in cls.__mro__ for name in vars(base).get("__annotations__", ())}


def test_panels_of_the_current_step_are_open(bpy, lodgs, draw_panel, tmp_path, fake):
    """Panels of later and finished steps are collapsed."""
    panels = [
        cls
        for module in lodgs("panels").MODULES
        for cls in getattr(module, "CLASSES", ())
        if getattr(cls, "bl_category", "") == "LODGS" and not hasattr(cls, "bl_parent_id")
    ]

    def open_panels():
        return {
            cls.bl_label
            for cls in panels
            if "DEFAULT_CLOSED" not in getattr(cls, "bl_options", ())
            and (not hasattr(cls, "poll") or cls.poll(bpy.context))
        }

    assert open_panels() == {"Scene"} and draw_panel("scene", "LODGS_PT_scene").collapsed == []
    fake()
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    assert open_panels() == {"Scene", "Training"}
    assert draw_panel("training", "LODGS_PT_training").collapsed == []
    root.lodgs.training.output = str(tmp_path / "runs")
    assert bpy.ops.lodgs.train() == {"FINISHED"}
    assert open_panels() == {"Scene", "Training", "Levels", "Detail", "Viewport"}
    assert draw_panel("training", "LODGS_PT_training").collapsed == ["LODGS_train_again"]
    assert draw_panel("scene", "LODGS_PT_scene").collapsed == ["LODGS_import_another"]


def test_status_bar_shows_work_and_a_notice_of_its_end(bpy, lodgs, work, monkeypatch):
    status, timers = lodgs("panels.status"), []
    monkeypatch.setattr(
        bpy.app.timers, "register", lambda do, first_interval, persistent: timers.append((do, first_interval))
    )
    (running,) = status.visible_work(100.0)
    assert running.running and (running.text, running.share) == ("Photos placed: 3 of 6", 0.5)
    work.running, work.message = False, "All 6 photos placed."
    for time in (110.0, 111.0, 110.0 + status.NOTICE - 1):
        assert [ended.text for ended in status.visible_work(time)] == [work.message]
    assert timers == [(status.extension.redraw, status.NOTICE)], "a timer removes the notice"
    assert not status.visible_work(110.0 + status.NOTICE + 1)
    work.running, work.message, work.fraction = True, "Again", 0.1
    monkeypatch.setattr(status.time, "monotonic", lambda: 300.0)
    layout = StatusLayout()
    status._draw(SimpleNamespace(layout=layout), None)
    assert layout.texts == [("Again", 0.1)]
    work.running, work.problem = False, "No."
    layout = StatusLayout()
    status._draw(SimpleNamespace(layout=layout), None)
    assert layout.texts == [("Again", "ERROR")]


def test_status_bar_omits_notes_of_the_trainer(lodgs, monkeypatch):
    """The bar is as wide as a few words."""
    watch = SimpleNamespace(
        message="Preparing (up to a minute on first use)", fraction=0, running=True, problem=""
    )
    monkeypatch.setattr(lodgs("panels.status"), "watches", {-1: watch})
    texts = [work.text for work in lodgs("panels.status").all_work()]
    assert "Splats: Preparing" in texts  # others may have finished work of other tests


def test_work_that_ended_unobserved_has_no_notice(lodgs, work):
    work.running = False
    assert lodgs("panels.status").visible_work(0.0) == []


def test_new_work_with_a_reused_id_has_no_notice(lodgs, work):
    """Python may reuse the id of a deleted object."""
    status, photo_preparation = lodgs("panels.status"), lodgs("runs.photo_preparation")
    state = {**vars(work), "running": False}
    for _ in range(20):
        photo_preparation.current = SimpleNamespace(**{**state, "running": True})
        assert len(status.visible_work(0.0)) == 1
        photo_preparation.current = None
        photo_preparation.current = SimpleNamespace(**state)
        assert status.visible_work(1.0) == []


@pytest.mark.one_blender
def test_runs_of_a_scene_are_listed_and_opened(bpy, lodgs, tmp_path, fake):
    fake()
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    jobs = lodgs("runs.jobs")
    run_folders = lodgs("runs.run_folders")
    root.lodgs.training.output = str(tmp_path / "runs")
    assert run_folders.find_runs(root) == []
    for _ in range(2):
        jobs.follow(jobs.start(root))
    foreign = tmp_path / "runs" / "other"
    foreign.mkdir()
    (foreign / "job.toml").write_text('scene = "/nowhere"\nout = "."\nmethod = "flod"\n')
    (tmp_path / "runs" / "broken").mkdir()
    (tmp_path / "runs" / "broken" / "job.toml").write_text("]")
    first, second = run_folders.find_runs(root)
    assert first.state == second.state == "done" and second.folder.path == run_folders.run_folder(root).path
    layout = StatusLayout()
    lodgs("panels.menus").LODGS_MT_runs.draw(SimpleNamespace(layout=layout), bpy.context)
    (name, text, icon, properties), (_, _, icon_of_second, _) = layout.operators
    assert name == "lodgs.open_run" and "FLoD" in text and "done" in text
    assert (icon, icon_of_second) == ("RADIOBUT_OFF", "RADIOBUT_ON")
    assert bpy.ops.lodgs.open_run(directory=properties.directory) == {"FINISHED"}
    assert run_folders.run_folder(root).path == first.folder.path and any(
        item.exists for item in root.lodgs.levels
    )
    (tmp_path / "blends").mkdir()
    root.lodgs.scene_folder = "//" + os.path.relpath(GARDEN, tmp_path / "blends")
    root.lodgs.training.run = "//../runs/" + first.folder.path.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "blends" / "b.blend"))
    assert len(run_folders.find_runs(root)) == 2
    layout.operators.clear()
    lodgs("panels.menus").LODGS_MT_runs.draw(SimpleNamespace(layout=layout), bpy.context)
    assert [icon for _, _, icon, _ in layout.operators] == ["RADIOBUT_ON", "RADIOBUT_OFF"]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("folder", ["placed", "looked", "replace"]),
        ("tiles", ["placed", "looked", "antialiased"]),
        ("streamed", ["placed", "looked", "antialiased", "lod_errors"]),
        ("page", ["placed", "looked"]),
    ],
)
def test_exports_to_folders_show_their_options(bpy, lodgs, monkeypatch, name, options):
    export, layout = lodgs("operators.export"), RecordingLayout()
    operator = getattr(export, f"LODGS_OT_export_{name}")
    monkeypatch.setattr(export, "_size", lambda *arguments: "8.6 MB")
    values = dict.fromkeys(getattr(bpy.ops.lodgs, f"export_{name}").get_rna_type().properties.keys(), False)
    dialog = SimpleNamespace(layout=layout, bl_rna=operator.bl_rna, kind=operator.kind, **values)
    operator.draw(dialog, bpy.context)
    assert layout.properties == options
    assert layout.texts == ["Estimated size: 8.6 MB"]
