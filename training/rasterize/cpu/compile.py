"""Compile, cache and run kernels on several threads. All imports of Numba's names go through this module.

Kernels are serial functions of a range of work, which :func:`run_parallel` distributes to threads. Numba's
own ``parallel=True`` has three disadvantages. It links the body of each loop into its caller and optimises it
again, so a kernel rounds differently in the process that compiled it than in processes that read it from the
cache. Its threads wait for each other at barriers. Its fallback layer aborts on concurrent calls.
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
    """Return the folder of compiled kernels, with one subfolder per version of the sources.

    Numba checks only the file of a kernel for changes, not the files of its helpers.
    """
    sources = sorted(Path(__file__).resolve().parent.parent.rglob("*.py"))
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    return cache_folder() / "numba" / digest[:16]


# Numba reads it on import. The default, next to the source, may not be writable.
os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernels_folder()))

import numba  # noqa: E402
import numpy as np  # noqa: E402

f32 = np.float32

FAST = frozenset({"contract", "reassoc", "nsz", "arcp", "afn", "nnan", "ninf"})
"""Flags for pixel kernels: all fast-math optimisations; special values never occur there."""
STRICT = frozenset()
"""Flags for kernels whose results must not depend on the compiler."""


_OPTIONS: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True}
"""Division as in C, and no wrapper for calls from C."""
_INLINED: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True, "forceinline": True}


def kernel(fastmath: frozenset[str]) -> Callable[[Callable], Any]:
    """Compile a function of arrays; it is cached on disk and releases the GIL."""
    return numba.njit(fastmath=set(fastmath), cache=True, nogil=True, **_OPTIONS)


def inlined(fastmath: frozenset[str]) -> Callable[[Callable], Any]:
    """Compile a function for use in kernels only. LLVM inlines it.

    A function that is not inlined may round differently in the process that compiled it than in processes
    that read it from the cache. Numba's own ``inline="always"`` copies the source into every caller and
    repeats type inference there, which takes longer than all other steps.
    """
    return numba.njit(**_INLINED, fastmath=set(fastmath))


def available_threads() -> int:
    """Return LODGS_THREADS if set, otherwise the number of cores available to this process."""
    setting = os.environ.get("LODGS_THREADS", "")
    if setting.isdecimal() and int(setting) > 0:
        return int(setting)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_threads = available_threads()
_pool: ThreadPoolExecutor | None = None


def thread_count() -> int:
    """Return the number of threads that run kernels."""
    return _threads


def set_thread_count(count: int) -> None:
    """Set the number of threads that run kernels; results do not depend on it."""
    global _threads, _pool
    _threads, _pool = count, None


def run_parallel(kernel: Callable, total: int, grain: int, *args: Any) -> None:
    """Call ``kernel(begin, end, *args)`` on all threads, for ranges of size ``grain`` that cover
    range(total).

    Every idle thread, including the caller's, takes the next range, so a suspended thread delays only its
    current range. The kernel's results must not depend on the partition into ranges.
    """
    global _pool
    if _recorded is not None:
        _recorded[kernel] = (0, 0, *args)
        return
    begins = iter(range(0, total, grain))  # next() on it is atomic

    def work() -> None:
        for begin in begins:
            kernel(begin, min(begin + grain, total), *args)

    helpers = min(_threads, -(-total // grain)) - 1
    if helpers > 0 and _pool is None:
        _pool = ThreadPoolExecutor(_threads - 1, "lodgs-kernels")
    futures = [_pool.submit(work) for _ in range(helpers)] if _pool is not None else []
    work()
    for future in futures:
        future.result()


def run_serial(kernel: Callable, *args: Any) -> None:
    """Call a kernel that cannot be parallelised."""
    if _recorded is not None:
        _recorded[kernel] = args
        return
    kernel(*args)


_recorded: dict[Any, tuple] | None = None
"""While this is a dictionary, kernels are recorded in it with arguments of little work, instead of run."""


def compile_in_two_processes(step: Callable[[], Any]) -> None:
    """Fill an empty cache with the kernels that ``step`` calls, in two thirds of the time of one process.

    Numba compiles in Python and holds the GIL, so threads would not help. Nothing is done if a cache exists,
    if only one thread is allowed, or if processes cannot be forked safely (macOS). A spawned process would
    have to import torch and the main program first. The forked process does not make the step, because torch
    cannot compute gradients on a GPU in a forked process.

    Args:
        step: function that tolerates kernels that do nothing.
    """
    cached = any(Path(numba.config.CACHE_DIR).rglob("*.nbi"))  # type: ignore[attr-defined]
    if cached or thread_count() == 1 or not sys.platform.startswith("linux"):
        return
    recorded = _kernels_of(step)
    with tempfile.TemporaryDirectory(prefix="lodgs-") as claims:
        fork = multiprocessing.get_context("fork")
        worker = fork.Process(target=_compile_share, args=(recorded, claims, -1), daemon=True)
        worker.start()
        try:
            _compile_share(recorded, claims, 1)
            worker.join()
        finally:
            worker.kill()
            worker.join()


def _kernels_of(step: Callable[[], Any]) -> dict[Any, tuple]:
    """Record the kernels that a step calls, with arguments of little work."""
    global _recorded
    _recorded = {}
    try:
        with np.errstate(all="ignore"):  # the step computes with uninitialised memory
            step()
        return _recorded
    finally:
        _recorded = None


def _compile_share(recorded: dict[Any, tuple], claims: str, direction: int) -> None:
    """Compile kernels that the other process has not claimed; a claim is a file in the folder ``claims``.

    One process starts with the first module and the other with the last, as kernels of a module share
    helpers.
    """
    by_module = sorted(recorded, key=lambda kernel: (kernel.py_func.__module__, kernel.py_func.__name__))
    for kernel in by_module[::direction]:
        try:
            (Path(claims) / kernel.py_func.__name__).touch(exist_ok=False)
        except FileExistsError:
            continue
        kernel(*recorded[kernel])


_idle: dict[str, list[np.ndarray]] = {}


class Buffers:
    """Named arrays that are reused after this object is deleted.

    New pages from the operating system would cost milliseconds per step. Two renderings with pending backward
    passes have separate arrays. No view of an array may outlive this object.
    """

    def __init__(self) -> None:
        self._arrays: list[tuple[str, np.ndarray]] = []

    def take(self, name: str, kind: Any, *shape: int) -> np.ndarray:
        """Return an uninitialised array of this type and shape."""
        size = math.prod(shape) * np.dtype(kind).itemsize
        idle = _idle.get(name)
        buffer = idle.pop() if idle else None
        if buffer is None or len(buffer) < size:
            fresh = np.empty(size + size // 4 + 64, np.uint8)
            buffer = fresh[-fresh.ctypes.data % 64 :]  # align rows of 64 bytes to cache lines
        self._arrays.append((name, buffer))
        return buffer[:size].view(kind).reshape(shape)

    def __del__(self) -> None:
        for name, buffer in self._arrays:
            _idle.setdefault(name, []).append(buffer)


_lock = threading.RLock()


def serialized(function: Callable) -> Callable:
    """Serialise calls of a function, because they share the threads."""

    @wraps(function)
    def call(*args, **kwargs):
        with _lock:
            return function(*args, **kwargs)

    return call
