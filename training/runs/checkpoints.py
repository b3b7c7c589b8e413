"""Checkpoints of a run, written atomically and verified when read.

``torch.save`` writes a ZIP archive with a CRC-32 of each member. ``torch.load`` ignores these checksums;
:func:`read_checkpoint` verifies them. Data too large to rewrite for every checkpoint is in separate files
of ``optimize.out_of_core.row_file``; the checkpoint holds a table of them.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import torch

from .. import VERSION
from ..errors import LodgsError, is_out_of_memory
from ..files import atomic_write, open_regular
from .folder import RunFolder

FORMAT = 1
"""Version of the checkpoint format; increased when the meaning of a method's state changes."""

MAX_CHECKPOINTS = 2
"""Number of checkpoints to keep, so that a run survives one corrupt file."""


def write_checkpoint(folder: RunFolder, step: int, levels: list[dict], method: dict) -> None:
    """Write a checkpoint, then delete all but the newest ones.

    Args:
        folder: the run.
        step: next step.
        levels: record of each finished level: ``level``, ``path``, ``splats``, ``facts``.
        method: the method's ``state_dict``.

    Raises:
        LodgsError: the checkpoint cannot be written.
    """
    state = {"format": FORMAT, "version": VERSION, "step": step, "levels": levels, "method": method}
    with atomic_write(folder.checkpoints / f"step_{step:07d}.pt") as temporary, open(temporary, "wb") as file:
        _save(state, file)
    for old in _newest_first(folder)[MAX_CHECKPOINTS:]:
        old.unlink(missing_ok=True)


def remove_checkpoints(folder: RunFolder) -> None:
    """Delete all checkpoints of a finished run, and their folder if it is empty."""
    for path in [*_newest_first(folder), *folder.checkpoints.glob("*_????????.bin")]:
        path.unlink(missing_ok=True)
    with suppress(OSError):  # it has other files, or does not exist
        folder.checkpoints.rmdir()


def read_newest(
    folder: RunFolder, device: torch.device | str, load: Callable[[dict], None], warn: Callable[[str], None]
) -> tuple[int, list[dict]] | None:
    """Load the newest readable checkpoint.

    Args:
        folder: the run.
        device: device of the loaded tensors.
        load: called with the method's state. If it raises, an older checkpoint is tried.
        warn: called with a message for each unreadable checkpoint.

    Returns:
        The next step and the records of finished levels; None if there are no checkpoints.

    Raises:
        LodgsError: no existing checkpoint is readable, or another version of LODGS wrote it.
        MemoryError, RuntimeError: not enough memory (``errors.is_out_of_memory``).
    """
    paths = _newest_first(folder)
    corrupt: list[Path] = []
    for path in paths:
        try:
            state = read_checkpoint(path, device)
            for record in state["levels"]:
                folder.find_file(record["path"])
            load(state["method"])
        except OtherVersion:
            raise
        except Exception as error:
            if is_out_of_memory(error):
                raise
            warn(f"Cannot read checkpoint {path.name} ({error}). Its steps are trained again.")
            corrupt += [] if isinstance(error, OSError) else [path]
            continue
        for path in corrupt:  # they would displace readable ones
            path.unlink(missing_ok=True)
        return state["step"], state["levels"]
    if paths:
        raise LodgsError(
            f"Cannot resume run {folder.path}: no checkpoint is readable.",
            f"Train again in another folder, or delete {folder.checkpoints.name} in this one first.",
        )
    return None


class OtherVersion(LodgsError):
    """An intact checkpoint in the format of another version of LODGS."""


def read_checkpoint(path: Path, device: torch.device | str) -> dict[str, Any]:
    """Read and verify a checkpoint: ``step``, ``levels`` and ``method``.

    Raises:
        OtherVersion: the checkpoint has another format.
        Exception: the file is damaged or not a checkpoint.
    """
    with open_regular(path) as file:
        with zipfile.ZipFile(file) as archive:
            if member := archive.testzip():
                raise ValueError(f"its member {member} is damaged")
        file.seek(0)
        state = torch.load(file, map_location=device, weights_only=True)
    if state.get("format") != FORMAT:
        version = state.get("version")
        named = isinstance(version, str) and version != VERSION
        writer = f"LODGS {version}" if named else "another version of LODGS"
        raise OtherVersion(
            f"Cannot resume from checkpoint {path} with LODGS {VERSION}: {writer} wrote it.",
            "Finish the run with that version, or train again in another folder.",
        )
    step, levels, method = state["step"], state["levels"], state["method"]
    if type(step) is not int or step < 0 or not isinstance(levels, list) or not isinstance(method, dict):
        raise ValueError("its step, levels or state has the wrong type")
    return state


def _newest_first(folder: RunFolder) -> list[Path]:
    return sorted(folder.checkpoints.glob("step_*.pt"), reverse=True)


class _ErrorRecorder:
    """A writable file that keeps its last OSError, because ``torch.save`` hides it."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.error: OSError | None = None

    def write(self, data) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            self.error = error
            raise

    def flush(self) -> None:
        self._file.flush()


def _save(state: dict, file: IO[bytes]) -> None:
    recorder: Any = _ErrorRecorder(file)
    try:
        torch.save(state, recorder)
    except RuntimeError:
        if recorder.error is not None:
            raise recorder.error from None
        raise
    file.flush()
