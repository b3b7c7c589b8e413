"""Run folders: links, locks, cancel requests and the process of the trainer."""

import errno
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from training.errors import LodgsError
from training.files import atomic_write
from training.runs import processes
from training.runs.events import event_line
from training.runs.folder import RunFolder, find_splats

ROOT = Path(__file__).resolve().parents[3]
LOCK_RUN = (
    "import sys, time; from training.runs.folder import RunFolder\n"
    "with RunFolder(sys.argv[1]).locked(): print('held', flush=True); time.sleep(1000)"
)


@pytest.fixture
def run(tmp_path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.create()
    return run


@pytest.fixture
def holder(run):
    """Another process that locks the run."""
    with subprocess.Popen(
        [sys.executable, "-c", LOCK_RUN, str(run.path)], cwd=ROOT, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        yield process
        process.kill()


@pytest.mark.parametrize(
    "name",
    [
        "events.jsonl", "trainer.log", "trainer.out", "lock", "job.toml", "bundle.ply", "levels",
        "checkpoints", "undistorted", "reserve", "metrics.json", "levels/level_1.ply",
    ],
)  # fmt: skip
def test_links_in_a_run_are_rejected(run, tmp_path, name):
    """A run from an untrusted source cannot redirect writes."""
    path = run.path / name
    if path.is_dir():
        path.rmdir()
    path.symlink_to(tmp_path / "outside")
    with pytest.raises(LodgsError, match="is a link or a special file"):
        run.create()
    assert not (tmp_path / "outside").exists()


def test_finished_run_has_a_folder_for_checkpoints_only_without_its_bundle(run):
    run.events_file.write_text(event_line("done") + "\n")
    run.bundle.touch()
    run.checkpoints.rmdir()
    run.create()
    assert not run.checkpoints.exists()
    run.bundle.unlink()
    run.create()
    assert run.checkpoints.is_dir()


def test_find_file_rejects_paths_outside_the_run(run, tmp_path):
    (run.path / "levels" / "level_1.ply").write_text("inside")
    (tmp_path / "secret").write_text("outside")
    (run.path / "levels" / "level_2.ply").symlink_to(tmp_path / "secret")
    assert run.find_file("levels/level_1.ply").read_text() == "inside"
    for path in ("levels/level_2.ply", "levels", "levels/level_3.ply", "../secret"):
        with pytest.raises(LodgsError, match="has no file"):
            run.find_file(path)


def test_locking_deletes_only_temporary_files_of_killed_trainers(run):
    leftovers = [
        run.checkpoints / ".step_0000001.pt.0123-45-89ab.tmp",
        run.path / ".bundle.ply.89ab-1234567-cdef.tmp",
    ]
    user_files = [run.path / ".notes.tmp", run.path / "mine.tmp", run.checkpoints / "step_0000001.pt"]
    for path in leftovers + user_files:
        path.write_text("")
    (run.undistorted / "undistorting-x" / "images").mkdir(parents=True)
    with run.locked():
        assert not any(path.exists() for path in leftovers) and all(path.exists() for path in user_files)
        assert not any(run.undistorted.iterdir())


def test_stale_cancel_request_is_ignored(run):
    run.request_cancel()
    with run.locked():
        assert run.take_cancel() and not run.take_cancel()
    run.request_cancel()
    long_ago = time.time() - 3600
    os.utime(run.path / "cancel", (long_ago, long_ago))
    with run.locked():
        assert not run.take_cancel()


@pytest.mark.skipif(os.name == "nt", reason="Windows does not delete open files")
def test_lost_lock_is_detected(run):
    with run.locked():
        run.require_lock()
        os.unlink(run.path / "lock")
        with RunFolder(run.path).locked(), pytest.raises(LodgsError, match="moved or deleted"):
            run.require_lock()


def test_kill_ends_the_trainer(run, holder):
    assert run.running
    run.kill()
    holder.wait(200)
    assert not run.running


@pytest.mark.parametrize(
    "change",
    [
        {"pid": 1}, {"pid": 0}, {"pid": -1}, {"pid": "x"}, {"pid": 2**70}, {"identity": ""},
        {"identity": "elsewhere 1 boot 5"}, {"identity": None}, {"pid": os.getppid()},
    ],
)  # fmt: skip
def test_kill_never_ends_another_process(run, holder, change, monkeypatch):
    lock = run.path / "lock"
    lock.write_text(json.dumps(json.loads(lock.read_text()) | change))
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("killed"))
    with pytest.raises(LodgsError, match="Cannot kill"):
        run.kill()
    assert holder.poll() is None


def test_kill_without_a_running_trainer_is_rejected(run, monkeypatch):
    holder = {"pid": os.getppid(), "identity": processes.identity(os.getppid())}
    (run.path / "lock").write_text(json.dumps(holder))
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("killed"))
    with pytest.raises(LodgsError, match="Cannot kill"):
        run.kill()


def test_process_identities_are_unique(monkeypatch):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        parent = processes.identity(os.getpid())
        identity = processes.identity(process.pid)
        assert parent and identity and parent != identity and parent == processes.identity(os.getpid())
        process.kill()
        process.wait()
        assert processes.identity(process.pid) == "" == processes.identity(-1)


def test_atomic_write_follows_links(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    assert sorted(os.listdir(tmp_path)) == ["link.txt", "real.txt"]


def test_ended_run_is_not_running_where_locks_need_write_access(tmp_path, monkeypatch):
    """NFS locks only files that are open for writing."""
    fcntl = pytest.importorskip("fcntl")
    run = RunFolder(tmp_path)
    original = fcntl.flock

    def flock(file, operation):
        if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        original(file, operation)

    run.create()
    monkeypatch.setattr(fcntl, "flock", flock)
    with run.locked():
        assert run.running
    assert not run.running


def test_command_stops_when_its_parent_ends(monkeypatch):
    """A Blender in background that is killed, even by SIGKILL, leaves no trainer behind."""
    code = """
import signal
import time
from training.runs.processes import stop_with_parent
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells ignore it for programs in background
stop_with_parent()
print("ready", flush=True)
try:
    time.sleep(1000)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as parent:
        monkeypatch.setenv(processes.PARENT, f"{parent.pid} {processes.identity(parent.pid)}")
        command = [sys.executable, "-c", code]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            assert child.poll() is None
            parent.kill()
            parent.wait()
            assert child.communicate(timeout=200)[0] == "interrupted\n"


@pytest.mark.parametrize("value", [None, "", "1", "x y", "PID elsewhere 1 boot 5"])
def test_unknown_parent_is_ignored(monkeypatch, value):
    """As in a container, which does not see Blender's process."""
    if value is not None:
        monkeypatch.setenv(processes.PARENT, value.replace("PID", str(os.getpid())))
    monkeypatch.setattr(processes.threading, "Thread", lambda **_: pytest.fail("watches"))
    processes.stop_with_parent()


def test_splats_of_a_run(run):
    assert find_splats(run.path) == run.path
    run.job.touch()
    with pytest.raises(LodgsError, match="the run is not finished"):
        find_splats(run.path)
    run.bundle.touch()
    assert find_splats(run.path) == run.bundle
    assert find_splats(run.bundle) == run.bundle
