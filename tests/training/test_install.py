"""``pip install`` of the package ``lodgs`` and its command, used outside the checkout."""

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
    """Return ``lodgs(*arguments)``, which runs the command in a new environment with our wheel.

    All other packages come from the test environment.
    """
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    offline = ["--quiet", "--no-deps", "--no-index"]
    wheel = [*pip, "wheel", *offline, "--no-build-isolation", "--wheel-dir", folder, ROOT]
    subprocess.run(wheel, check=True, timeout=600)
    venv.create(folder / "venv")
    paths = {"base": str(folder / "venv"), "platbase": str(folder / "venv")}
    python = Path(sysconfig.get_path("scripts", "venv", paths)) / "python"
    site = Path(sysconfig.get_path("purelib", "venv", paths))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (wheel_file,) = folder.glob("lodgs-*.whl")
    with zipfile.ZipFile(wheel_file) as file:
        data = {"lodgs/rasterize/gpu/shaders/sort.wgsl", "lodgs/rasterize/cuda/kernels.cu"}
        data |= {"lodgs/py.typed", "lodgs/__init__.pyi"}
        assert data <= set(file.namelist())
    subprocess.run([*pip, "--python", python, "install", *offline, wheel_file], check=True, timeout=600)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*arguments) -> str:
        process = subprocess.run(
            [python.with_name("lodgs"), *map(str, arguments)],
            cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    return run


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["reference", pytest.param("auto", marks=pytest.mark.nightly)])
def test_installed_command_checks_trains_and_reads(lodgs, tiny_scene, tmp_path, backend):
    """Every new copy of the package compiles its kernels, which takes half a minute: tested nightly."""
    assert lodgs("--version") == f"lodgs {VERSION}\n"
    versions = json.loads(lodgs("check"))
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {line.partition(">=")[0].lower() for line in dependencies}
    assert versions["ok"] and names <= {name.lower() for name in versions}
    events = lodgs(
        "train", "--scene", tiny_scene, "--out", tmp_path / "run", "--image-scale", 1, "--method", "3dgs",
        "--set", "steps=5", "--set", "margin=0", "--set", "free_depth=0", "--backend", backend,
    )  # fmt: skip
    assert json.loads(events.splitlines()[-1])["event"] == "done"
    assert lodgs("info", tmp_path / "run" / "bundle.ply").count("\n") > 2
