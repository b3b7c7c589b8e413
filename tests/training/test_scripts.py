"""Command lines of the scripts in ``tools``, ``lab`` and ``examples``."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = [
    path.relative_to(ROOT).as_posix()
    for folder in ("tools", "lab", "examples") for path in sorted((ROOT / folder).glob("*.py"))
    if '\nif __name__ == "__main__":' in path.read_text("utf-8")
]  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize(("option", "code"), [("--help", 0), ("--no-such-option", 2)])
@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_explain_themselves_and_reject_unknown_options(script, option, code):
    path = Path(script)
    program = ["-m", f"examples.{path.stem}"] if path.parent.name == "examples" else [script]
    command = [sys.executable, *program, option]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == code, result.stderr
    assert (result.stderr if code else result.stdout).startswith(f"usage: {path.name}")
