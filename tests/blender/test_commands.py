"""The main function of ``blender --command lodgs``."""

import json
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import COUNTS, splats
from training.scenes.colmap import read_scene

pytestmark = pytest.mark.one_blender


SCENE = Path(__file__).resolve().parents[2] / "examples" / "lantern_garden"


@pytest.fixture
def lodgs_command(lodgs):
    return lambda *arguments: lodgs("commands").main([str(a) for a in arguments])


def test_help_is_printed_without_a_command(lodgs_command, capsys):
    assert lodgs_command() == 0 and "\n    capture " in capsys.readouterr().out


def test_train_saves_and_exports(bpy, lodgs, lodgs_command, fake, tmp_path, capfd):
    fake()
    run, blend, bundle = tmp_path / "run", tmp_path / "made" / "out.blend", tmp_path / "made" / "bundle.ply"
    code = lodgs_command(
        "train", "--scene", SCENE, "--method", "flod", "--preset", "draft", "--out", run, "--blend", blend,
        "--export", bundle, "--image-scale", 0.25, "--seed", 3, "--set", "levels=2", "--set", "steps=[4, 5]",
    )  # fmt: skip
    assert code == 0
    output = capfd.readouterr().err
    for line in (
        "Level 1: 5 splats, 20.0 dB on held-out views",
        "Finished",
        "warning: One photograph is missing.",
    ):
        assert line in output.splitlines()
    job = lodgs("training.runs.job").Job.from_file(run / "job.toml")
    assert (job.seed, job.image_scale, job.parameters["steps"]) == (3, 0.25, [4, 5])

    plyfile = pytest.importorskip("plyfile")  # another reader of the bundle
    counts = [element.count for element in plyfile.PlyData.read(str(bundle)).elements][:2]
    assert sorted(counts) == sorted(COUNTS.values())
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    assert {i.number: len(i.object.data.points) for i in root.lodgs.levels} == COUNTS
    assert [obj for obj in root.children_recursive if obj.type == "CAMERA"]
    assert_viewports_show_the_central_photo(bpy)

    second = tmp_path / "again.ply"
    assert lodgs_command("export", blend, second) == 0
    assert second.read_bytes() == bundle.read_bytes()
    assert lodgs_command("info", bundle) == 0
    assert "20" in capfd.readouterr().out


def test_train_imports_the_model_and_photos_of_the_job(bpy, lodgs, lodgs_command, fake, tmp_path):
    """The trained levels belong to the cameras of this model, not of the largest one."""
    fake()
    scene, write = lodgs("training.scenes.colmap").read_scene(SCENE), lodgs("training.scenes.write_colmap")
    points, seen = scene.points[:4], np.ones((5, 4), bool)
    write.write_colmap(tmp_path / "few", scene.cameras[:5], points, seen, scene.point_colors[:4])
    places = ("--model", tmp_path / "few" / "sparse" / "0", "--images", SCENE / "images")
    train = ("train", "--scene", SCENE, *places, "--out", tmp_path / "run")
    assert lodgs_command(*train, "--blend", tmp_path / "out.blend") == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out.blend"))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    assert len([obj for obj in root.children_recursive if obj.type == "CAMERA"]) == 5
    job = lodgs("training.runs.job").Job.from_file(tmp_path / "run" / "job.toml")
    made = lodgs("runs.job_settings").make_job(root, tmp_path / "run", {})
    assert (made.model, made.images) == (job.model, job.images)


def test_train_from_a_base_sets_the_panels_settings(bpy, lodgs, lodgs_command, fake, tmp_path, monkeypatch):
    methods = lodgs("training.methods").METHODS
    monkeypatch.setitem(methods, "flod", replace(methods["flod"], from_base=True))
    fake()
    assert lodgs_command("train", "--scene", SCENE, "--out", tmp_path / "first") == 0
    train = ("train", "--scene", SCENE, "--out", tmp_path / "second", "--base", tmp_path / "first")
    train = (*train, "--set", "max_splats=500")
    fake("killed")
    assert lodgs_command(*train) == 1
    fake()
    assert lodgs_command(*train, "--blend", tmp_path / "out.blend") == 0, "resumed"
    written = lodgs("training.runs.job").Job.from_file(tmp_path / "second" / "job.toml")
    assert written.base == str(tmp_path / "first")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out.blend"))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    settings = root.lodgs.training
    assert (settings.start_from, settings.parameters.max_splats) == ("FILE", 500)
    panels = lodgs("runs.job_settings").make_job(root, tmp_path / "second", {})
    assert panels.resolved() == written, "the panel makes the same job"


def test_splats_without_photos_are_trained_in_one_command(bpy, lodgs, lodgs_command, fake, tmp_path, capfd):
    fake("killed")
    bundles = lodgs("training.splats.bundle")
    bundles.write_bundle(tmp_path / "some.ply", bundles.Bundle("", [bundles.Level(1, splats(7))]))
    train = ("train", "--base", tmp_path / "some.ply", "--capture", "dome", "--views", 5, "--method", "lodge")
    train = (*train, "--out", tmp_path / "run", "--blend", tmp_path / "out.blend")
    assert lodgs_command(*train) == 1
    fake()
    assert lodgs_command(*train) == 0, "resumed"
    assert "Finished" in capfd.readouterr().err
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out.blend"))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    assert {i.number: len(i.object.data.points) for i in root.lodgs.levels} == COUNTS
    assert (root.lodgs.training.views, root.lodgs.training.views_from) == (5, "DOME")
    train = ("train", "--base", tmp_path / "run", "--capture", "dome", "--method", "lodge")
    assert lodgs_command(*train, "--out", tmp_path / "next") == 0, "a base may be a finished run"


def test_same_command_resumes_a_stopped_run(lodgs_command, fake, tmp_path, capfd):
    train = ("train", "--scene", SCENE, "--out", tmp_path / "run")
    fake("killed")
    assert lodgs_command(*train, "--blend", tmp_path / "part.blend") == 1
    assert "signal 9" in capfd.readouterr().err
    assert (tmp_path / "part.blend").exists()  # holds the finished level
    fake("full")
    assert lodgs_command(*train) == 2
    assert "The disk is full" in capfd.readouterr().err
    fake()
    assert lodgs_command(*train, "--seed", 5) == 2
    assert "seed" in capfd.readouterr().err
    assert lodgs_command(*train, "--export", tmp_path / "bundle.ply") == 0
    assert (tmp_path / "bundle.ply").exists()
    (tmp_path / "bundle.ply").unlink()
    assert lodgs_command(*train, "--export", tmp_path / "bundle.ply") == 0  # loads the finished run
    assert (tmp_path / "bundle.ply").exists()
    assert lodgs_command(*train, "--seed", 5) == 2
    (tmp_path / "bundle.ply").unlink()
    assert lodgs_command("train", tmp_path / "run" / "job.toml", "--export", tmp_path / "bundle.ply") == 0
    assert (tmp_path / "bundle.ply").exists()


def test_train_has_the_trainers_options(lodgs, lodgs_command, capfd):
    assert lodgs_command("train", "--help") == 0
    output = capfd.readouterr().out
    names = {field.name for field in fields(lodgs("training.runs.job").Job)} - {"parameters"}
    assert all(f"--{name.replace('_', '-')} " in output for name in names | {"set", "blend", "export"})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--scene", "nowhere", "--out", "run"], "nowhere"),
        (["train", "--scene", SCENE, "--out", "run", "--set", "levels"], "--set levels"),
        (["train", "--out", "run"], "scene"),
        (["train", "--scene", SCENE, "--out", "run", "--set", "wings=2"], "wings"),
        (["train", "--scene", SCENE, "--out", "run", "--method", "magic"], "magic"),
        (["train", "--scene", SCENE, "--out", "run", "--image-scale", "7"], "image_scale"),
        (["train", "--scene", SCENE, "--out", "run", "--seed", "-1"], "-1"),
        (["train", "--scene", SCENE, "--out", "run", "--test-every", "1"], "test_every"),
        (["import", "nothing.ply", "--blend", "x.blend"], "nothing.ply"),
        (["export", "nothing.blend", "x.ply"], "nothing.blend"),
        (["info", "nothing.ply"], "nothing.ply"),
        (["dance"], "dance"),
    ],
)
def test_input_errors_print_one_sentence_and_exit_with_2(
    lodgs_command, fake, tmp_path, monkeypatch, capfd, arguments, message
):
    fake()
    monkeypatch.chdir(tmp_path)
    assert lodgs_command(*arguments) == 2
    output = capfd.readouterr().err
    assert message in output and "Traceback" not in output
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no resource limits")
def test_blend_file_on_a_full_disk_is_named(bpy, lodgs_command, tmp_path, capfd):
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        code = lodgs_command("import", SCENE, "--blend", tmp_path / "scene.blend")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert code == 2 and f"error: Cannot save {tmp_path / 'scene.blend'}: " in capfd.readouterr().err
    assert not (tmp_path / "scene.blend").exists()


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (
            PermissionError(13, "Permission denied", "images.bin"),
            2,
            "Cannot use images.bin: Permission denied.",
        ),
        (MemoryError("Unable to allocate 9 GiB"), 2, "Not enough memory."),
        (RuntimeError("Error: operator failed"), 1, "Error: operator failed"),
    ],
)
def test_system_errors_are_one_message(lodgs, lodgs_command, monkeypatch, capfd, error, code, message):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(lodgs("data.importing"), "import_colmap", fail)
    assert lodgs_command("import", SCENE, "--blend", "x.blend") == code
    output = capfd.readouterr().err
    assert f"error: {message}" in output and "Traceback" not in output


def test_help_exits_with_0(lodgs_command, capfd):
    assert lodgs_command("--help") == 0
    assert "train" in capfd.readouterr().out


def test_import_writes_a_blend_file(bpy, lodgs_command, tmp_path):
    assert lodgs_command("import", SCENE, "--blend", tmp_path / "scene.blend") == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    assert [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    scene = bpy.context.scene  # renders show the colours of the photos
    assert (scene.render.engine, scene.view_settings.view_transform) == ("LODGS", "Standard")
    assert_viewports_show_the_central_photo(bpy)


def assert_viewports_show_the_central_photo(bpy):
    scene = read_scene(SCENE)
    central = min(scene.cameras, key=lambda camera: float(np.linalg.norm(camera.center - scene.center)))
    view = bpy.data.objects[central.name].matrix_world
    regions = [area.spaces.active.region_3d for area in bpy.context.screen.areas if area.type == "VIEW_3D"]
    assert regions
    for region in regions:
        backward = region.view_rotation.to_matrix().col[2]
        position = region.view_location + region.view_distance * backward
        np.testing.assert_allclose(position, view.translation, atol=1e-4)
        np.testing.assert_allclose(backward, view.col[2][:3], atol=1e-4)


COMMAND = """
import os, sys
import bpy, addon_utils
addon_utils.enable("bl_ext.user_default.lodgs", default_set=True)
from bl_ext.user_default.lodgs.blender_lodgs import commands
code = commands.main(sys.argv[1:])
sys.stderr.flush()
os._exit(code)
"""


def _start_command(run: Path) -> subprocess.Popen:
    """Start a command in a separate process and wait until its slow trainer runs."""
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, "train", "--scene", str(SCENE), "--out", str(run)],
        stderr=subprocess.PIPE,
        text=True,
    )
    end = time.monotonic() + 200
    while not ((run / "events.jsonl").exists() and "progress" in (run / "events.jsonl").read_text()):
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    return process


def test_signal_in_a_callback_of_blender_cancels(lodgs, lodgs_command, fake, tmp_path, monkeypatch):
    """Blender prints the exception of a callback and continues."""
    fake()
    commands = lodgs("commands")
    import_photos = commands._import_for

    def import_with_signal(job):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        return import_photos(job)

    monkeypatch.setattr(commands, "_import_for", import_with_signal)
    assert lodgs_command("train", "--scene", SCENE, "--out", tmp_path / "run") == 3
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_signals_cancel_the_run(bpy, fake, tmp_path, number):
    """The command receives the signal, cancels the trainer and waits for it."""
    fake("slow")
    with _start_command(tmp_path / "run") as process:
        process.send_signal(number)
        assert process.wait(200) == 3
        assert process.stderr is not None
        output = process.stderr.read()
    assert "Cancelled. The same command resumes." in output and "Traceback" not in output
    last = json.loads((tmp_path / "run" / "events.jsonl").read_text().splitlines()[-1])
    assert last["event"] == "cancelled"


@pytest.mark.slow
def test_sigterm_ends_a_slow_render_with_exit_code_3(bpy, fake, tmp_path):
    """The render would take hours. Nothing half-written remains."""
    fake()
    bpy.ops.mesh.primitive_cube_add()
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1 << 20, False
    scene.cycles.use_adaptive_sampling = False
    blend, out = tmp_path / "scene.blend", tmp_path / "out"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    words = ["capture", blend, "--out", out, "--size", "640x480", "--around", "--views", "4"]
    command = [sys.executable, "-c", COMMAND, *map(str, words)]
    log = tmp_path / "log"
    with open(log, "w") as errors, subprocess.Popen(command, stderr=errors) as process:
        end = time.monotonic() + 200
        while "View 1 of 4" not in log.read_text():
            assert time.monotonic() < end and process.poll() is None, log.read_text()
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        try:
            assert process.wait(200) == 3
        finally:
            process.kill()
    assert log.read_text().count("Cancelled. The same command resumes.") == 1
    assert not [path for path in out.rglob("*") if path.is_file()]


def test_trainer_continues_after_blender_is_killed(bpy, lodgs, fake, tmp_path):
    fake("slow")
    with _start_command(tmp_path / "run") as process:
        process.kill()
    run = lodgs("training.runs.folder").RunFolder(tmp_path / "run")
    step = run.last_event("progress")["step"]
    end = time.monotonic() + 200
    while run.last_event("progress")["step"] == step:
        assert time.monotonic() < end and run.state() == "running"
        time.sleep(0.05)
    run.request_cancel()
    while run.state() != "cancelled":
        assert time.monotonic() < end
        time.sleep(0.05)


def test_cells_are_trained_by_one_command(bpy, lodgs, lodgs_command, fake, tmp_path, capfd):
    fake()
    run, blend = tmp_path / "run", tmp_path / "out.blend"
    run.mkdir()
    (run / "go on").touch()
    command = ["train", "--scene", SCENE, "--cells", "2x1", "--out", run, "--blend", blend]
    assert lodgs_command(*command) == 0
    assert "Training cells" in capfd.readouterr().err.splitlines()
    assert lodgs("training.runs.job").Job.from_file(run / "job.toml").cells == "2x1"
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    assert (root.lodgs.training.columns, root.lodgs.training.rows) == (2, 1), "the panel shows the cells"
    assert lodgs_command(*command) == 0, "a finished run is loaded"
