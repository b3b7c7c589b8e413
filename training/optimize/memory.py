"""How much memory this process may still take, and what it does with what it has freed. No torch."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from contextlib import suppress
from pathlib import Path

MAX_BYTES = 2 << 30
"""Bytes of photographs that are kept, if nothing is said and the computer has four times as much free."""
TARGET_BYTES = 36
"""Bytes a pixel: the photograph and its two local moments, float32."""
FALLBACK_BYTES = 4 << 30
"""Bytes that a computer is taken to have where it does not say."""


def free_memory() -> int:
    """Bytes that programs can be given without others being written to the disk, about.

    On Linux the system's own estimate, or what its container leaves where that is less; on Windows what is
    free; on macOS, which does not tell without a program of its own, half of what there is.
    """
    if sys.platform == "win32":
        return _on_windows()
    if sys.platform == "linux":
        with suppress(OSError, AttributeError, ValueError):
            found = re.search(r"^MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE)
            return min(int(found[1]) << 10, _in_container())  # type: ignore[index]
    with suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    return FALLBACK_BYTES


def keep_freed_memory(largest: int | None = None) -> None:
    """Keeps freed arrays for the next ones; glibc would fetch fresh pages, some 6 % of a step's time.

    Args:
        largest: those of so many bytes and more go back to the system at once, 32 MB at most; None: none do.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: the heap stays,
            mallopt(-4, 1 << 16 if largest else 0)  # M_MMAP_MAX: and large arrays come from it, too,
            if largest:
                mallopt(-3, largest)  # M_MMAP_THRESHOLD: up to here


def _in_container(folder: Path = Path("/sys/fs/cgroup")) -> int:
    """What the limit of this process's control group (version 2) leaves; what files hold can be given up."""
    try:
        limit = int((folder / "memory.max").read_text())
        used = int((folder / "memory.current").read_text())
        files = re.search(r"^inactive_file (\d+)", (folder / "memory.stat").read_text(), re.MULTILINE)
    except (OSError, ValueError):  # none, or "max"
        return sys.maxsize
    return max(limit - used + (int(files[1]) if files else 0), 0)


def _on_windows() -> int:
    class Status(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ulong), ("load", ctypes.c_ulong)] + [
            (name, ctypes.c_ulonglong)
            for name in ("total", "free", "page", "free_page", "virtual", "free_virtual", "extended")
        ]

    status = Status(length=ctypes.sizeof(Status))
    known = ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # type: ignore[attr-defined]
    return int(status.free) if known else FALLBACK_BYTES
