"""How kernels are compiled, cached and called. Import numba's names from here only."""

from __future__ import annotations

import hashlib
import math
import os
import sys
import threading
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any


def _cache_folder() -> Path:
    """Where this user's programs may keep what they can make again, one folder for each state of our sources.

    Numba looks only at the file that a kernel is in, not at those that it takes its helpers from.
    """
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    sources = sorted(Path(__file__).resolve().parent.parent.rglob("*.py"))
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    return base / "lodgs" / "numba" / digest[:16]


# Read when numba is imported. Its default, beside the source, is not writable in every installation.
os.environ.setdefault("NUMBA_CACHE_DIR", str(_cache_folder()))

import numba  # noqa: E402
import numpy as np  # noqa: E402

prange = numba.prange
f32 = np.float32

FAST = frozenset({"contract", "reassoc", "nsz", "arcp", "afn", "nnan", "ninf"})
"""For the pixel kernels: everything but reciprocal guesses about special values; none reaches them."""
STRICT = frozenset()
"""For what must give the same answer wherever it is compiled."""


def kernel(fastmath: frozenset[str], parallel: bool = False) -> Callable[[Callable], Any]:
    """Compile a function of arrays: cached on disk, without the GIL, dividing as C does."""
    return numba.njit(fastmath=set(fastmath), parallel=parallel, cache=True, nogil=True, error_model="numpy")


def inlined(fastmath: frozenset[str]) -> Callable[[Callable], Any]:
    """Compile a helper into the kernels that call it."""
    return numba.njit(fastmath=set(fastmath), inline="always", error_model="numpy")


_scratch: dict[str, np.ndarray] = {}


def scratch(name: str, *shape: int) -> np.ndarray:
    """A float32 array to use and forget within one serialised call; fresh pages would cost milliseconds."""
    size = math.prod(shape)
    if name not in _scratch or _scratch[name].size < size:
        _scratch[name] = np.empty(size + size // 4, np.float32)
    return _scratch[name][:size].reshape(shape)


_one_at_a_time = threading.RLock()


def serialised(function: Callable) -> Callable:
    """One call at a time: Numba's workqueue layer, all that some systems have, aborts on concurrent calls."""

    @wraps(function)
    def call(*args, **kwargs):
        with _one_at_a_time:
            return function(*args, **kwargs)

    return call
