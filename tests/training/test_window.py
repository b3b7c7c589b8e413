"""``make window``: missing programs, script results. The scripts themselves need a window."""

import sys

import pytest

from tools import window


@pytest.mark.parametrize("missing", ["blender", "Xvfb", "import"])
def test_missing_program_is_reported(tmp_path, monkeypatch, missing):
    monkeypatch.delenv("BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in {"blender", "Xvfb", "import"} - {missing}:
        program(tmp_path / name, "")
    with pytest.raises(SystemExit, match=rf"window: {missing.replace('blender', 'Blender')} not found. \w+"):
        window.find_programs()


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        ("facts('01-tab', 'passed')", ""),
        ("facts('01-tab', 'failed after tab: No cameras.')", "failed after tab: No cameras."),
        ("facts('01-tab')", "Blender ended before the script"),
        ("pass", "Blender ended before the script"),
        ("facts('passed'); raise OSError('unexpected')", "Errors were logged"),
    ],
)
def test_script_passes_only_if_all_steps_pass(tmp_path, code, problem):
    blender = program(
        tmp_path / "blender",
        "import json, pathlib, sys\n"
        "plan = json.loads(sys.argv[-1])\n"
        "facts = lambda *lines: pathlib.Path(plan['out'], 'facts.txt').write_text('\\n'.join(lines))\n"
        + code,
    )
    plan = {"out": str(tmp_path), "run": str(tmp_path / "run")}
    result = window.run_script(str(blender), plan, tmp_path / "blender.log")
    assert result.startswith(problem) and bool(result) == bool(problem)


@pytest.mark.parametrize(("keys", "script"), [({}, "window_tour.py"), ({"flight": "x"}, "window_flight.py")])
def test_flight_runs_its_own_script(tmp_path, keys, script):
    blender = program(
        tmp_path / "blender",
        "import pathlib, sys\n"
        f"pathlib.Path({str(tmp_path)!r}, 'facts.txt').write_text('passed')\n"
        "print(sys.argv[sys.argv.index('--python') + 1])",
    )
    plan = {"out": str(tmp_path), "run": str(tmp_path / "run")} | keys
    assert not window.run_script(str(blender), plan, tmp_path / "blender.log")
    assert (tmp_path / "blender.log").read_text().strip().endswith(f"tools/{script}")


def program(path, code):
    path.write_text(f"#!{sys.executable}\n{code}\n")
    path.chmod(0o755)
    return path
