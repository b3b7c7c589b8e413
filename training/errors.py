"""The one error that users are meant to see."""

import errno
import re

MAX_TEXT = 1000
"""Characters of a sentence, which may quote what others have written; the middle of more is left out."""
_NO_TEXT = re.compile("[\0\ud800-\udfff]")


class LodgsError(Exception):
    """A mistake or a limit that a user can act on: shown as one sentence or two, never as a traceback.

    Args:
        what: what could not be done and why, naming the file or value concerned.
        remedy: what the user can do about it.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        self.what, self.remedy = _shortened(printable(what)), _shortened(printable(remedy))
        super().__init__(f"{self.what} {self.remedy}".strip())


def printable(text: object) -> str:
    """A name, a path or a sentence as anything can show it: what is no text in it is escaped."""
    return _NO_TEXT.sub(lambda found: f"\\x{ord(found[0]):02x}", str(text))


def _shortened(text: str) -> str:
    if len(text) <= MAX_TEXT:
        return text
    return f"{text[: MAX_TEXT // 2]} ... {text[-MAX_TEXT // 2 :]}"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that memory does not suffice: Python's, numpy's or torch's, of CPU or GPU."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


_NO_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread")
