"""Reader for ``model.npz``: the named arrays of a method's networks, stored next to its levels."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from ..documents import open_file
from ..errors import LodgsError


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read arrays by name from an uncompressed ``numpy.savez`` file.

    Only finite numbers are accepted, and no more bytes than the file has.

    Raises:
        LodgsError: the file is unreadable, damaged or not written by LODGS.
    """
    with open_file(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                if any(member.compress_type != zipfile.ZIP_STORED for member in members):  # may be a ZIP bomb
                    raise ValueError("it is compressed")
                if sum(member.file_size for member in members) > file.seek(0, 2):
                    raise ValueError("its members are larger than the file")
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: np.asarray(archive[name]) for name in archive.files}
            for name, array in arrays.items():
                if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
                    raise ValueError(f"{name} holds a value that is not a finite number")
        except Exception as error:  # zipfile and numpy document no exception types
            raise array_error(path, error) from error
    return arrays


def array_error(path: Path, error: Exception) -> LodgsError:
    """Return the error to raise for a file whose arrays do not fit its run."""
    return LodgsError(
        f"Cannot use the networks in {path} ({type(error).__name__}: {str(error)[:300]}).",
        "Copy the run again, or delete this file to measure the levels without it.",
    )
