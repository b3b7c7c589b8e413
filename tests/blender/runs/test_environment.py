"""The trainer's Python: which one it is, and whether it can train."""

import json
from pathlib import Path

import pytest


@pytest.fixture
def environment(lodgs, tmp_path, monkeypatch):
    module = lodgs("runs.environment")
    monkeypatch.setattr(module, "folder", lambda: tmp_path / "trainer")
    monkeypatch.setattr(module, "report", None)
    monkeypatch.delenv(module.VARIABLE, raising=False)
    return module


@pytest.fixture
def preferences(lodgs, environment):
    found = lodgs("extension").preferences()
    found.python = ""
    yield found
    found.python = ""


def _program(path: Path, script: str) -> Path:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def test_the_variable_comes_before_the_preferences(environment, preferences, monkeypatch):
    with pytest.raises(Exception, match="none is set up"):
        environment.trainer_python()
    preferences.python = "/preferred/python"
    assert environment.trainer_python() == Path("/preferred/python")
    monkeypatch.setenv(environment.VARIABLE, "/pipeline/python")
    assert environment.trainer_python() == Path("/pipeline/python")


def test_the_newest_environment_that_is_ready_serves(environment, preferences, tmp_path):
    for number in (2, 9, 10, 11):
        (tmp_path / "trainer" / str(number)).mkdir(parents=True)
        if number != 11:  # still being made
            (tmp_path / "trainer" / str(number) / environment.READY).touch()
    assert [path.name for path in environment.made()] == ["10", "9", "2"]
    assert environment.trainer_python().relative_to(tmp_path / "trainer").parts[0] == "10"


def test_check_says_what_is_wrong(environment, tmp_path):
    assert environment.check(tmp_path / "none").problems == [f"There is no program {tmp_path / 'none'}."]
    (tmp_path / "text").write_text("no program")
    assert "not a program that may be run" in environment.check(tmp_path / "text").problems[0]
    ls = environment.check(_program(tmp_path / "ls", "echo hello"))
    assert ls.problems == [f"{tmp_path / 'ls'} is no Python."]
    old = environment.check(_program(tmp_path / "old", '[ "$1" = -c ] && echo 3 8 || exit 1'))
    assert old.problems == [f"{tmp_path / 'old'} is Python 3.8; training needs 3.11 or newer."]
    odd = environment.check(_program(tmp_path / "odd", '[ "$1" = -c ] && echo 3 12 || exit 1'))
    assert odd.problems == [f"{tmp_path / 'odd'} cannot run the trainer."]
    missing = environment.check(
        _program(tmp_path / "m", """echo '{"ok": false, "problems": ["No torch."]}'""")
    )
    assert missing.problems == ["No torch."] and not missing.ok


def test_check_of_an_environment_without_torch(environment, tmp_path):
    """A real one: this Python, which in Blender 5.2's environment has no torch, else a bare one."""
    import venv

    venv.create(tmp_path / "bare", with_pip=False)
    report = environment.check(tmp_path / "bare" / "bin" / "python")
    assert any("torch is missing" in problem for problem in report.problems)


def test_check_without_write_access(environment, tmp_path, monkeypatch):
    monkeypatch.setattr(
        environment.os, "access", lambda path, mode: False
    )  # the superuser may write anywhere
    problems = environment.check(tmp_path / "none").problems
    assert problems[-1].startswith("The folder ") and problems[-1].endswith(" cannot be written.")


def test_operator_reports_the_check(bpy, environment, preferences, tmp_path):
    preferences.python = str(tmp_path / "none")
    with pytest.raises(RuntimeError, match="There is no program"):
        bpy.ops.lodgs.check_environment()
    answer = json.dumps({"ok": True, "problems": [], "torch": "2.13.0"})
    preferences.python = str(_program(tmp_path / "good", f"echo '{answer}'"))
    assert bpy.ops.lodgs.check_environment() == {"FINISHED"}
    assert environment.report.ok and environment.report.versions["torch"] == "2.13.0"


def test_the_check_tells_what_trains_here(bpy, lodgs, environment, preferences, tmp_path):
    found = json.dumps({"graphics": "Radeon 780M", "sentence": "Automatic trains on the processor."})
    ready = json.dumps({"ok": True, "problems": [], "torch": "2.13.0"})
    script = f"""if [ "$3" = devices ]; then echo '{found}'; else echo '{ready}'; fi"""
    preferences.python = str(_program(tmp_path / "good", script))
    bpy.ops.lodgs.check_environment()
    assert environment.report.devices == "Automatic trains on the processor."
    backends = lodgs("panels.preferences")._backends(None, None)
    assert [(name, label) for name, label, *_ in backends][-1] == ("gpu", "GPU (Radeon 780M)")
    assert [number for *_, number in backends] == [0, 1, 2, 3], "as files have saved them"
    preferences.python = str(_program(tmp_path / "older", f"echo '{ready}'"))  # knows of no devices
    bpy.ops.lodgs.check_environment()
    assert environment.report.ok and environment.report.devices == ""


def test_blender_is_left_out_of_the_trainers_environment(lodgs, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/blender")
    monkeypatch.setenv("PYTHONHOME", "/blender")
    monkeypatch.setenv("KEPT", "1")
    values = lodgs("runs.processes").environment()
    assert "PYTHONPATH" not in values and "PYTHONHOME" not in values and values["KEPT"] == "1"
    assert "lodgs" in values["PYTHONPYCACHEPREFIX"]
