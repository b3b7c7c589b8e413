"""Messages and exit codes for exceptions that end a training."""

from __future__ import annotations

from ..errors import DISK_FULL, LodgsError, is_out_of_memory, system_remedy

DONE, CRASHED, BAD_INPUT, CANCELLED = 0, 1, 2, 3
"""Exit codes of ``python -m training train``."""


def describe_error(error: BaseException) -> tuple[str, str, int]:
    """Return problem, remedy and exit code for an exception."""
    if isinstance(error, LodgsError):
        return error.what, error.remedy, BAD_INPUT
    if is_out_of_memory(error):
        remedy = "Lower max_splats or image_scale, or close other programs; then resume the run."
        return "Training stopped: not enough memory.", remedy, BAD_INPUT
    if isinstance(error, OSError):
        path = f" ({error.filename})" if error.filename else ""
        if error.errno in DISK_FULL:
            remedy = "Free some space and resume the run."
            return f"Training stopped: the disk is full{path}.", remedy, BAD_INPUT
        return (
            f"Training stopped: {error.strerror or error}{path}.",
            system_remedy(error, "Check that the disk is connected and writable, then resume the run."),
            BAD_INPUT,
        )
    kind = type(error).__name__
    return (
        f"Training stopped because of an unexpected {kind}: {error}.",
        "Report it with the details in the log.",
        CRASHED,
    )
