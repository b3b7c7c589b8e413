"""Checkpoints: verified reading, damage, full disks and low memory."""

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


def test_checkpoint_round_trip(run):
    states = []
    assert read_newest(run, "cpu", states.append, pytest.fail) == (2, [])
    assert states[0]["step"] == 2 and states[0]["means"].shape == (200, 3)


@pytest.mark.parametrize("damage", ["flip", "zero", "cut", "swap"])
def test_damage_is_detected_or_harmless(run, damage):
    path = run.checkpoints / "step_0000002.pt"
    good, truth = path.read_bytes(), read_checkpoint(path, "cpu")
    rng = random.Random(damage)
    detected = 0
    for _ in range(60):
        data = bytearray(good)
        offset = rng.randrange(len(good) - 64)
        if damage == "flip":
            data[offset] ^= 1 << rng.randrange(8)
        elif damage == "zero":
            data[offset : offset + 64] = bytes(64)
        elif damage == "cut":
            del data[offset:]
        else:
            data[offset : offset + 32], data[:32] = data[:32], data[offset : offset + 32]
        path.write_bytes(data)
        try:
            state = read_checkpoint(path, "cpu")
        except Exception:
            detected += 1
            continue
        assert state["step"] == truth["step"] and state["method"]["step"] == 2
        assert torch.equal(state["method"]["means"], truth["method"]["means"])
    assert detected > 20


def test_full_disk_is_reported_as_such(run, monkeypatch):
    """torch reports only ``[enforce fail at inline_container.cc``."""
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

    monkeypatch.setattr(checkpoints, "_ErrorRecorder", Full)
    with pytest.raises(Exception, match="No space left on device") as error:
        write_checkpoint(run, 3, [], {"means": torch.zeros(5000, 3)})
    assert "Free some space" in describe_error(error.value)[1]
    assert [path.name for path in sorted(run.checkpoints.iterdir())] == ["step_0000001.pt", "step_0000002.pt"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (OSError(errno.EROFS, "Read-only file system", "/run/x"), "Read-only file system (/run/x)"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "not enough memory"),
        (RuntimeError("[enforce fail at alloc_cpu.cpp:121] . DefaultCPUAllocator: can't allocate memory: you "
                      "tried to allocate 4000000000000 bytes."), "not enough memory"),
        (MemoryError(), "not enough memory"),
    ],
)  # fmt: skip
def test_lack_of_resources_is_reported_with_a_remedy(error, message):
    problem, remedy, code = describe_error(error)
    assert message in problem and remedy and code == 2


def test_corrupt_checkpoint_does_not_displace_a_readable_one(run):
    corrupt = run.checkpoints / "step_0000002.pt"
    warnings = []
    corrupt.write_bytes(b"nothing")
    assert read_newest(run, "cpu", lambda state: None, warnings.append) == (1, [])
    assert len(warnings) == 1 and not corrupt.exists()
    write_checkpoint(run, 2, [], {})
    assert read_newest(run, "cpu", lambda state: None, pytest.fail) == (2, [])
    assert (run.checkpoints / "step_0000001.pt").exists()


def test_low_memory_does_not_delete_checkpoints(run):
    def load(state):
        raise MemoryError

    with pytest.raises(MemoryError):
        read_newest(run, "cpu", load, pytest.fail)
    assert len(list(run.checkpoints.glob("step_*.pt"))) == 2
