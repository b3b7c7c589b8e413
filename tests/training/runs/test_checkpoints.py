"""Checkpoints: whole or not at all, whatever happened to the file."""

import errno
import os
import random

import pytest
import torch

from training.runs.checkpoints import read_checkpoint, read_newest, write_checkpoint
from training.runs.failures import describe_error
from training.runs.folder import RunFolder


@pytest.fixture
def run(tmp_path) -> RunFolder:
    run = RunFolder(tmp_path)
    run.create()
    generator = torch.Generator().manual_seed(1)
    for step in (1, 2):
        write_checkpoint(run, step, [], {"means": torch.rand(200, 3, generator=generator), "step": step})
    return run


def test_what_was_written_is_read(run):
    taken = []
    assert read_newest(run, "cpu", taken.append, pytest.fail) == (2, [])
    assert taken[0]["step"] == 2 and taken[0]["means"].shape == (200, 3)


@pytest.mark.parametrize("damage", ["flip", "zero", "cut", "swap"])
def test_damage_is_noticed_or_changes_nothing(run, damage):
    path = run.checkpoints / "step_0000002.pt"
    good, truth = path.read_bytes(), read_checkpoint(path, "cpu")
    chance = random.Random(damage)
    refused = 0
    for _ in range(60):
        data, place = bytearray(good), chance.randrange(len(good) - 64)
        if damage == "flip":
            data[place] ^= 1 << chance.randrange(8)
        elif damage == "zero":
            data[place : place + 64] = bytes(64)
        elif damage == "cut":
            del data[place:]
        else:
            data[place : place + 32], data[:32] = data[:32], data[place : place + 32]
        path.write_bytes(data)
        try:
            state = read_checkpoint(path, "cpu")
        except Exception:
            refused += 1
            continue
        assert state["step"] == truth["step"] and state["method"]["step"] == 2
        assert torch.equal(state["method"]["means"], truth["method"]["means"])
    assert refused > 20


def test_a_full_disk_is_said_to_be_full(run, monkeypatch):
    """torch itself says ``[enforce fail at inline_container.cc``."""
    from training.runs import checkpoints

    class Full:
        def __init__(self, file):
            self._file, self.error = file, None

        def write(self, data):
            if self._file.tell() > 3000:
                self.error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                raise self.error
            return self._file.write(data)

        def flush(self):
            self._file.flush()

    monkeypatch.setattr(checkpoints, "_Remembering", Full)
    with pytest.raises(Exception, match="No space left on device") as error:
        write_checkpoint(run, 3, [], {"means": torch.zeros(5000, 3)})
    assert "Free some space" in describe_error(error.value)[1]
    assert [path.name for path in sorted(run.checkpoints.iterdir())] == ["step_0000001.pt", "step_0000002.pt"]


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "The disk is full"),
        (OSError(errno.EROFS, "Read-only file system", "/run/x"), "Read-only file system (/run/x)"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "not enough memory"),
        (RuntimeError("[enforce fail at alloc_cpu.cpp:121] . DefaultCPUAllocator: can't allocate memory: you "
                      "tried to allocate 4000000000000 bytes."), "not enough memory"),
        (MemoryError(), "not enough memory"),
    ],
)  # fmt: skip
def test_what_a_computer_lacks_is_a_sentence(error, says):
    what, remedy, code = describe_error(error)
    assert says in what and remedy and code == 2


def test_a_spoilt_checkpoint_does_not_push_out_one_that_can_be_read(run):
    spoilt, warned = run.checkpoints / "step_0000002.pt", []
    spoilt.write_bytes(b"nothing")
    assert read_newest(run, "cpu", lambda state: None, warned.append) == (1, [])
    assert len(warned) == 1 and not spoilt.exists()
    write_checkpoint(run, 2, [], {})
    assert read_newest(run, "cpu", lambda state: None, pytest.fail) == (2, [])
    assert (run.checkpoints / "step_0000001.pt").exists()


def test_too_little_memory_is_no_spoilt_checkpoint(run):
    def take(state):
        raise MemoryError

    with pytest.raises(MemoryError):
        read_newest(run, "cpu", take, pytest.fail)
    assert len(list(run.checkpoints.glob("step_*.pt"))) == 2
