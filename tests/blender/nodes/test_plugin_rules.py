"""A rule of a third-party package, which has no node group."""

import os
import subprocess
import sys

import pytest

from tests.training.test_plugins import METHOD, ROOT, RULE, TRAIN, install

pytestmark = pytest.mark.one_blender


SCRIPT = """
import importlib, sys
import numpy as np
from tools.blender_module import EXTENSION, start_blender

bpy = start_blender()

def lodgs(name):
    return importlib.import_module(f"{EXTENSION}.{name}")

assert "mymethod" in lodgs("training.methods").METHODS
assert "plugged" not in lodgs("training.lod.rule").rules()
levels, gaussians = lodgs("training.splats.levels"), lodgs("training.splats.gaussians")
ones = np.ones((5, 4), np.float32)
splats = gaussians.Splats(ones[:, :3], ones, ones[:, :3], ones[:, 0], ones[:, None, :3])
bundle = levels.Bundle("mymethod", [levels.Level(n, splats) for n in (1, 2)], rule="plugged")
lodgs("training.splats.bundle").write_bundle(sys.argv[1], bundle)
root = lodgs("blender_lodgs.data.importing").import_splats(bpy.context, sys.argv[1])
assert root.lodgs.rule == "plugged" and root.lodgs.mode == "SINGLE" and not root.lodgs.by_distance
assert len(root.lodgs.levels) == 2
"""


def test_scene_with_a_plugin_rule_shows_one_level(tmp_path):
    files = {"mymethod/__init__.py": METHOD, "mymethod/train.py": TRAIN, "mymethod/rule.py": RULE}
    entries = "[lodgs.methods]\nmymethod = mymethod\n[lodgs.rules]\nplugged = mymethod.rule\n"
    install(tmp_path, "mymethod", entries, files)
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path / "bundle.ply"], capture_output=True, text=True, timeout=600,
        check=False, cwd=ROOT, env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(tmp_path)])},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    assert "Skipped" not in process.stderr
