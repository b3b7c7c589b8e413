"""Blocks: what a plan asks of them, how they are put together, and whatever befalls them on the way."""

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
from training.runs.blocks import train as blocks_module
from training.runs.blocks.merge import merge
from training.runs.blocks.plan import Block, Division, choose_cells, plan, read_plan, write_plan
from training.runs.blocks.train import BlocksStopped, train_blocks
from training.runs.data import training_data
from training.runs.events import MAX_BYTES, event_line
from training.runs.folder import RunFolder
from training.runs.job import POLISH_STEPS, Job
from training.scenes.cameras import Camera
from training.scenes.colmap import Scene
from training.scenes.regions import Region
from training.splats.bundle import Bundle, Level, read_bundle, write_bundle
from training.splats.gaussians import Splats

ROOT = Path(__file__).resolve().parents[4]
FEW = {"max_splats": 200, "random_background": False}
TINY = {"steps": 45, "densify_interval": 10, "grad_threshold": 1e-5, **FEW}


def job_for(scene, out, method="3dgs", **further) -> Job:
    parameters = further.pop("parameters", TINY)
    return Job.from_dict({
        "scene": str(scene), "out": str(out), "method": method, "image_scale": 1.0, "test_every": 4,
        "cells": "2x1", "parameters": parameters, **further,
    })  # fmt: skip


def planned(job: Job) -> list[Block]:
    folder = RunFolder(job.out)
    folder.create()
    return write_plan(job.resolved(), folder).blocks


# -- a plan ------------------------------------------------------------------------------------------------


def test_each_view_is_seen_as_often_as_in_the_whole(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", parameters={**TINY, "steps": 600, "max_splats": 1000})
    whole = training_data(replace(job, cells=""), RunFolder(tmp_path))
    for block in planned(job):
        data, p = training_data(block.job, block.folder), block.job.resolved_parameters()
        assert p.steps / len(data.train) == pytest.approx(600 / len(whole.train), abs=0.5)
        assert p.max_splats == pytest.approx(1000 * len(data.scene.points) / len(whole.scene.points), abs=0.5)
        assert block.job.method == "3dgs" and block.job.cells == ""


@pytest.mark.parametrize("method", ["flod", "octree", "clod", "3dgs", "lodge", "tree"])
def test_all_have_the_units_of_the_whole_and_hold_out_its_views(tiny_scene, tmp_path, method):
    job = job_for(tiny_scene, tmp_path / "run", method, parameters={})
    whole = training_data(replace(job, cells=""), RunFolder(tmp_path))
    blocks = planned(job)
    seen = set()
    for block in blocks:
        data = training_data(block.job, block.folder)
        for name in ("extent", "median_depth", "near", "focal", "threshold_scale"):
            assert getattr(data, name) == getattr(whole, name)
        np.testing.assert_array_equal(data.mean_camera, whole.mean_camera)
        held_out = {camera.name for camera in whole.test}
        assert {camera.name for camera in data.test} == held_out & set(block.region.views)
        assert not {camera.name for camera in data.train} & held_out
        seen |= {camera.name for camera in data.train}
        assert 0 < len(data.scene.points) <= len(whole.scene.points)
    assert seen == {camera.name for camera in whole.train}
    assert {block.job.method for block in blocks} == {METHODS[method].in_cells}


def test_a_photograph_that_is_spoilt_shifts_no_held_out_views(tiny_scene, tmp_path):
    """Left out where they are decoded, it would be counted there and not where the whole is measured."""
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    photograph = scene / "images" / "01.jpg"
    data = photograph.read_bytes()
    table = data.index(b"\xff\xc4") + 5  # a Huffman table: its size and its end can be read, no pixels
    photograph.write_bytes(data[:table] + b"\xff" * 16 + data[table + 16 :])
    job = job_for(scene, tmp_path / "run")
    blocks, whole = planned(job), training_data(job, RunFolder(tmp_path))
    held_out = {camera.name for camera in whole.test}
    assert held_out == {"00.jpg", "04.jpg", "08.jpg"}
    trained = {camera.name for block in blocks for camera in training_data(block.job, block.folder).train}
    assert not trained & {*held_out, "01.jpg"} and len(trained) == 5


def test_a_plan_that_cannot_be_leaves_the_folder_free(tiny_scene, tmp_path, capsys):
    out = tmp_path / "run"
    command = f"blocks plan {tiny_scene} --method 3dgs --out {out}".split()
    assert main(command) == 2
    assert "how many cells" in capsys.readouterr().err
    assert main([*command, "--cells", "5x1"]) == 2
    assert "too few" in capsys.readouterr().err
    assert main([*command, "--cells", "2x1"]) == 0
    assert "blocks run" in capsys.readouterr().out
    assert main([*command, "--cells", "1x2"]) == 2, "it is another plan's now"
    assert "belongs to another job" in capsys.readouterr().err


def test_blocks_of_a_plan_are_relative_to_it(tiny_scene, tmp_path):
    planned(job_for(tiny_scene, tmp_path / "run", "flod", test_every=0, parameters={}))
    (tmp_path / "run").rename(tmp_path / "moved")
    division = read_plan(RunFolder(tmp_path / "moved"))
    assert division.seams and division.coarse
    for block in division.blocks + division.seams:
        assert Path(block.job.region) == block.folder.path / "region.json"
        assert Path(block.job.out) == block.folder.path
        lies = division.coarse.folder.path if block.kind == "block" else block.folder.base
        assert Path(block.job.base) == lies


def test_a_plan_tells_ahead_what_its_blocks_then_take(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", "flod", parameters={}).resolved()
    told = plan(job)
    assert not (tmp_path / "run").exists(), "nothing is written"
    for each, block in zip(told, planned(job), strict=True):
        data, p = training_data(block.job, block.folder), block.job.resolved_parameters()
        assert (each.number, each.region.views) == (block.number, block.region.views)
        assert (each.views, each.points) == (len(data.train), len(data.scene.points))
        assert (each.steps, each.splats) == (p.total_steps, p.max_splats)
        assert each.memory > 1000 * each.splats


def test_coarse_levels_and_blocks_make_the_steps_and_levels_of_all(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", "flod", parameters={})
    planned(job)
    division = read_plan(RunFolder(job.out))
    coarse = division.coarse.job.resolved_parameters()
    assert (coarse.first_level, coarse.last_level) == (1, 3) and not division.coarse.job.base
    assert coarse.steps == job.resolved_parameters().steps
    for block in division.blocks:
        p = block.job.resolved_parameters()
        assert (p.first_level, p.last_level) == (4, 0)
        assert (p.footprint, p.rho, p.levels, p.sh_degree) == (
            coarse.footprint,
            coarse.rho,
            coarse.levels,
            coarse.sh_degree,
        )
        assert block.job.base == str(division.coarse.folder.path)
    few = job_for(tiny_scene, tmp_path / "few", "flod", parameters={"levels": 2})
    planned(few)
    division = read_plan(RunFolder(few.out))
    assert division.coarse is None and division.blocks[0].job.base == ""


def test_seams_are_planned_where_views_stand_at_borders_and_rules_allow_it(tiny_scene, tmp_path):
    def seams(name, **further):
        job = job_for(tiny_scene, tmp_path / name, test_every=0, parameters={}, **further)
        planned(job)
        return read_plan(RunFolder(job.out)).seams

    found = seams("one")
    assert found and all(seam.job.parameters["steps"] == POLISH_STEPS for seam in found)
    assert all(seam.region.seam and seam.job.base == str(seam.folder.base) for seam in found)
    assert not seams("none", polish=0) and not seams("clod", method="clod")


def test_as_few_cells_as_keep_to_what_a_block_may_have(tmp_path):
    """Views and points in a square of 60 by 40; views look down, so that each sees what is around it."""
    job = Job.from_dict(
        {"scene": str(tmp_path), "out": str(tmp_path / "run"), "parameters": {"max_splats": 900}}
    )
    scene = street_map(tmp_path)
    sizes = {}
    for cells in ("1x1", "2x1", "2x2"):
        sizes[cells] = max(each.splats for each in plan(job.with_cells(cells), scene))
    assert sizes["1x1"] == 900 and sizes["2x2"] < sizes["2x1"] < 900
    for cells, most in sizes.items():
        assert choose_cells(job, splats=most, scene=scene) == cells
    more = choose_cells(job, splats=sizes["2x2"] // 2, scene=scene)
    assert max(each.splats for each in plan(job.with_cells(more), scene)) <= sizes["2x2"] // 2
    assert Job("s", "o", cells=more).grid > (2, 2)
    assert choose_cells(job, memory=10**12, scene=scene) == "1x1"
    with pytest.raises(LodgsError, match=r"still has|too few|too little"):
        choose_cells(job, splats=3, scene=scene)


def street_map(folder: Path) -> Scene:
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    cameras = []
    for x in range(0, 60, 4):
        for y in range(0, 40, 4):
            pose = np.eye(4)
            turned = down * [[-1], [-1], [1]] if x % 8 else down  # there and back, as drones fly
            pose[:3, :3], pose[:3, 3] = turned, -turned @ (x, y, 3)
            cameras.append(Camera(f"{x:02}-{y:02}", 64, 48, 40.0, 40.0, 32.0, 24.0, pose))
    points = np.random.default_rng(0).uniform((0, 0, 0), (60, 40, 1), (3000, 3)).astype(np.float32)
    return Scene(folder, folder, folder, cameras, points, np.zeros((3000, 3), np.uint8))


def test_parts_have_names(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run", test_every=0)
    planned(job)
    division = read_plan(RunFolder(job.out))
    assert division.part("block-2") == division.blocks[1] and division.part("coarse") is None
    assert division.part("seam-1") == division.seams[0]
    for name in ("", "block", "block-3", "block-0", "seam-", "coarse-1", "merge", "2"):
        with pytest.raises(LodgsError, match="There is no part"):
            division.part(name)
    assert main(["blocks", "run", job.out, "--only", "coarse"]) == 0, "a part that is not needed is done"
    assert main(["blocks", "run", job.out, "--only", "seam-1"]) == 2, "its blocks are not finished"


def test_levels_to_go_on_from_have_to_be_said(tiny_scene, tmp_path):
    keys = {"scene": str(tiny_scene), "out": str(tmp_path / "run"), "method": "flod"}
    with pytest.raises(LodgsError, match="which levels to go on from"):
        Job.from_dict({**keys, "parameters": {"first_level": 2}})
    with pytest.raises(LodgsError, match="cannot begin with the splats"):
        Job.from_dict({**keys, "base": "base.ply"})
    assert Job.from_dict({**keys, "base": "base.ply", "parameters": {"first_level": 2}}).base


def test_what_cannot_be_is_refused_in_a_sentence(tiny_scene, tmp_path):
    for cells in ("0x2", "2", "axb", "1000x1000", "-1x2", "2x2x2"):
        with pytest.raises(LodgsError, match="cells"):
            job_for(tiny_scene, tmp_path / "run", cells=cells)
    with pytest.raises(LodgsError, match="cells one by one"):
        job_for(tiny_scene, tmp_path / "run", "octree_neural", parameters={})
    with pytest.raises(LodgsError, match="both 'cells' and 'region'"):
        job_for(tiny_scene, tmp_path / "run", region="region.json")
    with pytest.raises(LodgsError, match="too few"):
        planned(job_for(tiny_scene, tmp_path / "run", cells="5x1"))
    assert not (tmp_path / "run" / "blocks").exists()


# -- put together ------------------------------------------------------------------------------------------


def finished(folder: Path, number: int, cell, splats: list[Splats], **further) -> Block:
    """A block with a bundle of these levels."""
    run = RunFolder(folder / str(number))
    run.create()
    levels = [Level(i, each, {"s_min": 1.0 / i}) for i, each in enumerate(splats, 1)]
    write_bundle(run.bundle, Bundle(**({"method": "flod", "rule": "bands"} | further), levels=levels))
    inside = np.array([cell, [-np.inf, np.inf]])
    return Block(number, run, Region(np.eye(3), inside, inside, ("a",)))


def random_splats(rng, count) -> Splats:
    return Splats(
        rng.normal(0, 1, (count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(-3, 1, (count, 3)).astype(np.float32), rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 4, 3)).astype(np.float32), {"lod_level": np.arange(count, dtype=np.int32)},
    )  # fmt: skip


def test_every_splat_of_its_own_cell_is_there_once_and_no_other(tmp_path, monkeypatch):
    from training.runs.blocks import merge as merge_module

    monkeypatch.setattr(merge_module, "BATCH_ROWS", 7)
    rng = np.random.default_rng(0)
    sets = [[random_splats(rng, n) for n in (20, 50)] for _ in range(3)]
    cells = [(-np.inf, -0.3), (-0.3, 0.4), (0.4, np.inf)]
    blocks = [
        finished(tmp_path, i, cell, its) for i, (cell, its) in enumerate(zip(cells, sets, strict=True), 1)
    ]
    kept = merge(Division(None, blocks, []), tmp_path / "whole.ply")
    made = read_bundle(tmp_path / "whole.ply")
    assert [level.facts for level in made.levels] == [{"s_min": 1.0}, {"s_min": 0.5}]
    assert sum(own for own, _ in kept) == sum(len(level.splats) for level in made.levels)
    assert [all_ for _, all_ in kept] == [70, 70, 70]
    for number, level in enumerate(made.levels):
        wanted = Splats.concatenated([
            its[number].select((its[number].means[:, 0] >= low) & (its[number].means[:, 0] < high))
            for (low, high), its in zip(cells, sets, strict=True)
        ])  # fmt: skip
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            np.testing.assert_array_equal(getattr(level.splats, name), getattr(wanted, name))
        np.testing.assert_array_equal(level.splats.extras["lod_level"], wanted.extras["lod_level"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2", "3", "whole.ply"]


def test_blocks_that_do_not_belong_together_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    one = finished(tmp_path, 1, (-np.inf, 0), [random_splats(rng, 9)])
    other = finished(tmp_path, 2, (0, np.inf), [random_splats(rng, 9)], method="3dgs", rule="")
    with pytest.raises(LodgsError, match="another kind"):
        merge(Division(None, [one, other], []), tmp_path / "whole.ply")
    assert not (tmp_path / "whole.ply").exists()


# -- whatever befalls them -----------------------------------------------------------------------------------


class Workers:
    """Train blocks as they are told: by block, what each attempt does, given the block's folder."""

    def __init__(self, **plans) -> None:
        self.plans = {name.removeprefix("block_"): list(plan) for name, plan in plans.items()}
        self.attempts = dict.fromkeys(self.plans, 0)

    def __call__(self, folder: Path) -> Future:
        future: Future = Future()
        future.set_running_or_notify_cancel()
        what = self.plans[folder.name][min(self.attempts[folder.name], len(self.plans[folder.name]) - 1)]
        self.attempts[folder.name] += 1

        def work() -> None:
            try:
                future.set_result(what(RunFolder(folder)))
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
    made = finished(folder.path.parent / "made", int(folder.path.name), (-np.inf, np.inf), [LEVEL])
    made.folder.bundle.rename(folder.bundle)
    with folder.events_file.open("a") as file:
        file.write(event_line("done", bundle="bundle.ply") + "\n")
    return 0


def lost(_: RunFolder) -> int:
    raise RuntimeError("the worker is gone")


def refused(folder: RunFolder) -> int:
    with folder.events_file.open("a") as file:
        file.write(event_line("error", what="The disk is full.", remedy="Free some space.") + "\n")
    return 2


def cancelled(_: RunFolder) -> int:
    return 3


LEVEL = random_splats(np.random.default_rng(3), 5)


@pytest.fixture
def blocks(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(blocks_module, "POLL_SECONDS", 0.005)
    return planned(job_for(tiny_scene, tmp_path / "run"))


def trained(blocks, workers, tell=lambda *_, **__: None):
    path = blocks[0].folder.path.parent / "whole.ply"
    train_blocks(Division(None, blocks, []), path, workers, tell)
    return path


def test_a_block_that_gets_on_is_begun_again_as_often_as_it_is_lost(blocks):
    workers = Workers(block_1=[*(progressing(i, -9) for i in range(8)), lost, done], block_2=[done])
    assert trained(blocks, workers).exists()
    assert workers.attempts == {"1": 10, "2": 1}


def test_one_that_does_not_get_on_ends_the_run_after_the_others_are_done(blocks):
    workers = Workers(block_1=[lost], block_2=[progressing(3, -9), done])
    with pytest.raises(LodgsError, match=r"Block 1 was lost 3 times at step 0 \(the worker is gone\)"):
        trained(blocks, workers)
    assert blocks[1].folder.bundle.exists() and workers.attempts == {"1": 3, "2": 2}
    again = Workers(block_1=[done], block_2=[lost])
    assert trained(blocks, again).exists()
    assert again.attempts == {"1": 1, "2": 0}, "what is finished is not begun again"


def test_what_is_wrong_with_a_block_is_said_in_its_words(blocks):
    with pytest.raises(LodgsError, match="Block 2: The disk is full") as found:
        trained(blocks, Workers(block_1=[done], block_2=[refused]))
    assert found.value.remedy == "Free some space."


def test_one_that_could_not_even_write_what_is_wrong_says_so(blocks):
    with pytest.raises(LodgsError, match=r"Block 2: The trainer could write nothing more .* disk is full"):
        trained(blocks, Workers(block_1=[done], block_2=[lambda _: 2]))


def test_whom_nobody_has_begun_is_given_up_at_an_interrupt(blocks, monkeypatch):
    """A cluster without workers, on which nothing will ever be begun; it may be later, by itself."""
    monkeypatch.setattr(blocks_module, "START_SECONDS", 0.05)
    asked = []

    def submit(folder: Path) -> Future:
        asked.append(Future())
        return asked[-1]

    def interrupt(kind, **_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(blocks, submit, interrupt)
    assert [future.cancelled() for future in asked] == [True, True]
    assert not any(block.folder.take_cancel() for block in blocks)


def test_a_lost_scheduler_is_no_loss_of_a_block(blocks):
    """Its blocks are given out again as often as it comes back; that it does not is said by who gives out."""

    def scheduler_lost(_: RunFolder) -> int:
        raise CancelledError

    workers = Workers(block_1=[scheduler_lost] * 5 + [done], block_2=[done])
    assert trained(blocks, workers).exists() and workers.attempts == {"1": 6, "2": 1}


def test_a_block_can_be_stopped_alone_and_gone_on_with(blocks):
    with pytest.raises(BlocksStopped, match="block 2"):
        trained(blocks, Workers(block_1=[done], block_2=[cancelled]))
    assert trained(blocks, Workers(block_1=[lost], block_2=[done])).exists()


def test_a_block_that_was_stopped_goes_on_beside_the_others_when_it_is_asked_to(blocks):
    """While the other is at work, and no sooner; what was asked is forgotten then."""
    told, folder = [], blocks[1].folder

    def until_the_other_is_done(_: RunFolder) -> int:
        while not folder.bundle.exists():
            time.sleep(0.002)
        return done(blocks[0].folder)

    def tell(kind, **values):
        states = [each["state"] for each in values.get("blocks", ())]
        told.append(states)
        if states == ["running", "cancelled"] and not workers.attempts["2"] > 1:
            folder.request_resume()

    def stopped(folder: RunFolder) -> int:
        progressing(5, 3)(folder)
        progressing(5, 3)(blocks[0].folder)  # of which something is heard so
        return 3

    workers = Workers(block_1=[until_the_other_is_done], block_2=[stopped, done])
    assert trained(blocks, workers, tell).exists()
    assert workers.attempts == {"1": 1, "2": 2} and not folder.take_resume()
    assert ["running", "cancelled"] in told and told[-1] != ["running", "cancelled"]


def test_one_that_is_asked_to_go_on_before_all_begin_does_so_alone(blocks):
    workers = Workers(block_1=[done], block_2=[done])
    blocks[1].folder.request_resume()
    with pytest.raises(BlocksStopped, match="block 1"):
        trained(blocks, workers)
    assert workers.attempts == {"1": 0, "2": 1}
    assert trained(blocks, workers).exists(), "then it is forgotten"
    assert workers.attempts == {"1": 1, "2": 1}


def test_a_block_is_at_work_once_its_trainer_has_said_so(blocks):
    """Not because an earlier one has: blocks wait for their turn again when a run goes on."""
    states = []

    def tell(kind, **values):
        if kind == "progress":
            states.append([(each["state"], each["step"]) for each in values["blocks"]])

    def waits(folder: RunFolder) -> int:
        while len(states) < 5:
            time.sleep(0.002)
        return done(folder)

    progressing(7, 3)(blocks[0].folder)
    trained(blocks, Workers(block_1=[waits], block_2=[done]), tell)
    assert states[0][0] == ("waiting", 7)


def test_an_interrupt_stops_all_politely(blocks):
    def until_cancelled(folder: RunFolder) -> int:
        while not folder.take_cancel():
            time.sleep(0.002)
        return 3

    def interrupt(kind, **_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(blocks, Workers(block_1=[until_cancelled], block_2=[until_cancelled]), interrupt)


def test_how_all_get_on_is_one_event(blocks):
    told = []
    workers = Workers(block_1=[progressing(20, -9), done], block_2=[progressing(10, -9), done])
    trained(blocks, workers, lambda kind, **values: told.append((kind, values)))
    *_, last = (values for kind, values in told if kind == "progress")
    steps = [block.job.resolved_parameters().total_steps for block in blocks]
    assert last["step"] == last["of"] == sum(steps)
    assert last["blocks"] == [
        {"block": number, "kind": "block", "state": "done", "step": step, "of": step}
        for number, step in enumerate(steps, 1)
    ]
    from training.runs.events import _well_formed

    event = json.loads(event_line("progress", **last))
    assert _well_formed(event) == event, "whoever reads runs understands it"


# -- from the outside ----------------------------------------------------------------------------------------


def run_all(keys: dict) -> tuple[int, RunFolder]:
    return training_loop.train(Job.from_dict(keys)), RunFolder(keys["out"])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["3dgs", "flod", "octree"])
def test_cells_give_a_bundle_like_the_whole(tiny_scene, tmp_path, method):
    parameters = {
        "3dgs": TINY,
        "flod": {**TINY, "levels": 3, "steps": [15, 15, 15], "footprint": 6.0},
        "octree": {**FEW, "levels": 3, "steps": 45, "footprint": 6.0},
    }[method]
    keys = asdict(job_for(tiny_scene, tmp_path / "cells", method, parameters=parameters))
    code, folder = run_all(keys)
    assert code == 0, folder.events()[0][-1]
    code, whole = run_all({**keys, "cells": "", "out": str(tmp_path / "whole")})
    assert code == 0
    one, other = read_bundle(folder.bundle), read_bundle(whole.bundle)
    assert (one.method, one.rule, one.facts, one.controls) == (
        other.method,
        other.rule,
        other.facts,
        other.controls,
    )
    assert [level.number for level in one.levels] == [level.number for level in other.levels]
    assert [level.facts for level in one.levels] == [level.facts for level in other.levels]
    same = {key: value for key, value in one.meta.items() if key in other.meta}
    assert same == other.meta
    assert [event["splats"] for event in folder.levels()] == [len(level.splats) for level in one.levels]
    assert folder.state() == "done" and "train_psnr" in folder.last_event("done")


@pytest.mark.slow
def test_a_tree_is_built_over_what_blocks_give_together(tiny_scene, tmp_path):
    parameters = {**TINY, "tune_steps": 5}
    keys = asdict(job_for(tiny_scene, tmp_path / "cells", "tree", parameters=parameters))
    code, folder = run_all(keys)
    assert code == 0, folder.events()[0][-1]
    leaves, made = read_bundle(folder.merged), read_bundle(folder.bundle)
    assert made.rule == "cut" and len(made.levels[-1].splats) == len(leaves.levels[-1].splats)


@pytest.mark.slow
def test_trainers_killed_and_a_run_interrupted_end_in_the_same_bundle(tiny_scene, tmp_path):
    keys = asdict(job_for(tiny_scene, tmp_path / "calm", parameters={**TINY, "steps": 1000}))
    code, calm = run_all(keys)
    assert code == 0
    path = tmp_path / "job.json"
    path.write_text(json.dumps({**keys, "out": str(tmp_path / "wild")}))
    environment = {**os.environ, "LODGS_CHECKPOINT_SECONDS": "0.2"}
    wild, kills = RunFolder(tmp_path / "wild"), 0
    for attempt in range(20):
        process = subprocess.Popen(
            [sys.executable, "-m", "training", "train", str(path)], cwd=ROOT, env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        until = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < until:
            time.sleep(0.02)  # less than a block takes, on any machine
            for block in read_plan(wild).blocks if wild.blocks.exists() else ():
                if kills < 4 and block.folder.running and block.folder.last_event("progress"):
                    with suppress(LodgsError):  # it has just ended by itself
                        block.folder.kill()
                        kills += 1
            if attempt == 0 and kills >= 2:
                process.send_signal(signal.SIGKILL)
        if process.wait() == 0:
            break
    assert wild.bundle.read_bytes() == calm.bundle.read_bytes() and kills >= 2


def test_many_blocks_fill_no_file_with_how_they_get_on(monkeypatch):
    """A hundred of them for two weeks, looked at every five minutes."""
    clock = itertools.count(0, 300)
    monkeypatch.setattr(blocks_module.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(blocks_module.time, "sleep", lambda seconds: None)

    class Block:
        code, progress, step, steps, looks = 0, {}, 0, 9, 0

        def __init__(self, number):
            self.block = SimpleNamespace(kind="block", number=number, name=f"block {number}")
            self.ends = 40 * number

        begin = staticmethod(lambda submit: None)

        @property
        def state(self):
            return "done" if self.looks >= self.ends else "running"

        def look(self, submit):
            self.looks += 1
            return self.looks >= self.ends

    said = []
    stage = [Block(number) for number in range(1, 101)]
    blocks_module._train_stage(stage, stage, None, lambda kind, **values: said.append(values))
    assert sum(len(event_line("progress", **values)) for values in said) < MAX_BYTES / 4
    told = [values["blocks"] for values in said if "blocks" in values]
    counts = [sum(each["state"] == "done" for each in blocks) for blocks in told]
    assert set(counts) >= set(range(1, 100)) and said[-1]["blocks"] == told[-1] and counts[-1] == 100
