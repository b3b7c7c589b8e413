"""The exception for mistakes and limits that a user can act on."""

import errno
import os
import re

DISK_FULL = {errno.ENOSPC, errno.EDQUOT}
"""Error codes of a full disk or an exceeded quota."""
INPUT, DISK, MEMORY, SYSTEM, BUG = ERROR_CAUSES = ("input", "disk", "memory", "system", "bug")
"""Causes of errors: a mistake or limit of the input, a full disk, too little memory, another failure of the
computer, and an unexpected exception."""
MAX_TEXT = 1000
"""Maximum number of characters of a sentence. Longer ones, which quote foreign text, lose their middle."""
_UNPRINTABLE = re.compile("[\0\ud800-\udfff]")


_LINK_LOOP = "Symlink loop from "
"""Start of the message of ``Path.resolve`` about an endless link before Python 3.13."""


class LodgsError(Exception):
    """A mistake or a limit that a user can act on: shown as one or two sentences, never as a traceback.

    Args:
        what: the failed action and its reason, with the file or value concerned.
        remedy: the user's next step, in the imperative.
        cause: one of ERROR_CAUSES; None for the cause of the exception from which this one is raised.
    """

    def __init__(self, what: str, remedy: str = "", cause: str | None = None) -> None:
        self.what = _shorten(printable(what))
        self.remedy = _shorten(printable(remedy))
        self.cause = cause
        super().__init__(f"{self.what} {self.remedy}".strip())


class SystemProblem(LodgsError):
    """A failure of the computer, such as a lost disk or too many open files."""


def error_cause(error: BaseException) -> str:
    """Return the cause of an exception, one of ERROR_CAUSES."""
    if is_out_of_memory(error):
        return MEMORY
    if isinstance(error, OSError):
        return DISK if error.errno in DISK_FULL else SYSTEM
    if not isinstance(error, LodgsError):
        return BUG
    if error.cause:
        return error.cause
    origin = None if error.__cause__ is None else error_cause(error.__cause__)
    if origin in (DISK, MEMORY):
        return origin
    return SYSTEM if isinstance(error, SystemProblem) else INPUT


def describe_system_error(error: BaseException) -> LodgsError | None:
    """Return a failure of the disk, the memory or another part of the computer as sentences, else None."""
    if is_out_of_memory(error):
        return SystemProblem("Not enough memory.", "Close other programs, or reduce the size of the task.")
    if isinstance(error, RuntimeError) and str(error).startswith(_LINK_LOOP):
        path = str(error)[len(_LINK_LOOP) :]
        return SystemProblem(
            f"Cannot use {path}: the link leads to itself.", "Remove it, or choose another path."
        )
    if not isinstance(error, OSError):
        return None
    action = f"Cannot use {printable(error.filename)}" if error.filename else "Cannot continue"
    return SystemProblem(f"{action}: {error.strerror or error}.", system_remedy(error))


def system_reason(error: OSError) -> str:
    """Return the reason of a system error, with the file if the error names one, without a final period."""
    path = error.filename2 or error.filename
    if not error.strerror:
        return str(error)
    return f"{error.strerror} ({printable(path)})" if path else error.strerror


def system_remedy(error: OSError, default: str = "") -> str:
    """Return the remedy for a full disk or an exceeded limit, or else the default."""
    if error.errno in DISK_FULL:
        return "Free some space on this disk, or choose another folder."
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "Raise the limit of open files (ulimit -n), or close other programs."
    if error.errno == errno.EFBIG:
        return "Raise the limit of the file size (ulimit -f), or choose another disk."
    return default


_ABOUT_THE_FILE = {
    errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.ELOOP, errno.ENAMETOOLONG, errno.ENXIO
}  # fmt: skip
"""Error codes that concern one file, which is missing or no regular file."""


def is_system_problem(error: BaseException) -> bool:
    """Return whether an error concerns the computer, a disk or permissions, not the content of one file."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno not in _ABOUT_THE_FILE
    return is_out_of_memory(error)


def read_error(path: object, error: OSError, remedy: str) -> LodgsError:
    """Return the error of a file that cannot be read; a SystemProblem if the file is not to blame."""
    kind = SystemProblem if is_system_problem(error) else LodgsError
    reason = error.strerror or error
    if isinstance(error, FileNotFoundError) and os.path.islink(str(path)):
        reason = f"it {missing_clause(path)}"
    return kind(f"Cannot read {printable(path)}: {reason}.", system_remedy(error, remedy))


def missing_clause(path: object) -> str:
    """Return "does not exist", with the target if a path is a symbolic link."""
    name = str(path)
    target = f"links to {printable(os.readlink(name))}, which " if os.path.islink(name) else ""
    return f"{target}does not exist"


def printable(text: object) -> str:
    """Return a name, a path or a sentence with NUL characters and lone surrogates escaped."""
    return _UNPRINTABLE.sub(lambda match: f"\\x{ord(match[0]):02x}", str(text))


def _shorten(text: str) -> str:
    if len(text) <= MAX_TEXT:
        return text
    return f"{text[: MAX_TEXT // 2]} ... {text[-MAX_TEXT // 2 :]}"


def is_out_of_memory(error: BaseException) -> bool:
    """Return True for the out-of-memory errors of Python, numpy and torch, on the CPU or the GPU."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and any(phrase in str(error) for phrase in _NO_MEMORY)


_NO_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread")
