"""Who may import whom: only the extension knows Blender, and what Blender loads needs no trainer."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TRAINER_ONLY = {"torch", "numba", "pycolmap", "PIL", "OpenEXR", "scipy", "torchmetrics", "matplotlib"}
FOR_BLENDER = [
    "training.errors",
    "training.files",
    "training.lod.rules",
    "training.methods",
    "training.methods.parameters",
    "training.render.picture",
    "training.render.wire",
    "training.runs.folder",
    "training.runs.job",
    "training.scenes.cameras",
    "training.scenes.colmap",
    "training.scenes.orientation",
    "training.splats.bundle",
    "training.splats.gaussians",
    "training.splats.ply",
]


def imports(path: Path) -> set[str]:
    """Top-level packages that a file imports, anywhere in it; relative imports count as none."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


def test_only_the_extension_imports_bpy():
    files = sorted((ROOT / "training").rglob("*.py"))
    assert len(files) > 20
    assert [path for path in files if imports(path) & {"bpy", "bpy_extras", "gpu", "mathutils"}] == []
    assert any("bpy" in imports(path) for path in (ROOT / "blender_lodgs").rglob("*.py"))


def test_the_extension_never_imports_the_trainers_packages():
    files = sorted((ROOT / "blender_lodgs").rglob("*.py"))
    assert [(path, imports(path) & TRAINER_ONLY) for path in files if imports(path) & TRAINER_ONLY] == []


def test_imports_inside_the_packages_are_relative():
    for package in ("training", "blender_lodgs"):
        for path in (ROOT / package).rglob("*.py"):
            assert not imports(path) & {"training", "blender_lodgs", "bl_ext"}, path


@pytest.mark.parametrize("module", FOR_BLENDER)
def test_what_blender_loads_works_without_the_trainer(module):
    blocked = f"""
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {TRAINER_ONLY!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
import {module}
"""
    done = subprocess.run([sys.executable, "-c", blocked], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
