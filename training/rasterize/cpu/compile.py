"""How kernels are compiled, cached and run on several threads. Import numba's names from here only.

Kernels are serial functions of a range of work, and :func:`run_parallel` deals ranges out to threads. Numba's
own ``parallel=True`` would link the body of each loop into its caller and optimise it a second time, so that
a kernel rounds otherwise in the process that compiled it than in those that read it from the cache; its
threads wait for each other at barriers, and its fallback layer aborts on concurrent calls.
"""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from pathlib import Path
from typing import Any

from ...files import cache_folder


def _kernels_folder() -> Path:
    """Where compiled kernels are kept, one folder for each state of our sources.

    Numba looks only at the file that a kernel is in, not at those that it takes its helpers from.
    """
    sources = sorted(Path(__file__).resolve().parent.parent.rglob("*.py"))
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    return cache_folder() / "numba" / digest[:16]


# Read when numba is imported. Its default, beside the source, is not writable in every installation.
os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernels_folder()))

import numba  # noqa: E402
import numpy as np  # noqa: E402

f32 = np.float32

FAST = frozenset({"contract", "reassoc", "nsz", "arcp", "afn", "nnan", "ninf"})
"""For the pixel kernels: everything but reciprocal guesses about special values; none reaches them."""
STRICT = frozenset()
"""For what must give the same answer wherever it is compiled."""


_OPTIONS: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True}
"""Dividing as C does, and not callable from C, which would take a wrapper."""
_HELPER: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True}


def kernel(fastmath: frozenset[str]) -> Callable[[Callable], Any]:
    """Compile a function of arrays: cached on disk, without the GIL."""
    return numba.njit(fastmath=set(fastmath), cache=True, nogil=True, **_OPTIONS)


def helper(fastmath: frozenset[str]) -> Callable[[Callable], Any]:
    """Compile a function for kernels only. LLVM decides whether it becomes part of its caller.

    Numba's own ``inline="always"`` copies the source into every caller and infers its types there again,
    which takes longer than all else.
    """
    return numba.njit(**_HELPER, fastmath=set(fastmath))


def inlined(fastmath: frozenset[str]) -> Callable[[Callable], Any]:
    """As :func:`helper`, always a part of its caller: for what inner loops call."""
    return numba.njit(**_HELPER, fastmath=set(fastmath), forceinline=True)


def available_threads() -> int:
    """What this process may use: the cores that it is allowed on, or LODGS_THREADS."""
    wanted = os.environ.get("LODGS_THREADS", "")
    if wanted.isdecimal() and int(wanted) > 0:
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_threads = available_threads()
_pool: ThreadPoolExecutor | None = None


def thread_count() -> int:
    """How many threads kernels run on."""
    return _threads


def set_thread_count(count: int) -> None:
    """Run kernels on this many threads from now on; results do not depend on it."""
    global _threads, _pool
    _threads, _pool = count, None


def run_parallel(kernel: Callable, total: int, grain: int, *args: Any) -> None:
    """Call ``kernel(begin, end, *args)`` on all threads, for ranges of ``grain`` that cover range(total).

    Whoever is free takes the next range, the caller too, so a thread that the system holds up delays nobody
    but the range in its hands. What a kernel writes must not depend on how the ranges fall.
    """
    global _pool
    if _noted is not None:
        _noted[kernel] = (0, 0, *args)
        return
    begins = iter(range(0, total, grain))  # next() on it is atomic

    def work() -> None:
        for begin in begins:
            kernel(begin, min(begin + grain, total), *args)

    helpers = min(_threads, -(-total // grain)) - 1
    if helpers > 0 and _pool is None:
        _pool = ThreadPoolExecutor(_threads - 1, "lodgs-kernels")
    waiting = [_pool.submit(work) for _ in range(helpers)] if _pool is not None else []
    work()
    for helper in waiting:
        helper.result()


def run_serial(kernel: Callable, *args: Any) -> None:
    """Call a kernel whose work cannot be dealt out."""
    if _noted is not None:
        _noted[kernel] = args
        return
    kernel(*args)


_noted: dict[Any, tuple] | None = None
"""While this is a dictionary, kernels are not run but noted in it, with arguments that make little work."""


def compile_in_two_processes(step: Callable[[], Any]) -> None:
    """Fill an empty cache with the kernels that ``step`` calls, in two thirds of the time of one process.

    Numba compiles in Python and holds the GIL, so threads would not help. Nothing is done where there is a
    cache already, where only one thread is to be used, or where a process cannot be forked (macOS's own
    libraries do not bear it): a fresh one would import torch first, and the main program as well. The forked
    one does not make the step: where torch has a GPU, gradients cannot be taken there.

    Args:
        step: is content with kernels that do nothing.
    """
    cached = any(Path(numba.config.CACHE_DIR).rglob("*.nbi"))  # type: ignore[attr-defined]
    if cached or thread_count() == 1 or not sys.platform.startswith("linux"):
        return
    noted = _kernels_of(step)
    with tempfile.TemporaryDirectory(prefix="lodgs-") as taken:
        fork = multiprocessing.get_context("fork")
        other = fork.Process(target=_compile_share, args=(noted, taken, -1), daemon=True)
        other.start()
        try:
            _compile_share(noted, taken, 1)
            other.join()
        finally:
            other.kill()
            other.join()


def _kernels_of(step: Callable[[], Any]) -> dict[Any, tuple]:
    """The kernels that a step calls, with arguments that make little work."""
    global _noted
    _noted = {}
    try:
        with np.errstate(all="ignore"):  # it reckons with whatever the memory held
            step()
        return _noted
    finally:
        _noted = None


def _compile_share(noted: dict[Any, tuple], taken: str, direction: int) -> None:
    """Compile those kernels that nobody has taken yet, by a file in the folder ``taken``.

    One process begins with the first module and one with the last, as kernels of a module share helpers.
    """
    by_module = sorted(noted, key=lambda kernel: (kernel.py_func.__module__, kernel.py_func.__name__))
    for kernel in by_module[::direction]:
        try:
            (Path(taken) / kernel.py_func.__name__).touch(exist_ok=False)
        except FileExistsError:
            continue
        kernel(*noted[kernel])


_idle: dict[str, list[np.ndarray]] = {}


class Buffers:
    """Arrays that go to the next who asks for their names once this object is gone.

    Fresh pages from the system would cost milliseconds a step. Two renderings that wait for their backward
    passes have their own arrays. Nothing that outlives this object may be a view of one.
    """

    def __init__(self) -> None:
        self._taken: list[tuple[str, np.ndarray]] = []

    def take(self, name: str, kind: Any, *shape: int) -> np.ndarray:
        """An array of this type and shape that holds anything."""
        size = math.prod(shape) * np.dtype(kind).itemsize
        idle = _idle.get(name)
        buffer = idle.pop() if idle else None
        if buffer is None or len(buffer) < size:
            fresh = np.empty(size + size // 4 + 64, np.uint8)
            buffer = fresh[-fresh.ctypes.data % 64 :]  # rows of 64 bytes are to be one cache line each
        self._taken.append((name, buffer))
        return buffer[:size].view(kind).reshape(shape)

    def __del__(self) -> None:
        for name, buffer in self._taken:
            _idle.setdefault(name, []).append(buffer)


_one_at_a_time = threading.RLock()


def serialised(function: Callable) -> Callable:
    """One call at a time: the threads are shared."""

    @wraps(function)
    def call(*args, **kwargs):
        with _one_at_a_time:
            return function(*args, **kwargs)

    return call
