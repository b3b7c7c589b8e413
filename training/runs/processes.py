"""Which process is which: a number alone is given to another one later, and on another computer at once."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
from pathlib import Path


def identity(pid: int) -> str:
    """What tells a running process of this computer from every other there ever was, here or elsewhere.

    Returns:
        The computer, when it was started where that is known, and when the process was; "" where there is no
        such process or the system does not tell.
    """
    if pid <= 0:
        return ""
    try:
        started = _started(pid)
    except (OSError, ValueError, IndexError, subprocess.SubprocessError):
        return ""
    return f"{platform.node()} {pid} {started}" if started else ""


def kill(pid: int, known: str) -> bool:
    """Ends a process by force if it is the one that ``identity`` described; whether it was."""
    if not known or identity(pid) != known or pid == os.getpid():
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
        status = Path(f"/proc/{pid}/stat").read_text()  # the name in brackets may hold anything
        state, *fields = status[status.rindex(")") + 1 :].split()
        return "" if state == "Z" else f"{boot} {fields[18]}"
    command = ["ps", "-o", "lstart=", "-p", str(pid)]
    environment = {**os.environ, "LC_ALL": "C"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=5, env=environment, check=False)
    return " ".join(done.stdout.split())


def _started_on_windows(pid: int) -> str:
    import ctypes

    kernel = getattr(ctypes, "windll").kernel32  # noqa: B009 - not there elsewhere
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = kernel.OpenProcess(0x1000, False, pid)  # PROCESS_QUERY_LIMITED_INFORMATION
    if not handle:
        return ""
    times = (ctypes.c_uint64 * 4)()  # created, ended, in the kernel, outside it
    places = [ctypes.byref(times, 8 * i) for i in range(4)]
    told = kernel.GetProcessTimes(ctypes.c_void_p(handle), *places)
    kernel.CloseHandle(ctypes.c_void_p(handle))
    return str(times[0]) if told and not times[1] else ""
