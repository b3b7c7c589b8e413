"""Estimate the free memory and configure the allocator. Does not import torch."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from contextlib import suppress
from pathlib import Path

MAX_BYTES = 2 << 30
"""Upper limit of the default image cache."""
TARGET_BYTES = 12
"""Bytes per pixel of a training image: float32 colours."""
FALLBACK_BYTES = 4 << 30
"""Memory to assume if the system reports none."""


def free_memory() -> int:
    """Estimate the bytes available to programs without swapping.

    Linux reports an estimate, limited here by the container's memory limit. Windows reports the free memory.
    macOS reports it only through a separate program, so half of the physical memory is assumed there.
    """
    if sys.platform == "win32":
        return _windows_memory()
    if sys.platform == "linux":
        with suppress(OSError, AttributeError, ValueError):
            match = re.search(r"^MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE)
            return min(int(match[1]) << 10, _container_memory())  # type: ignore[index]
    with suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    return FALLBACK_BYTES


def reset_peak_memory() -> None:
    """Let :func:`peak_memory` measure from now on; without effect where the system does not allow it."""
    if sys.platform == "linux":
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")


def resident_memory() -> int | None:
    """Return the number of bytes of memory that this process uses; None if it is unknown."""
    return _process_memory("VmRSS") if sys.platform == "linux" else None


def peak_memory() -> int | None:
    """Return the largest number of bytes of memory that this process used; None if it is unknown."""
    if sys.platform == "linux":
        return _process_memory("VmHWM")
    if sys.platform != "win32":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # macOS: bytes
    return None


def _process_memory(name: str) -> int | None:
    """Return a size of this process that Linux states, in bytes."""
    with suppress(OSError):
        match = re.search(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
        return int(match[1]) << 10 if match else None
    return None


def keep_freed_memory(largest: int | None = None) -> None:
    """Let glibc reuse the memory of freed arrays. Requesting new pages takes about 6 % of a step.

    Args:
        largest: return arrays of at least this many bytes (up to 32 MB) to the system; None returns none.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: keep the heap
            mallopt(-4, 1 << 16 if largest else 0)  # M_MMAP_MAX: allocate large arrays from the heap
            if largest:
                mallopt(-3, largest)  # M_MMAP_THRESHOLD: except arrays above this size


def _container_memory(folder: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the bytes left by the control group's limit (version 2), including reclaimable file cache."""
    try:
        limit = int((folder / "memory.max").read_text())
        used = int((folder / "memory.current").read_text())
        files = re.search(r"^inactive_file (\d+)", (folder / "memory.stat").read_text(), re.MULTILINE)
    except (OSError, ValueError):  # no control group, or the limit "max"
        return sys.maxsize
    return max(limit - used + (int(files[1]) if files else 0), 0)


def _windows_memory() -> int:
    class Status(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ulong), ("load", ctypes.c_ulong)] + [
            (name, ctypes.c_ulonglong)
            for name in ("total", "free", "page", "free_page", "virtual", "free_virtual", "extended")
        ]

    status = Status(length=ctypes.sizeof(Status))
    success = ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # type: ignore[attr-defined]
    return int(status.free) if success else FALLBACK_BYTES
