"""Files that appear whole or not at all, and files that are really files."""

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

from .errors import LodgsError

DISK_FULL = {errno.ENOSPC, errno.EDQUOT}
"""What systems say of a disk that is full."""


def cache_folder() -> Path:
    """Where this user's programs may keep what they can make again."""
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "lodgs"


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; what the block writes there becomes ``path`` when it ends well.

    The file is flushed to the disk and then moved into place, so whoever looks finds the old file or the new
    one, never a part. When the block raises, the temporary file is removed and ``path`` stays as it was. The
    parent folder is made if it is missing. A link is followed: what it points to is replaced.

    Raises:
        LodgsError: the disk is full, or the place cannot be written.
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
            f"{path} could not be written: {error.strerror or error}.",
            "Free some space there or choose another folder."
            if error.errno in DISK_FULL
            else "Choose another name or folder.",
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_temporaries(folder: Path) -> None:
    """Removes what killed processes left of :func:`atomic_write` in a folder. Nobody may be writing there."""
    for path in folder.glob(".*.tmp"):
        if re.fullmatch(r"\..+\.[0-9a-f]{8}\.tmp", path.name):
            with suppress(OSError):
                path.unlink()


def link_or_copy(source: Path, target: Path) -> None:
    """Makes ``target``, if it is not there, the same file where the disk can have one twice; else a copy.

    Raises:
        OSError: it cannot be written.
    """
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        beside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
        try:
            shutil.copyfile(source, beside)
            os.replace(beside, target)
        finally:
            beside.unlink(missing_ok=True)


def check_folder(folder: Path, remedy: str) -> None:
    """Raises LodgsError, with that remedy, where there is no such folder."""
    if folder.is_file():
        packed = folder.suffix.lower() in (".zip", ".r3d", ".7z", ".rar", ".tar", ".gz")
        raise LodgsError(f"{folder} is a file, not a folder.", "Unpack it first." if packed else remedy)
    if not folder.is_dir():
        raise LodgsError(f"There is no folder {folder}.", remedy)


def open_regular(path: str | Path, writing: bool = False) -> BinaryIO:
    """Opens a file for reading, or for writing as well; unlike ``open`` it never waits for a pipe's other
    end, or reads a device.

    Raises:
        OSError: it cannot be read, or is no file.
    """
    how = os.O_RDWR if writing else os.O_RDONLY
    descriptor = os.open(path, how | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a file", str(path))
    return open(descriptor, "r+b" if writing else "rb")


def try_lock(file: IO[bytes]) -> bool:
    """Locks the file, open for writing, for this process if nobody else has; released when it is closed.

    Raises:
        OSError: it is open for reading alone, where that is not enough (NFS).
    """
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(1 << 30)  # what is locked cannot be read there, and the beginning says who holds it
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno == errno.EBADF:  # on NFS a lock is a write: nobody knows whether it is locked
            raise
        return False
    return True


@contextmanager
def exclusive(name: str) -> Iterator[None]:
    """Waits while another of this user's processes is in a block of this name.

    Where the cache folder cannot be written, nobody waits.
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
    """Make the rename itself durable; Windows has no such call and needs none."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
