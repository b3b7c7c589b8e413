"""Reading the arrays of a run's networks, and errors that name the file."""

import io
import zipfile

import numpy as np
import pytest

from training.errors import LodgsError
from training.runs.arrays import read_arrays

GOOD = {"means": np.arange(6.0, dtype="f4").reshape(2, 3), "level": np.array([1, 2], "u1")}


def npz(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def zip_file(name: str, content: bytes, kind: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as archive:
        archive.writestr(name, content)
    return file.getvalue()


def test_arrays_round_trip(tmp_path):
    (tmp_path / "model.npz").write_bytes(npz(**GOOD))
    arrays = read_arrays(tmp_path / "model.npz")
    assert arrays.keys() == GOOD.keys()
    for name, array in GOOD.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype


VALID = npz(**GOOD)
OFFSET = VALID.index(np.float32(5).tobytes())
HUGE = VALID.replace(b"(2, 3)", b"(9**9")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not an archive",
        VALID[:-30],
        VALID[:OFFSET] + b"\xff" + VALID[OFFSET + 1 :],  # fails the checksum
        HUGE,
        npz(means=np.array([1, None], object)),  # pickled
        npz(means=np.array([1.0, np.nan])),
        npz(means=np.array(["a"])),
        zip_file("means.npy", bytes(10_000_000), zipfile.ZIP_DEFLATED),
        zip_file("means.npy", b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f4', 'fortran_order': False, "
               b"'shape': (99999999999,), }".ljust(117) + b"\n"),
        zip_file("means.txt", b"1 2 3"),
    ],
)  # fmt: skip
def test_invalid_array_files_raise_an_error(tmp_path, content):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    with pytest.raises(LodgsError, match=r"networks in .*model\.npz"):
        read_arrays(path)
