"""Blocks: planning, merging, failures of workers, and whole runs."""

import errno
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.methods import METHODS
from training.runs import train as training_loop
from training.runs.cells import train as train_module
from training.runs.cells.merge import merge
from training.runs.cells.plan import Division, Part, choose_cells, plan, read_plan, write_plan
from training.runs.cells.train import CellsStopped, train_cells
from training.runs.data import training_data
from training.runs.events import MAX_BYTES, event_line
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.cameras import Camera
from training.scenes.colmap import Scene
from training.scenes.regions import Region
from training.splats.bundle import read_bundle, read_header, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

ROOT = Path(__file__).resolve().parents[4]
FEW = {"max_splats": 200, "random_background": False}
TINY = {"steps": 45, "densify_interval": 10, "grad_threshold": 1e-5, **FEW}


def job_for(scene, out, method="3dgs", **keys) -> Job:
    parameters = keys.pop("parameters", TINY)
    return Job.from_dict({
        "scene": str(scene), "out": str(out), "method": method, "image_scale": 1.0, "test_every": 4,
        "cells": "2x1", "parameters": parameters, **keys,
    })  # fmt: skip


def planned(job: Job) -> list[Part]:
    folder = RunFolder(job.out)
    folder.create()
    return write_plan(job.resolved(), folder).cells


# -- planning ---------------------------------------------------------------------------------------------


def test_steps_and_splats_of_cells_are_proportional_to_views_and_points(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", parameters={**TINY, "steps": 600, "max_splats": 1000})
    undivided = training_data(replace(job, cells=""), RunFolder(tmp_path))
    for cell in planned(job):
        data, p = training_data(cell.job, cell.folder), cell.job.resolved_parameters()
        assert p.steps / len(data.train) == pytest.approx(600 / len(undivided.train), abs=0.5)
        assert p.max_splats == pytest.approx(
            1000 * len(data.scene.points) / len(undivided.scene.points), abs=0.5
        )
        assert cell.job.method == "3dgs" and cell.job.cells == ""


@pytest.mark.parametrize("method", ["flod", "octree", "clod", "3dgs", "lodge", "tree"])
def test_cells_have_the_units_and_held_out_views_of_the_full_scene(tiny_scene, tmp_path, method):
    job = job_for(tiny_scene, tmp_path / "run", method, parameters={})
    undivided = training_data(replace(job, cells=""), RunFolder(tmp_path))
    cells = planned(job)
    trained = set()
    for cell in cells:
        data = training_data(cell.job, cell.folder)
        for name in ("extent", "median_depth", "near", "focal", "threshold_scale"):
            assert getattr(data, name) == getattr(undivided, name)
        np.testing.assert_array_equal(data.mean_camera, undivided.mean_camera)
        held_out = {camera.name for camera in undivided.test}
        assert {camera.name for camera in data.test} == held_out & set(cell.region.views)
        assert not {camera.name for camera in data.train} & held_out
        trained |= {camera.name for camera in data.train}
        assert 0 < len(data.scene.points) <= len(undivided.scene.points)
    assert trained == {camera.name for camera in undivided.train}
    assert {cell.job.method for cell in cells} == {METHODS[method].cell_method}


def test_corrupt_photo_does_not_change_the_held_out_views(tiny_scene, tmp_path):
    """Blocks decode photos, the plan does not; both must count the same views."""
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    photo = scene / "images" / "01.jpg"
    data = photo.read_bytes()
    table = data.index(b"\xff\xc4") + 5  # Huffman table: size and end stay readable, pixels do not
    photo.write_bytes(data[:table] + b"\xff" * 16 + data[table + 16 :])
    job = job_for(scene, tmp_path / "run")
    cells = planned(job)
    held_out = {camera.name for camera in training_data(job, RunFolder(tmp_path)).test}
    assert held_out == {"00.jpg", "04.jpg", "08.jpg"}
    trained = {camera.name for cell in cells for camera in training_data(cell.job, cell.folder).train}
    assert not trained & {*held_out, "01.jpg"} and len(trained) == 5


def test_invalid_plan_writes_nothing(tiny_scene, tmp_path, capsys):
    out = tmp_path / "run"
    command = f"blocks plan {tiny_scene} --method 3dgs --out {out}".split()
    assert main(command) == 2
    assert "cells" in capsys.readouterr().err
    assert main([*command, "--cells", "5x1"]) == 2
    assert "each cell needs" in capsys.readouterr().err
    assert main([*command, "--cells", "2x1"]) == 0
    assert "blocks run" in capsys.readouterr().out
    assert main([*command, "--cells", "1x2"]) == 2, "the folder belongs to another plan"
    assert "belongs to another job" in capsys.readouterr().err


def test_plan_can_be_moved(tiny_scene, tmp_path):
    planned(job_for(tiny_scene, tmp_path / "run", "flod", test_every=0, parameters={}))
    (tmp_path / "run").rename(tmp_path / "moved")
    division = read_plan(RunFolder(tmp_path / "moved"))
    assert division.seams and division.coarse
    for cell in division.cells + division.seams:
        assert Path(cell.job.region) == cell.folder.path / "region.json"
        assert Path(cell.job.out) == cell.folder.path
        base = division.coarse.folder.path if cell.kind == "block" else cell.folder.base
        assert Path(cell.job.base) == base


def test_plan_predicts_the_cost_of_cells(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", "flod", parameters={}).resolved()
    cells = plan(job)
    assert not (tmp_path / "run").exists(), "planning writes nothing"
    for cell, part in zip(cells, planned(job), strict=True):
        data, p = training_data(part.job, part.folder), part.job.resolved_parameters()
        assert (cell.number, cell.region.views) == (part.number, part.region.views)
        assert (cell.views, cell.points) == (len(data.train), len(data.scene.points))
        assert (cell.steps, cell.splats) == (p.total_steps, p.max_splats)
        assert cell.memory > 1000 * cell.splats


def test_coarse_part_and_cells_share_the_levels(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", "flod", parameters={})
    planned(job)
    division = read_plan(RunFolder(job.out))
    coarse = division.coarse.job.resolved_parameters()
    assert (coarse.first_level, coarse.last_level) == (1, 3) and not division.coarse.job.base
    assert coarse.steps == job.resolved_parameters().steps
    for cell in division.cells:
        p = cell.job.resolved_parameters()
        assert (p.first_level, p.last_level) == (4, 0)
        assert (p.footprint, p.rho, p.levels, p.sh_degree) == (
            coarse.footprint,
            coarse.rho,
            coarse.levels,
            coarse.sh_degree,
        )
        assert cell.job.base == str(division.coarse.folder.path)
    shallow = job_for(tiny_scene, tmp_path / "few", "flod", parameters={"levels": 2})
    planned(shallow)
    division = read_plan(RunFolder(shallow.out))
    assert division.coarse is None and division.cells[0].job.base == ""
    for last, (coarse, first) in {2: (None, 1), 4: (2, 3)}.items():
        folder = tmp_path / f"last_{last}"
        planned(job_for(tiny_scene, folder, "flod", parameters={"last_level": last}))
        parts = read_plan(RunFolder(folder))
        assert coarse == (parts.coarse and parts.coarse.job.resolved_parameters().last_level)
        cell_levels = parts.cells[0].job.resolved_parameters()
        assert (cell_levels.first_level, cell_levels.end) == (first, last)
    # merged levels would have distances that differ between cells
    assert not any(cell.job.resolved_parameters().merges for cell in division.cells)


def test_seams_need_polish_steps_and_a_rule_without_weights(tiny_scene, tmp_path):
    def seams(name, **keys):
        job = job_for(tiny_scene, tmp_path / name, test_every=0, parameters={}, **keys)
        planned(job)
        return read_plan(RunFolder(job.out)).seams

    planned_seams = seams("one")
    assert planned_seams and all(seam.job.parameters["steps"] == Job.polish for seam in planned_seams)
    assert all(seam.region.seam and seam.job.base == str(seam.folder.base) for seam in planned_seams)
    assert not seams("none", polish=0) and not seams("clod", method="clod")


def test_choose_cells_returns_the_smallest_grid_within_limits(tmp_path):
    """Points in a rectangle of 60 by 40, with cameras above that look down."""
    job = Job.from_dict(
        {"scene": str(tmp_path), "out": str(tmp_path / "run"), "parameters": {"max_splats": 900}}
    )
    scene = street_map(tmp_path)
    sizes = {}
    for cells in ("1x1", "2x1", "2x2"):
        sizes[cells] = max(cell.splats for cell in plan(job.with_cells(cells), scene))
    assert sizes["1x1"] == 900 and sizes["2x2"] < sizes["2x1"] < 900
    for cells, limit in sizes.items():
        assert choose_cells(job, splats=limit, scene=scene) == cells
    finer = choose_cells(job, splats=sizes["2x2"] // 2, scene=scene)
    assert max(cell.splats for cell in plan(job.with_cells(finer), scene)) <= sizes["2x2"] // 2
    assert Job("s", "o", cells=finer).grid > (2, 2)
    assert choose_cells(job, memory=10**12, scene=scene) == "1x1"
    with pytest.raises(LodgsError, match=r"within the limit|too few|needs 2 views"):
        choose_cells(job, splats=3, scene=scene)
    unlimited = replace(job, parameters={"max_splats": 0})
    assert {cell.splats for cell in plan(unlimited.with_cells("2x1"), scene)} == {0}
    with pytest.raises(LodgsError, match=r"number of splats is unlimited\. Set max_splats"):
        choose_cells(unlimited, splats=100, scene=scene)


def street_map(folder: Path) -> Scene:
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    cameras = []
    for x in range(0, 60, 4):
        for y in range(0, 40, 4):
            pose = np.eye(4)
            rotation = down * [[-1], [-1], [1]] if x % 8 else down  # alternating flight directions
            pose[:3, :3] = rotation
            pose[:3, 3] = -rotation @ (x, y, 3)
            cameras.append(Camera(f"{x:02}-{y:02}", 64, 48, 40.0, 40.0, 32.0, 24.0, pose))
    points = np.random.default_rng(0).uniform((0, 0, 0), (60, 40, 1), (3000, 3)).astype(np.float32)
    return Scene(folder, folder, folder, cameras, points, np.zeros((3000, 3), np.uint8))


def test_parts_are_found_by_name(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", test_every=0)
    planned(job)
    division = read_plan(RunFolder(job.out))
    assert division.part("block-2") == division.cells[1] and division.part("coarse") is None
    assert division.part("seam-1") == division.seams[0]
    for name in ("", "block", "block-3", "block-0", "seam-", "coarse-1", "merge", "2"):
        with pytest.raises(LodgsError, match="Unknown part"):
            division.part(name)
    assert main(["blocks", "run", job.out, "--only", "coarse"]) == 0, "an unneeded part counts as finished"
    assert main(["blocks", "run", job.out, "--only", "seam-1"]) == 2, "its cells are unfinished"


def test_continuing_levels_requires_a_base(tiny_scene, tmp_path):
    keys = {"scene": str(tiny_scene), "out": str(tmp_path / "run"), "method": "flod"}
    with pytest.raises(LodgsError, match="has no base"):
        Job.from_dict({**keys, "parameters": {"first_level": 2}})
    with pytest.raises(LodgsError, match="cannot start from a base"):
        Job.from_dict({**keys, "base": "base.ply"})
    assert Job.from_dict({**keys, "base": "base.ply", "parameters": {"first_level": 2}}).base


def test_invalid_cells_are_rejected(tiny_scene, tmp_path):
    for cells in ("0x2", "2", "axb", "1000x1000", "-1x2", "2x2x2"):
        with pytest.raises(LodgsError, match="cells"):
            job_for(tiny_scene, tmp_path / "run", cells=cells)
    with pytest.raises(LodgsError, match="cannot train a scene in cells"):
        job_for(tiny_scene, tmp_path / "run", "octree_neural", parameters={})
    with pytest.raises(LodgsError, match="single level in cells"):
        job_for(tiny_scene, tmp_path / "run", "lodge", parameters={"levels": 1})
    with pytest.raises(LodgsError, match="both 'cells' and 'region'"):
        job_for(tiny_scene, tmp_path / "run", region="region.json")
    with pytest.raises(LodgsError, match="each cell needs"):
        planned(job_for(tiny_scene, tmp_path / "run", cells="5x1"))
    assert not (tmp_path / "run" / "blocks").exists()


# -- merging ---------------------------------------------------------------------------------------


def finished(folder: Path, number: int, limits, splats: list[Splats], **header) -> Part:
    """Return a finished cell whose bundle has these levels."""
    run = RunFolder(folder / str(number))
    run.create()
    levels = [Level(i, level, {"s_min": 1.0 / i}) for i, level in enumerate(splats, 1)]
    write_bundle(run.bundle, Bundle(**({"method": "flod", "rule": "bands"} | header), levels=levels))
    inside = np.array([limits, [-np.inf, np.inf]])
    return Part(number, run, Region(np.eye(3), inside, inside, ("a",)))


def random_splats(rng, count) -> Splats:
    return Splats(
        rng.normal(0, 1, (count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(-3, 1, (count, 3)).astype(np.float32), rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 4, 3)).astype(np.float32), {"lod_level": np.arange(count, dtype=np.int32)},
    )  # fmt: skip


def test_merged_bundle_has_each_cells_splats_inside_its_cell(tmp_path, monkeypatch):
    from training.runs.cells import merge as merge_module

    monkeypatch.setattr(merge_module, "BATCH_ROWS", 7)
    rng = np.random.default_rng(0)
    sets = [[random_splats(rng, n) for n in (20, 50)] for _ in range(3)]
    ranges = [(-np.inf, -0.3), (-0.3, 0.4), (0.4, np.inf)]
    cells = [
        finished(tmp_path, i, limits, levels)
        for i, (limits, levels) in enumerate(zip(ranges, sets, strict=True), 1)
    ]
    counts = merge(Division(None, cells, []), tmp_path / "merged.ply")
    merged = read_bundle(tmp_path / "merged.ply")
    assert [level.facts for level in merged.levels] == [{"s_min": 1.0}, {"s_min": 0.5}]
    assert sum(inside for inside, _ in counts) == sum(len(level.splats) for level in merged.levels)
    assert [total for _, total in counts] == [70, 70, 70]
    for number, level in enumerate(merged.levels):
        expected = Splats.concatenated([
            levels[number].select((levels[number].means[:, 0] >= low) & (levels[number].means[:, 0] < high))
            for (low, high), levels in zip(ranges, sets, strict=True)
        ])  # fmt: skip
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            np.testing.assert_array_equal(getattr(level.splats, name), getattr(expected, name))
        np.testing.assert_array_equal(level.splats.extras["lod_level"], expected.extras["lod_level"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2", "3", "merged.ply"]


def test_incompatible_cells_are_rejected(tmp_path):
    rng = np.random.default_rng(0)
    first = finished(tmp_path, 1, (-np.inf, 0), [random_splats(rng, 9)])
    second = finished(tmp_path, 2, (0, np.inf), [random_splats(rng, 9)], method="3dgs", rule="")
    with pytest.raises(LodgsError, match="differ"):
        merge(Division(None, [first, second], []), tmp_path / "merged.ply")
    assert not (tmp_path / "merged.ply").exists()


# -- failures and cancelling ---------------------------------------------------------------------------------


class Workers:
    """Simulated workers. For each cell, a list of functions that stand for the attempts to train it."""

    def __init__(self, **plans) -> None:
        self.plans = {name.removeprefix("cell_"): list(plan) for name, plan in plans.items()}
        self.attempts = dict.fromkeys(self.plans, 0)

    def __call__(self, folder: Path) -> Future:
        future: Future = Future()
        future.set_running_or_notify_cancel()
        attempt = self.plans[folder.name][min(self.attempts[folder.name], len(self.plans[folder.name]) - 1)]
        self.attempts[folder.name] += 1

        def work() -> None:
            try:
                future.set_result(attempt(RunFolder(folder)))
            except Exception as error:
                future.set_exception(error)

        threading.Thread(target=work, daemon=True).start()
        return future


def progressing(step: int, code: int):
    def work(folder: RunFolder) -> int:
        line = event_line(
            "progress", level=1, levels=1, step=step, of=45, loss=0.1, psnr=20.0, splats=9, steps_per_s=1.0,
            eta_s=1.0,
        )  # fmt: skip
        with folder.events_file.open("a") as file:
            file.write(line + "\n")
        return code

    return work


def done(folder: RunFolder) -> int:
    cell = finished(folder.path.parent / "finished", int(folder.path.name), (-np.inf, np.inf), [LEVEL])
    cell.folder.bundle.rename(folder.bundle)
    with folder.events_file.open("a") as file:
        file.write(event_line("done", bundle="bundle.ply") + "\n")
    return 0


def lost(_: RunFolder) -> int:
    raise RuntimeError("worker lost")


def failed(folder: RunFolder) -> int:
    with folder.events_file.open("a") as file:
        file.write(event_line("error", what="Full.", remedy="Free some space.", cause="disk") + "\n")
    return 2


def cancelled(_: RunFolder) -> int:
    return 3


LEVEL = random_splats(np.random.default_rng(3), 5)


@pytest.fixture
def cells(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(train_module, "POLL_SECONDS", 0.005)
    return planned(job_for(tiny_scene, tmp_path / "run"))


def train_all(cells, workers, report=lambda *_, **__: None):
    path = cells[0].folder.path.parent / "merged.ply"
    train_cells(Division(None, cells, []), path, workers, report)
    return path


def test_lost_cell_that_makes_progress_is_restarted_every_time(cells):
    workers = Workers(cell_1=[*(progressing(i, -9) for i in range(8)), lost, done], cell_2=[done])
    assert train_all(cells, workers).exists()
    assert workers.attempts == {"1": 10, "2": 1}


def test_cell_without_progress_fails_the_run_after_the_others_have_finished(cells):
    workers = Workers(cell_1=[lost], cell_2=[progressing(3, -9), done])
    with pytest.raises(LodgsError, match=r"trainer of cell 1 was lost 3 times at step 0 \(worker lost\)"):
        train_all(cells, workers)
    assert cells[1].folder.bundle.exists() and workers.attempts == {"1": 3, "2": 2}
    second_run = Workers(cell_1=[done], cell_2=[lost])
    assert train_all(cells, second_run).exists()
    assert second_run.attempts == {"1": 1, "2": 0}, "finished cells are not trained again"


def test_error_of_a_cell_is_reported(cells):
    with pytest.raises(LodgsError, match="Cell 2: Full") as error:
        train_all(cells, Workers(cell_1=[done], cell_2=[failed]))
    assert error.value.remedy == "Free some space." and error.value.cause == "disk"


def test_cell_that_cannot_write_its_error_is_reported(cells):
    with pytest.raises(LodgsError, match=r"Cell 2: The trainer could not write to .* disk is full"):
        train_all(cells, Workers(cell_1=[done], cell_2=[lambda _: 2]))


def test_cell_that_cannot_start_is_reported_at_once(cells):
    def cannot_start(_: RunFolder) -> int:
        raise LodgsError("Cannot start.", "Check the folder.") from OSError(errno.ENOSPC, "")

    workers = Workers(cell_1=[done], cell_2=[cannot_start])
    with pytest.raises(LodgsError, match="Cell 2: Cannot start") as error:
        train_all(cells, workers)
    assert workers.attempts["2"] == 1
    assert error.value.remedy == "Check the folder." and error.value.cause == "disk"


def test_interrupt_withdraws_cells_that_no_worker_has_started(cells, monkeypatch):
    """A cluster without workers never starts them, or only later."""
    monkeypatch.setattr(train_module, "START_SECONDS", 0.05)
    futures = []

    def submit(folder: Path) -> Future:
        futures.append(Future())
        return futures[-1]

    def interrupt(kind, **_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_all(cells, submit, interrupt)
    assert [future.cancelled() for future in futures] == [True, True]
    assert not any(cell.folder.take_cancel() for cell in cells)


def test_lost_scheduler_does_not_count_as_a_lost_cell(cells):
    """Blocks are submitted again; if the scheduler stays away, ``submit`` raises an error."""

    def scheduler_lost(_: RunFolder) -> int:
        raise CancelledError

    workers = Workers(cell_1=[scheduler_lost] * 5 + [done], cell_2=[done])
    assert train_all(cells, workers).exists() and workers.attempts == {"1": 6, "2": 1}


def test_single_cell_can_be_cancelled_and_resumed(cells):
    with pytest.raises(CellsStopped, match="cell 2"):
        train_all(cells, Workers(cell_1=[done], cell_2=[cancelled]))
    assert train_all(cells, Workers(cell_1=[lost], cell_2=[done])).exists()


def test_cancelled_cell_resumes_on_request_while_others_train(cells):
    """The request is consumed."""
    reports = []
    folder = cells[1].folder

    def wait_for_second_cell(_: RunFolder) -> int:
        while not folder.bundle.exists():
            time.sleep(0.002)
        return done(cells[0].folder)

    def report(kind, **values):
        states = [cell["state"] for cell in values.get("blocks", ())]
        reports.append(states)
        if states == ["running", "cancelled"] and not workers.attempts["2"] > 1:
            folder.request_resume()

    def cancel(folder: RunFolder) -> int:
        progressing(5, 3)(folder)
        progressing(5, 3)(cells[0].folder)  # makes the first cell "running"
        return 3

    workers = Workers(cell_1=[wait_for_second_cell], cell_2=[cancel, done])
    assert train_all(cells, workers, report).exists()
    assert workers.attempts == {"1": 1, "2": 2} and not folder.take_resume()
    assert ["running", "cancelled"] in reports and reports[-1] != ["running", "cancelled"]


def test_resume_request_before_the_start_trains_only_that_cell(cells):
    workers = Workers(cell_1=[done], cell_2=[done])
    cells[1].folder.request_resume()
    with pytest.raises(CellsStopped, match="cell 1"):
        train_all(cells, workers)
    assert workers.attempts == {"1": 0, "2": 1}
    assert train_all(cells, workers).exists(), "the request is consumed"
    assert workers.attempts == {"1": 1, "2": 1}


def test_cell_is_running_once_its_trainer_has_written_an_event(cells):
    """Events of earlier trainers do not count: cells wait again when a run resumes."""
    states = []

    def report(kind, **values):
        if kind == "progress":
            states.append([(cell["state"], cell["step"]) for cell in values["blocks"]])

    def waits(folder: RunFolder) -> int:
        while len(states) < 5:
            time.sleep(0.002)
        return done(folder)

    progressing(7, 3)(cells[0].folder)
    train_all(cells, Workers(cell_1=[waits], cell_2=[done]), report)
    assert states[0][0] == ("waiting", 7)


def test_interrupt_cancels_running_cells(cells):
    def until_cancelled(folder: RunFolder) -> int:
        while not folder.take_cancel():
            time.sleep(0.002)
        return 3

    def interrupt(kind, **_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_all(cells, Workers(cell_1=[until_cancelled], cell_2=[until_cancelled]), interrupt)


def test_progress_event_contains_all_cells(cells):
    reports = []
    workers = Workers(cell_1=[progressing(20, -9), done], cell_2=[progressing(10, -9), done])
    train_all(cells, workers, lambda kind, **values: reports.append((kind, values)))
    *_, last = (values for kind, values in reports if kind == "progress")
    steps = [cell.job.resolved_parameters().total_steps for cell in cells]
    assert last["step"] == last["of"] == sum(steps)
    assert last["blocks"] == [
        {"block": number, "kind": "block", "state": "done", "step": step, "of": step}
        for number, step in enumerate(steps, 1)
    ]
    from training.runs.events import _well_formed

    event = json.loads(event_line("progress", **last))
    assert _well_formed(event) == event, "readers accept the event"


# -- whole runs --------------------------------------------------------------------------------------


def run_all(keys: dict) -> tuple[int, RunFolder]:
    return training_loop.train(Job.from_dict(keys)), RunFolder(keys["out"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [
        pytest.param("3dgs", marks=pytest.mark.nightly),
        "flod",
        pytest.param("octree", marks=pytest.mark.nightly),
    ],
)
def test_bundle_of_cells_is_like_that_of_an_undivided_run(tiny_scene, tmp_path, cells_in_process, method):
    parameters = {
        "3dgs": TINY,
        "flod": {**TINY, "levels": 3, "steps": [15, 15, 15], "footprint": 6.0},
        "octree": {**FEW, "levels": 3, "steps": 45, "footprint": 6.0, "levels_from": "anchors"},
    }[method]
    keys = asdict(job_for(tiny_scene, tmp_path / "cells", method, parameters=parameters))
    code, folder = run_all(keys)
    assert code == 0, folder.events()[0][-1]
    code, undivided = run_all({**keys, "cells": "", "out": str(tmp_path / "undivided")})
    assert code == 0
    bundle, expected = read_bundle(folder.bundle), read_bundle(undivided.bundle)
    for name in ("method", "rule", "facts", "controls"):
        assert getattr(bundle, name) == getattr(expected, name)
    assert [level.number for level in bundle.levels] == [level.number for level in expected.levels]
    facts = [level.facts for level in bundle.levels]
    if method == "flod":  # only undivided runs measure the distances of levels
        heads = [read_header(cell.folder.bundle) for cell in read_plan(folder).cells]
        assert all([level.facts for level in head.levels] == facts for head in heads) and len(heads) > 1
        assert expected.meta.pop("footprint_px") > 0 and bundle.meta["footprint_px"] == pytest.approx(6.0)
    else:
        assert facts == [level.facts for level in expected.levels]
    assert {key: value for key, value in bundle.meta.items() if key in expected.meta} == expected.meta
    assert [event["splats"] for event in folder.levels()] == [len(level.splats) for level in bundle.levels]
    assert folder.state() == "done" and "train_psnr" in folder.last_event("done")
    assert not folder.checkpoints.exists()


@pytest.mark.slow
def test_tree_is_built_from_merged_cells(tiny_scene, tmp_path, cells_in_process):
    parameters = {**TINY, "tune_steps": 5}
    keys = asdict(job_for(tiny_scene, tmp_path / "cells", "tree", parameters=parameters))
    code, folder = run_all(keys)
    assert code == 0, folder.events()[0][-1]
    leaves, tree = read_bundle(folder.merged), read_bundle(folder.bundle)
    assert tree.rule == "cut" and len(tree.levels[-1].splats) == len(leaves.levels[-1].splats)


@pytest.mark.slow
@pytest.mark.nightly
def test_killed_trainers_and_an_interrupted_run_give_the_same_bundle(tiny_scene, tmp_path):
    keys = asdict(job_for(tiny_scene, tmp_path / "undisturbed", parameters={**TINY, "steps": 1000}))
    code, undisturbed = run_all(keys)
    assert code == 0
    path = tmp_path / "job.json"
    path.write_text(json.dumps({**keys, "out": str(tmp_path / "attacked")}))
    environment = {**os.environ, "LODGS_CHECKPOINT_SECONDS": "0.2"}
    attacked = RunFolder(tmp_path / "attacked")
    kills = 0
    for attempt in range(20):
        process = subprocess.Popen(
            [sys.executable, "-m", "training", "train", str(path)], cwd=ROOT, env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        deadline = time.monotonic() + 200
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)  # shorter than the training of a cell
            for cell in read_plan(attacked).cells if attacked.blocks.exists() else ():
                if kills < 4 and cell.folder.running and cell.folder.last_event("progress"):
                    with suppress(LodgsError):  # it has just ended
                        cell.folder.kill()
                        kills += 1
            if attempt == 0 and kills >= 2:
                process.send_signal(signal.SIGKILL)
        if process.wait() == 0:
            break
    assert attacked.bundle.read_bytes() == undisturbed.bundle.read_bytes() and kills >= 2


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(os.name == "nt", reason="Windows cancels with a file")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 3), (signal.SIGKILL, -signal.SIGKILL)])
def test_cell_trainers_save_and_end_with_their_parent(tiny_scene, tmp_path, number, code):
    keys = asdict(job_for(tiny_scene, tmp_path / "run", parameters={**TINY, "steps": 100_000}))
    path = tmp_path / "job.json"
    path.write_text(json.dumps(keys))
    process = subprocess.Popen(
        [sys.executable, "-m", "training", "train", str(path)], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    run = RunFolder(tmp_path / "run")
    cell = RunFolder(run.blocks / "1")
    deadline = time.monotonic() + 200
    while not cell.last_event("progress") and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(200) == code
    while cell.running and time.monotonic() < deadline:
        time.sleep(0.05)
    assert list(cell.checkpoints.glob("*.pt")) and not cell.running
    states = {signal.SIGTERM: ("cancelled", "cancelled"), signal.SIGKILL: ("interrupted", "failed")}
    assert (run.state(), cell.state()) == states[number]


def test_progress_of_many_cells_does_not_fill_the_event_file(monkeypatch):
    """A hundred cells for two weeks, polled every five minutes."""
    clock = itertools.count(0, 300)
    monkeypatch.setattr(train_module.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(train_module.time, "sleep", lambda seconds: None)

    class Watch:
        code, progress, step, steps, polls = 0, {}, 0, 9, 0

        def __init__(self, number):
            self.part = SimpleNamespace(kind="block", number=number, name=f"cell {number}")
            self.last = 40 * number

        start = staticmethod(lambda submit: None)

        @property
        def state(self):
            return "done" if self.polls >= self.last else "running"

        def poll(self, submit):
            self.polls += 1
            return self.polls >= self.last

    reports = []
    stage = [Watch(number) for number in range(1, 101)]
    train_module._train_stage(stage, stage, None, lambda kind, **values: reports.append(values))
    assert sum(len(event_line("progress", **values)) for values in reports) < MAX_BYTES / 4
    detailed = [values["blocks"] for values in reports if "blocks" in values]
    counts = [sum(cell["state"] == "done" for cell in cells) for cells in detailed]
    assert set(counts) >= set(range(1, 100)) and reports[-1]["blocks"] == detailed[-1] and counts[-1] == 100
