"""What a user is told of whatever ends a training."""

from __future__ import annotations

from ..errors import LodgsError, is_out_of_memory
from ..files import DISK_FULL

DONE, CRASHED, BAD_INPUT, CANCELLED = 0, 1, 2, 3
"""Exit codes of ``python -m training train``."""


def describe_error(error: BaseException) -> tuple[str, str, int]:
    """What to tell the user of an exception: what, remedy, exit code."""
    if isinstance(error, LodgsError):
        return error.what, error.remedy, BAD_INPUT
    if is_out_of_memory(error):
        remedy = "Lower max_splats or image_scale, or close other programs; then resume the run."
        return "There is not enough memory; training stopped.", remedy, BAD_INPUT
    if isinstance(error, OSError):
        if error.errno in DISK_FULL:
            return "The disk is full; training stopped.", "Free some space and resume the run.", BAD_INPUT
        about = f" ({error.filename})" if error.filename else ""
        return (
            f"Training stopped: {error.strerror or error}{about}.",
            "Check that the disk is there and may be written to, then resume the run.",
            BAD_INPUT,
        )
    kind = type(error).__name__
    return (
        f"Training stopped on an unexpected {kind}: {error}.",
        "Its details are in the log; please report it.",
        CRASHED,
    )
