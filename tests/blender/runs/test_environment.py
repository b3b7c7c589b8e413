"""Selection and checks of the trainer's Python."""

import json
import os
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_blender


@pytest.fixture
def environment(lodgs, tmp_path, monkeypatch):
    module = lodgs("runs.environment")
    monkeypatch.setattr(module, "environments_folder", lambda: tmp_path / "trainer")
    monkeypatch.setattr(module, "report", None)
    monkeypatch.delenv(module.VARIABLE, raising=False)
    return module


@pytest.fixture
def preferences(lodgs, environment):
    preferences = lodgs("extension").preferences()
    preferences.python = ""
    yield preferences
    preferences.python = ""


def _program(path: Path, script: str) -> Path:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def test_environment_variable_overrides_preferences(environment, preferences, monkeypatch):
    with pytest.raises(Exception, match="not installed"):
        environment.trainer_python()
    preferences.python = "/preferred/python"
    assert environment.trainer_python() == Path("/preferred/python")
    monkeypatch.setenv(environment.VARIABLE, "/pipeline/python")
    assert environment.trainer_python() == Path("/pipeline/python")


def test_newest_ready_environment_is_used(environment, preferences, tmp_path):
    for number in (2, 9, 10, 11):
        (tmp_path / "trainer" / str(number)).mkdir(parents=True)
        if number != 11:  # being installed
            (tmp_path / "trainer" / str(number) / environment.READY).touch()
    assert [path.name for path in environment.ready_environments()] == ["10", "9", "2"]
    assert environment.trainer_python().relative_to(tmp_path / "trainer").parts[0] == "10"


def test_check_reports_problems(environment, tmp_path):
    assert environment.check(tmp_path / "none").problems == [f"Python {tmp_path / 'none'} does not exist."]
    (tmp_path / "text").write_text("no program")
    assert "is not executable" in environment.check(tmp_path / "text").problems[0]
    ls = environment.check(_program(tmp_path / "ls", "echo hello"))
    assert ls.problems == [f"{tmp_path / 'ls'} is not a Python interpreter."]
    old = environment.check(_program(tmp_path / "old", '[ "$1" = -c ] && echo 3 8 || exit 1'))
    assert old.problems == [f"{tmp_path / 'old'} is Python 3.8, but training needs 3.11 or newer."]
    odd = environment.check(_program(tmp_path / "odd", '[ "$1" = -c ] && echo 3 12 || exit 1'))
    assert odd.problems == [f"{tmp_path / 'odd'} cannot run the trainer."]
    missing = environment.check(
        _program(tmp_path / "m", """echo '{"ok": false, "problems": ["No torch."]}'""")
    )
    assert missing.problems == ["No torch."] and not missing.ok


def test_check_of_an_environment_without_torch(environment, tmp_path):
    """Use a real virtual environment without packages."""
    import venv

    venv.create(tmp_path / "bare", with_pip=False)
    report = environment.check(tmp_path / "bare" / "bin" / "python")
    assert any("torch is missing" in problem for problem in report.problems)


def test_check_without_write_access(environment, tmp_path, monkeypatch):
    # the superuser may write anywhere
    monkeypatch.setattr(environment.os, "access", lambda path, mode: False)
    problems = environment.check(tmp_path / "none").problems
    assert problems[-1].startswith("Cannot write to the folder ")


def test_operator_reports_the_check(bpy, environment, preferences, tmp_path):
    preferences.python = str(tmp_path / "none")
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.lodgs.check_environment()
    answer = json.dumps({"ok": True, "problems": [], "torch": "2.13.0"})
    preferences.python = str(_program(tmp_path / "good", f"echo '{answer}'"))
    assert bpy.ops.lodgs.check_environment() == {"FINISHED"}
    assert environment.report.ok and environment.report.versions["torch"] == "2.13.0"


def test_check_reports_devices(bpy, lodgs, environment, preferences, tmp_path):
    devices = json.dumps({"graphics": "Radeon 780M", "sentence": "Automatic trains on the processor."})
    ready = json.dumps({"ok": True, "problems": [], "torch": "2.13.0"})
    script = f"""if [ "$3" = devices ]; then echo '{devices}'; else echo '{ready}'; fi"""
    preferences.python = str(_program(tmp_path / "good", script))
    bpy.ops.lodgs.check_environment()
    assert environment.report.devices == "Automatic trains on the processor."
    backends = lodgs("panels.preferences")._backends(None, None)
    assert [(name, label) for name, label, *_ in backends][-1] == ("gpu", "GPU (Radeon 780M)")
    assert [number for *_, number in backends] == [0, 1, 2, 3], "numbers are stored in .blend files"
    preferences.python = str(
        _program(tmp_path / "older", f"echo '{ready}'")
    )  # an older trainer without the command
    bpy.ops.lodgs.check_environment()
    assert environment.report.ok and environment.report.devices == ""


def test_programs_of_a_background_blender_stop_with_it(bpy, lodgs):
    processes = lodgs("training.runs.processes")
    assert bpy.app.background
    number, _, identity = lodgs("runs.processes").environment()[processes.PARENT].partition(" ")
    assert int(number) == os.getpid() and identity == processes.identity(os.getpid())


def test_blender_variables_are_removed_from_the_trainers_environment(lodgs, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/blender")
    monkeypatch.setenv("PYTHONHOME", "/blender")
    monkeypatch.setenv("KEPT", "1")
    values = lodgs("runs.processes").environment()
    assert "PYTHONPATH" not in values and "PYTHONHOME" not in values and values["KEPT"] == "1"
    assert "lodgs" in values["PYTHONPYCACHEPREFIX"]


def test_preferences_have_defaults_without_stored_values(bpy, lodgs):
    """Blender stores none for extensions that the command line enables with --addons."""
    extension, addons = lodgs("extension"), bpy.context.preferences.addons

    def values() -> list:
        return [getattr(extension.preferences(), name) for name in extension.PreferenceValues.__annotations__]

    stored = values()
    addons.remove(addons[extension.ID])
    try:
        assert values() == stored
    finally:
        addons.new().module = extension.ID
