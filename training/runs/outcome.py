"""Describe how a run's trainer ended. Imports no torch: Blender uses it."""

from __future__ import annotations

from .events import read_events
from .failures import BAD_INPUT, CANCELLED, DONE
from .folder import RunFolder


def run_outcome(folder: RunFolder, code: int | None) -> tuple[str, str]:
    """Return the state of a run whose trainer has ended, and a message if it did not end as intended.

    Args:
        folder: the run.
        code: exit code of the trainer's process; None if another process started it.

    Returns:
        ``RunFolder.state``, and one or two sentences with cause and remedy, or "".

    Raises:
        LodgsError, OSError: the run folder cannot be read.
    """
    if not folder.path.is_dir():
        return "interrupted", f"The run folder {folder.path} does not exist: it was moved or deleted."
    state = folder.state()
    if code == BAD_INPUT and state in {"running", "done", "cancelled"}:
        code = None  # another process trained this run; ours could not lock it
    error = folder.end_event() if state == "failed" else None
    if error is None and code == BAD_INPUT:  # it could not open its run
        printed = read_events(folder.output)[0]
        error = next((event for event in reversed(printed) if event["event"] == "error"), None)
    if error is not None:
        return "failed", f"{error['what']} {error.get('remedy', '')}".strip()
    if code == BAD_INPUT:
        return "failed", (
            f"The trainer could not write to {folder.path}: the disk is full or read-only. "
            "Free some space and resume the run."
        )
    if state in {"interrupted", "empty"} or code not in {None, DONE, CANCELLED}:
        return "interrupted", _exit_reason(code, folder.log_tail(1))
    return state, ""


def _exit_reason(code: int | None, last_line: str) -> str:
    """Return the likely reason for the end of a trainer that reported no error."""
    if code is not None and code < 0:
        reason = f"was killed (signal {-code}), often because memory ran out"
    elif code:
        reason = f"stopped with exit code {code}"
    else:
        reason = "stopped without a message: it was killed, or the computer was switched off"
    last = f" Its last log line: {last_line.strip()}" if last_line.strip() else ""
    return f"The trainer {reason}.{last}"
