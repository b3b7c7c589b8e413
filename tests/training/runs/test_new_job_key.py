"""A job key is added by its declaration alone: see "Add a job key" in CONTRIBUTING."""

import json
import subprocess
import sys
from pathlib import Path

from tests.checkout import copy_checkout

KEY = """
    fog: float = setting(
        0.5, "Density of the fog.", low=0.25, high=2, soft=(None, 1), unit="px", panel="Advanced"
    )
"""
SCRIPT = """
import argparse, json, sys
from pathlib import Path
from training.cli.job_options import add_options, job_from_options, options_of
from training.errors import LodgsError
from training.runs.job import Job
from tools import tables  # last: it puts the original checkout on the path

parser = argparse.ArgumentParser()
add_options(parser)
job = job_from_options(parser.parse_args(["--scene", "/scene", "--out", sys.argv[1], "--fog", "1"]))
job.write(path := Path(sys.argv[1]) / "job.toml")
try:
    Job.from_dict({"scene": "/scene", "out": "/run", "fog": 3})
except LodgsError as error:
    message = str(error)
print(json.dumps({
    "help": parser.format_help(), "options": options_of(job), "error": message,
    "reread": Job.from_file(path).fog, "docs": tables.job_page(),
}))
"""


def checkout_with_key(folder: Path) -> Path:
    """Copy the checkout, with KEY added to the declaration of jobs."""
    folder.mkdir()
    copy_checkout(folder, "training")
    declaration = folder / "training" / "runs" / "job.py"
    before, marker, after = declaration.read_text().partition("    parameters: dict = ")
    declaration.write_text(before + KEY.lstrip("\n") + marker + after)
    return folder


def test_new_key_has_option_check_and_documentation(tmp_path):
    checkout = checkout_with_key(tmp_path / "checkout")
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    result = json.loads(process.stdout)
    assert "--fog PX" in result["help"] and "density of the fog (default 0.5)" in result["help"]
    assert result["options"][-2:] == ["--fog", "1.0"] and result["reread"] == 1.0
    assert "fog = 3 is invalid" in result["error"] and "at least 0.25 and at most 2" in result["error"]
    assert "| `fog` | Density of the fog. | 0.25 to 2 | px | 0.5 |" in result["docs"]
