"""A door is where others' input comes in; `attempt` says what it made of one, and what it cost.

A door answers with success or with a `LodgsError`, within `MOST_SECONDS` and `MOST_BYTES`. All else is a
defect. A short round, part of all tests, fails on the first one, which hypothesis makes small. A long round
(`make fuzz`, ``LODGS_FUZZ=20000`` inputs) notes it and goes on; ``conftest`` prints the table at the end.
"""

from __future__ import annotations

import os
import resource
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

from training.errors import LodgsError

MOST_SECONDS = 10.0
MOST_BYTES = 4 << 30
"""Most that one input may take: of time, and of memory beyond what was in use before."""
LONG = int(os.environ.get("LODGS_FUZZ", "0"))
"""Inputs of a long round over all doors; 0 for a short one."""

Answer = TypeVar("Answer")


@dataclass
class Record:
    """What came of the inputs of one door.

    Attributes:
        tried, clean, told: all inputs; those that were taken; those that were refused in a sentence.
        slowest: seconds of the slowest input.
        growth: bytes by which one input raised the process's peak memory, at most.
        defects: the traceback of each distinct one, by where it is, and how often.
    """

    tried: int = 0
    clean: int = 0
    told: int = 0
    slowest: float = 0.0
    growth: int = 0
    defects: dict[str, list] = field(default_factory=dict)


RECORDS: dict[str, Record] = {}
"""Of this process, by the door's name."""


class Defect(AssertionError):
    """What no input may cause, beside exceptions of any other kind than `LodgsError`."""


def attempt(door: str, call: Callable[[], Answer], given: object = None) -> Answer | None:
    """Try one input at a door.

    Args:
        door: its name in the table, such as "PLY".
        call: reads the input, and uses it as far as it is to be trusted from then on.
        given: the input, for a long round's report of a defect.

    Returns:
        What the call returned; None where it was told why not.
    """
    record = RECORDS.setdefault(door, Record())
    record.tried += 1
    peak, started = _peak(), time.perf_counter()
    answer = None
    try:
        try:
            with _limited():
                answer = call()
            record.clean += 1
        except LodgsError as error:
            record.told += 1
            _check_sentence(error)
        seconds, growth = time.perf_counter() - started, _peak() - peak
        record.slowest, record.growth = max(record.slowest, seconds), max(record.growth, growth)
        if seconds > MOST_SECONDS or growth > MOST_BYTES:
            raise Defect(f"{door}: {seconds:.1f} s, {growth / 2**20:.0f} MiB")
    except Exception as error:
        if not LONG:
            raise
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{type(error).__name__} {os.path.relpath(where.filename)}:{where.lineno}"
        found = record.defects.setdefault(
            place, [0, "".join(traceback.format_exception(error)), repr(given)[:20_000]]
        )
        found[0] += 1
    return answer


def _check_sentence(error: LodgsError) -> None:
    text = str(error)
    text.encode()  # what cannot be printed is no answer
    if not error.what or len(text) > 2000 or "Traceback" in text or "\0" in text:
        raise Defect(f"no sentence: {text[:200]!r}") from error


@contextmanager
def _limited():
    """In a long round an endless input is given up, so that the next ones have their turn."""
    if not LONG:
        yield
        return

    def give_up(*_):
        raise Defect(f"not done in {6 * MOST_SECONDS:.0f} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, 6 * MOST_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
