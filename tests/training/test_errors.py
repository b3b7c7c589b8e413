"""Causes of errors, which events of a run carry."""

import errno

import pytest

from training.errors import ERROR_CAUSES, LodgsError, SystemProblem, error_cause, read_error
from training.files import atomic_write
from training.runs.events import event_line, read_events


def wrapped(error: BaseException) -> LodgsError:
    """Return a sentence about an error."""
    try:
        raise LodgsError("Cannot continue.") from error
    except LodgsError as result:
        return result


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (LodgsError("Cannot read a.ply."), "input"),
        (wrapped(KeyError("x")), "input"),
        (wrapped(FileNotFoundError(errno.ENOENT, "No such file")), "input"),
        (OSError(errno.ENOSPC, "No space left"), "disk"),
        (OSError(errno.EDQUOT, "Quota exceeded"), "disk"),
        (wrapped(wrapped(OSError(errno.ENOSPC, "No space left"))), "disk"),
        (LodgsError("Cell 1: the disk is full.", cause="disk"), "disk"),
        (MemoryError(), "memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "memory"),
        (SystemProblem("The share is lost."), "system"),
        (read_error("a.png", OSError(errno.EIO, "Input/output error"), ""), "system"),
        (OSError(errno.EMFILE, "Too many open files"), "system"),
        (ZeroDivisionError(), "bug"),
    ],
)
def test_cause_of_an_error(error, cause):
    assert error_cause(error) == cause and cause in ERROR_CAUSES


def test_full_disk_is_the_cause_of_a_failed_atomic_write(tmp_path):
    with pytest.raises(LodgsError) as caught, atomic_write(tmp_path / "a") as temporary:
        raise OSError(errno.ENOSPC, "No space left on device", str(temporary))
    assert error_cause(caught.value) == "disk"


def test_events_without_cause_remain_readable(tmp_path):
    """Earlier trainers wrote none; values that are no cause are dropped."""
    lines = [
        event_line("error", what="Full.", remedy="Free some."),
        event_line("error", what="Full.", cause="disk"),
        event_line("error", what="Full.", cause="moon"),
        event_line("error", what="Full.", cause=["disk"]),
    ]
    (tmp_path / "events.jsonl").write_text("\n".join(lines) + "\n")
    events, _ = read_events(tmp_path / "events.jsonl")
    assert [event.get("cause") for event in events] == [None, "disk", None, None]
