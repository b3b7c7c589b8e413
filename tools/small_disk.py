"""Small disks and their files, for attacks that fill them. Linux only, as root."""

from __future__ import annotations

import subprocess
from contextlib import contextmanager
from pathlib import Path

DISK_FULL_MESSAGES = "No space left on device", "disk is full", "Free some space", "Free some disk space"


def contents(run: Path) -> dict[str, bytes]:
    """Return a run's files by name, without the contents of files with times and paths."""
    changing = {"events.jsonl", "lock", "job.toml"}
    excluded = {"trainer.log", "trainer.out"}
    files = {path.relative_to(run).as_posix(): path for path in run.rglob("*") if path.is_file()}
    return {
        name: b"" if path.name in changing else path.read_bytes()
        for name, path in files.items()
        if path.name not in excluded
    }


def disk_usage(folder: Path) -> int:
    """Return the bytes that a folder takes on a tmpfs."""
    paths = list(folder.rglob("*"))
    return sum(-(-path.stat().st_size // 4096) * 4096 for path in paths if path.is_file())


@contextmanager
def small_disk(folder: Path, size: int):
    """Mount a tmpfs of this many bytes at a folder."""
    folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "lodgs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
