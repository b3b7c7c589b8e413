"""Copy of this checkout, to which a test adds files as a recipe in CONTRIBUTING says."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_PARTS = "blender_lodgs", "training", "tools", "__init__.py", "blender_manifest.toml"


def copy_checkout(folder: Path, package: str) -> None:
    """Copy a package into a folder, and link the other parts that Blender and the command line need."""
    for name in _PARTS:
        if name == package:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            (folder / name).symlink_to(ROOT / name)


def recipe_code(title: str) -> str:
    """Return the Python code in a section of CONTRIBUTING."""
    section = (ROOT / "CONTRIBUTING.md").read_text().split(f"## {title}\n")[1].split("\n## ")[0]
    match = re.search(r"```python\n(.*?)```", section, re.S)
    assert match, title
    return match[1]
