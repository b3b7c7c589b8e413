"""Identify processes: a process ID alone is reused over time and across computers."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
from pathlib import Path


def identity(pid: int) -> str:
    """Return a globally unique name of a running process of this computer.

    Returns:
        Host name, boot ID if available, and start time of the process; "" if there is no such process or the
        system does not report it.
    """
    if pid <= 0:
        return ""
    try:
        started = _started(pid)
    except (OSError, ValueError, IndexError, subprocess.SubprocessError):
        return ""
    return f"{platform.node()} {pid} {started}" if started else ""


def kill(pid: int, expected: str) -> bool:
    """Kill a process if its :func:`identity` is ``expected``; return whether it was killed."""
    if not expected or identity(pid) != expected or pid == os.getpid():
        return False
    try:
        os.kill(pid, signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL)
    except OSError:
        return False
    return True


def _started(pid: int) -> str:
    if sys.platform == "win32":
        return _started_on_windows(pid)
    if sys.platform == "linux":
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        status = Path(f"/proc/{pid}/stat").read_text()  # the name in brackets may contain spaces and brackets
        state, *fields = status[status.rindex(")") + 1 :].split()
        return "" if state == "Z" else f"{boot} {fields[18]}"
    command = ["ps", "-o", "lstart=", "-p", str(pid)]
    environment = {**os.environ, "LC_ALL": "C"}
    result = subprocess.run(command, capture_output=True, text=True, timeout=5, env=environment, check=False)
    return " ".join(result.stdout.split())


def _started_on_windows(pid: int) -> str:
    import ctypes

    kernel = getattr(ctypes, "windll").kernel32  # noqa: B009 - exists on Windows only
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = kernel.OpenProcess(0x1000, False, pid)  # PROCESS_QUERY_LIMITED_INFORMATION
    if not handle:
        return ""
    times = (ctypes.c_uint64 * 4)()  # creation, exit, kernel time, user time
    pointers = [ctypes.byref(times, 8 * i) for i in range(4)]
    succeeded = kernel.GetProcessTimes(ctypes.c_void_p(handle), *pointers)
    kernel.CloseHandle(ctypes.c_void_p(handle))
    return str(times[0]) if succeeded and not times[1] else ""
