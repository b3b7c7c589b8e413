"""Camera choices: stored numbers, and a new choice that is declared by one entry of the table."""

import subprocess
import sys

import pytest

from tests.checkout import ROOT, copy_checkout

pytestmark = pytest.mark.one_blender


ENTRY = '    CameraChoice("SECOND", "Second Object", "Another object", object="second_camera"),\n'
LAST = "    VIEWPORT,\n)\n"
SCRIPT = """
import importlib, sys
from pathlib import Path
import numpy as np
from tools import blender_module

blender_module.REPOSITORY = Path(sys.argv[1])
bpy = blender_module.start_blender()

def lodgs(name):
    return importlib.import_module(f"{blender_module.EXTENSION}.{name}")

levels, gaussians = lodgs("training.splats.levels"), lodgs("training.splats.gaussians")
n = 100
means = np.float32([[x, 0, 0] for x in range(n)])
ones = np.ones((n, 4), np.float32)
splats = gaussians.Splats(means, ones, ones[:, :3], ones[:, 0], ones[:, None, :3])
facts = [{"s_min": 0.01}, {"s_min": 0.0}]
numbered = [levels.Level(number, splats, fact) for number, fact in enumerate(facts, 1)]
bundle = levels.Bundle("flod", numbered, rule="bands")
with lodgs("blender_lodgs.data.importing").new_scene(bpy.context, "scene") as root:
    lodgs("blender_lodgs.data.scenes").set_bundle_facts(root, bundle)
    for level in bundle.levels:
        lodgs("blender_lodgs.data.scenes").set_level(root, level)
settings = root.lodgs
camera, second = bpy.data.objects.new("a", bpy.data.cameras.new("a")), bpy.data.objects.new("b", None)
for obj in (camera, second):
    bpy.context.scene.collection.objects.link(obj)
bpy.context.scene.camera, second.location = camera, (60, 0, 0)
settings.mode, settings.bands.first = "SELECTIVE", 1
selection = lodgs("blender_lodgs.data.selection")

def visible():
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = settings.levels[1].object.evaluated_get(depsgraph)
    query = selection.evaluated_query(evaluated, depsgraph)
    near = 0.01 * settings.focal_px > np.abs(means[:, 0] - query.position[0])
    assert near.any() and len(evaluated.data.points) == near.sum() < n
    return query.position

assert settings.bl_rna.properties["camera_choice"].enum_items["SECOND"].value == 4
assert visible() == (0, 0, 0)
settings.camera_choice, settings.second_camera = "SECOND", second
np.testing.assert_allclose(visible(), (60, 0, 0), atol=1e-5)
settings.freeze = True
second.location = (0, 0, 0)
np.testing.assert_allclose(visible(), (60, 0, 0), atol=1e-5)
settings.freeze = False
assert visible() == (0, 0, 0)
"""


def test_entry_of_the_table_declares_a_choice(tmp_path):
    copy_checkout(tmp_path, "blender_lodgs")
    table = tmp_path / "blender_lodgs/nodes/camera_choices.py"
    text = table.read_text()
    assert text.count(LAST) == 1
    table.write_text(text.replace(LAST, f"    VIEWPORT,\n{ENTRY})\n"))
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path], capture_output=True, text=True, timeout=600, check=False,
        cwd=ROOT,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr


def test_numbers_of_choices_in_files(bpy, lodgs):
    items = lodgs("data.scene_properties").SplatScene.bl_rna.properties["camera_choice"].enum_items
    numbers = {item.identifier: item.value for item in items}
    assert numbers == {"CAMERA": 0, "OBJECT": 1, "TRAINING": 2, "VIEW": 3}


def test_position_drivers_need_no_scripts(bpy, lodgs):
    choices = lodgs("nodes.camera_choices")
    expression = choices.position_expression("camera_choice", "freeze")
    for values, expected in (
        ({"camera_choice": 2, "freeze": 0}, "center"), ({"camera_choice": 3, "freeze": 0}, "held"),
        ({"camera_choice": 2, "freeze": 1}, "held"), ({"camera_choice": 0, "freeze": 0}, "held"),
    ):  # fmt: skip
        values |= {"camera_center": "center", "stored_position": "held"}
        assert eval(expression, values) == expected
