"""Comparison of methods: the trainer's command, its progress in the panel, its page, cancel and errors."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy, lodgs, monkeypatch):
    monkeypatch.setattr(lodgs("runs.method_comparison"), "current", None)
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN))
    return lodgs("data.roots").active_root(bpy.context)


@pytest.fixture
def trainer(tmp_path, monkeypatch):
    """``trainer(lines)`` makes a trainer that prints lines to its log, writes its arguments and ends."""

    def make(*lines: str, code: int = 0):
        program = tmp_path / "python"
        body = "\n".join(f"echo '{line}' >&2" for line in lines)
        real = os.environ["LODGS_TRAINER_PYTHON"]
        program.write_text(
            f'#!/bin/sh\n[ "$3" = compare ] || exec {real} "$@"\n'
            f'echo "$@" > {tmp_path}/arguments\n{body}\nexit {code}\n'
        )
        program.chmod(0o755)
        monkeypatch.setenv("LODGS_TRAINER_PYTHON", str(program))

    if sys.platform == "win32":
        pytest.skip("needs a shell")
    return make


def test_methods_train_with_the_settings_of_the_panel(bpy, lodgs, root, trainer, tmp_path):
    trainer("Training FLoD (1 of 1), step 30 of 40")
    root.lodgs.training.output = str(tmp_path / "runs")
    root.lodgs.training.image_scale = 0.25
    lodgs("extension").preferences().backend = "cpu"
    assert bpy.ops.lodgs.compare_methods(methods={"flod", "clod"}) == {"FINISHED"}
    words = (tmp_path / "arguments").read_text().split()
    assert words[:3] == ["-m", "training", "compare"]
    assert words[words.index("--methods") + 1 :][:2] == ["flod", "clod"]
    assert words[words.index("--backend") + 1] == "cpu"
    assert "--image-scale=0.25" in words and words[words.index("--preset") + 1] == "draft"
    page = tmp_path / "runs" / "comparison" / bpy.path.clean_name(root.name) / "index.html"
    assert lodgs("runs.method_comparison").current.message.endswith(str(page))


def test_failure_names_the_trainers_reason(bpy, root, trainer, tmp_path):
    trainer("error: Cannot compare methods: no reason.", code=2)
    root.lodgs.training.output = str(tmp_path / "runs")
    with pytest.raises(RuntimeError, match="no reason"):
        bpy.ops.lodgs.compare_methods(methods={"flod"})


def test_nothing_is_compared_without_methods(bpy, root):
    with pytest.raises(RuntimeError, match="none is chosen"):
        bpy.ops.lodgs.compare_methods(methods=set())


def test_panel_shows_the_steps_of_a_running_comparison(bpy, lodgs, root, trainer, tmp_path, monkeypatch):
    module = lodgs("runs.method_comparison")
    trainer("Training FLoD (1 of 2), step 30 of 40")
    root.lodgs.training.output = str(tmp_path / "runs")
    work = module.compare_methods(root, ["flod"])
    monkeypatch.setattr(work, "_process", SimpleNamespace(wait=work._process.wait, poll=lambda: None))
    work._process.wait()
    assert work.step() and work.message == "Training FLoD (1 of 2), step 30 of 40"
    assert work.fraction == pytest.approx(0.75)
    with pytest.raises(RuntimeError, match="already running"):
        bpy.ops.lodgs.compare_methods(methods={"flod"})
