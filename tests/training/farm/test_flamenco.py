"""Flamenco job type for scenes in cells, compiled in Node with a simulated manager, and its commands."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.training.runs.cells.conftest import cells_in_process  # noqa: F401 - a fixture
from training.__main__ import main
from training.methods import METHODS
from training.optimize.method_info import PRESETS
from training.runs import train as training_loop
from training.runs.cells.plan import read_plan
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.splats.bundle import read_bundle

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = ROOT / "farm" / "flamenco" / "lodgs_blocks.js"
MANAGER = """
const shellSplit = text => text.split(" ");  // as the manager's, without quotation marks
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
    """Return the job type, and the tasks it creates from these and default settings."""
    script = folder / "job.js"
    script.write_text(source.read_text() + MANAGER)

    def run(values: dict) -> dict:
        process = subprocess.run(
            ["node", str(script), json.dumps(values)], capture_output=True, text=True, check=True
        )
        return json.loads(process.stdout)

    defaults = {
        setting["key"]: setting.get("default", "")
        for setting in run({"columns": 1, "rows": 1})["type"]["settings"]
    }
    return run(defaults | settings)


@needs_node
def test_tasks_of_all_cells_depend_on_earlier_stages(tmp_path):
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
def test_no_seam_tasks_without_polish_steps(tmp_path):
    tasks = compiled(tmp_path, scene="/scene", output="/run", columns=2, rows=1, polish=0)["tasks"]
    assert [task["name"] for task in tasks] == ["plan", "coarse", "block-1", "block-2", "merge"]
    assert tasks[-1]["after"] == ["block-1", "block-2"]


@needs_node
def test_extra_options_apply_to_the_plan(tmp_path):
    plan, *parts = compiled(tmp_path, columns=1, rows=2, options="--seed 3 --set max_splats=500000")["tasks"]
    assert plan["commands"][0]["args"][-4:] == ["--seed", "3", "--set", "max_splats=500000"]
    assert not any("--seed" in command["args"] for task in parts for command in task["commands"])


@needs_node
def test_form_has_the_image_scale_of_the_preset(tmp_path):
    def options_of_plan(**settings) -> list[str]:
        return compiled(tmp_path, preset="paper", **settings)["tasks"][0]["commands"][0]["args"]

    assert "--image-scale" not in options_of_plan()
    assert options_of_plan(image_scale=0.25)[-2:] == ["--image-scale", "0.25"]


@needs_node
def test_settings_match_methods_and_presets(tmp_path):
    settings = {setting["key"]: setting for setting in compiled(tmp_path)["type"]["settings"]}
    assert set(settings["method"]["choices"]) == {name for name, info in METHODS.items() if info.cell_method}
    assert settings["preset"]["choices"] == list(PRESETS)
    assert settings["polish"]["default"] == Job.polish
    for setting in settings.values():
        assert setting["type"] in ("string", "int32", "float", "bool") and setting["description"]


@needs_node
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("method", "steps"),
    [("3dgs", 10), pytest.param("flod", [6, 6, 6, 6, 12], marks=pytest.mark.nightly)],
)
@pytest.mark.usefixtures("cells_in_process")
def test_commands_of_the_tasks_give_the_same_bundle_as_one_run(tiny_scene, tmp_path, method, steps):
    tasks = compiled(
        tmp_path, scene=str(tiny_scene), output=str(tmp_path / "farm"), columns=2, rows=1, method=method,
        image_scale=0.5, polish=4,
    )["tasks"]  # fmt: skip
    few_steps = ["--set", f"steps={steps}", "--set", "max_splats=200", "--test-every", "0"]
    for task in tasks:
        for command in task["commands"]:
            arguments = command["args"] + (few_steps if task["name"] == "plan" else [])
            assert main(arguments) == 0
    job = {
        "scene": str(tiny_scene), "out": str(tmp_path / "single"), "method": method, "cells": "2x1",
        "test_every": 0, "polish": 4, "parameters": {"steps": steps, "max_splats": 200},
    }  # fmt: skip
    assert training_loop.train(Job.from_dict(job)) == 0
    division = read_plan(RunFolder(tmp_path / "farm"))
    assert division.seams and bool(division.coarse) == (method == "flod")
    expected, bundle = (tmp_path / name / "bundle.ply" for name in ("single", "farm"))
    assert bundle.read_bytes() == expected.read_bytes() and len(read_bundle(bundle).levels[0].splats)
