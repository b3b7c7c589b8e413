"""A job key that is declared with a panel has a property, and its value is in the jobs of a scene."""

import subprocess
import sys

import pytest

from tests.checkout import ROOT
from tests.training.runs.test_new_job_key import checkout_with_key

pytestmark = pytest.mark.one_blender


SCRIPT = """
import importlib, sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock
from tools import blender_module

blender_module.REPOSITORY = Path(sys.argv[1])
bpy = blender_module.start_blender()

def lodgs(name):
    return importlib.import_module(f"{blender_module.EXTENSION}.blender_lodgs.{name}")

root = bpy.data.objects.new("root", None)
bpy.context.scene.collection.objects.link(root)
root.lodgs.is_root, root.lodgs.scene_folder = True, "/scene"
fog = root.lodgs.training.bl_rna.properties["fog"]
assert (fog.name, fog.description, fog.subtype) == ("Fog", "Density of the fog", "PIXEL")
assert (fog.default, fog.hard_min, fog.hard_max, fog.soft_max) == (0.5, 0.25, 2, 1)
root.lodgs.training.fog = 0.75
settings = lodgs("runs.job_settings")
job = settings.make_job(root, Path("/run"), {})
assert job.fog == 0.75
root.lodgs.training.fog = 1
settings.apply_job(root.lodgs.training, job)
assert root.lodgs.training.fog == 0.75
bpy.context.view_layer.objects.active = root
layout = MagicMock()
lodgs("panels.training").LODGS_PT_training_advanced.draw(SimpleNamespace(layout=layout), bpy.context)
assert "fog" in [call.args[1] for call in layout.prop.call_args_list]
"""


def test_new_key_has_a_property_and_is_in_jobs(bpy, tmp_path):
    checkout = checkout_with_key(tmp_path / "checkout")
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT, checkout], cwd=ROOT, capture_output=True, text=True, check=False,
        timeout=600,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
