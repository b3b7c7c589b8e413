"""Copy of this checkout, to which a test adds files as a recipe in CONTRIBUTING says."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from textwrap import dedent

ROOT = Path(__file__).resolve().parents[1]
_PARTS = "blender_lodgs", "training", "tools", "__init__.py", "blender_manifest.toml"


def copy_checkout(folder: Path, package: str) -> None:
    """Copy a package into a folder, and link the other parts that Blender and the command line need."""
    for name in _PARTS:
        if name == package:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            (folder / name).symlink_to(ROOT / name)


def recipe_code(title: str, text: str = "", language: str = "python") -> str:
    """Return the code block in a section of CONTRIBUTING that contains a text."""
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = contributing.split(f"## {title}\n")[1].split("\n## ")[0]
    blocks = re.findall(rf"^ *```{language}\n(.*?)^ *```$", section, re.DOTALL | re.MULTILINE)
    (block,) = (dedent(block) for block in blocks if text in block)
    return block
