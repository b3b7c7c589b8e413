"""Networks beside a run's levels: read, or one sentence that names the file."""

import io
import zipfile

import numpy as np
import pytest

from training.errors import LodgsError
from training.runs.arrays import read_arrays

GOOD = {"means": np.arange(6.0, dtype="f4").reshape(2, 3), "level": np.array([1, 2], "u1")}


def saved(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def zipped(name: str, content: bytes, kind: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as archive:
        archive.writestr(name, content)
    return file.getvalue()


def test_arrays_come_back(tmp_path):
    (tmp_path / "model.npz").write_bytes(saved(**GOOD))
    back = read_arrays(tmp_path / "model.npz")
    assert back.keys() == GOOD.keys()
    for name, array in GOOD.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype


WHOLE = saved(**GOOD)
AT = WHOLE.index(np.float32(5).tobytes())
HUGE = WHOLE.replace(b"(2, 3)", b"(9**9")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not an archive",
        WHOLE[:-30],
        WHOLE[:AT] + b"\xff" + WHOLE[AT + 1 :],  # the archive has a checksum of it
        HUGE,
        saved(means=np.array([1, None], object)),  # pickled
        saved(means=np.array([1.0, np.nan])),
        saved(means=np.array(["a"])),
        zipped("means.npy", bytes(10_000_000), zipfile.ZIP_DEFLATED),
        zipped("means.npy", b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f4', 'fortran_order': False, "
               b"'shape': (99999999999,), }".ljust(117) + b"\n"),
        zipped("means.txt", b"1 2 3"),
    ],
)  # fmt: skip
def test_what_is_no_file_of_arrays_is_one_sentence(tmp_path, content):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    with pytest.raises(LodgsError, match=r"model\.npz cannot be used"):
        read_arrays(path)
