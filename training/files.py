"""Atomic file writes, checked file access and locks."""

from __future__ import annotations

import errno
import filecmp
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import time
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PureWindowsPath
from typing import IO, BinaryIO

from .errors import LodgsError, is_system_problem, missing_clause, printable, read_error, system_remedy

_DEVICE = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\xb9\xb2\xb3])\s*([.:].*)?", re.I)

CLUTTER = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""Files that macOS and Windows add to folders."""


def cache_folder() -> Path:
    """Return the user's cache folder for data that can be computed again."""
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "lodgs"


def names_device(path: str | Path, windows: bool = os.name == "nt") -> bool:
    """Return whether a path names a device of Windows, which opening may trigger: CON, \\\\.\\PhysicalDrive0.

    Devices and pipes of other systems are files of another kind, see `open_regular`.
    """
    text = str(path).replace("/", "\\")
    if re.match(r"\\[\\?][.?]\\(?!([A-Z]:|UNC)\\)", text, re.IGNORECASE):
        return True
    return windows and any(_DEVICE.fullmatch(part.strip(" .")) for part in text.split("\\"))


def network_share(path: str | Path) -> str:
    """Return the share, or a similar prefix, of a Windows path that leads to another computer, or ""."""
    drive = PureWindowsPath(re.sub(r"^[\\/]\?\?", r"\\\\?", str(path))).drive.replace("/", "\\").lower()
    is_local = not drive.startswith("\\\\") or re.fullmatch(r"\\\\[?.]\\[a-z]:", drive)
    return "" if is_local else drive


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, and rename it to ``path`` when the block succeeds.

    The file is flushed to the disk before it is renamed, so other programs see the old file or the new one,
    never a part of it. If the block raises, the temporary file is removed and ``path`` stays unchanged. A
    missing parent folder is created. If ``path`` is a symbolic link, its target is replaced.

    Raises:
        LodgsError: the disk is full, the location is not writable, or a folder, pipe or device has the name.
    """
    path = _target(path, is_file)
    temporary = _temporary_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale(path.parent)
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
            f"Cannot write {_final_path(path)}: {error.strerror or error}.",
            system_remedy(error, "Choose another name or folder."),
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder, and rename it to ``folder`` when the block succeeds. It replaces a former one.

    If ``folder`` is a symbolic link, its target is replaced.

    Raises:
        LodgsError: the disk is full, the location is not writable, or a file has the name.
    """
    folder = _target(folder, os.path.isdir)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(folder.parent) as work:
            new = work / "new"
            new.mkdir()
            yield new
            try:
                if folder.exists():
                    os.rename(folder, work / "previous")
                os.rename(new, folder)
            finally:  # a signal, or a file that another program has open
                if (work / "previous").exists() and not folder.exists():
                    os.rename(work / "previous", folder)
    except OSError as error:
        raise LodgsError(
            f"Cannot write {folder}: {error.strerror or error}.",
            system_remedy(error, "Choose another folder."),
        ) from error


def _target(path: str | Path, is_replaceable: Callable[[Path], bool]) -> Path:
    """Return the path behind links that a write creates or replaces.

    Raises:
        LodgsError: the name is invalid, or belongs to something that must not be replaced.
    """
    check_name(path)
    path = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    if os.path.lexists(path) and not is_replaceable(path):
        others = "a folder" if os.path.isdir(path) else "a pipe, device or endless link"
        kind = "a file" if is_file(path) else others
        raise LodgsError(f"Cannot write {path}: {kind} has this name.", "Choose another name or folder.")
    return path


def check_name(path: str | Path) -> None:
    """Raise LodgsError if a path contains a NUL or half of a surrogate pair, which no file system stores."""
    try:
        encoded = os.fsencode(path)
    except ValueError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise LodgsError(
            f"Cannot write {printable(path)}: the name is not a valid file name.", "Choose another name."
        )


@contextmanager
def name_errors(path: Path) -> Iterator[None]:
    """Add a path to system errors in the block that name no file, as those of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yield a new folder, and remove it when the block ends.

    Args:
        parent: folder that contains it; None for the system's folder for temporary files.

    Raises:
        OSError: the folder cannot be created.
    """
    place = Path(tempfile.gettempdir()) if parent is None else parent
    _remove_stale(place)
    folder = place / f".lodgs-{_token()}"
    folder.mkdir(0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _temporary_path(path: Path) -> Path:
    """Return a unique path next to ``path``, with a name that is not longer than file systems allow."""
    return path.with_name(f".{path.name[:50]}.{_token()}.tmp")


def _final_path(path: Path) -> Path:
    """Return the path that a path of :func:`_temporary_path` replaces, for messages; others unchanged."""
    match = _TEMPORARY.fullmatch(path.name)
    return path.with_name(path.name[1 : match.start(1) - 1]) if match and path.suffix == ".tmp" else path


def _token() -> str:
    """Return a unique part of a temporary name that identifies this process."""
    return f"{_host()}-{os.getpid()}-{uuid.uuid4().hex[:4]}"


def _host() -> str:
    return f"{zlib.crc32(platform.node().encode()) & 0xFFFF:04x}"


_TEMPORARY = re.compile(r"\.(?:lodgs-|.+\.)([0-9a-f]{4})-(\d+)-[0-9a-f]{4}(?:\.tmp)?")
"""Name of a temporary file or folder; host and process ID of its owner."""


def remove_temporaries(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder. No process may be writing there."""
    for path in folder.glob(".*"):
        if _TEMPORARY.fullmatch(path.name):
            _remove(path)


def _remove_stale(folder: Path) -> None:
    """Remove temporary files and folders whose process, of this user and computer, was killed.

    Each folder is searched once per process.
    """
    if folder in _searched:
        return
    _searched.add(folder)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _TEMPORARY.fullmatch(entry.name)
            if match and match[1] == _host() and _is_abandoned(entry, int(match[2])):
                _remove(Path(entry.path))


_searched: set[Path] = set()


def _is_abandoned(entry: os.DirEntry[str], pid: int) -> bool:
    """Return whether the process of a temporary file has ended; on Windows, whether the file is a day old."""
    state = entry.stat(follow_symlinks=False)
    if sys.platform == "win32":
        return time.time() - state.st_mtime > 86_400
    if state.st_uid != os.getuid() or pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:  # another user's process
        return False
    return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def link_or_copy(source: Path, target: Path) -> None:
    """Create ``target`` as a hard link to ``source``, or as a copy if the disk has no hard links.

    An existing ``target`` stays unchanged.

    Raises:
        OSError: the target cannot be written, or has another content.
    """
    if target.exists():
        if os.path.samefile(source, target) or filecmp.cmp(source, target, shallow=False):
            return
        raise FileExistsError(errno.EEXIST, "another file has this name", str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        temporary = _temporary_path(target)
        try:
            shutil.copyfile(source, temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)


def check_folder(folder: Path, remedy: str) -> None:
    """Raise LodgsError, with the given remedy, unless the folder exists."""
    if folder.is_file():
        is_archive = folder.suffix.lower() in (".zip", ".r3d", ".7z", ".rar", ".tar", ".gz")
        raise LodgsError(
            f"Cannot open {folder}: it is a file, not a folder.", "Unpack it first." if is_archive else remedy
        )
    if not folder.is_dir():
        raise LodgsError(f"Cannot open {folder}: the folder {missing_clause(folder)}.", remedy)


def check_export_folder(folder: Path, main: str, others: str) -> None:
    """Raise LodgsError if a folder is no place for an export that replaces it.

    It must be missing, empty or an earlier export without other files.

    Args:
        main: name of the export's main file.
        others: regular expression for the names of its other files and folders.
    """
    if folder.exists() and not folder.is_dir():
        raise LodgsError(f"Cannot export to {folder}: it is not a folder.", "Choose an empty folder.")
    names = {path.name for path in folder.iterdir()} - CLUTTER if folder.is_dir() else set()
    if names and not (main in names and all(re.fullmatch(others, name) for name in names - {main})):
        raise LodgsError(f"Cannot export to {folder}: it contains other files.", "Choose an empty folder.")


def create_folder(folder: Path) -> None:
    """Create a folder for output, with its parents.

    Raises:
        LodgsError: it cannot be created or written.
    """
    check_name(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise LodgsError(
            f"Cannot write to {folder}: {error.strerror or error}.", "Choose another output folder."
        ) from error


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
    if names_device(path):
        raise OSError(errno.EINVAL, "it names a device", str(path))
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


def _sync_folder(folder: Path) -> None:
    """Flush a folder, which makes a rename durable. Windows needs no such call."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
