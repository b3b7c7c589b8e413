"""Tests of row files: equivalence to arrays, and checkpoints after crashes and disk errors."""

import errno
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from training.errors import LodgsError
from training.optimize.out_of_core import row_file as row_file_module
from training.optimize.out_of_core.row_file import RowFile, RowLayout
from training.runs.checkpoints import read_newest, remove_checkpoints, write_checkpoint
from training.runs.folder import RunFolder

LAYOUT = RowLayout({"means": (3,), "opacity": (), "sh": (2, 3)})
ROOT = Path(__file__).resolve().parents[4]


def records(seed: int, count: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((count, LAYOUT.width), np.float32))


def test_layout_splits_records_into_views_and_joins_them():
    joined = records(0, 5)
    parts = LAYOUT.split(joined)
    assert {name: tuple(part.shape) for name, part in parts.items()} == {
        "means": (5, 3), "opacity": (5,), "sh": (5, 2, 3),
    }  # fmt: skip
    assert torch.equal(LAYOUT.join(parts), joined)
    parts["opacity"][2] = 7
    assert joined[2, 3] == 7


class RowFileModel(RuleBasedStateMachine):
    """Compare a file of tiny blocks with an array, including checkpoints and resumes."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="rows-"))
        self.rows = self.open()
        self.truth = np.zeros((0, LAYOUT.width), np.float32)
        self.checkpoints: list[tuple[dict, np.ndarray]] = []

    def open(self) -> RowFile:
        return RowFile(self.folder, LAYOUT, block=3, staging=3 * 3 * 4 * LAYOUT.width)

    def teardown(self) -> None:
        self.rows.close()
        shutil.rmtree(self.folder)

    @rule(count=st.integers(0, 25), seed=st.integers(0, 1000))
    def append(self, count, seed):
        self.rows.append(records(seed, count))
        self.truth = np.concatenate([self.truth, records(seed, count).numpy()])

    @precondition(lambda self: len(self.truth) > 0)
    @rule(data=st.data(), seed=st.integers(0, 1000))
    def write(self, data, seed):
        selection = np.array(data.draw(st.lists(st.integers(0, len(self.truth) - 1), unique=True)), np.int64)
        self.rows.write(selection, records(seed, len(selection)))
        self.truth[selection] = records(seed, len(selection))

    @precondition(lambda self: len(self.truth) > 0)
    @rule(data=st.data())
    def read(self, data):
        selection = np.array(data.draw(st.lists(st.integers(0, len(self.truth) - 1))), np.int64)
        np.testing.assert_array_equal(self.rows.read(selection), self.truth[selection])

    @rule()
    def checkpoint(self):
        self.checkpoints = [*self.checkpoints[-2:], (self.rows.state_dict(), self.truth.copy())]
        if len(self.checkpoints) == 3:
            files = {state["file"] for state, _ in self.checkpoints} - {""}
            assert {path.name for path in self.folder.iterdir()} == files

    @rule()
    def rewrite(self):
        """Copy all rows to a new file, as density control does."""
        grown = self.open()
        grown.append(self.rows.read(np.arange(len(self.rows))))
        grown.supersede(self.rows)
        self.rows = grown

    @precondition(lambda self: self.checkpoints)
    @rule(age=st.integers(0, 2), started=st.booleans())
    def resume(self, age, started):
        """Resume one of the last three checkpoints, possibly after writes."""
        del self.checkpoints[max(len(self.checkpoints) - age, 1) :]
        state, truth = self.checkpoints[-1]
        self.rows.close()
        self.rows = self.open()
        if started:
            self.rows.append(records(1, 20))
        self.rows.load_state_dict(state)
        self.truth = truth.copy()

    @invariant()
    def rows_match(self):
        assert len(self.rows) == len(self.truth)
        np.testing.assert_array_equal(self.rows.read(np.arange(len(self.truth))), self.truth)
        used = np.concatenate([self.rows._slots[self.rows._slots >= 0], self.rows._free])
        assert len(set(used.tolist())) == len(used)


TestRowFileModel = RowFileModel.TestCase
TestRowFileModel.settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


def test_invalid_rows_are_rejected(tmp_path):
    rows = RowFile(tmp_path, LAYOUT, block=4)
    rows.append(records(0, 32))
    with pytest.raises(IndexError):
        rows.read(np.array([32]))
    with pytest.raises(IndexError):
        rows.write(np.array([-1]), records(0, 1))
    with pytest.raises(ValueError, match="duplicate row"):
        rows.write(np.array([1, 1]), records(0, 2))


def test_checkpoint_size_depends_on_changes(tmp_path):
    rows = RowFile(tmp_path, LAYOUT, block=8)
    rows.append(records(0, 8000))
    rows.state_dict()
    (path,) = tmp_path.iterdir()
    size = path.stat().st_size
    for number in range(20):  # ten blocks each time
        rows.write(np.arange(80) + 80 * number, records(number, 80))
        rows.write(np.arange(80) + 80 * number, records(number + 1, 80))
        rows.state_dict()
    block = 8 * 4 * LAYOUT.width
    assert size == 1000 * block and path.stat().st_size <= size + 3 * 10 * block


def test_corrupt_files_are_rejected(tmp_path):
    rows = RowFile(tmp_path, LAYOUT, block=8)
    rows.append(records(0, 100))
    state = rows.state_dict()
    rows.close()
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()

    def resume() -> RowFile:
        restored = RowFile(tmp_path, LAYOUT, block=8)
        restored.load_state_dict(state)
        return restored

    assert torch.equal(resume().read(np.arange(100)), records(0, 100))
    for corrupt in (content[:500] + b"\x55" + content[501:], content[:-100], b""):
        path.write_bytes(corrupt)
        with pytest.raises(ValueError, match=r"corrupt|truncated"):
            resume()
    path.unlink()
    with pytest.raises(ValueError, match="missing"):
        resume()
    for name in ("../rows_00000000.bin", "/etc/passwd"):
        with pytest.raises(ValueError, match="invalid name"):
            RowFile(tmp_path, LAYOUT, block=8).load_state_dict({**state, "file": name})
    with pytest.raises(ValueError, match="another layout"):
        RowFile(tmp_path, LAYOUT, block=4).load_state_dict(state)


# -- crashes -----------------------------------------------------------------------------------------------


def run_steps(folder: RunFolder, first: int, last: int, count: list[int] | None = None) -> None:
    """Resume a small run from its newest checkpoint. Every step changes and adds rows."""
    rows = RowFile(folder.checkpoints, LAYOUT, block=4, staging=4 * 4 * 4 * LAYOUT.width)
    rows.append(records(99, 25))  # methods initialise before they load a checkpoint
    newest = read_newest(folder, "cpu", lambda state: rows.load_state_dict(state["rows"]), print)
    for step in range(newest[0] if newest else first, last):
        rng = np.random.default_rng(step)
        selection = rng.permutation(len(rows))[:9]
        rows.write(selection, rows.read(selection) + records(step, 9))
        rows.append(records(step, 3))
        if step % 2:
            write_checkpoint(folder, step + 1, [], {"rows": rows.state_dict()})
    rows.close()


def load_newest(folder: RunFolder) -> tuple[int, np.ndarray]:
    """Return the step and rows of the newest checkpoint."""
    rows = RowFile(folder.checkpoints, LAYOUT, block=4)
    warnings: list[str] = []
    newest = read_newest(folder, "cpu", lambda state: rows.load_state_dict(state["rows"]), warnings.append)
    assert not warnings
    if newest is None:
        return 0, np.zeros(0)
    content = rows.read(np.arange(len(rows))).numpy()
    rows.close()
    return newest[0], content


STEPS = 6


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Return the rows of each checkpoint of an uninterrupted run."""
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    folder.create()
    truth = {0: np.zeros(0)}
    for end in range(2, STEPS + 1, 2):
        run_steps(folder, 0, end)
        step, content = load_newest(folder)
        assert step == end
        truth[end] = content
    return truth


def intercept_writes(hit) -> None:
    """Call ``hit`` with a number before each write, flush and rename."""
    counter = iter(range(10**6))
    write, fsync, replace = row_file_module._write, os.fsync, os.replace

    def writing(file, array):
        hit(next(counter), lambda: write(file, array.reshape(-1)[: array.size // 2]))
        write(file, array)

    def syncing(descriptor):
        hit(next(counter), lambda: None)
        fsync(descriptor)

    def moving(source, target):
        hit(next(counter), lambda: None)
        replace(source, target)

    row_file_module._write, os.fsync, os.replace = writing, syncing, moving


def _killed(folder: RunFolder, at: int, counted) -> None:
    def hit(number: int, write_part) -> None:
        counted.value = number + 1
        if number == at:
            write_part()
            os._exit(9)

    intercept_writes(hit)
    run_steps(folder, 0, STEPS)
    os._exit(0)


def _full(folder: RunFolder, at: int, counted) -> None:
    """Fail all writes from number ``at`` on, and check the error message."""

    def hit(number: int, write_part) -> None:
        counted.value = number + 1
        if number >= at:
            write_part()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    intercept_writes(hit)
    try:
        run_steps(folder, 0, STEPS)
    except LodgsError as error:
        os._exit(8 if "No space left on device" in str(error) and "Free some space" in str(error) else 7)
    os._exit(0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="processes do not fork")
@pytest.mark.parametrize(("end", "code"), [(_killed, 9), pytest.param(_full, 8, marks=pytest.mark.nightly)])
def test_run_resumes_after_a_crash_at_any_write(tmp_path, uninterrupted, monkeypatch, end, code):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # only needed for power cuts, and slow
    fork = multiprocessing.get_context("fork")
    counted = fork.Value("i", 0)
    at = crashes = 0
    while True:
        folder = RunFolder(tmp_path / f"{at}")
        folder.create()
        process = fork.Process(target=end, args=(folder, at, counted))
        process.start()
        process.join()
        if process.exitcode == 0:
            assert at >= counted.value > 20, "a crash at every write was tested"
            break
        assert process.exitcode == code
        crashes += 1
        step, content = load_newest(folder)
        np.testing.assert_array_equal(content, uninterrupted[step])
        run_steps(folder, 0, STEPS)
        step, content = load_newest(folder)
        assert step == STEPS
        np.testing.assert_array_equal(content, uninterrupted[STEPS])
        at += 1
    assert crashes == at


def test_older_checkpoint_is_used_if_the_newest_is_corrupt(tmp_path, uninterrupted):
    folder = RunFolder(tmp_path)
    folder.create()
    run_steps(folder, 0, STEPS)
    (folder.checkpoints / f"step_{STEPS:07d}.pt").write_bytes(b"nothing")
    rows, warnings = RowFile(folder.checkpoints, LAYOUT, block=4), []
    newest = read_newest(folder, "cpu", lambda state: rows.load_state_dict(state["rows"]), warnings.append)
    assert newest is not None and newest[0] == STEPS - 2 and len(warnings) == 1
    np.testing.assert_array_equal(rows.read(np.arange(len(rows))), uninterrupted[STEPS - 2])
    rows.close()
    remove_checkpoints(folder)
    assert not folder.checkpoints.exists()


def test_files_of_earlier_processes_are_deleted(tmp_path):
    folder = RunFolder(tmp_path)
    folder.create()
    (folder.checkpoints / "rows_0123abcd.bin").write_bytes(b"left")
    (folder.checkpoints / "rows_of_mine.bin").write_bytes(b"not ours")
    run_steps(folder, 0, STEPS)
    names = {path.name for path in folder.checkpoints.glob("*.bin")}
    assert "rows_0123abcd.bin" not in names and "rows_of_mine.bin" in names and len(names) == 2


# -- memory ------------------------------------------------------------------------------------------------

MEMORY_SCRIPT = """
import json, re, sys
import numpy as np, torch
from pathlib import Path
from training.optimize.out_of_core.cut_cache import CutCache
from training.optimize.out_of_core.row_file import RowFile, RowLayout

torch.set_num_threads(1)
budget, times = int(sys.argv[1]), int(sys.argv[2])
layout = RowLayout({"values": (70,)})

def peak():
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) << 10

rows = RowFile(Path(sys.argv[3]), layout)
count, at_once = times * budget // 280, 5000
rng = np.random.default_rng(0)
rows.append(torch.ones(64, 70))
warm = CutCache(rows, 1, 1 << 20)  # exclude memory that libraries allocate once
places = warm.acquire(np.zeros(1), np.ones(1), lambda _: (rng.permutation(64), np.array([64])))
warm.put(places, warm.get(places) + 1)
warm.state_dict()
before = peak()
for begin in range(0, count, at_once):
    rows.append(torch.zeros(min(at_once, count - begin), 70))
groups, size = count // 500, 500
cache = CutCache(rows, groups, budget)
for step in range(60):
    selected = rng.choice(groups, 10, replace=False)
    def cut(missing):
        offsets = rng.random((len(missing), size)).argsort(1)[:, :300]
        near = (selected[missing][:, None] * size + offsets).ravel()
        return near, np.full(len(missing), 300)
    places = cache.acquire(selected, rng.random(10) + 1, cut)
    cache.put(places, cache.get(places) + 1)
    if step % 20 == 19:
        cache.state_dict()
result = {"rows": count, "peak": peak() - before, "capacity": cache.capacity, "loaded": cache.loaded}
print(json.dumps(result))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_process_stays_within_the_memory_budget(tmp_path):
    """Access ten times as many rows as fit, at random, and read the peak memory from the system.

    4 bytes per row and 16 MB are added for transfers between file and tensors (six times
    ``STAGING_BYTES``), temporary arrays of a step, and allocators. The latter vary by 14 MB between runs, so
    several are tried until one is within the limit; a leak would occur in all of them.
    """
    budget = 24 << 20
    for _ in range(6):
        process = subprocess.run(
            [sys.executable, "-c", MEMORY_SCRIPT, str(budget), "10", str(tmp_path)],
            cwd=ROOT, capture_output=True, text=True,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr
        result = json.loads(process.stdout)
        assert result["rows"] * 280 >= 9.9 * budget and result["loaded"] > result["capacity"]
        if result["peak"] < budget + 4 * result["rows"] + (16 << 20):
            break
    assert result["peak"] < budget + 4 * result["rows"] + (16 << 20)
