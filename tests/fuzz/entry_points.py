"""Entry points that read untrusted input, and :func:`attempt`, which records their results and costs.

An entry point must succeed or raise a `LodgsError`, within `MAX_SECONDS` and `MAX_BYTES`; everything else is
a defect. A short round, part of all tests, fails on the first defect, which hypothesis minimises. A long
round (`make fuzz`, ``LODGS_FUZZ=20000`` inputs) records defects and continues; ``conftest`` prints the table
at the end.
"""

from __future__ import annotations

import os
import resource
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

from training.errors import LodgsError

MAX_SECONDS = 10.0
MAX_BYTES = 4 << 30
"""Limits per input: time, and memory in addition to the memory in use."""
LONG = int(os.environ.get("LODGS_FUZZ", "0"))
"""Number of inputs of a long round over all entry points; 0 for a short round."""

Answer = TypeVar("Answer")


@dataclass
class Record:
    """Results of the inputs of one entry point.

    Attributes:
        tried, accepted, rejected: number of all inputs, of successes, and of LodgsErrors.
        slowest: seconds of the slowest input.
        growth: largest increase of the process's peak memory by one input, in bytes.
        defects: count, traceback and input of each distinct defect, by its location.
    """

    tried: int = 0
    accepted: int = 0
    rejected: int = 0
    slowest: float = 0.0
    growth: int = 0
    defects: dict[str, list] = field(default_factory=dict)


RECORDS: dict[str, Record] = {}
"""Records of this process by entry point."""


class Defect(AssertionError):
    """Raised for exceeded limits and unusable error messages."""


def attempt(entry_point: str, call: Callable[[], Answer], content: object = None) -> Answer | None:
    """Try one input.

    Args:
        entry_point: name in the table, such as "PLY".
        call: reads the input, and uses the result as far as it must be trustworthy.
        content: the input, for the report of a defect.

    Returns:
        The result of the call; None if the input was rejected.
    """
    record = RECORDS.setdefault(entry_point, Record())
    record.tried += 1
    peak = _peak_memory()
    started = time.process_time()  # does not depend on other programs
    answer = None
    try:
        try:
            with _time_limit():
                answer = call()
            record.accepted += 1
        except LodgsError as error:
            record.rejected += 1
            _check_message(error)
        seconds = time.process_time() - started
        growth = _peak_memory() - peak
        record.slowest = max(record.slowest, seconds)
        record.growth = max(record.growth, growth)
        if seconds > MAX_SECONDS or growth > MAX_BYTES:
            raise Defect(f"{entry_point}: {seconds:.1f} s, {growth / 2**20:.0f} MiB")
    except Exception as error:
        if not LONG:
            raise
        frame = traceback.extract_tb(error.__traceback__)[-1]
        location = f"{type(error).__name__} {os.path.relpath(frame.filename)}:{frame.lineno}"
        defect = record.defects.setdefault(
            location, [0, "".join(traceback.format_exception(error)), repr(content)[:20_000]]
        )
        defect[0] += 1
    return answer


def _check_message(error: LodgsError) -> None:
    text = str(error)
    text.encode()  # the message must be printable
    if not error.what or len(text) > 2000 or "Traceback" in text or "\0" in text:
        raise Defect(f"unusable message: {text[:200]!r}") from error


@contextmanager
def _time_limit() -> Iterator[None]:
    """Stop an endless call in a long round, so that the remaining inputs are tried."""
    if not LONG:
        yield
        return

    def give_up(*_: object) -> None:
        raise Defect(f"not finished after {6 * MAX_SECONDS:.0f} s")

    handler = signal.signal(signal.SIGVTALRM, give_up)
    signal.setitimer(signal.ITIMER_VIRTUAL, 6 * MAX_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, handler)


def _peak_memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
