"""Build dist/lodgs-VERSION.zip with Blender's extension tool, and validate it.

Needs git, and a Python with pip and the bpy wheel: ``python tools/extension.py``.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from tools.viewer import FOLDER as VIEWER  # noqa: E402
from tools.viewer import fetch  # noqa: E402


def read_manifest() -> dict:
    """Return the extension's manifest."""
    return tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))


def blender_tool() -> list[str]:
    """Return the command of the extension tool in the bpy wheel; exit with a message if it is missing."""
    spec = importlib.util.find_spec("bpy")  # finds the tool without starting Blender
    for folder in spec.submodule_search_locations or [] if spec else []:
        for tool in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"):
            return [sys.executable, str(tool)]
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


def tracked_files() -> list[str]:
    """Return the paths of all files that git tracks, relative to the repository's root."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z"]
    names = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [name for name in names.split("\0") if name and (ROOT / name).is_file()]


def build(folder: Path, version: str | None = None, website: str | None = None) -> Path:
    """Build and validate the zip from the tracked files.

    Args:
        folder: output folder; created if it does not exist.
        version: replaces the manifest's version, for tests of updates.
        website: address of the documentation, added to the manifest.

    Returns:
        The zip file. Exits with Blender's message on errors.
    """
    manifest = read_manifest()
    fetch_wheels(manifest["wheels"])
    folder.mkdir(parents=True, exist_ok=True)
    archive = folder / f"{manifest['id']}-{version or manifest['version']}.zip"
    with tempfile.TemporaryDirectory() as work:
        viewer = [path.relative_to(ROOT).as_posix() for path in VIEWER.glob("*")] if fetch() else []
        for name in [*tracked_files(), *viewer, *manifest["wheels"]]:
            target = Path(work, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
        copy = Path(work, "blender_manifest.toml")
        text = copy.read_text("utf-8").replace(manifest["version"], version or manifest["version"], 1)
        if website:
            text = text.replace('\ntype = "add-on"', f'\nwebsite = "{website}"\ntype = "add-on"', 1)
        copy.write_text(text, "utf-8")
        for command in (
            ["build", "--source-dir", work, "--output-filepath", str(archive)],
            ["validate", str(archive)],
        ):
            if code := subprocess.run([*blender_tool(), *command], check=False).returncode:
                sys.exit(code)
    return archive


def write_repository(folder: Path) -> None:
    """Write index.json and index.html for the zips of a folder, which Blender accepts as a repository."""
    command = [*blender_tool(), "server-generate", f"--repo-dir={folder}", "--html"]
    if code := subprocess.run(command, check=False).returncode:
        sys.exit(code)
    page = folder / "index.html"
    text = page.read_text(encoding="utf-8")
    if "<td>~</td>" in text:  # no website
        page.write_text(re.sub(r" *<t[hd]>(Website|~)</t[hd]>\n", "", text), encoding="utf-8")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(build(ROOT / "dist"))
