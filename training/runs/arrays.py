"""What a method with networks keeps of them beside its levels, ``model.npz``: arrays by name."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from ..documents import open_file
from ..errors import LodgsError


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file of ``numpy.savez``: numbers that are finite, of no more bytes than the file.

    Raises:
        LodgsError: the file cannot be read, is damaged, or is none of ours.
    """
    with open_file(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                parts = archive.infolist()
                if any(part.compress_type != zipfile.ZIP_STORED for part in parts):  # it might hold anything
                    raise ValueError("it is compressed")
                if sum(part.file_size for part in parts) > file.seek(0, 2):
                    raise ValueError("its parts are larger than it")
            file.seek(0)
            with np.load(file, allow_pickle=False) as found:
                arrays = {name: np.asarray(found[name]) for name in found.files}
            for name, array in arrays.items():
                if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
                    raise ValueError(f"{name} holds what is no number")
        except Exception as error:  # of zipfile and numpy, which promise no kinds
            raise damaged(path, error) from error
    return arrays


def damaged(path: Path, error: Exception) -> LodgsError:
    """What to tell of a file whose arrays are not those of its run."""
    return LodgsError(
        f"The networks in {path} cannot be used ({type(error).__name__}: {str(error)[:300]}).",
        "Copy the run again, or remove that file: the levels are measured without it.",
    )
