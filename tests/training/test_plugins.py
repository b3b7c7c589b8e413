"""Methods and rules of third-party packages, installed beside a checkout."""

import json
import os
import subprocess
import sys
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

    def run(*arguments) -> subprocess.CompletedProcess:
        process = subprocess.run(
            [sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=240, check=False,
            cwd=ROOT, env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])},
        )  # fmt: skip
        assert process.returncode == 0, process.stdout + process.stderr
        return process

    return run


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
