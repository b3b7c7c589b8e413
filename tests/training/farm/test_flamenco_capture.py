"""The job type for Flamenco that captures a Blender scene: what it compiles, and what its commands do."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.training.farm.test_flamenco import ROOT, compiled, needs_node
from training.scenes.colmap import read_scene

SCRIPT = ROOT / "farm" / "flamenco" / "lodgs_capture.js"
SCENE = """
import sys, bpy
bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
bpy.ops.mesh.primitive_plane_add(size=9)
bpy.ops.mesh.primitive_cube_add(location=(0, 0, 1))
bpy.context.scene.render.engine, bpy.context.scene.cycles.samples = "CYCLES", 1
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
sys.stdout.flush(), __import__("os")._exit(0)
"""
BLENDER = [sys.executable, str(ROOT / "tests" / "blender" / "as_blender.py")]


@needs_node
def test_ranges_hold_each_view_once_and_the_model_waits_for_all(tmp_path):
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
    (walk, _) = compiled(tmp_path, SCRIPT, views_from="curve", curve="My Way", views=4)["tasks"]
    at = walk["commands"][0]["args"].index("--curve")
    assert walk["commands"][0]["args"][at + 1] == "My Way"


@needs_node
@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="Blender's module is not installed")
def test_its_commands_one_after_the_other_give_the_scene_of_one_command(tmp_path, monkeypatch):
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", sys.executable)
    blend, farm, one = tmp_path / "scene.blend", tmp_path / "farm", tmp_path / "one"
    subprocess.run([sys.executable, "-c", SCENE, str(blend)], check=True)
    tasks = compiled(
        tmp_path, SCRIPT, blendfile=str(blend), output=str(farm), views=5, chunk=2, width=64, height=48
    )["tasks"]  # fmt: skip
    assert len(tasks) == 4
    for task in tasks:
        assert not (farm / "sparse").exists()
        for command in task["commands"]:
            subprocess.run([*BLENDER, *command["args"]], check=True)
    last = [word if word != str(farm) else str(one) for word in tasks[-1]["commands"][0]["args"]]
    subprocess.run([*BLENDER, *last], check=True)
    assert kept(farm) == kept(one) and len(read_scene(farm).points)


def kept(folder: Path) -> dict[str, bytes]:
    """What a capture has left, by name, without the dates that Blender writes into its files."""
    exact = [file for file in folder.rglob("*") if file.suffix in (".json", ".bin")]
    pictures = {file.name: np.asarray(Image.open(file)).tobytes() for file in folder.rglob("*.png")}
    assert len(pictures) == 5 and len(exact) == 8
    return pictures | {file.name: file.read_bytes() for file in exact}
