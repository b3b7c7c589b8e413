"""Identify processes: a process ID alone is reused over time and across computers."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import threading
import time
from _thread import interrupt_main
from pathlib import Path

PARENT = "LODGS_PARENT"
"""Environment variable with the ID and the identity of the process that a command must not outlive."""


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


def interrupt() -> None:
    """Send Ctrl-C to the main thread, even while it waits for another program."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        interrupt_main()


parent_ended = threading.Event()
"""Set when the process that started this one has ended; only after :func:`stop_with_parent`."""


def parent_variable() -> dict[str, str]:
    """Return the environment variable for programs that must end with this process."""
    return {PARENT: f"{os.getpid()} {identity(os.getpid())}"}


def stop_with_parent() -> None:
    """Interrupt this process as Ctrl-C does when the process in :data:`PARENT` has ended.

    Does nothing without the variable, or if that process is not visible, as from inside a container.
    """
    number, _, expected = os.environ.get(PARENT, "").partition(" ")
    if number.isdecimal() and expected and identity(int(number)) == expected:
        threading.Thread(target=_interrupt_after, args=(int(number), expected), daemon=True).start()


def _interrupt_after(pid: int, expected: str) -> None:
    failures = 0
    while failures < 2:  # a busy system may fail to report the process once
        time.sleep(0.5)
        failures = 0 if identity(pid) == expected else failures + 1
    parent_ended.set()
    interrupt()


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
