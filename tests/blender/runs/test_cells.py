"""Scenes that are trained in cells, from Blender: what is planned, how each gets on, stopped and resumed."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import COUNTS, STEPS
from training.runs.blocks.plan import plan
from training.scenes.colmap import read_scene

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def jobs(lodgs):
    return lodgs("runs.jobs")


@pytest.fixture
def job_settings(lodgs):
    return lodgs("runs.job_settings")


@pytest.fixture
def root(bpy):
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    root.lodgs.training.columns = 2
    return root


def _wait(watch, until, seconds=20.0):
    end = time.monotonic() + seconds
    while not until():
        assert watch.running, (watch.message, watch.problem)
        assert time.monotonic() < end, (watch.state, watch.blocks)
        watch.step()
        time.sleep(0.02)


def _states(watch):
    return [block["state"] for block in watch.blocks]


# -- planned -----------------------------------------------------------------------------------------------


def test_a_plan_says_what_the_trainer_will_do(bpy, lodgs, job_settings, root):
    settings = root.lodgs.training
    settings.rows, settings.method, settings.test_every = 2, "3dgs", 4
    assert bpy.ops.lodgs.plan_cells() == {"FINISHED"}
    job, scene = job_settings.make_job(root, Path("/run"), {}), read_scene(GARDEN)
    assert job.cells == "2x2"
    names = [camera.name for camera in scene.cameras]
    truth = plan(job, scene)
    assert len(settings.planned_cells) == len(truth) == 4
    for cell, planned in zip(settings.planned_cells, truth, strict=True):
        region, p = planned.region, planned.job.resolved_parameters()
        trained = {camera.name for camera in scene.split(4)[0]}
        assert (cell.views, cell.splats, cell.steps) == (
            len(trained & set(region.views)), p.max_splats, p.total_steps,
        )  # fmt: skip
        assert cell.points == region.start_points(scene).sum()
        assert cell.megabytes == pytest.approx(planned.memory / 1e6)
        assert [names[place] for place in json.loads(cell.places)] == list(region.views)
        eyes, frames = lodgs("data.cells").eyes(root, cell)
        centers = [camera.center for camera in scene.cameras if camera.name in region.views]
        np.testing.assert_allclose(eyes, centers, atol=1e-4)
        assert frames.shape == (len(eyes), 4, 3)


def test_outlines_meet_on_the_ground_and_hold_their_cameras(bpy, lodgs, root):
    settings = root.lodgs.training
    settings.rows = 2
    bpy.ops.lodgs.plan_cells()
    scene = read_scene(GARDEN)
    up = scene.up_rotation()[2]
    corners = np.array([cell.outline for cell in settings.planned_cells]).reshape(4, 4, 3)
    enlarged = np.array([cell.enlarged for cell in settings.planned_cells]).reshape(4, 4, 3)
    heights = np.concatenate([corners, enlarged]) @ up
    np.testing.assert_allclose(heights, np.quantile(scene.points @ up, 0.01), atol=1e-3)

    def sides(outline):
        return np.linalg.norm(outline[[1, 3]] - outline[0], axis=1)

    def around(outline, places):
        along = (outline[[1, 3]] - outline[0]) / sides(outline)[:, None] ** 2
        return ((s := (places - outline[0]) @ along.T) > -1e-4).all(axis=1) & (s < 1 + 1e-4).all(axis=1)

    centers = np.array([camera.center for camera in scene.cameras])
    stand = [around(outline, centers) for outline in corners]
    assert (np.sum(stand, axis=0) == 1).all(), "each camera stands in one cell"
    for inner, outer, cell in zip(corners, enlarged, settings.planned_cells, strict=True):
        assert around(outer, inner).all() and (sides(outer) > 1.05 * sides(inner)).all()
        assert set(np.flatnonzero(around(outer, centers))) <= set(json.loads(cell.places))


def test_a_plan_is_for_the_settings_that_it_was_made_with(bpy, lodgs, job_settings, root, tmp_path):
    cells, settings = lodgs("data.cells"), root.lodgs.training
    bpy.ops.lodgs.plan_cells()

    def fits():
        return cells.is_planned(settings, job_settings.make_job(root, tmp_path, {}))

    assert fits()
    settings.seed = 9
    assert fits(), "on which no plan depends"
    for name, value in (("rows", 2), ("preset", "standard"), ("test_every", 3), ("method", "3dgs")):
        setattr(settings, name, value)
        assert not fits()
        bpy.ops.lodgs.plan_cells()
        assert fits()
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    settings = root.lodgs.training
    assert fits() and len(settings.planned_cells) == 4


def test_what_cannot_be_divided_is_refused_in_a_sentence(bpy, root, tmp_path, fake):
    fake()
    settings = root.lodgs.training
    settings.columns = 30
    with pytest.raises(RuntimeError, match="48 views are too few for 30x1 cells"):
        bpy.ops.lodgs.plan_cells()
    assert not settings.planned_cells and not settings.planned_for
    settings.rows = 30
    with pytest.raises(RuntimeError, match="256 cells at most"):
        bpy.ops.lodgs.plan_cells()
    settings.columns = settings.rows = 2
    settings.method = "octree_neural"
    for operator in (bpy.ops.lodgs.plan_cells, bpy.ops.lodgs.train):
        with pytest.raises(RuntimeError, match="cannot train cells one by one"):
            operator()
    settings.method, settings.start_from = "lodge", "SCENE"
    with pytest.raises(RuntimeError, match="Choose Points in Start From"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


# -- trained -----------------------------------------------------------------------------------------------


def test_cells_are_trained_and_followed(bpy, lodgs, jobs, fake, root, tmp_path):
    fake()
    settings = root.lodgs.training
    watch = jobs.start(root, str(tmp_path / "run"))
    assert lodgs("training.runs.job").Job.from_file(tmp_path / "run" / "job.toml").cells == "2x1"
    _wait(watch, lambda: [block["step"] for block in watch.blocks] == [STEPS // 2] * 2)
    assert _states(watch) == ["running"] * 2 and watch.fraction == 0.5
    assert len(settings.planned_cells) == 2, "for the list, though nothing was planned"
    (tmp_path / "run" / "go on").touch()
    jobs.follow(watch)
    assert (watch.state, watch.problem, _states(watch)) == ("done", "", ["done"] * 2)
    assert {item.number: len(item.object.data.points) for item in root.lodgs.levels} == COUNTS
    assert "--on here" in watch.folder.log_tail()


def test_one_cell_is_stopped_and_goes_on_beside_the_others(bpy, jobs, fake, root, tmp_path):
    fake()
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.blocks)
    with pytest.raises(RuntimeError, match="Cell 2 of 'lantern_garden' has nothing to go on with"):
        bpy.ops.lodgs.resume_block(block=2)
    assert bpy.ops.lodgs.cancel_block(block=2) == {"FINISHED"}
    assert watch.stopping == {("block", 2)}
    _wait(watch, lambda: _states(watch) == ["running", "cancelled"])
    assert not watch.stopping
    for number in (2, 3):
        with pytest.raises(RuntimeError, match=f"Cell {number} of 'lantern_garden' is not being trained"):
            bpy.ops.lodgs.cancel_block(block=number)
    assert bpy.ops.lodgs.resume_block(block=2) == {"FINISHED"}
    _wait(watch, lambda: _states(watch) == ["running"] * 2)
    (tmp_path / "run" / "go on").touch()
    jobs.follow(watch)
    assert watch.state == "done"


def test_all_are_stopped_and_one_goes_on_alone_or_all_do(bpy, lodgs, jobs, fake, root, tmp_path):
    fake()
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.blocks)
    assert bpy.ops.lodgs.cancel_training() == {"FINISHED"}
    jobs.follow(watch)
    assert (watch.state, watch.problem) == ("cancelled", "")
    with pytest.raises(RuntimeError, match="is not being trained"):
        bpy.ops.lodgs.cancel_block(block=1)
    (tmp_path / "run" / "go on").touch()
    with pytest.raises(RuntimeError, match="Cell 3"):
        bpy.ops.lodgs.resume_block(block=3)
    bpy.ops.lodgs.resume_block(block=1)
    watch = lodgs("runs.watch").watch_of(root)
    assert (watch.state, _states(watch)) == ("cancelled", ["done", "cancelled"])
    with pytest.raises(RuntimeError, match="nothing to go on with"):
        bpy.ops.lodgs.resume_block(block=1)
    assert bpy.ops.lodgs.resume_training() == {"FINISHED"}
    watch = lodgs("runs.watch").watch_of(root)
    assert (watch.state, _states(watch)) == ("done", ["done"] * 2)


def test_a_file_opened_again_finds_its_cells(bpy, lodgs, jobs, fake, root, tmp_path):
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    fake()
    watch = jobs.start(root)
    bpy.ops.wm.save_mainfile()  # before the list is there
    _wait(watch, lambda: watch.blocks)
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=blend)
    root = bpy.data.objects["lantern_garden"]
    found = lodgs("runs.watch").watch_of(root)
    assert found is not watch and found.running and found.process is None and len(found.blocks) == 2
    _wait(found, lambda: len(root.lodgs.training.planned_cells) == 2)
    jobs.cancel_block(root, 1)
    _wait(found, lambda: _states(found)[0] == "cancelled")
    jobs.cancel(root)
    _wait(found, lambda: not found.running)


def test_cells_at_once_need_dask(bpy, lodgs, jobs, fake, root, tmp_path):
    fake("no_dask")
    root.lodgs.training.at_once = 3
    with pytest.raises(RuntimeError, match=r"3 cells at once needs Dask.*set Cells at Once to 1"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    root.lodgs.training.columns = 1  # no cells
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "whole")) == {"FINISHED"}
    root.lodgs.training.columns = 2
    fake()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "go on").touch()
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "run")) == {"FINISHED"}
    assert "--on local:3" in lodgs("training.runs.folder").RunFolder(tmp_path / "run").log_tail()


def test_a_second_cancel_ends_every_cells_trainer(lodgs, jobs, fake, root, tmp_path, monkeypatch):
    """The run's own may not listen; what its cells' trainers are doing ends as well."""
    fake()
    folder, ended = lodgs("training.runs.folder").RunFolder, []
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.blocks)
    monkeypatch.setattr(folder, "end", lambda run: ended.append(run.path.name))
    watch.cancel_requested = True
    jobs.cancel(root)
    assert ended == ["1", "2"]
    _wait(watch, lambda: not watch.running)
    assert watch.state == "interrupted"


def test_the_panel_shows_a_jobs_cells(lodgs, job_settings, root, tmp_path):
    job = lodgs("training.runs.job").Job("/scene", "/run", "3dgs", cells="3x2")
    job_settings.apply_job(root.lodgs.training, job)
    assert job_settings.make_job(root, tmp_path, {}).cells == "3x2"
    job_settings.apply_job(root.lodgs.training, lodgs("training.runs.job").Job("/scene", "/run"))
    assert job_settings.make_job(root, tmp_path, {}).cells == ""
