"""The one error that users are meant to see."""

import errno


class LodgsError(Exception):
    """A mistake or a limit that a user can act on: shown as one sentence or two, never as a traceback.

    Args:
        what: what could not be done and why, naming the file or value concerned.
        remedy: what the user can do about it.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        super().__init__(f"{what} {remedy}".strip())
        self.what = what
        self.remedy = remedy


def out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that memory does not suffice: Python's, numpy's or torch's, of CPU or GPU."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


_NO_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread")
