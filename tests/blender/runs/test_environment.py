"""The trainer's Python: found, checked and made."""

import json
from pathlib import Path

import pytest


@pytest.fixture
def environment(lodgs, monkeypatch):
    module = lodgs("runs.environment")
    monkeypatch.setattr(module, "setup", None)
    monkeypatch.setattr(module, "report", None)
    monkeypatch.delenv(module.VARIABLE, raising=False)
    return module


@pytest.fixture
def preferences(lodgs, environment):
    found = lodgs("extension").preferences()
    found.python = ""
    yield found
    found.python = ""


@pytest.fixture
def online(environment, monkeypatch):
    """``bpy.app.online_access``, which cannot be set, as the module sees it."""

    class App:
        online_access = True

    class Bpy:
        app, path = App, environment.bpy.path

    monkeypatch.setattr(environment, "bpy", Bpy)


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


def test_blender_is_left_out_of_the_trainers_environment(lodgs, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/blender")
    monkeypatch.setenv("PYTHONHOME", "/blender")
    monkeypatch.setenv("KEPT", "1")
    values = lodgs("runs.processes").environment()
    assert "PYTHONPATH" not in values and "PYTHONHOME" not in values and values["KEPT"] == "1"
    assert "lodgs" in values["PYTHONPYCACHEPREFIX"]


def test_nothing_is_downloaded_without_leave(bpy, environment):
    assert not bpy.app.online_access
    with pytest.raises(RuntimeError, match="Allow Online Access"):
        bpy.ops.lodgs.make_environment()
    assert environment.setup is None


def test_make_an_environment(bpy, environment, preferences, online, tmp_path, monkeypatch):
    """With nothing to download; the operator waits in background."""
    requirements = tmp_path / "requirements.txt"
    requirements.write_text("# nothing\n")
    monkeypatch.setattr(environment, "REQUIREMENTS", requirements)
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    assert environment.setup.fraction == 1 and not environment.setup.running
    python = environment.trainer_python()
    assert python.is_relative_to(environment.made_folder()) and python.exists()
    assert any("torch is missing" in problem for problem in environment.check(python).problems)


def test_what_a_gpu_needs_is_installed_where_it_can_be_compiled(
    bpy, environment, preferences, online, tmp_path, monkeypatch
):
    """Seen by what pip says of a file of requirements that cannot be met."""
    for name in ("REQUIREMENTS", "CUDA_REQUIREMENTS"):
        (tmp_path / name).write_text("./no-gsplat\n" if "CUDA" in name else "")
        monkeypatch.setattr(environment, name, tmp_path / name)
    which, programs = environment.shutil.which, {}
    monkeypatch.setattr(environment.shutil, "which", lambda name: programs.get(name, which(name)))
    programs |= {"nvidia-smi": "/nvidia-smi", "nvcc": None}
    assert bpy.ops.lodgs.make_environment() == {"FINISHED"}
    programs["nvcc"] = "/nvcc"
    with pytest.raises(RuntimeError, match="no-gsplat"):
        bpy.ops.lodgs.make_environment()


def test_a_failed_environment_leaves_nothing(bpy, environment, preferences, online, tmp_path, monkeypatch):
    requirements = tmp_path / "requirements.txt"
    requirements.write_text("./no-such-package\n")
    monkeypatch.setattr(environment, "REQUIREMENTS", requirements)
    with pytest.raises(RuntimeError, match="pip install failed"):
        bpy.ops.lodgs.make_environment()
    assert not environment.made_folder().exists()
    with pytest.raises(Exception, match="none is set up"):
        environment.trainer_python()


def test_cancel_making(bpy, environment, preferences, online, tmp_path, monkeypatch):
    base = _program(tmp_path / "slow", "echo Collecting patience; sleep 30")
    monkeypatch.setattr(environment, "find_base", lambda: base)
    setup = environment.make()
    with pytest.raises(Exception, match="being made already"):
        environment.make()
    assert bpy.ops.lodgs.cancel_environment() == {"FINISHED"}
    setup._thread.join(10)
    assert not setup.running and setup.message == "Cancelled" and setup.problem == ""
    assert not environment.made_folder().exists()


def test_no_python_fits(environment, monkeypatch):
    monkeypatch.setattr(environment, "_version", lambda python: (3, 8))
    with pytest.raises(Exception, match=r"No Python from 3\.11 to 3\.14"):
        environment.find_base()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("Collecting typing-extensions>=4.10 (from torch->-r x)", "Collecting typing-extensions"),
        (
            "Downloading nvidia_nccl_cu13-2.29.7-py3-none-any.whl (206.0 MB)",
            "Downloading nvidia_nccl_cu13 (206.0 MB)",
        ),
        ("Downloading torch-2.13.0-cp314-cp314.whl.metadata (31 kB)", "Downloading torch (31 kB)"),
        ("Installing collected packages: mpmath, torch", "Installing the packages"),
    ],
)
def test_what_pip_does_in_few_words(lodgs, line, words):
    assert lodgs("runs.environment").brief(line) == words
