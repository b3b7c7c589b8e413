"""The job type for Flamenco, compiled in Node against the manager's interface, and what its commands do."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from training.methods import METHODS
from training.optimize.method_info import PRESETS
from training.runs import train as training_loop
from training.runs.blocks.plan import read_plan
from training.runs.folder import RunFolder
from training.runs.job import POLISH_STEPS, Job
from training.splats.bundle import read_bundle

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = ROOT / "farm" / "flamenco" / "lodgs_blocks.js"
MANAGER = """
const shellSplit = text => text.split(" ");  // the manager's, but for quotation marks
const path = { join: (...parts) => parts.join("/") };
const author = {
    Task: (name, type) => ({
        name, type, commands: [], after: [],
        addCommand(command) { this.commands.push(command); },
        addDependency(other) { this.after.push(other.name); },
    }),
    Command: (name, parameters) => ({ name, ...parameters }),
};
const job = { settings: JSON.parse(process.argv[2]), tasks: [], addTask(task) { this.tasks.push(task); } };
compileJob(job);
console.log(JSON.stringify({ type: JOB_TYPE, tasks: job.tasks }));
"""

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="Node.js is not installed")


def compiled(folder: Path, source: Path = SCRIPT, **settings) -> dict:
    """The job type, and the tasks that it makes of these settings and the defaults of others."""
    script = folder / "job.js"
    script.write_text(source.read_text() + MANAGER)

    def run(values: dict) -> dict:
        told = subprocess.run(
            ["node", str(script), json.dumps(values)], capture_output=True, text=True, check=True
        )
        return json.loads(told.stdout)

    defaults = {
        each["key"]: each.get("default", "") for each in run({"columns": 1, "rows": 1})["type"]["settings"]
    }
    return run(defaults | settings)


@needs_node
def test_tasks_wait_for_each_other_and_there_is_one_for_each_cell(tmp_path):
    tasks = compiled(tmp_path, scene="/scene", output="/run", columns=2, rows=3)["tasks"]
    plan, coarse, *parts, last = tasks
    blocks, seams = parts[:6], parts[6:]
    assert plan["after"] == [] and coarse["after"] == ["plan"] and len(blocks) == len(seams) == 6
    assert all(block["after"] == ["coarse"] for block in blocks)
    assert all(seam["after"] == [block["name"] for block in blocks] for seam in seams)
    assert last["after"] == [seam["name"] for seam in seams]
    assert len({task["name"] for task in tasks}) == 15
    for task in tasks:
        assert task["type"] == "misc"
        assert [(command["name"], command["exe"]) for command in task["commands"]] == [("exec", "{lodgs}")]


@needs_node
def test_without_polishing_there_are_no_seams(tmp_path):
    tasks = compiled(tmp_path, scene="/scene", output="/run", columns=2, rows=1, polish=0)["tasks"]
    assert [task["name"] for task in tasks] == ["plan", "coarse", "block-1", "block-2", "put together"]
    assert tasks[-1]["after"] == ["block-1", "block-2"]


@needs_node
def test_options_are_the_plans(tmp_path):
    plan, *others = compiled(tmp_path, columns=1, rows=2, options="--seed 3 --set max_splats=500000")["tasks"]
    assert plan["commands"][0]["args"][-4:] == ["--seed", "3", "--set", "max_splats=500000"]
    assert not any("--seed" in command["args"] for task in others for command in task["commands"])


@needs_node
def test_it_offers_what_there_is(tmp_path):
    settings = {each["key"]: each for each in compiled(tmp_path)["type"]["settings"]}
    assert set(settings["method"]["choices"]) == {name for name, info in METHODS.items() if info.in_cells}
    assert settings["preset"]["choices"] == list(PRESETS)
    assert settings["polish"]["default"] == POLISH_STEPS
    for each in settings.values():
        assert each["type"] in ("string", "int32", "float", "bool") and each["description"]


@needs_node
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("method, steps", [("3dgs", 30), ("flod", [6, 6, 6, 6, 12])])
def test_its_commands_one_after_the_other_give_the_bundle_of_one_command(tiny_scene, tmp_path, method, steps):
    tasks = compiled(
        tmp_path, scene=str(tiny_scene), output=str(tmp_path / "farm"), columns=2, rows=1, method=method,
        image_scale=0.5, polish=4,
    )["tasks"]  # fmt: skip
    short = ["--set", f"steps={steps}", "--set", "max_splats=200", "--test-every", "0"]  # it takes seconds
    for task in tasks:
        for command in task["commands"]:
            arguments = command["args"] + (short if task["name"] == "plan" else [])
            subprocess.run([sys.executable, "-m", "training", *arguments], cwd=ROOT, check=True)
    job = {
        "scene": str(tiny_scene), "out": str(tmp_path / "one"), "method": method, "cells": "2x1",
        "test_every": 0, "polish": 4, "parameters": {"steps": steps, "max_splats": 200},
    }  # fmt: skip
    assert training_loop.train(Job.from_dict(job)) == 0
    division = read_plan(RunFolder(tmp_path / "farm"))
    assert division.seams and bool(division.coarse) == (method == "flod")
    one, farm = tmp_path / "one" / "bundle.ply", tmp_path / "farm" / "bundle.ply"
    assert one.read_bytes() == farm.read_bytes() and len(read_bundle(one).levels[0].splats)
