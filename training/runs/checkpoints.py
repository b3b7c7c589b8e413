"""Checkpoints of a run: written whole, verified, and read whole or not at all.

A checkpoint is what ``torch.save`` writes: a ZIP archive. It holds a CRC-32 of each of its parts, which
``torch.load`` does not look at and :func:`read_checkpoint` does. What is too much to be written every time
lies beside them, in files of ``optimize.out_of_core.row_file``, of which a checkpoint holds a table.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import torch

from .. import VERSION
from ..errors import LodgsError, is_out_of_memory
from ..files import atomic_write, open_regular
from .folder import RunFolder

FORMAT = 1
"""Version of what a checkpoint holds; raised when a method's state means something else than before."""

MAX_CHECKPOINTS = 2
"""How many checkpoints a run has, so that one that the disk has spoilt does not end it."""


def write_checkpoint(folder: RunFolder, step: int, levels: list[dict], method: dict) -> None:
    """Writes a checkpoint, then drops all but the newest ones.

    Args:
        step: the next step to make.
        levels: a record of each finished level: ``level``, ``path``, ``splats``, ``facts``.
        method: the method's ``state_dict``.

    Raises:
        LodgsError: it cannot be written.
    """
    state = {"format": FORMAT, "version": VERSION, "step": step, "levels": levels, "method": method}
    with atomic_write(folder.checkpoints / f"step_{step:07d}.pt") as temporary, open(temporary, "wb") as file:
        _save(state, file)
    for old in _newest_first(folder)[MAX_CHECKPOINTS:]:
        old.unlink(missing_ok=True)


def remove_checkpoints(folder: RunFolder) -> None:
    """Removes all checkpoints: a finished run has no more use for them."""
    for path in [*_newest_first(folder), *folder.checkpoints.glob("*_????????.bin")]:
        path.unlink(missing_ok=True)


def read_newest(
    folder: RunFolder, device: torch.device | str, take: Callable[[dict], None], warn: Callable[[str], None]
) -> tuple[int, list[dict]] | None:
    """Takes up the newest checkpoint that can be read.

    Args:
        device: where its tensors go.
        take: told the method's state; it raises where that does not fit, and may then be told an older one.
        warn: told of each checkpoint that cannot be read.

    Returns:
        The next step and the records of finished levels; None where there are no checkpoints.

    Raises:
        LodgsError: none of those that are there can be read, or another version of LODGS wrote them.
        MemoryError, RuntimeError: there is no memory for one (``errors.is_out_of_memory``).
    """
    paths, damaged = _newest_first(folder), list[Path]()
    for path in paths:
        try:
            state = read_checkpoint(path, device)
            for record in state["levels"]:
                folder.find_file(record["path"])
            take(state["method"])
        except OtherVersion:
            raise
        except Exception as error:
            if is_out_of_memory(error):
                raise
            warn(f"The checkpoint {path.name} cannot be read ({error}); what it held is trained again.")
            damaged += [] if isinstance(error, OSError) else [path]
            continue
        for spoilt in damaged:  # which would stand in the place of one that can be read
            spoilt.unlink(missing_ok=True)
        return state["step"], state["levels"]
    if paths:
        raise LodgsError(
            f"No checkpoint of the run {folder.path} can be read.",
            f"Train it anew: in another folder, or here after deleting {folder.checkpoints.name} in it.",
        )
    return None


class OtherVersion(LodgsError):
    """A checkpoint is whole, but another version of LODGS wrote it."""


def read_checkpoint(path: Path, device: torch.device | str) -> dict[str, Any]:
    """What a checkpoint holds: ``step``, ``levels`` and ``method``, after all of it has been verified.

    Raises:
        OtherVersion: it is of another format.
        Exception: it is damaged, or no checkpoint.
    """
    with open_regular(path) as file:
        with zipfile.ZipFile(file) as archive:
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} in it is damaged")
        file.seek(0)
        state = torch.load(file, map_location=device, weights_only=True)
    if state.get("format") != FORMAT:
        version = state.get("version")
        maker = f"LODGS {version}" if isinstance(version, str) and version != VERSION else "another LODGS"
        raise OtherVersion(
            f"The checkpoint {path} was made by {maker}, and this one ({VERSION}) cannot go on from it.",
            "Finish the run with that version, or train it anew in another folder.",
        )
    step, levels, method = state["step"], state["levels"], state["method"]
    if type(step) is not int or step < 0 or not isinstance(levels, list) or not isinstance(method, dict):
        raise ValueError("its step, levels or state is of the wrong kind")
    return state


def _newest_first(folder: RunFolder) -> list[Path]:
    return sorted(folder.checkpoints.glob("step_*.pt"), reverse=True)


class _Remembering:
    """A file to write to that remembers why it could not be: torch says nothing of it."""

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
    remembering: Any = _Remembering(file)
    try:
        torch.save(state, remembering)
    except RuntimeError:
        if remembering.error is not None:
            raise remembering.error from None
        raise
    file.flush()
