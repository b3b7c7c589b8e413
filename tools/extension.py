"""Build dist/lodgs-VERSION.zip with Blender's extension tool, and validate it.

Needs a Python with pip and the bpy wheel: ``python tools/extension.py``.
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
    """Return the extension tool of the bpy wheel; exit with a message if it is missing."""
    spec = importlib.util.find_spec("bpy")  # finds the tool without starting Blender
    for folder in spec.submodule_search_locations or [] if spec else []:
        for tool in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"):
            return tool
    sys.exit("extension: the package bpy is not installed. Run `make setup` first.")


def fetch_wheels(wheels: list[str]) -> None:
    """Download missing wheels of the manifest, and verify their hashes."""
    lock = (ROOT / "requirements" / "trainer.txt").read_text(encoding="utf-8")
    for wheel in (ROOT / name for name in wheels):
        if not wheel.exists():
            name, version, *_ = wheel.name.split("-")
            command = [
                sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:",
                "--dest", str(wheel.parent), f"{name}=={version}",
            ]  # fmt: skip
            if subprocess.run(command, check=False).returncode:
                sys.exit(f"extension: cannot download {wheel.name}. Check the network.")
        if f"--hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}" not in lock:
            sys.exit(f"extension: {wheel} differs from the wheel in requirements/trainer.txt. Delete it.")


def build(folder: Path) -> Path:
    """Build and validate the zip.

    Args:
        folder: output folder; created if it does not exist.

    Returns:
        The zip file. Exits with Blender's message on errors.
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
