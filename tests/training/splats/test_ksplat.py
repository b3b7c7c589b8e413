"""``.ksplat`` files of GaussianSplats3D against the splats that it wrote, and damaged files."""

import os
import struct
import sys

import numpy as np
import pytest

from tests.training.splats.ksplat_files import FILES, source
from training.errors import LodgsError
from training.splats.bundle import read_bundle
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.ksplat import KsplatRows
from training.splats.ply import read_ply

HEADER, SECTION = 4096, 1024


@pytest.fixture
def read(tmp_path):
    def read(content: bytes) -> KsplatRows:
        path = tmp_path / f"{hash(content)}.ksplat"  # files are mapped into memory
        path.write_bytes(content)
        return KsplatRows(path)

    return read


def changed(compression: int, **values) -> bytes:
    """Return a file with other values (format, number) at offsets ``at_OFFSET``."""
    content = bytearray(FILES[compression])
    for name, (kind, value) in values.items():
        struct.pack_into(f"<{kind}", content, int(name.removeprefix("at_")), value)
    return bytes(content)


def assert_close(actual: Splats, expected: Splats, positions: float, floats: float, harmonics: float) -> None:
    np.testing.assert_allclose(actual.means, expected.means, rtol=0, atol=positions)
    unit = [
        splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True) for splats in (actual, expected)
    ]
    np.testing.assert_allclose(*unit, rtol=0, atol=floats)
    np.testing.assert_allclose(actual.log_scales, expected.log_scales, rtol=0, atol=floats)
    np.testing.assert_allclose(actual.sh[:, 1:], expected.sh[:, 1:], rtol=0, atol=harmonics)
    alphas = [1 / (1 + np.exp(-splats.opacity_logits)) for splats in (actual, expected)]
    np.testing.assert_allclose(*alphas, rtol=0, atol=1 / 255)
    np.testing.assert_allclose(actual.sh[:, 0], expected.sh[:, 0], rtol=0, atol=1 / 255 / 0.282)


@pytest.mark.parametrize(
    ("compression", "precision"), [(0, (0, 1e-6, 0)), (1, (5e-5, 1e-3, 1e-3)), (2, (5e-5, 1e-3, 7e-3))]
)
def test_values_are_those_of_the_source(read, compression, precision):
    rows = read(FILES[compression])
    assert len(rows) == 9
    assert_close(rows.select(slice(None)), source(), *precision)
    some = np.array([1, 5, 8])
    assert_close(rows.select(some), source().select(some), *precision)


def test_sections_follow_one_another(read):
    """Two sections of degree 2 and 0, and an empty one in between."""
    head, body = FILES[1][HEADER : HEADER + SECTION], FILES[1][HEADER + SECTION :]
    flat = changed(1, at_4136=("H", 0))[HEADER : HEADER + SECTION]
    start = 4 + 5 * 12
    short = b"".join(body[begin : begin + 24] for begin in range(start, len(body), 24 + 48))
    first = bytearray(FILES[1][:HEADER])
    struct.pack_into("<I", first, 4, 3)
    struct.pack_into("<I", first, 16, 18)
    rows = read(bytes(first) + head + bytes(SECTION) + flat + body + body[:start] + short)
    splats, expected = rows.select(slice(None)), read(FILES[1]).select(slice(None))
    assert len(rows) == 18
    np.testing.assert_array_equal(splats.means, np.tile(expected.means, (2, 1)))
    np.testing.assert_array_equal(splats.sh[:9], expected.sh)
    np.testing.assert_array_equal(splats.sh[9:, :1], expected.sh[:, :1])
    assert not splats.sh[9:, 1:].any()
    across = rows.select(np.array([8, 9]))
    np.testing.assert_array_equal(across.means, expected.means[[8, 0]])


def test_scales_below_half_precision_are_kept(read):
    """Flat splats have scales that half precision rounds to 0."""
    row = HEADER + SECTION + 4 + 5 * 12
    splats = read(changed(1, **{f"at_{row + 6}": ("H", 0)})).select(slice(0, 1))
    assert splats.log_scales[0, 0] == pytest.approx(np.log(2.0**-24))


def test_file_is_imported(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(FILES[1])
    with open_as_ply(tmp_path / "a.ksplat") as path:
        assert_close(read_bundle(path).levels[-1].splats, source(), 5e-5, 1e-3, 1e-3)


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_splat_transform_reads_the_same_values(tmp_path, splat_transform, compression):
    (tmp_path / "a.ksplat").write_bytes(FILES[compression])
    splat_transform(tmp_path / "a.ksplat", tmp_path / "a.ply")
    assert_close(
        KsplatRows(tmp_path / "a.ksplat").select(slice(None)), read_ply(tmp_path / "a.ply"), 0, 1e-6, 1e-6
    )


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "too short for a header"),
        (bytes(HEADER), r"version 0\.0, compression 0 is unknown"),
        (FILES[1][:-1], "too short for 9 splats in a section"),
        (changed(1, at_0=("B", 1)), r"version 1\.1, compression 1 is unknown"),
        (changed(1, at_20=("H", 3)), "compression 3 is unknown"),
        (changed(1, at_4=("I", 2**32 - 1)), "too short for 4,294,967,295 sections"),
        (changed(1, at_16=("I", 8)), "its sections have 9 of 8 splats"),
        (changed(1, at_4096=("I", 10)), "the header of a section contradicts itself"),
        (changed(1, at_4100=("I", 2**32 - 1)), "too short for 4,294,967,295 splats"),
        (changed(1, at_4108=("I", 2**32 - 1)), "too short"),
        (changed(1, at_4116=("H", 0)), "its buckets have 0 bytes"),
        (changed(1, at_4104=("I", 1)), "its buckets have fewer than 9 splats"),
        (changed(1, at_4128=("I", 2**32 - 1)), "the header of a section contradicts itself"),
        (changed(1, at_4136=("H", 4)), "the header of a section contradicts itself"),
    ],
)
def test_damaged_files_raise_one_sentence(read, content, reason):
    with pytest.raises(LodgsError, match=reason) as error:
        read(content)
    assert str(error.value.what).count(". ") == 0


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
def test_file_that_another_program_truncates_is_reported(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(FILES[0])
    rows = KsplatRows(tmp_path / "a.ksplat")
    os.truncate(tmp_path / "a.ksplat", HEADER)
    with pytest.raises(LodgsError, match="another program has truncated it"):
        rows.select(slice(None))
