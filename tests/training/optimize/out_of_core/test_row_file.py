"""Rows in a file: as in memory, whatever is done to them; as a checkpoint has them, however a run ends."""

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
from training.optimize.out_of_core import row_file as rows_module
from training.optimize.out_of_core.row_file import RowFile, RowLayout
from training.runs.checkpoints import read_newest, remove_checkpoints, write_checkpoint
from training.runs.folder import RunFolder

LAYOUT = RowLayout({"means": (3,), "opacity": (), "sh": (2, 3)})
ROOT = Path(__file__).resolve().parents[3]


def records(seed: int, count: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((count, LAYOUT.width), np.float32))


def test_a_layout_splits_records_into_views_and_joins_them():
    made = records(0, 5)
    parts = LAYOUT.split(made)
    assert {name: tuple(part.shape) for name, part in parts.items()} == {
        "means": (5, 3), "opacity": (5,), "sh": (5, 2, 3),
    }  # fmt: skip
    assert torch.equal(LAYOUT.join(parts), made)
    parts["opacity"][2] = 7
    assert made[2, 3] == 7


class AsInMemory(RuleBasedStateMachine):
    """A file of tiny blocks beside an array, checkpoints taken, gone back to, and files damaged."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="rows-"))
        self.rows = self.opened()
        self.truth = np.zeros((0, LAYOUT.width), np.float32)
        self.taken: list[tuple[dict, np.ndarray]] = []

    def opened(self) -> RowFile:
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
        some = np.array(data.draw(st.lists(st.integers(0, len(self.truth) - 1), unique=True)), np.int64)
        self.rows.write(some, records(seed, len(some)))
        self.truth[some] = records(seed, len(some))

    @precondition(lambda self: len(self.truth) > 0)
    @rule(data=st.data())
    def read(self, data):
        some = np.array(data.draw(st.lists(st.integers(0, len(self.truth) - 1))), np.int64)
        np.testing.assert_array_equal(self.rows.read(some), self.truth[some])

    @rule()
    def checkpoint(self):
        self.taken = [*self.taken[-2:], (self.rows.state_dict(), self.truth.copy())]
        if len(self.taken) == 3:
            named = {state["file"] for state, _ in self.taken} - {""}
            assert {path.name for path in self.folder.iterdir()} == named

    @rule()
    def write_anew(self):
        """All rows to a file of their own, as density control does."""
        grown = self.opened()
        grown.append(self.rows.read(np.arange(len(self.rows))))
        grown.supersede(self.rows)
        self.rows = grown

    @precondition(lambda self: self.taken)
    @rule(back=st.integers(0, 2), began=st.booleans())
    def resume(self, back, began):
        """From one of the last three; a fresh object may have begun to write before."""
        del self.taken[max(len(self.taken) - back, 1) :]
        state, truth = self.taken[-1]
        self.rows.close()
        self.rows = self.opened()
        if began:
            self.rows.append(records(1, 20))
        self.rows.load_state_dict(state)
        self.truth = truth.copy()

    @invariant()
    def all_is_as_it_should_be(self):
        assert len(self.rows) == len(self.truth)
        np.testing.assert_array_equal(self.rows.read(np.arange(len(self.truth))), self.truth)
        used = np.concatenate([self.rows._slots[self.rows._slots >= 0], self.rows._free])
        assert len(set(used.tolist())) == len(used)


TestAsInMemory = AsInMemory.TestCase
TestAsInMemory.settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


def test_rows_that_are_not_there_are_refused(tmp_path):
    rows = RowFile(tmp_path, LAYOUT, block=4)
    rows.append(records(0, 32))
    with pytest.raises(IndexError):
        rows.read(np.array([32]))
    with pytest.raises(IndexError):
        rows.write(np.array([-1]), records(0, 1))
    with pytest.raises(ValueError, match="twice"):
        rows.write(np.array([1, 1]), records(0, 2))


def test_a_checkpoint_costs_what_has_changed(tmp_path):
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


def test_damage_is_found_before_anything_is_taken(tmp_path):
    rows = RowFile(tmp_path, LAYOUT, block=8)
    rows.append(records(0, 100))
    state = rows.state_dict()
    rows.close()
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()

    def resumed() -> RowFile:
        found = RowFile(tmp_path, LAYOUT, block=8)
        found.load_state_dict(state)
        return found

    assert torch.equal(resumed().read(np.arange(100)), records(0, 100))
    for spoilt in (whole[:500] + b"\x55" + whole[501:], whole[:-100], b""):
        path.write_bytes(spoilt)
        with pytest.raises(ValueError, match=r"damaged|cut short"):
            resumed()
    path.unlink()
    with pytest.raises(ValueError, match="missing"):
        resumed()
    for name in ("../rows_00000000.bin", "/etc/passwd"):
        with pytest.raises(ValueError, match="impossible name"):
            RowFile(tmp_path, LAYOUT, block=8).load_state_dict({**state, "file": name})
    with pytest.raises(ValueError, match="another kind"):
        RowFile(tmp_path, LAYOUT, block=4).load_state_dict(state)


# -- ends --------------------------------------------------------------------------------------------------


def life(folder: RunFolder, first: int, last: int, count: list[int] | None = None) -> None:
    """Goes on with a small run where its newest checkpoint is; every step changes rows, and adds some."""
    rows = RowFile(folder.checkpoints, LAYOUT, block=4, staging=4 * 4 * 4 * LAYOUT.width)
    rows.append(records(99, 25))  # as a method begins before it takes up a checkpoint
    found = read_newest(folder, "cpu", lambda state: rows.load_state_dict(state["rows"]), print)
    for step in range(found[0] if found else first, last):
        rng = np.random.default_rng(step)
        some = rng.permutation(len(rows))[:9]
        rows.write(some, rows.read(some) + records(step, 9))
        rows.append(records(step, 3))
        if step % 2:
            write_checkpoint(folder, step + 1, [], {"rows": rows.state_dict()})
    rows.close()


def held(folder: RunFolder) -> tuple[int, np.ndarray]:
    """The newest checkpoint's step and rows."""
    rows = RowFile(folder.checkpoints, LAYOUT, block=4)
    warned: list[str] = []
    found = read_newest(folder, "cpu", lambda state: rows.load_state_dict(state["rows"]), warned.append)
    assert not warned
    if found is None:
        return 0, np.zeros(0)
    content = rows.read(np.arange(len(rows))).numpy()
    rows.close()
    return found[0], content


STEPS = 6


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """What each checkpoint of an undisturbed run holds."""
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    folder.create()
    truth = {0: np.zeros(0)}
    for end in range(2, STEPS + 1, 2):
        life(folder, 0, end)
        step, content = held(folder)
        assert step == end
        truth[end] = content
    return truth


def moments(hit) -> None:
    """Lets ``hit`` be told of every moment at which something gets to the disk; a number each."""
    counter = iter(range(10**6))
    write, fsync, replace = rows_module._write, os.fsync, os.replace

    def writing(file, array):
        hit(next(counter), lambda: write(file, array.reshape(-1)[: array.size // 2]))
        write(file, array)

    def syncing(descriptor):
        hit(next(counter), lambda: None)
        fsync(descriptor)

    def moving(source, target):
        hit(next(counter), lambda: None)
        replace(source, target)

    rows_module._write, os.fsync, os.replace = writing, syncing, moving  # pyright: ignore


def _killed(folder: RunFolder, at: int, counted) -> None:
    def hit(number: int, some_of_it) -> None:
        counted.value = number + 1
        if number == at:
            some_of_it()
            os._exit(9)

    moments(hit)
    life(folder, 0, STEPS)
    os._exit(0)


def _full(folder: RunFolder, at: int, counted) -> None:
    """From a moment on nothing more gets to the disk; how that is told."""

    def hit(number: int, some_of_it) -> None:
        counted.value = number + 1
        if number >= at:
            some_of_it()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    moments(hit)
    try:
        life(folder, 0, STEPS)
    except LodgsError as error:
        os._exit(8 if "No space left on device" in str(error) and "Free some space" in str(error) else 7)
    os._exit(0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="processes do not fork")
@pytest.mark.parametrize(("end", "code"), [(_killed, 9), (_full, 8)])
def test_wherever_it_ends_the_last_checkpoint_is_whole_and_the_run_goes_on(
    tmp_path, undisturbed, monkeypatch, end, code
):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # no power is cut here, and disks take their time
    fork = multiprocessing.get_context("fork")
    counted = fork.Value("i", 0)
    at = ends = 0
    while True:
        folder = RunFolder(tmp_path / f"{at}")
        folder.create()
        process = fork.Process(target=end, args=(folder, at, counted))
        process.start()
        process.join()
        if process.exitcode == 0:
            assert at >= counted.value > 20, "every moment has had its turn"
            break
        assert process.exitcode == code
        ends += 1
        step, content = held(folder)
        np.testing.assert_array_equal(content, undisturbed[step])
        life(folder, 0, STEPS)
        step, content = held(folder)
        assert step == STEPS
        np.testing.assert_array_equal(content, undisturbed[STEPS])
        at += 1
    assert ends == at


def test_an_older_checkpoint_serves_where_the_newest_is_spoilt(tmp_path, undisturbed):
    folder = RunFolder(tmp_path)
    folder.create()
    life(folder, 0, STEPS)
    (folder.checkpoints / f"step_{STEPS:07d}.pt").write_bytes(b"nothing")
    rows, warned = RowFile(folder.checkpoints, LAYOUT, block=4), []
    found = read_newest(folder, "cpu", lambda state: rows.load_state_dict(state["rows"]), warned.append)
    assert found is not None and found[0] == STEPS - 2 and len(warned) == 1
    np.testing.assert_array_equal(rows.read(np.arange(len(rows))), undisturbed[STEPS - 2])
    rows.close()
    remove_checkpoints(folder)
    assert not list(folder.checkpoints.iterdir())


def test_files_of_earlier_lives_go(tmp_path):
    folder = RunFolder(tmp_path)
    folder.create()
    (folder.checkpoints / "rows_0123abcd.bin").write_bytes(b"left")
    (folder.checkpoints / "rows_of_mine.bin").write_bytes(b"not ours")
    life(folder, 0, STEPS)
    names = {path.name for path in folder.checkpoints.glob("*.bin")}
    assert "rows_0123abcd.bin" not in names and "rows_of_mine.bin" in names and len(names) == 2


# -- memory ------------------------------------------------------------------------------------------------

MEASURED = """
import json, re, sys
import numpy as np, torch
from pathlib import Path
from training.optimize.out_of_core.cut_cache import CutCache
from training.optimize.out_of_core.row_file import FileRows, Layout

torch.set_num_threads(1)
budget, times = int(sys.argv[1]), int(sys.argv[2])
layout = Layout({"values": (70,)})

def peak():
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) << 10

rows = FileRows(Path(sys.argv[3]), layout)
count, at_once = times * budget // 280, 5000
rng = np.random.default_rng(0)
rows.append(torch.ones(64, 70))
warm = CutCache(rows, 1, 1 << 20)  # what libraries take when they are first used is not ours
places = warm.take(np.zeros(1), np.ones(1), lambda _: (rng.permutation(64), np.array([64])))
warm.put(places, warm.get(places) + 1)
warm.state_dict()
before = peak()
for begin in range(0, count, at_once):
    rows.append(torch.zeros(min(at_once, count - begin), 70))
groups, size = count // 500, 500
cache = CutCache(rows, groups, budget)
for step in range(60):
    some = rng.choice(groups, 10, replace=False)
    def cut(anew):
        near = (some[anew][:, None] * size + rng.random((len(anew), size)).argsort(1)[:, :300]).ravel()
        return near, np.full(len(anew), 300)
    places = cache.take(some, rng.random(10) + 1, cut)
    cache.put(places, cache.get(places) + 1)
    if step % 20 == 19:
        cache.state_dict()
found = {"rows": count, "peak": peak() - before, "capacity": cache.capacity, "loaded": cache.loaded}
print(json.dumps(found))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc for the resident memory")
def test_the_process_stays_within_the_budget(tmp_path):
    """Ten times as many rows as there is memory for, touched at random; by the system's own count.

    What comes on top: 4 bytes a row, and 16 MB for what is between file and tensors at a time (STAGING, in
    six copies), what a step asks for, and what allocators keep. That differs by 14 MB between runs of the
    same code, so several are made until one stays within; what were held beyond would be in all of them.
    """
    budget = 24 << 20
    for _ in range(6):
        done = subprocess.run(
            [sys.executable, "-c", MEASURED, str(budget), "10", str(tmp_path)],
            cwd=ROOT, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["rows"] * 280 >= 9.9 * budget and found["loaded"] > found["capacity"]
        if found["peak"] < budget + 4 * found["rows"] + (16 << 20):
            break
    assert found["peak"] < budget + 4 * found["rows"] + (16 << 20)
