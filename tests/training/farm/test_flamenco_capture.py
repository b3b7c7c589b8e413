"""Flamenco job type that captures a Blender scene: its tasks and their commands."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.training.farm.test_flamenco import ROOT, compiled, needs_node
from training.scenes.colmap import read_scene

SCRIPT = ROOT / "farm" / "flamenco" / "lodgs_capture.js"
COMMANDS = """
import importlib, json, os, sys
from pathlib import Path
from tools.blender_module import EXTENSION, start_blender

bpy = start_blender()
blend, model, commands = sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3])
bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
bpy.ops.mesh.primitive_plane_add(size=9)
bpy.ops.mesh.primitive_cube_add(location=(0, 0, 1))
bpy.context.scene.render.engine, bpy.context.scene.cycles.samples = "CYCLES", 1
bpy.ops.wm.save_as_mainfile(filepath=blend)
main = importlib.import_module(f"{EXTENSION}.blender_lodgs.commands").main
for number, command in enumerate(commands):
    assert command[:2] == ["--command", "lodgs"]
    assert model.exists() == (number == 4)  # written by the fourth command
    assert main(command[2:]) == 0
sys.stdout.flush()
os._exit(0)
"""
"""Create a scene and run the commands in one Blender process."""


@needs_node
def test_ranges_cover_each_view_once_and_the_model_depends_on_all(tmp_path):
    tasks = compiled(tmp_path, SCRIPT, blendfile="/a.blend", output="/out", views=21, chunk=8)["tasks"]
    *parts, last = tasks
    ranges = [task["commands"][0]["args"][-1] for task in parts]
    assert ranges == ["1-8", "9-16", "17-21"]
    assert last["after"] == [task["name"] for task in parts] and all(task["after"] == [] for task in parts)
    assert len({task["name"] for task in tasks}) == 4
    for task in tasks:
        (command,) = task["commands"]
        assert (task["type"], command["name"], command["exe"]) == ("misc", "exec", "{blender}")
    assert "--around" in last["commands"][0]["args"] and "--range" not in last["commands"][0]["args"]
    (walk, _) = compiled(tmp_path, SCRIPT, views_from="curve", curve="My Path", views=4)["tasks"]
    arguments = walk["commands"][0]["args"]
    assert arguments[arguments.index("--curve") + 1] == "My Path"


@needs_node
@pytest.mark.nightly
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="Blender's module is not installed")
def test_commands_of_the_tasks_give_the_same_scene_as_one_command(tmp_path, monkeypatch):
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", sys.executable)
    blend, farm, single = tmp_path / "scene.blend", tmp_path / "farm", tmp_path / "single"
    tasks = compiled(
        tmp_path, SCRIPT, blendfile=str(blend), output=str(farm), views=5, chunk=2, width=64, height=48
    )["tasks"]
    assert len(tasks) == 4
    commands = [command["args"] for task in tasks for command in task["commands"]]
    commands.append([str(single) if word == str(farm) else word for word in commands[-1]])
    subprocess.run(
        [sys.executable, "-c", COMMANDS, str(blend), str(farm / "sparse"), json.dumps(commands)],
        cwd=ROOT, check=True,
    )  # fmt: skip
    assert contents(farm) == contents(single) and len(read_scene(farm).points)


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a capture by name; of images only the pixels, because Blender stores dates."""
    exact = [file for file in folder.rglob("*") if file.suffix in (".json", ".bin")]
    images = {file.name: np.asarray(Image.open(file)).tobytes() for file in folder.rglob("*.png")}
    assert len(images) == 5 and len(exact) == 8
    return images | {file.name: file.read_bytes() for file in exact}
