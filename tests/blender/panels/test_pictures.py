"""Pictures of panels in the documentation."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_layouts_match_the_pictures_of_panels(bpy, tmp_path):
    if bpy.app.version[:2] != (4, 5):
        pytest.skip("layouts are recorded in Blender 4.5")
    current = tmp_path / "panels.json"
    tool = [sys.executable, str(ROOT / "tools" / "panel_layouts.py"), str(current)]
    subprocess.run(tool, check=True, capture_output=True, timeout=600)
    recorded = json.loads((ROOT / "docs" / "images" / "panels.json").read_text())
    digests = json.loads(current.read_text())
    changed = sorted(name for name in digests | recorded if digests.get(name) != recorded.get(name))
    assert not changed, f"{changed} changed after their pictures: run make pictures"


def test_all_pictures_exist_and_are_linked():
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "examples" / "README.md"]
    linked = {name for page in pages for name in re.findall(r"images/([\w-]+\.\w+)", page.read_text("utf-8"))}
    files = {path.name for path in (ROOT / "docs" / "images").iterdir()} - {"panels.json"}
    assert files == {name for name in linked if (ROOT / "docs" / "images" / name).exists()}
