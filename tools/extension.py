"""Builds dist/lodgs-VERSION.zip with Blender's own tool, and has the same tool validate it.

Run from anywhere with a Python that has pip and the bpy wheel: ``python tools/extension.py``.
"""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def blender_tool() -> Path:
    """The extension tool inside the bpy wheel. Exits with a sentence if there is none."""
    found = importlib.util.find_spec("bpy")  # not imported: Blender need not start
    for folder in found.submodule_search_locations or [] if found else []:
        for tool in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"):
            return tool
    sys.exit("extension: the package bpy is missing in this Python; run `make setup` first.")


def fetch_wheels(wheels: list[str]) -> None:
    """Download the wheels that the manifest names unless they are there, and make sure of their hashes."""
    lock = (ROOT / "requirements" / "trainer.txt").read_text(encoding="utf-8")
    for wheel in (ROOT / name for name in wheels):
        if not wheel.exists():
            name, version, *_ = wheel.name.split("-")
            command = [
                sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:",
                "--dest", str(wheel.parent), f"{name}=={version}",
            ]  # fmt: skip
            if subprocess.run(command, check=False).returncode:
                sys.exit(f"extension: {wheel.name} could not be downloaded; check the network.")
        if f"--hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}" not in lock:
            sys.exit(f"extension: {wheel} is not the wheel of requirements/trainer.txt; remove it.")


def build(folder: Path) -> Path:
    """Build and validate the zip.

    Args:
        folder: where the zip goes; made if it is missing.

    Returns:
        The zip. Exits with Blender's message if it refuses something.
    """
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    fetch_wheels(manifest["wheels"])
    folder.mkdir(parents=True, exist_ok=True)
    archive = folder / f"{manifest['id']}-{manifest['version']}.zip"
    tool = [sys.executable, str(blender_tool())]
    for command in (
        [*tool, "build", "--source-dir", str(ROOT), "--output-filepath", str(archive)],
        [*tool, "validate", str(archive)],
    ):
        if code := subprocess.run(command, check=False).returncode:
            sys.exit(code)
    return archive


if __name__ == "__main__":
    print(build(ROOT / "dist"))
