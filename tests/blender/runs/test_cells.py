"""Training of a scene in cells from Blender: plan, progress, cancel and resume."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import COUNTS, STEPS
from training.runs.cells.plan import plan
from training.scenes.colmap import read_scene

pytestmark = pytest.mark.one_blender


GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy):
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    root.lodgs.training.columns = 2
    return root


def _wait(watch, until, seconds=200.0):
    end = time.monotonic() + seconds
    while not until():
        assert watch.running, (watch.message, watch.problem)
        assert time.monotonic() < end, (watch.state, watch.parts)
        watch.step()
        time.sleep(0.02)


def _states(watch):
    return [part["state"] for part in watch.parts]


# -- plan --------------------------------------------------------------------------------------------------


def test_plan_matches_the_plan_of_the_trainer(bpy, lodgs, job_settings, root):
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
        assert [names[index] for index in json.loads(cell.view_indices)] == list(region.views)
        centers_in_blender, frames = lodgs("data.cells").cell_cameras(root, cell)
        centers = [camera.center for camera in scene.cameras if camera.name in region.views]
        np.testing.assert_allclose(centers_in_blender, centers, atol=1e-4)
        assert frames.shape == (len(centers_in_blender), 4, 3)


def test_outlines_lie_on_the_ground_and_contain_their_cameras(bpy, lodgs, root):
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

    def contains(outline, points):
        axes = (outline[[1, 3]] - outline[0]) / sides(outline)[:, None] ** 2
        return ((s := (points - outline[0]) @ axes.T) > -1e-4).all(axis=1) & (s < 1 + 1e-4).all(axis=1)

    centers = np.array([camera.center for camera in scene.cameras])
    inside = [contains(outline, centers) for outline in corners]
    assert (np.sum(inside, axis=0) == 1).all(), "each camera is in one cell"
    for inner, outer, cell in zip(corners, enlarged, settings.planned_cells, strict=True):
        assert contains(outer, inner).all() and (sides(outer) > 1.05 * sides(inner)).all()
        assert set(np.flatnonzero(contains(outer, centers))) <= set(json.loads(cell.view_indices))


def test_plan_is_outdated_by_changed_settings(bpy, lodgs, job_settings, root, tmp_path):
    cells, settings = lodgs("data.cells"), root.lodgs.training
    bpy.ops.lodgs.plan_cells()

    def is_current():
        return cells.is_planned(settings, job_settings.make_job(root, tmp_path, {}))

    assert is_current()
    settings.seed = 9
    assert is_current(), "the plan does not depend on the seed"
    for name, value in (("rows", 2), ("preset", "standard"), ("test_every", 3), ("method", "3dgs")):
        setattr(settings, name, value)
        assert not is_current()
        bpy.ops.lodgs.plan_cells()
        assert is_current()
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    settings = root.lodgs.training
    assert is_current() and len(settings.planned_cells) == 4


def test_impossible_plans_are_rejected(bpy, root, tmp_path, fake):
    fake()
    settings = root.lodgs.training
    settings.columns = 30
    with pytest.raises(RuntimeError, match="30x1 cells with 48 views"):
        bpy.ops.lodgs.plan_cells()
    assert not settings.planned_cells and not settings.planned_for
    settings.rows = 30
    with pytest.raises(RuntimeError, match="at most 256 cells"):
        bpy.ops.lodgs.plan_cells()
    settings.columns = settings.rows = 2
    settings.method = "octree_neural"
    for operator in (bpy.ops.lodgs.plan_cells, bpy.ops.lodgs.train):
        with pytest.raises(RuntimeError, match="cannot train a scene in cells"):
            operator()
    settings.method, settings.start_from = "lodge", "SCENE"
    with pytest.raises(RuntimeError, match="Choose Points in Start From"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


# -- training ----------------------------------------------------------------------------------------------


def test_cells_are_trained(bpy, lodgs, jobs, fake, root, tmp_path):
    fake()
    settings = root.lodgs.training
    watch = jobs.start(root, str(tmp_path / "run"))
    assert lodgs("training.runs.job").Job.from_file(tmp_path / "run" / "job.toml").cells == "2x1"
    _wait(watch, lambda: [part["step"] for part in watch.parts] == [STEPS // 2] * 2)
    assert _states(watch) == ["running"] * 2 and watch.fraction == 0.5
    assert len(settings.planned_cells) == 2, "the list needs them without a plan"
    (tmp_path / "run" / "go on").touch()
    jobs.follow(watch)
    assert (watch.state, watch.problem, _states(watch)) == ("done", "", ["done"] * 2)
    assert {item.number: len(item.object.data.points) for item in root.lodgs.levels} == COUNTS
    assert "--on here" in watch.folder.log_tail()


def test_one_cell_is_cancelled_and_resumed(bpy, jobs, fake, root, tmp_path):
    fake()
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.parts)
    with pytest.raises(RuntimeError, match="Cannot resume cell 2 of 'lantern_garden'"):
        bpy.ops.lodgs.resume_cell(cell=2)
    assert bpy.ops.lodgs.cancel_cell(cell=2) == {"FINISHED"}
    assert watch.stopping == {("block", 2)}
    _wait(watch, lambda: _states(watch) == ["running", "cancelled"])
    assert not watch.stopping
    for number in (2, 3):
        with pytest.raises(RuntimeError, match=f"cell {number} of 'lantern_garden': it is not being trained"):
            bpy.ops.lodgs.cancel_cell(cell=number)
    assert bpy.ops.lodgs.resume_cell(cell=2) == {"FINISHED"}
    _wait(watch, lambda: _states(watch) == ["running"] * 2)
    (tmp_path / "run" / "go on").touch()
    jobs.follow(watch)
    assert watch.state == "done"


def test_cancelled_run_resumes_one_or_all_cells(bpy, lodgs, jobs, fake, root, tmp_path):
    fake()
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.parts)
    assert bpy.ops.lodgs.cancel_training() == {"FINISHED"}
    jobs.follow(watch)
    assert (watch.state, watch.problem) == ("cancelled", "")
    with pytest.raises(RuntimeError, match="it is not being trained"):
        bpy.ops.lodgs.cancel_cell(cell=1)
    (tmp_path / "run" / "go on").touch()
    with pytest.raises(RuntimeError, match="cell 3"):
        bpy.ops.lodgs.resume_cell(cell=3)
    bpy.ops.lodgs.resume_cell(cell=1)
    watch = lodgs("runs.watch").watch_of(root)
    assert (watch.state, _states(watch)) == ("cancelled", ["done", "cancelled"])
    with pytest.raises(RuntimeError, match="it is not stopped"):
        bpy.ops.lodgs.resume_cell(cell=1)
    assert bpy.ops.lodgs.resume_training() == {"FINISHED"}
    watch = lodgs("runs.watch").watch_of(root)
    assert (watch.state, _states(watch)) == ("done", ["done"] * 2)


def test_reopened_file_attaches_to_its_cells(bpy, lodgs, jobs, fake, root, tmp_path):
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    fake()
    watch = jobs.start(root)
    bpy.ops.wm.save_mainfile()  # before the run has reported its cells
    _wait(watch, lambda: watch.parts)
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=blend)
    root = bpy.data.objects["lantern_garden"]
    attached = lodgs("runs.watch").watch_of(root)
    assert attached is not watch and attached.running
    assert attached.process is None and len(attached.parts) == 2
    _wait(attached, lambda: len(root.lodgs.training.planned_cells) == 2)
    jobs.cancel_cell(root, 1)
    _wait(attached, lambda: _states(attached)[0] == "cancelled")
    jobs.cancel(root)
    _wait(attached, lambda: not attached.running)


def test_cells_at_once_need_dask(bpy, lodgs, jobs, fake, root, tmp_path):
    fake("no_dask")
    root.lodgs.training.at_once = 3
    with pytest.raises(RuntimeError, match=r"3 cells at once: .*Dask\.\s(.|\n)*set Cells at Once to 1"):
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


def test_second_cancel_kills_the_trainers_of_all_cells(lodgs, jobs, fake, root, tmp_path, monkeypatch):
    """The trainer of the run may not respond. Those of the cells are killed too."""
    fake()
    folder = lodgs("training.runs.folder").RunFolder
    killed = []
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.parts)
    monkeypatch.setattr(folder, "kill", lambda run: killed.append(run.path.name))
    watch.cancel_requested = True
    jobs.cancel(root)
    assert killed == ["1", "2"]
    _wait(watch, lambda: not watch.running)
    assert watch.state == "interrupted"


def test_apply_job_sets_the_cells(lodgs, job_settings, root, tmp_path):
    job = lodgs("training.runs.job").Job("/scene", "/run", "3dgs", cells="3x2")
    job_settings.apply_job(root.lodgs.training, job)
    assert job_settings.make_job(root, tmp_path, {}).cells == "3x2"
    job_settings.apply_job(root.lodgs.training, lodgs("training.runs.job").Job("/scene", "/run"))
    assert job_settings.make_job(root, tmp_path, {}).cells == ""
