"""How a run's trainer ended, in words, for whoever started or followed it. No torch: Blender says it."""

from __future__ import annotations

from .events import read_events
from .folder import RunFolder


def run_outcome(folder: RunFolder, code: int | None) -> tuple[str, str]:
    """What became of a run whose trainer is not at work any more.

    Args:
        code: the exit code of its process; None where somebody else started it.

    Returns:
        ``RunFolder.state``, and where nobody wanted that, why it is so and what to do: a sentence or two.

    Raises:
        LodgsError, OSError: the run's folder cannot be read.
    """
    if not folder.path.is_dir():
        return "interrupted", f"The run folder {folder.path} is gone: it was moved or deleted."
    state = folder.state()
    error = folder.end_event() if state == "failed" else None
    if error is None and code == 2:  # it could not even open its run
        printed = read_events(folder.output)[0]
        error = printed[-1] if printed and printed[-1]["event"] == "error" else None
    if error is not None:
        return "failed", f"{error['what']} {error.get('remedy', '')}".strip()
    if code == 2:
        return "failed", (
            f"The trainer could write nothing more into {folder.path}: the disk is full, or must not be "
            "written to. Free some space and resume the run."
        )
    if state in {"interrupted", "empty"} or code not in {None, 0, 3}:
        return "interrupted", _exit_reason(code, folder.log_tail(1))
    return state, ""


def _exit_reason(code: int | None, last_line: str) -> str:
    """Why a trainer that sent no error has ended, as far as one can know."""
    if code is not None and code < 0:
        how = f"was killed (signal {-code}); often that means too little memory"
    elif code:
        how = f"stopped with exit code {code}"
    else:
        how = "stopped without a word: killed, or the computer was switched off"
    last = f" Its last words: {last_line.strip()}" if last_line.strip() else ""
    return f"The trainer {how}.{last}"
