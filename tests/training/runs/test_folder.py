"""A run's folder: whose it is, what is written where, and which process is at work in it."""

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
from training.runs.folder import RunFolder

ROOT = Path(__file__).resolve().parents[3]
HOLDS = (
    "import sys, time; from training.runs.folder import RunFolder\n"
    "with RunFolder(sys.argv[1]).locked(): print('held', flush=True); time.sleep(600)"
)


@pytest.fixture
def run(tmp_path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.create()
    return run


@pytest.fixture
def holder(run):
    """Another process that holds the run."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(run.path)], cwd=ROOT, stdout=subprocess.PIPE
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
def test_links_in_a_run_are_refused(run, tmp_path, name):
    """A stranger's run does not choose where is written."""
    place = run.path / name
    if place.is_dir():
        place.rmdir()
    place.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(LodgsError, match="is a link or a special file"):
        run.create()
    assert not (tmp_path / "elsewhere").exists()


def test_files_of_a_run_lie_in_it(run, tmp_path):
    (run.path / "levels" / "level_1.ply").write_text("here")
    (tmp_path / "secret").write_text("there")
    (run.path / "levels" / "level_2.ply").symlink_to(tmp_path / "secret")
    assert run.find_file("levels/level_1.ply").read_text() == "here"
    for path in ("levels/level_2.ply", "levels", "levels/level_3.ply", "../secret"):
        with pytest.raises(LodgsError, match="holds no file"):
            run.find_file(path)


def test_what_killed_trainers_left_goes_and_nothing_else(run):
    left = [run.checkpoints / ".step_0000001.pt.0123abcd.tmp", run.path / ".bundle.ply.89abcdef.tmp"]
    kept = [run.path / ".notes.tmp", run.path / "mine.tmp", run.checkpoints / "step_0000001.pt"]
    for path in left + kept:
        path.write_text("")
    (run.undistorted / "undistorting-x" / "images").mkdir(parents=True)
    with run.locked():
        assert not any(path.exists() for path in left) and all(path.exists() for path in kept)
        assert not any(run.undistorted.iterdir())


def test_a_cancel_that_was_meant_for_another_trainer_is_forgotten(run):
    run.request_cancel()
    with run.locked():
        assert run.take_cancel() and not run.take_cancel()
    run.request_cancel()
    long_ago = time.time() - 3600
    os.utime(run.path / "cancel", (long_ago, long_ago))
    with run.locked():
        assert not run.take_cancel()


@pytest.mark.skipif(os.name == "nt", reason="Windows does not delete what is open")
def test_who_has_lost_the_lock_notices(run):
    with run.locked():
        run.require_lock()
        os.unlink(run.path / "lock")
        with RunFolder(run.path).locked(), pytest.raises(LodgsError, match="or its lock was"):
            run.require_lock()


def test_a_trainer_is_ended_by_force(run, holder):
    assert run.running
    run.kill()
    holder.wait(20)
    assert not run.running


@pytest.mark.parametrize(
    "change",
    [
        {"pid": 1}, {"pid": 0}, {"pid": -1}, {"pid": "x"}, {"pid": 2**70}, {"identity": ""},
        {"identity": "elsewhere 1 boot 5"}, {"identity": None}, {"pid": os.getppid()},
    ],
)  # fmt: skip
def test_no_other_process_is_ended_whatever_the_file_says(run, holder, change, monkeypatch):
    lock = run.path / "lock"
    lock.write_text(json.dumps(json.loads(lock.read_text()) | change))
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("it was"))
    with pytest.raises(LodgsError, match="cannot be ended from here"):
        run.kill()
    assert holder.poll() is None


def test_no_process_is_ended_where_none_is_at_work(run, monkeypatch):
    holder = {"pid": os.getppid(), "identity": processes.identity(os.getppid())}
    (run.path / "lock").write_text(json.dumps(holder))
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("it was"))
    with pytest.raises(LodgsError, match="cannot be ended from here"):
        run.kill()


def test_processes_are_told_apart(monkeypatch):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        mine, theirs = processes.identity(os.getpid()), processes.identity(other.pid)
        assert mine and theirs and mine != theirs and mine == processes.identity(os.getpid())
        other.kill()
        other.wait()
        assert processes.identity(other.pid) == "" == processes.identity(-1)


def test_a_link_among_exports_is_followed(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    assert sorted(os.listdir(tmp_path)) == ["link.txt", "real.txt"]


def test_where_locks_are_writes_a_run_that_has_ended_is_not_running(tmp_path, monkeypatch):
    """As NFS has it: a lock takes a file that is open for writing."""
    fcntl = pytest.importorskip("fcntl")
    run, real = RunFolder(tmp_path), fcntl.flock

    def flock(file, how):
        if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        real(file, how)

    run.create()
    monkeypatch.setattr(fcntl, "flock", flock)
    with run.locked():
        assert run.running
    assert not run.running
