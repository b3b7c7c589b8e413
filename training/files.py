"""Atomic file writes, checked file access and locks."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, BinaryIO

from .errors import LodgsError, is_system_problem, read_error, system_remedy


def cache_folder() -> Path:
    """Return the user's cache folder for data that can be computed again."""
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "lodgs"


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, and rename it to ``path`` when the block succeeds.

    The file is flushed to the disk before it is renamed, so other programs see the old file or the new one,
    never a part of it. If the block raises, the temporary file is removed and ``path`` stays unchanged. A
    missing parent folder is created. If ``path`` is a symbolic link, its target is replaced.

    Raises:
        LodgsError: the disk is full, or the location is not writable.
    """
    path = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        # A full disk names no file; an error that names another file is not about this write.
        if error.filename is not None and Path(error.filename) not in (temporary, path, *path.parents):
            raise
        raise LodgsError(
            f"Cannot write {path}: {error.strerror or error}.",
            system_remedy(error, "Choose another name or folder."),
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_temporaries(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder. No process may be writing there."""
    for path in folder.glob(".*.tmp"):
        if re.fullmatch(r"\..+\.[0-9a-f]{8}\.tmp", path.name):
            with suppress(OSError):
                path.unlink()


def link_or_copy(source: Path, target: Path) -> None:
    """Create ``target`` as a hard link to ``source``, or as a copy if the disk has no hard links.

    An existing ``target`` stays unchanged.

    Raises:
        OSError: the target cannot be written.
    """
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
        try:
            shutil.copyfile(source, temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)


def check_folder(folder: Path, remedy: str) -> None:
    """Raise LodgsError, with the given remedy, unless the folder exists."""
    if folder.is_file():
        is_archive = folder.suffix.lower() in (".zip", ".r3d", ".7z", ".rar", ".tar", ".gz")
        raise LodgsError(f"{folder} is a file, not a folder.", "Unpack it first." if is_archive else remedy)
    if not folder.is_dir():
        raise LodgsError(f"The folder {folder} does not exist.", remedy)


def is_file(path: str | Path) -> bool:
    """Return whether a regular file exists, also for names that are too long or invalid.

    Raises:
        SystemProblem: the system cannot tell, for example because a network share is lost.
    """
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except ValueError:
        return False
    except OSError as error:
        raise_system_problem(error)
        return False


def raise_system_problem(error: OSError) -> None:
    """Raise SystemProblem unless the error concerns only its file; the ``onerror`` of ``os.walk``."""
    if is_system_problem(error):
        raise read_error(error.filename, error, "Check that its disk is connected.") from error


def open_regular(path: str | Path, writing: bool = False) -> BinaryIO:
    """Open a regular file. Unlike ``open``, neither wait for the other end of a pipe nor read a device.

    Args:
        writing: open for writing as well as for reading.

    Raises:
        OSError: the file cannot be opened, or is not a regular file.
    """
    flags = os.O_RDWR if writing else os.O_RDONLY
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a file", str(path))
    return open(descriptor, "r+b" if writing else "rb")


def try_lock(file: IO[bytes]) -> bool:
    """Lock a file that is open for writing, until it is closed.

    Returns:
        False if another process holds the lock.

    Raises:
        OSError: the file is open for reading only and the file system (NFS) requires write access.
    """
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(1 << 30)  # Windows blocks reading of a locked range; the owner's name is at the start
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno == errno.EBADF:  # NFS locks only files open for writing, so the state is unknown
            raise
        return False
    return True


@contextmanager
def exclusive(name: str) -> Iterator[None]:
    """Run a block while no other process of this user runs a block of the same name.

    Without a writable cache folder, blocks do not wait for one another.
    """
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        lock = (cache_folder() / f"{name}.lock").open("a+b", buffering=0)
    except OSError:
        yield
        return
    with lock:
        while not try_lock(lock):
            time.sleep(0.1)
        yield


def _sync_folder(folder: Path) -> None:
    """Flush a folder, which makes a rename durable. Windows needs no such call."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
