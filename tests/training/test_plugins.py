"""Methods and rules of third-party packages, installed beside a checkout."""

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

METHOD = """
from dataclasses import replace
from lodgs.methods.threedgs import METHOD as BASE

METHOD = replace(BASE, name="plugged", number=1000, label="Plugged", about="for tests", rule="plugged")
"""
TRAIN = """
from lodgs.methods.threedgs.train import Method as Base

class Method(Base):
    pass
"""
RULE = """
import numpy as np
from lodgs.lod.rule import NO_TABLES, Rule

class Plugged(Rule):
    name = "plugged"

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES):
        return np.ones(len(means), np.float32)

RULE = Plugged()
"""
RECIPE = """
from math import inf

import numpy as np
from lodgs.lod.rule import NO_COLUMNS, NO_TABLES, Control, Rule, distances

class Rings(Rule):
    name = "rings"
    level_facts = ("radius",)
    columns = ("importance",)
    lengths = ("radius",)
    controls = (Control("gain", 1.0, 0.1, 10.0, "Gain", "Factor on all radii"),)

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES):
        near, far = self.distance_band(focal_px, facts, values)
        distance = distances(means, position) / (1 + columns["importance"])
        return ((distance >= near) & (distance < far)).astype(np.float32)

    def distance_band(self, focal_px, facts, values, highest=NO_COLUMNS):
        return values["gain"] * facts["radius"], values["gain"] * facts["coarser_radius"] or inf

RULE = Rings()
"""
EXPORT = """
import sys
import numpy as np
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

def level(number, count, radius):
    means, rest = np.zeros((count, 3), "f4"), np.ones((count, 4), "f4")
    importance = {"importance": np.arange(count, dtype="f4") % 2}
    splats = Splats(means, rest, means - 2, means[:, 0], means[:, None], importance)
    return Level(number, splats, {"radius": radius})

write_bundle(sys.argv[1], Bundle("", [level(1, 10, 8.0), level(2, 20, 0.0)], "rings"))
"""
SELECT = """
import sys
import training

for distance in (5, 10, 30, 40):
    selected = training.select(training.load_bundle(sys.argv[1]), (0, 0, distance), 500, {"gain": 1.5})
    print(*[len(rows) for rows, _ in selected.values()])
"""
BROKEN = {
    "absent_package": ("lodgs.methods", "no_such_package", "No module named 'no_such_package'"),
    "taken_number": ("lodgs.methods", "taken_number", "another method has the number 3"),
    "taken_name": ("lodgs.methods", "taken_name", "another method has the name '3dgs'"),
    "no_method": ("lodgs.methods", "no_method", "METHOD is not a MethodInfo"),
    "no_train": ("lodgs.methods", "no_train", "no module no_train.train"),
    "crash": ("lodgs.rules", "crash", "ZeroDivisionError: division by zero"),
    "no_rule": ("lodgs.rules", "no_rule", "RULE is not a Rule"),
    "taken_rule": ("lodgs.rules", "taken_rule", "another rule has the name 'decay'"),
}
"""Group, module and expected reason of broken plug-ins by name."""
SOURCES = {
    "taken_number/__init__.py": METHOD.replace('"plugged", number=1000', '"numbered", number=3'),
    "taken_name/__init__.py": METHOD.replace('"plugged", n', '"3dgs", n'),
    "no_method/__init__.py": "METHOD = 3",
    "no_train/__init__.py": METHOD.replace('"plugged", number=1000', '"no_train", number=1001'),
    "crash.py": "1 / 0",
    "no_rule.py": "RULE = None",
    "taken_rule.py": "from lodgs.lod.rules.decay import RULE",
}


def install(folder: Path, package: str, entries: str, files: dict[str, str]) -> None:
    """Write a package's files and metadata as pip does."""
    metadata = folder / f"{package}-1.0.dist-info"
    for path, text in {
        **{folder / name: text for name, text in files.items()},
        metadata / "METADATA": f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n",
        metadata / "entry_points.txt": entries,
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def run_python(folder: Path, *arguments) -> subprocess.CompletedProcess:
    """Run Python with the packages of a folder installed."""
    process = subprocess.run(
        [sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=240, check=False,
        cwd=ROOT, env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    return process


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return ``run(*arguments)``, which runs Python with a plug-in and broken plug-ins installed."""
    folder = tmp_path_factory.mktemp("site")
    files = {"plugged/__init__.py": METHOD, "plugged/train.py": TRAIN, "plugged/rule.py": RULE}
    install(
        folder,
        "plugged",
        "[lodgs.methods]\nplugged = plugged\n[lodgs.rules]\nplugged = plugged.rule\n",
        files,
    )
    groups = {
        group: "".join(f"{name} = {module}\n" for name, (g, module, _) in BROKEN.items() if g == group)
        for group in ("lodgs.methods", "lodgs.rules")
    }
    install(folder, "broken", "".join(f"[{group}]\n{lines}" for group, lines in groups.items()), SOURCES)
    return partial(run_python, folder)


def test_methods_are_listed_and_broken_plugins_only_warn(run):
    process = run("-m", "training", "methods")
    lines = process.stdout.splitlines()
    assert lines[-1].split() == ["plugged", "Plugged:", "for", "tests"]
    assert [line.split()[0] for line in lines[:-1]].count("3dgs") == 1
    for name, (group, _, reason) in BROKEN.items():
        warning = f"Skipped '{name}' ({group}) of the package broken: "
        assert (warning in process.stderr) == (group == "lodgs.methods"), name
        assert (reason in process.stderr) == (group == "lodgs.methods"), name


def test_rules_are_found_and_broken_plugins_only_warn(run):
    process = run(
        "-c", "from training.lod.rule import find_rule, rules; print(find_rule('plugged'), *rules())"
    )
    assert "Plugged object" in process.stdout and process.stdout.split()[-1] == "plugged"
    for name, (group, _, reason) in BROKEN.items():
        if group == "lodgs.rules":
            assert f"Skipped '{name}' (lodgs.rules) of the package broken: " in process.stderr
            assert reason in process.stderr


def test_plugins_import_no_torch(run):
    run("-W", "ignore", "-c", "import sys, training.methods; assert 'torch' not in sys.modules")


def test_recipe_for_a_rule(tmp_path):
    """A new rule needs one module: it selects, and edits scale its lengths."""
    install(tmp_path, "rings", "[lodgs.rules]\nrings = rings\n", {"rings.py": RECIPE})
    bundle, larger = tmp_path / "bundle.ply", tmp_path / "larger.ply"
    run_python(tmp_path, "-c", EXPORT, bundle)
    assert "rings" in run_python(tmp_path, "-m", "training", "info", bundle).stdout
    # the fine level ends at 12, and at 24 for the important half
    counts = run_python(tmp_path, "-c", SELECT, bundle).stdout.splitlines()
    assert counts == ["0 20", "0 20", "10 0", "10 0"]
    run_python(tmp_path, "-m", "training", "edit", bundle, "--out", larger, "--scale", "2")
    counts = run_python(tmp_path, "-c", SELECT, larger).stdout.splitlines()
    assert counts == ["0 20", "0 20", "5 10", "5 10"]


def test_restricted_rules_are_unknown(run):
    code = "from training.lod import rule; rule.restrict_rules(['bands']); print(*rule.rules())"
    assert run("-W", "ignore", "-c", code).stdout.split() == ["bands"]


@pytest.mark.slow
def test_method_trains_and_its_rule_selects(run, tiny_scene, tmp_path):
    process = run(
        "-m", "training", "train", "--scene", tiny_scene, "--out", tmp_path / "run", "--method", "plugged",
        "--set", "steps=3", "--image-scale", "1", "--test-every", "0", "--backend", "cpu",
    )  # fmt: skip
    events = [json.loads(line) for line in process.stdout.splitlines()]
    assert events[-1]["event"] == "done" and events[0]["method"] == "plugged"
    render = (
        "-m",
        "training",
        "render",
        tmp_path / "run",
        "--view",
        "00.jpg",
        "--out",
        tmp_path / "view.png",
    )
    run(*render, "--by-distance")
    assert (tmp_path / "view.png").stat().st_size > 100
