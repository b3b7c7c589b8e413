"""Training from Blender with a fake trainer that fails on request, and with the real trainer."""

import os
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import COUNTS, LEAVES, splats

pytestmark = pytest.mark.one_blender


REPOSITORY = Path(__file__).resolve().parents[3]
TRAINER = os.environ.get("LODGS_TRAINER_PYTHON", "")


@pytest.fixture
def watch_of(lodgs):
    return lodgs("runs.watch").watch_of


def _levels(root) -> dict[int, int]:
    """Return the number of points by level."""
    return {item.number: len(item.object.data.points) for item in root.lodgs.levels if item.exists}


def _wait(watch, until, seconds=200.0):
    """Step a run, as the timer does with a window, until a condition holds."""
    end = time.monotonic() + seconds
    while not until():
        assert watch.running, (watch.message, watch.problem)
        assert time.monotonic() < end, (watch.state, watch.message, watch.problem)
        watch.step()
        time.sleep(0.02)


def test_training_adds_levels_and_facts(bpy, jobs, watch_of, fake, root, tmp_path):
    fake()
    run = tmp_path / "run"
    assert bpy.ops.lodgs.train(folder=str(run)) == {"FINISHED"}
    assert _levels(root) == COUNTS
    assert watch_of(root).summary["train_psnr"] == 21.5
    positions = np.empty(COUNTS[2] * 3, np.float32)
    root.lodgs.levels[1].object.data.attributes["position"].data.foreach_get("vector", positions)
    assert np.array_equal(positions.reshape(-1, 3), splats(COUNTS[2]).means)
    assert (root.lodgs.rule, root.lodgs.levels[0].facts) == ("bands", '{"s_min": 0.1}')
    assert tuple(root.lodgs.camera_center) == (1, 2, 3)
    assert root.lodgs.method == "flod" and '"focal_px": 100.0' in root.lodgs.meta
    watch = watch_of(root)
    assert (watch.state, watch.problem) == ("done", "")
    assert watch.warnings == ["One photograph is missing."]
    assert watch.progress["of"] == 10_000


def test_controls_follow_the_run_until_the_user_sets_them(bpy, lodgs, jobs, fake, root, tmp_path):
    fake()
    assert root.lodgs.bands.gamma == 1.0
    bpy.ops.lodgs.train(folder=str(tmp_path / "first"))
    assert root.lodgs.bands.gamma == 2.0
    scenes, Bundle = lodgs("data.scenes"), lodgs("training.splats.levels").Bundle
    scenes.set_bundle_facts(root, Bundle("flod", [], "bands", {}, {"gamma": 0.4}))
    assert root.lodgs.bands.gamma == pytest.approx(0.4), "not set by the user"
    assert scenes.read_levels(root).controls == {"gamma": 0.4}
    root.lodgs.bands.gamma = 0.7
    bpy.ops.lodgs.train(folder=str(tmp_path / "second"))
    assert root.lodgs.bands.gamma == pytest.approx(0.7)
    assert scenes.read_levels(root).controls == {"gamma": 0.7}


def test_job_has_the_settings(bpy, lodgs, jobs, fake, root, tmp_path):
    settings = root.lodgs.training
    settings.method, settings.preset, settings.seed = "flod", "standard", 7
    settings.parameters.levels, settings.parameters.max_splats, settings.image_scale = 3, 1234, 0.25
    fake()
    bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    job = lodgs("training.runs.job").Job.from_file(tmp_path / "run" / "job.toml")
    assert (job.method, job.preset, job.seed, job.image_scale) == ("flod", "standard", 7, 0.25)
    assert job.scene == str(tmp_path / "scene")
    assert job.parameters["levels"] == 3 and job.parameters["max_splats"] == 1234
    assert job.parameters["steps"] == [4000, 6000, 15000]
    assert job.parameters["footprint"] == 16.0  # not set: value of the preset


def test_float32_properties_give_rounded_numbers(job_settings, root):
    settings = root.lodgs.training
    settings.image_scale, settings.parameters.footprint = 0.3, 8.3
    assert job_settings.changed_parameters(settings) == {"footprint": 8.3}
    assert job_settings.make_job(root, Path("/run"), {}).image_scale == 0.3


@pytest.mark.parametrize(
    "budget", [3 * LEAVES, pytest.param(2 * LEAVES - 2, marks=pytest.mark.nightly), 2000]
)
def test_tree_larger_than_the_budget_is_streamed(bpy, lodgs, jobs, fake, root, tmp_path, budget):
    """A tree larger than the budget appears at the end, like an imported one."""
    fake("tree")
    root.lodgs.stream.budget = budget
    counts = []
    watch = jobs.start(root, str(tmp_path / "run"))
    jobs.follow(watch, lambda watch: counts.append(sum(_levels(root).values())))
    assert (watch.state, watch.problem) == ("done", "")
    streams, fits = lodgs("data.streams"), budget > 2 * LEAVES
    assert max(counts) <= (2 * LEAVES - 1 if fits else budget // 4)
    trained = lodgs("data.scenes").read_levels(root)
    imported = lodgs("data.importing").import_splats(
        bpy.context, tmp_path / "run" / "bundle.ply", budget=budget
    )
    expected = lodgs("data.scenes").read_levels(imported)
    for level, reference in zip(trained.levels, expected.levels, strict=True):
        means, expected_means = (np.sort(item.splats.means, axis=0) for item in (level, reference))
        np.testing.assert_array_equal(means, expected_means)
    assert (streams.source_of(root) is None) == (streams.source_of(imported) is None) == fits
    if not fits:
        source = streams.source_of(root)
        assert source.path == tmp_path / "run" / "bundle.ply" and source.total == 2 * LEAVES - 1
        assert root.lodgs.camera_choice == "VIEW" and root.lodgs.stream.budget == budget
        fake("")  # levels of another run replace the streamed file
        assert bpy.ops.object.select_all(action="DESELECT") and not root.select_set(True)
        bpy.context.view_layer.objects.active = root
        jobs.follow(jobs.start(root, str(tmp_path / "other")))
        assert _levels(root) == COUNTS and streams.file_of(root) is None


@pytest.fixture
def from_base(lodgs, monkeypatch):
    """Let FLoD start from splats."""
    methods = lodgs("training.methods").METHODS
    monkeypatch.setitem(methods, "flod", replace(methods["flod"], from_base=True))


def test_training_starts_from_points_a_run_or_a_file(
    bpy, lodgs, job_settings, fake, root, tmp_path, from_base, monkeypatch
):
    settings, base = root.lodgs.training, lambda: job_settings.make_job(root, Path("/run"), {}).base
    error = lodgs("training.errors").LodgsError
    assert base() == ""
    settings.start_from = "RUN"
    with pytest.raises(error, match="'tiny' has no finished run"):
        base()
    fake("killed")
    settings.start_from = "POINTS"
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.train(folder=str(tmp_path / "first"))
    settings.start_from = "RUN"
    with pytest.raises(RuntimeError, match="no finished run"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "second"))
    assert not (tmp_path / "second").exists()
    fake()
    bpy.ops.lodgs.resume_training()
    assert base() == str(tmp_path / "first")
    fake("killed")
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.train(folder=str(tmp_path / "second"))
    fake()
    assert bpy.ops.lodgs.resume_training() == {"FINISHED"}, "the base is in the run already"
    job = lodgs("training.runs.job").Job.from_file(tmp_path / "second" / "job.toml")
    assert job.base == str(tmp_path / "first")
    settings.start_from = "FILE"
    with pytest.raises(error, match="no file is chosen"):
        base()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"), check_existing=False)
    settings = bpy.data.objects["tiny"].lodgs.training
    settings.base = "//splats.ply"
    root = bpy.data.objects["tiny"]
    assert job_settings.make_job(root, Path("/run"), {}).base == str(tmp_path / "splats.ply")
    settings.method = "octree"  # starts from points only
    assert job_settings.make_job(root, Path("/run"), {}).base == ""


def test_apply_job_sets_the_settings(lodgs, job_settings, root, from_base):
    settings = root.lodgs.training
    settings.parameters.max_splats = 5
    parameters = {"levels": 2, "footprint": 9.5, "steps": [10, 20]}
    job = lodgs("training.runs.job").Job(
        "/scene", "/run", "flod", "standard", base="/before", seed=9, parameters=parameters
    )
    job_settings.apply_job(settings, job)
    assert job_settings.changed_parameters(settings) == {"levels": 2, "footprint": 9.5}
    root.lodgs.scene_folder = "/scene"
    assert job_settings.make_job(root, Path("/run"), {"steps": [10, 20]}) == job
    job_settings.apply_job(settings, job.resolved())  # as stored in a run
    assert job_settings.changed_parameters(settings) == {"levels": 2, "footprint": 9.5}


def test_apply_job_sets_the_distances(lodgs, job_settings, root):
    settings, job = root.lodgs.training, lodgs("training.runs.job").Job
    parameters = {"levels": 4, "distances": [9.0, 0.0, 2.5, 0.0]}
    job_settings.apply_job(settings, job("/scene", "/run", "lodge", "draft", parameters=parameters))
    assert not settings.find_distances
    assert job_settings.changed_parameters(settings) == {"levels": 4, "distances": (9.0, 0.0, 2.5, 0.0)}
    job_settings.apply_job(settings, job("/scene", "/run", "lodge", "draft"))
    assert settings.find_distances and job_settings.changed_parameters(settings) == {}
    job_settings.apply_job(settings, job("/scene", "/run", "flod", "draft"))
    assert job_settings.changed_parameters(settings) == {}


@pytest.mark.parametrize(
    "backend", ["auto", "cuda", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("cpu", "gpu"))]
)
def test_backend_is_a_preference(bpy, lodgs, jobs, fake, root, tmp_path, backend):
    preferences = lodgs("extension").preferences()
    assert preferences.backend == "auto"
    fake()
    try:
        preferences.backend = backend
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    finally:
        preferences.backend = "auto"
    assert lodgs("training.runs.job").Job.from_file(tmp_path / "run" / "job.toml").backend == backend


@pytest.mark.parametrize(
    ("mode", "state", "message"),
    [
        ("killed", "interrupted", "signal 9"),
        ("crash", "interrupted", "the card caught fire"),
        ("full", "failed", "The disk is full; training stopped. Free some space and resume the run."),
        ("odd", "interrupted", "exit code 1"),
        ("refused", "failed", "The run folder belongs to another job. Choose another."),
    ],
)
def test_dead_trainer_is_reported_and_resumed(
    bpy, jobs, watch_of, fake, root, tmp_path, mode, state, message
):
    fake(mode)
    with pytest.raises(RuntimeError, match="Error:") as error:
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert message in str(error.value) and "Traceback" not in str(error.value)
    watch = watch_of(root)
    assert watch.state == state and message in watch.problem
    if mode == "odd":
        assert not watch.progress and not _levels(root)
    if mode in {"killed", "crash"}:
        assert _levels(root) == {1: COUNTS[1]}  # the finished level is shown
    if mode == "crash":
        assert bpy.ops.lodgs.show_log() == {"FINISHED"}
        assert "RuntimeError" in bpy.data.texts["LODGS trainer log"].as_string()
    fake()
    assert bpy.ops.lodgs.resume_training() == {"FINISHED"}
    assert watch_of(root).problem == "" and _levels(root) == COUNTS


def test_invalid_events_are_ignored(bpy, jobs, fake, root, tmp_path):
    fake("garbage")
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "run")) == {"FINISHED"}
    assert _levels(root) == COUNTS


def test_cancel_and_resume(bpy, jobs, fake, root, tmp_path):
    fake("slow")
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.progress)
    assert bpy.ops.lodgs.cancel_training() == {"FINISHED"}
    _wait(watch, lambda: not watch.running)
    assert (watch.state, watch.problem) == ("cancelled", "")
    with pytest.raises(RuntimeError, match="no training of 'tiny' is running"):
        bpy.ops.lodgs.cancel_training()
    fake()
    assert bpy.ops.lodgs.resume_training() == {"FINISHED"}
    with pytest.raises(RuntimeError, match="is finished"):
        bpy.ops.lodgs.resume_training()


def test_unresponsive_trainer_is_reported_and_can_be_killed(lodgs, jobs, fake, root, tmp_path, monkeypatch):
    fake("mute")
    monkeypatch.setattr(lodgs("runs.watch"), "UNRESPONSIVE_AFTER", 0.2)
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.unresponsive)
    jobs.cancel(root)
    assert watch.step() and watch.running  # it does not respond
    jobs.cancel(root)
    _wait(watch, lambda: not watch.running)
    assert watch.state == "interrupted"


def test_cancel_is_not_lost_before_the_trainer_is_ready(bpy, jobs, fake, root, tmp_path):
    """A request to an earlier trainer is cleared. A request to the new one has effect."""
    fake("slow")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "cancel").touch()
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.progress.get("step", 0) > 3)
    jobs.cancel(root)
    _wait(watch, lambda: not watch.running)
    watch = jobs.resume(root)
    jobs.cancel(root)
    _wait(watch, lambda: not watch.running)
    assert watch.state == "cancelled"


def test_cancel_that_comes_too_late_leaves_no_request(jobs, fake, root, tmp_path):
    fake()
    watch = jobs.start(root, str(tmp_path / "run"))
    watch.process.wait()
    jobs.cancel(root)
    assert (tmp_path / "run" / "cancel").exists()
    _wait(watch, lambda: not watch.running)
    assert watch.state == "done" and not (tmp_path / "run" / "cancel").exists()


def test_only_the_trainer_of_the_run_is_killed(lodgs, jobs, fake, root, tmp_path):
    fake("slow")
    first = jobs.start(root, str(tmp_path / "run"))
    _wait(first, lambda: first.progress)
    attached = jobs.attach(root, str(tmp_path / "run"))  # as another Blender does
    assert attached.process is None and attached.running
    lock = tmp_path / "run" / "lock"
    content = lock.read_text()
    lock.write_text(content.replace(f'"pid": {first.process.pid}', f'"pid": {os.getpid()}'))
    attached.cancel_requested = True
    with pytest.raises(lodgs("training.errors").LodgsError):
        jobs.cancel(root)
    assert first.process.poll() is None
    lock.write_text(content)
    jobs.cancel(root)
    assert first.process.wait(200) == -9
    _wait(attached, lambda: not attached.running)


SECOND_BLENDER = """
import sys
sys.path.insert(0, sys.argv[1])
from tools.blender_module import EXTENSION, start_blender
import importlib
bpy = start_blender()
jobs = importlib.import_module(f"{EXTENSION}.blender_lodgs.runs.jobs")
root = bpy.data.objects.new("tiny", None)
bpy.context.scene.collection.objects.link(root)
root.lodgs.is_root, root.lodgs.scene_folder = True, sys.argv[2]
root.lodgs.training.run = sys.argv[2]
for attempt in jobs.start, jobs.resume:
    try:
        attempt(root, *[sys.argv[2]][: attempt is jobs.start])
    except Exception as error:
        print("second", type(error).__name__, error, flush=True)
watch = jobs.attach(root, sys.argv[2])
jobs.follow(watch)
print("second", watch.state, [item.number for item in root.lodgs.levels if item.exists], watch.problem)
"""


def test_second_blender_is_refused_and_can_follow_the_run(jobs, fake, root, tmp_path):
    fake("two halves")
    run = tmp_path / "run"
    watch = jobs.start(root, str(run))
    _wait(watch, lambda: watch.levels)
    job = (run / "job.toml").read_bytes()
    command = [sys.executable, "-c", SECOND_BLENDER, str(REPOSITORY), str(run)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as second:
        printed = (line.removeprefix("second ") for line in second.stdout if line.startswith("second "))
        lines = [next(printed), next(printed)]
        (run / "go on").touch()
        lines += printed
    assert lines[0].startswith(f"LodgsError Cannot train in {run}: another training is running there.")
    assert lines[1].startswith(f"LodgsError Cannot resume the run in {run}: it is running.")
    assert lines[2].split() == ["done", "[1,", "2]"], lines
    while watch.step():
        time.sleep(0.02)
    assert (watch.state, watch.problem, _levels(root)) == ("done", "", COUNTS)
    assert (run / "job.toml").read_bytes() == job


def test_blender_follows_the_first_of_two_trainers(lodgs, jobs, fake, root, tmp_path, monkeypatch):
    """The Blender of the refused trainer follows the other one."""
    fake("two halves")
    run = tmp_path / "run"
    first = jobs.start(root, str(run))
    _wait(first, lambda: first.levels)
    folder = lodgs("runs.watch").RunFolder
    with monkeypatch.context() as patch:
        patch.setattr(folder, "locked", lambda self: nullcontext())
        second = jobs._resume(root, folder(run))
    assert second.process.wait(60) == 2
    in_use = lodgs("runs.watch").IN_USE
    _wait(second, lambda: second.process is None)
    assert second.step() and second.warnings.count(in_use) == 1
    (run / "go on").touch()
    assert first.process.wait(60) == 0
    while second.step():
        time.sleep(0.02)
    assert (second.state, second.problem, _levels(root)) == ("done", "", COUNTS)


def test_new_run_of_another_blender_is_kept(lodgs, jobs, fake, root, tmp_path, monkeypatch):
    fake()
    run = tmp_path / "run"
    create = lodgs("runs.watch").RunFolder.create

    def create_with_job(self):
        create(self)
        (run / "job.toml").write_text("job of another Blender")

    monkeypatch.setattr(lodgs("runs.watch").RunFolder, "create", create_with_job)
    with pytest.raises(lodgs("training.errors").LodgsError, match="another Blender has started a run"):
        jobs.start(root, str(run))
    assert (run / "job.toml").read_text() == "job of another Blender"


def test_moved_run_is_resumed(bpy, watch_of, fake, root, tmp_path):
    fake("killed")
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    (tmp_path / "run").rename(tmp_path / "moved")
    job = tmp_path / "moved" / "job.toml"  # format of older versions
    job.write_text(job.read_text().replace('out = "."', f'out = "{tmp_path / "run"}"'))
    with pytest.raises(RuntimeError, match="contains no run"):
        bpy.ops.lodgs.open_run(directory=str(tmp_path / "run"))
    bpy.ops.lodgs.open_run(directory=str(tmp_path / "moved"))
    fake()
    assert bpy.ops.lodgs.resume_training() == {"FINISHED"}
    assert watch_of(root).state == "done" and (tmp_path / "moved" / "bundle.ply").exists()
    assert not (tmp_path / "run").exists()


def test_following_a_run_with_corrupt_events_never_raises(bpy, jobs, fake, root, tmp_path):
    fake("killed")
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    run = tmp_path / "run"
    level = '{"event": "level", "level": 1, "path": "levels/level_1.ply", "splats": 5, "meta": %s}'
    second = (level % "{}").replace('"level": 1', '"level": 2')
    (tmp_path / "secret.ply").write_bytes((run / "levels" / "level_1.ply").read_bytes())
    lines = [
        '{"event": "hello", "method": 3}',
        level % "3", level % '{"camera_center": "here"}', level % '{"a": "\\ud800"}', level % ("[" * 20_000),
        (level % "{}").replace('"level": 1', f'"level": {2**31}'),
        second.replace("levels/level_1.ply", str(tmp_path / "secret.ply")),
        second.replace("levels/level_1.ply", "../secret.ply"),
        second.replace("levels/level_1.ply", "events.jsonl"),
        '{"event": "done"}',
    ]  # fmt: skip
    with (run / "events.jsonl").open("a") as file:
        file.write("\n".join(lines) + "\n")
    watch = jobs.attach(root, str(run))
    while watch.step():
        pass
    assert list(_levels(root)) == [1] and watch.problem
    assert any("unknown format" in warning for warning in watch.warnings)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_opening_a_file_reads_no_pipe_and_no_network_share(bpy, lodgs, watch_of, root, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    for name in ("events.jsonl", "lock", "trainer.log"):
        os.mkfifo(tmp_path / "run" / name)
    (tmp_path / "run" / "job.toml").write_text("")
    root.lodgs.training.run = str(tmp_path / "run")
    remote = root.copy()
    root.users_collection[0].objects.link(remote)
    remote.lodgs.training.run = r"\\server\share\run"
    folder = lodgs("training.runs.folder").RunFolder
    queried = []
    state = folder.state
    monkeypatch.setattr(folder, "state", lambda run: queried.append(run.path.name) or state(run))
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    assert queried == ["run"] and watch_of(bpy.data.objects["tiny"]) is None


def test_one_trainer_per_folder_and_several_at_once(bpy, lodgs, jobs, fake, root, tmp_path):
    error = lodgs("training.errors").LodgsError
    copy = root.copy()
    root.users_collection[0].objects.link(copy)
    fake("slow")
    first = jobs.start(root, str(tmp_path / "run"))
    _wait(first, lambda: first.progress)
    with pytest.raises(error, match="another training is running"):
        jobs.start(copy, str(tmp_path / "run"))
    second = jobs.start(copy, str(tmp_path / "run 2"))
    _wait(second, lambda: second.progress)
    for obj in (root, copy):
        jobs.cancel(obj)
    _wait(first, lambda: not first.running)
    _wait(second, lambda: not second.running)
    with pytest.raises(error, match="contains a run"):
        jobs.start(copy, str(tmp_path / "run"))


def test_reopened_file_attaches_to_its_run(bpy, jobs, watch_of, fake, root, tmp_path):
    """Save and close the file while the run trains, reopen it while it trains, and after it has finished."""
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    fake("slow")
    watch = jobs.start(root)
    assert watch.folder.path == tmp_path / "lodgs_runs" / "tiny"
    assert root.lodgs.training.run == "//lodgs_runs/tiny"
    _wait(watch, lambda: watch.progress)
    bpy.ops.wm.save_mainfile()

    bpy.ops.wm.read_homefile(use_empty=True)
    assert not watch.step()  # its scene root no longer exists
    bpy.ops.wm.open_mainfile(filepath=blend)
    attached = watch_of(bpy.data.objects["tiny"])
    assert attached.running and attached.process is None and attached.progress["step"] >= 1
    jobs.cancel(bpy.data.objects["tiny"])
    _wait(attached, lambda: not attached.running)
    assert attached.state == "cancelled"
    bpy.ops.wm.save_mainfile()

    fake()
    resumed = jobs.resume(bpy.data.objects["tiny"])
    bpy.ops.wm.read_homefile(use_empty=True)  # closed before the first level
    resumed.process.wait(200)
    bpy.ops.wm.open_mainfile(filepath=blend)
    root = bpy.data.objects["tiny"]
    assert watch_of(root).state == "done" and _levels(root) == COUNTS
    assert tuple(root.lodgs.camera_center) == (1, 2, 3)

    # levels are not loaded twice: a level that the user deleted stays deleted
    bpy.data.objects.remove(root.lodgs.levels[0].object)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=blend)
    root = bpy.data.objects["tiny"]
    assert watch_of(root).state == "done" and _levels(root) == {2: COUNTS[2]}
    assert bpy.ops.lodgs.open_run(directory="//lodgs_runs/tiny") == {"FINISHED"}
    assert _levels(root) == COUNTS


def test_undo_keeps_levels_and_the_run(bpy, jobs, watch_of, fake, tmp_path, request):
    """Undo after a level keeps the level. Undo and redo of the import attach to the run again."""
    bpy.ops.ed.undo_push(message="Start")
    root = request.getfixturevalue("root")
    bpy.ops.ed.undo_push(message="Import")
    fake("slow")
    watch = jobs.start(root, str(tmp_path / "run"))
    bpy.ops.ed.undo_push(message="Train")
    _wait(watch, lambda: watch.progress)

    bpy.ops.ed.undo()  # before Train
    root = bpy.data.objects["tiny"]
    assert root.lodgs.training.run == str(tmp_path / "run") and watch_of(root) is watch
    bpy.ops.ed.undo()  # before the import
    assert "tiny" not in bpy.data.objects and not watch.step()
    bpy.ops.ed.redo()
    root = bpy.data.objects["tiny"]
    assert watch_of(root) is None  # without a run at that step
    bpy.ops.ed.redo()
    root = bpy.data.objects["tiny"]
    attached = watch_of(root)
    assert attached is not watch and attached.running
    jobs.cancel(root)
    _wait(attached, lambda: not attached.running)

    fake()
    resumed = jobs.resume(root)
    _wait(resumed, lambda: not resumed.running)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
    bpy.ops.ed.undo_push(message="Add")
    bpy.ops.ed.undo()
    root = bpy.data.objects["tiny"]
    assert "user object" not in bpy.data.objects and _levels(root) == COUNTS
    bpy.ops.ed.undo()  # Training finished
    bpy.ops.ed.undo()  # Level 2
    assert _levels(bpy.data.objects["tiny"]) == {1: COUNTS[1]}
    bpy.ops.ed.redo()
    assert _levels(bpy.data.objects["tiny"]) == COUNTS


def test_level_removed_by_undo_returns_at_the_end(bpy, jobs, fake, tmp_path, request):
    """Undo a level and do something else, so that redo cannot bring the level back."""
    root = request.getfixturevalue("root")
    bpy.ops.ed.undo_push(message="Import")
    fake("two halves")
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: 2 in watch.levels)
    bpy.ops.ed.undo()
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
    bpy.ops.ed.undo_push(message="Add")
    assert _levels(bpy.data.objects["tiny"]) == {1: COUNTS[1]}
    (tmp_path / "run" / "go on").touch()
    _wait(watch, lambda: not watch.running)
    root = bpy.data.objects["tiny"]
    assert watch.state == "done" and not watch.problem and _levels(root) == COUNTS
    assert [item.number for item in root.lodgs.levels] == [1, 2] and "user object" in bpy.data.objects


def test_training_continues_after_removing_the_scene(bpy, jobs, fake, root, tmp_path, capfd):
    fake("slow")
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.progress)
    assert bpy.ops.lodgs.remove_scene() == {"FINISHED"}
    assert f"its training continues in {tmp_path / 'run'}" in capfd.readouterr().out
    assert not watch.step() and watch.process.poll() is None
    watch.folder.request_cancel()
    assert watch.process.wait(200) == 3


def test_missing_run_folder_is_no_error_on_opening(bpy, jobs, watch_of, root, tmp_path):
    root.lodgs.training.run = str(tmp_path / "missing")
    blend = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    assert watch_of(bpy.data.objects["tiny"]) is None
    with pytest.raises(RuntimeError, match="contains no run"):
        bpy.ops.lodgs.open_run(directory=str(tmp_path / "missing"))


def test_deleting_the_root_ends_only_the_watch(bpy, jobs, lodgs, fake, root, tmp_path):
    fake("slow")
    watch = jobs.start(root, str(tmp_path / "run"))
    _wait(watch, lambda: watch.progress)
    bpy.data.objects.remove(root)
    assert not watch.step()
    assert lodgs("runs.watch").watches == {} and watch.folder.state() == "running"
    watch.folder.request_cancel()
    assert watch.process.wait(200) == 3


def test_run_with_fewer_levels_removes_the_other_levels(bpy, lodgs, jobs, fake, root, tmp_path):
    Level = lodgs("training.splats.levels").Level
    for number in (1, 2, 3):
        lodgs("data.scenes").set_level(root, Level(number, splats(3)))
    fake()
    bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert _levels(root) == COUNTS


def test_levels_of_two_runs_are_never_mixed(bpy, lodgs, jobs, fake, root, tmp_path):
    """If a second training dies after its first level, only this level remains."""
    fake()
    bpy.ops.lodgs.train(folder=str(tmp_path / "first"))
    coarsest = root.lodgs.levels[0].object
    fake("crash")
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.train(folder=str(tmp_path / "second"))
    assert _levels(root) == {1: COUNTS[1]}
    assert root.lodgs.levels[0].object == coarsest, "the object stays with its modifiers and children"
    assert (root.lodgs.bands.last, root.lodgs.single_level) == (1, 1)
    assert [level.number for level in lodgs("data.scenes").read_levels(root).levels] == [1]


def test_run_folders_do_not_collide(lodgs, jobs, fake, root, tmp_path):
    fake()

    def train():
        watch = jobs.start(root)
        with pytest.raises(lodgs("training.errors").LodgsError, match="is already being trained"):
            jobs.start(root)
        watch.process.wait(200)
        while watch.step():
            pass
        return watch.folder.path

    assert train() == tmp_path / "home" / "lodgs_runs" / "tiny"  # the file is not saved: at home
    assert train() == tmp_path / "home" / "lodgs_runs" / "tiny-2"
    root.lodgs.training.output = str(tmp_path / "mine")
    assert train() == tmp_path / "mine" / "tiny"


def test_wrong_settings_are_reported(bpy, jobs, fake, root, tmp_path, monkeypatch):
    fake()
    with pytest.raises(RuntimeError, match="'tiny' has no run"):
        bpy.ops.lodgs.resume_training()
    with pytest.raises(RuntimeError, match="has not written one"):
        bpy.ops.lodgs.show_log()
    (tmp_path / "file").write_text("")
    with pytest.raises(RuntimeError, match="Cannot read the run folder"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "file" / "run"))
    root.lodgs.training.test_every = 1
    with pytest.raises(RuntimeError, match="test_every"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    root.lodgs.training.test_every = 8
    fake("no_torch")
    with pytest.raises(RuntimeError, match="torch is missing"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    monkeypatch.delenv("LODGS_TRAINER_PYTHON")
    with pytest.raises(RuntimeError, match="not installed"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    root.lodgs.scene_folder = ""
    with pytest.raises(RuntimeError, match="it has no photos"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    bpy.data.objects.remove(root)
    assert not bpy.ops.lodgs.train.poll()


@pytest.mark.nightly
def test_real_trainer_is_cancelled_and_resumed(bpy, jobs, tmp_path):
    """Train levels from small images in a few steps, cancel and resume."""
    if not TRAINER:
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    bpy.ops.lodgs.import_colmap(directory=str(REPOSITORY / "examples" / "lantern_garden"), photographs=False)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    root.lodgs.training.image_scale = 0.1
    settings = {"levels": 2, "steps": [10, 2000], "levels_from": "trained"}
    watch = jobs.start(root, str(tmp_path / "run"), settings)
    _wait(watch, lambda: watch.progress.get("step", 0) > 12)
    assert list(_levels(root)) == [1]
    jobs.cancel(root)
    _wait(watch, lambda: not watch.running)
    assert (watch.state, watch.problem) == ("cancelled", "")
    watch = jobs.resume(root)
    _wait(watch, lambda: watch.message.startswith("Level"))
    assert watch.progress["step"] > 12
    watch.process.kill()
    _wait(watch, lambda: not watch.running)
    assert "signal 9" in watch.problem


def test_resume_uses_the_current_backend(bpy, lodgs, jobs, fake, root, tmp_path):
    fake("killed")
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    lodgs("extension").preferences().backend = "cpu"
    fake()
    bpy.ops.lodgs.resume_training()
    Job = lodgs("training.runs.job").Job
    assert Job.from_file(tmp_path / "run" / "job.toml").backend == "cpu"


@pytest.mark.nightly
def test_octree_levels_are_cumulative_and_follow_the_distance(bpy, lodgs, jobs, tmp_path):
    """With the real trainer, all levels arrive together, twice, and are selected by distance at once."""
    if not TRAINER:
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    bpy.ops.lodgs.import_colmap(directory=str(REPOSITORY / "examples" / "lantern_garden"), photographs=False)
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    root.lodgs.training.image_scale, root.lodgs.training.method = 0.1, "octree"
    parameters = {"levels": 3, "steps": 12, "coarse_share": 0.5, "levels_from": "anchors"}
    watch = jobs.start(root, str(tmp_path / "run"), parameters)
    _wait(watch, lambda: len(watch.levels) == 3)
    finest = root.lodgs.levels[-1].object
    _wait(watch, lambda: not watch.running)
    assert (watch.state, watch.problem) == ("done", "")
    settings = root.lodgs
    assert settings.cumulative and settings.rule == "octree" and '"d_max"' in settings.facts
    assert list(_levels(root)) == [1, 2, 3]
    assert settings.levels[-1].object == finest, "a newer version of a level keeps its object"
    settings.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    visible, total = lodgs("data.scenes").count_visible(bpy.context, root)
    settings.octree.offset = -16
    bpy.context.view_layer.update()
    assert lodgs("data.scenes").count_visible(bpy.context, root)[0] == len(
        settings.levels[0].object.data.points
    )
    assert 0 < visible <= total
    bundles = lodgs("training.splats.bundle")
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "export.ply"))
    exported, trained = (bundles.read_bundle(p) for p in (tmp_path / "export.ply", watch.folder.bundle))
    assert exported.cumulative and exported.meta == trained.meta
    for a, b in zip(exported.levels, trained.levels, strict=True):
        assert (a.splats.means == b.splats.means).all()
        assert (a.splats.extras["lod_bias"] == b.splats.extras["lod_bias"]).all()
        assert (a.splats.extras["lod_level"] == a.number).all()
