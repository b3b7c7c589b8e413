"""The exception for mistakes and limits that a user can act on."""

import errno
import re

MAX_TEXT = 1000
"""Maximum number of characters of a sentence. Longer ones, which quote foreign text, lose their middle."""
_UNPRINTABLE = re.compile("[\0\ud800-\udfff]")


class LodgsError(Exception):
    """A mistake or a limit that a user can act on: shown as one or two sentences, never as a traceback.

    Args:
        what: the failed action and its reason, with the file or value concerned.
        remedy: the user's next step, in the imperative.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        self.what = _shorten(printable(what))
        self.remedy = _shorten(printable(remedy))
        super().__init__(f"{self.what} {self.remedy}".strip())


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
