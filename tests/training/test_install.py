"""``pip install`` from a checkout: the package ``lodgs`` and its command, where no checkout is."""

import json
import os
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from training import VERSION

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def lodgs(tmp_path_factory):
    """``lodgs(words)`` runs the command of a fresh environment that has our wheel and borrows the rest."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    offline = ["--quiet", "--no-deps", "--no-index"]
    wheel = [*pip, "wheel", *offline, "--no-build-isolation", "--wheel-dir", folder, ROOT]
    subprocess.run(wheel, check=True, timeout=120)
    venv.create(folder / "venv")
    paths = {"base": str(folder / "venv"), "platbase": str(folder / "venv")}
    python = Path(sysconfig.get_path("scripts", "venv", paths)) / "python"
    site = Path(sysconfig.get_path("purelib", "venv", paths))
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (built,) = folder.glob("lodgs-*.whl")
    with zipfile.ZipFile(built) as file:
        assert "lodgs/rasterize/gpu/shaders/sort.wgsl" in file.namelist()
    subprocess.run([*pip, "--python", python, "install", *offline, built], check=True, timeout=120)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*words) -> str:
        done = subprocess.run(
            [python.with_name("lodgs"), *map(str, words)],
            cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.mark.slow
def test_the_installed_command_checks_trains_and_reads(lodgs, tiny_scene, tmp_path):
    assert lodgs("--version") == f"lodgs {VERSION}\n"
    found = json.loads(lodgs("check"))
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {line.partition(">=")[0].lower() for line in wanted}
    assert found["ok"] and names <= {name.lower() for name in found}
    events = lodgs(
        "train", "--scene", tiny_scene, "--out", tmp_path / "run", "--image-scale", 1, "--set", "levels=2",
        "--set", "steps=5",
    )  # fmt: skip
    assert json.loads(events.splitlines()[-1])["event"] == "done"
    assert lodgs("info", tmp_path / "run" / "bundle.ply").count("\n") > 2
    assert "Automatic trains on" in json.loads(lodgs("devices", "--json"))["sentence"]
