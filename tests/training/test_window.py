"""``make window`` says what is missing, and passes only when the tour does. The tour needs a window."""

import sys

import pytest

from tools import window


@pytest.mark.parametrize("missing", ["blender", "Xvfb", "import"])
def test_missing_program_is_named(tmp_path, monkeypatch, missing):
    monkeypatch.delenv("BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in {"blender", "Xvfb", "import"} - {missing}:
        program(tmp_path / name, "")
    with pytest.raises(SystemExit, match=rf"window: {missing.replace('blender', 'Blender')} is missing; \w+"):
        window.find_programs()


@pytest.mark.parametrize(
    ("does", "problem"),
    [
        ("facts('01-tab', 'passed')", ""),
        ("facts('01-tab', 'failed after tab: No cameras.')", "failed after tab: No cameras."),
        ("facts('01-tab')", "Blender ended before the tour did"),
        ("pass", "Blender ended before the tour did"),
        ("facts('passed'); raise OSError('by the way')", "There was an error by the way"),
    ],
)
def test_tour_passes_only_when_all_steps_did(tmp_path, does, problem):
    blender = program(
        tmp_path / "blender",
        "import json, pathlib, sys\n"
        "plan = json.loads(sys.argv[-1])\n"
        "facts = lambda *lines: pathlib.Path(plan['out'], 'facts.txt').write_text('\\n'.join(lines))\n"
        + does,
    )
    plan = {"out": str(tmp_path), "run": str(tmp_path / "run")}
    found = window.tour(str(blender), plan, tmp_path / "blender.log")
    assert found.startswith(problem) and bool(found) == bool(problem)


@pytest.mark.parametrize(("more", "script"), [({}, "window_tour.py"), ({"flight": "x"}, "window_flight.py")])
def test_a_flight_has_its_own_steps(tmp_path, more, script):
    blender = program(
        tmp_path / "blender",
        "import pathlib, sys\n"
        f"pathlib.Path({str(tmp_path)!r}, 'facts.txt').write_text('passed')\n"
        "print(sys.argv[sys.argv.index('--python') + 1])",
    )
    plan = {"out": str(tmp_path), "run": str(tmp_path / "run")} | more
    assert not window.tour(str(blender), plan, tmp_path / "blender.log")
    assert (tmp_path / "blender.log").read_text().strip().endswith(f"tools/{script}")


def program(path, code):
    path.write_text(f"#!{sys.executable}\n{code}\n")
    path.chmod(0o755)
    return path
