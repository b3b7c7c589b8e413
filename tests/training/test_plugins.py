"""Methods and rules of third-party packages, installed beside a checkout."""

import json
import os
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import pytest

from tests.checkout import ROOT, recipe_code
from training.splats.bundle import read_bundle

METHOD = recipe_code("Add a method", "METHOD = MethodInfo(")
TRAIN = recipe_code("Add a method", "class Method(")
PROJECT = tomllib.loads(recipe_code("Add a method", language="toml"))["project"]
ENTRY_POINT = PROJECT["entry-points"]["lodgs.methods"]
RULE = """
import numpy as np
from lodgs.lod.rule import NO_TABLES, Rule

class Plugged(Rule):
    name = "plugged"

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES):
        return np.ones(len(means), np.float32)

RULE = Plugged()
"""
RECIPE = recipe_code("Add a rule", "RULE = Rings()").replace("from ..rule", "from lodgs.lod.rule")
EXPORT_AND_SELECT = """
import sys
import numpy as np
import training
from training.__main__ import main
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

def level(number, count, radius):
    means, rest = np.zeros((count, 3), "f4"), np.ones((count, 4), "f4")
    importance = {"importance": np.arange(count, dtype="f4") % 2}
    splats = Splats(means, rest, means - 2, means[:, 0], means[:, None], importance)
    return Level(number, splats, {"radius": radius})

def print_counts(path):
    for distance in (5, 10, 30, 40):
        selected = training.select(training.load_bundle(path), (0, 0, distance), 500, {"gain": 1.5})
        print(*[len(rows) for rows, _ in selected.values()])

bundle, larger = sys.argv[1:]
write_bundle(bundle, Bundle("", [level(1, 10, 8.0), level(2, 20, 0.0)], "rings"))
print_counts(bundle)
assert main(["edit", bundle, "--out", larger, "--scale", "2"]) == 0
print_counts(larger)
assert main(["info", bundle]) == 0
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
    "taken_number/__init__.py": METHOD.replace('"mymethod"', '"numbered"').replace("number=1000", "number=3"),
    "taken_name/__init__.py": METHOD.replace('"mymethod"', '"3dgs"'),
    "no_method/__init__.py": "METHOD = 3",
    "no_train/__init__.py": METHOD.replace('"mymethod"', '"no_train"').replace("number=1000", "number=1001"),
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
        [sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=600, check=False,
        cwd=ROOT, env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])},
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    return process


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return ``run(*arguments)``, which runs Python with a plug-in and broken plug-ins installed."""
    folder = tmp_path_factory.mktemp("site")
    method = METHOD.replace(
        "    parameters=MyParameters,", '    parameters=MyParameters,\n    rule="plugged",'
    )
    files = {"mymethod/__init__.py": method, "mymethod/train.py": TRAIN, "mymethod/rule.py": RULE}
    ((name, module),) = ENTRY_POINT.items()
    entries = f"[lodgs.methods]\n{name} = {module}\n[lodgs.rules]\nplugged = mymethod.rule\n"
    install(folder, "mymethod", entries, files)
    groups = {
        group: "".join(f"{name} = {module}\n" for name, (g, module, _) in BROKEN.items() if g == group)
        for group in ("lodgs.methods", "lodgs.rules")
    }
    install(folder, "broken", "".join(f"[{group}]\n{lines}" for group, lines in groups.items()), SOURCES)
    return partial(run_python, folder)


def test_methods_are_listed_and_broken_plugins_only_warn(run):
    process = run("-m", "training", "methods")
    lines = process.stdout.splitlines()
    assert " ".join(lines[-1].split()) == "mymethod My method: the points of the scene as splats"
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
    lines = run_python(tmp_path, "-c", EXPORT_AND_SELECT, bundle, larger).stdout.splitlines()
    # the fine level ends at 12, for the important half at 24
    assert lines[:4] == ["0 20", "0 20", "10 0", "10 0"]
    lines = lines[lines.index(f"{larger}: written") + 1 :]
    assert lines[:4] == ["0 20", "0 20", "5 10", "5 10"]
    assert "rings" in "".join(lines[4:])


def test_restricted_rules_are_unknown(run):
    code = "from training.lod import rule; rule.restrict_rules(['bands']); print(*rule.rules())"
    assert run("-W", "ignore", "-c", code).stdout.split() == ["bands"]


@pytest.mark.slow
def test_method_of_the_recipe_trains_and_its_rule_selects(run, tiny_scene, tmp_path):
    """Training writes a bundle, and rendering by distance uses the rule."""
    view = tmp_path / "view.png"
    train = [
        "train", "--scene", tiny_scene, "--out", tmp_path / "run", "--method", "mymethod", "--set", "steps=3",
        "--set", "interval=2", "--image-scale", "1", "--test-every", "0", "--backend", "cpu",
    ]  # fmt: skip
    render = ["render", tmp_path / "run", "--view", "00.jpg", "--out", view, "--by-distance"]
    commands = [list(map(str, train)), list(map(str, render))]
    code = f"from training.__main__ import main; sys.exit(any(main(words) for words in {commands}))"
    process = run("-c", f"import sys; {code}")
    events = [json.loads(line) for line in process.stdout.splitlines() if line.startswith("{")]
    assert events[-1]["event"] == "done" and events[0]["method"] == "mymethod"
    bundle = read_bundle(tmp_path / "run" / "bundle.ply")
    assert (bundle.method, bundle.rule) == ("mymethod", "plugged")
    assert [level.number for level in bundle.levels] == [1] and len(bundle.levels[0].splats) > 10
    assert view.stat().st_size > 100


def test_recipe_imports_no_other_method():
    assert ENTRY_POINT == {"mymethod": "mymethod"} and "lodgs.methods." not in METHOD + TRAIN
