"""SPZ against values worked by hand from its documentation, and its rounding."""

import gzip
import struct

import numpy as np
import pytest

from tests.training.splats.test_formats import random_splats
from training.splats.spz import pack_spz, unpack_spz

HEADER = "<IIIBBBB"
QUARTER = np.sqrt(0.5)


def content(version: int, rotation: bytes, degree: int = 0, rest: bytes = b"") -> bytes:
    """One splat at (1, -2, 0.25) with 12 fractional bits, scales exp(-2) and opacity 51 / 255."""
    head = struct.pack(HEADER, 0x5053474E, version, 1, degree, 12, 0, 0)
    position = b"".join(struct.pack("<i", value)[:3] for value in (4096, -8192, 1024))
    return gzip.compress(head + position + bytes([51, 255, 0, 128]) + bytes([128] * 3) + rotation + rest)


@pytest.mark.parametrize(
    ("version", "rotation", "expected"),
    [
        (2, bytes([128, 128, 255]), (0, 1 / 255, 1 / 255, 1)),
        (3, struct.pack("<I", 3 << 30), (1, 0, 0, 0)),
        (3, struct.pack("<I", 3 << 30 | 512 | 511), (QUARTER, 0, 0, -QUARTER)),
        (3, struct.pack("<I", 0 << 30 | 511), (QUARTER, QUARTER, 0, 0)),
    ],
)
def test_values_of_one_splat(version, rotation, expected):
    splats = unpack_spz(content(version, rotation, 1, bytes(range(120, 129))), 1)
    np.testing.assert_array_equal(splats.means, [[1, -2, 0.25]])
    np.testing.assert_allclose(splats.log_scales, -2, rtol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, np.log(0.25), rtol=1e-5)
    np.testing.assert_allclose(splats.sh[0, 0], np.array([0.5, -0.5, 128 / 255 - 0.5]) / 0.15, rtol=1e-5)
    np.testing.assert_allclose(splats.sh[0, 1:].ravel() * 128, np.arange(-8, 1), atol=1e-5)
    np.testing.assert_allclose(splats.quats[0], expected, atol=6e-3)


@pytest.mark.parametrize("degree", range(4))
def test_errors_are_at_most_half_a_step(degree):
    splats = random_splats(500, degree)
    splats.quats /= np.linalg.norm(splats.quats, axis=1, keepdims=True)
    reread = unpack_spz(pack_spz(splats), 500)
    assert np.abs(reread.means - splats.means).max() <= np.abs(splats.means).max() * 2.0**-22
    in_range = splats.log_scales.clip(-10, 5.9)
    assert np.abs(reread.log_scales - in_range).max() <= 0.5 / 16 + 1e-6
    alphas, expected = (
        1 / (1 + np.exp(-logits)) for logits in (reread.opacity_logits, splats.opacity_logits)
    )
    assert np.abs(alphas - expected).max() <= 0.5 / 255 + 1e-6
    cosines = np.abs((reread.quats * splats.quats).sum(1) / np.linalg.norm(reread.quats, axis=1))
    angles = np.degrees(2 * np.arccos(cosines.clip(0, 1)))
    assert np.median(angles) < 1 and angles.max() < 12  # w is derived, inexactly if it is small
    color = splats.sh[:, 0].clip(-0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(reread.sh[:, 0] - color).max() <= 0.5 / 255 / 0.15 + 1e-6
    steps = np.where(np.arange(1, splats.sh.shape[1]) <= 3, 8, 16)[:, None] / 128
    assert (
        np.abs(reread.sh[:, 1:] - splats.sh[:, 1:].clip(-1, 127 / 128)) <= steps / 2 + 1 / 256 + 1e-6
    ).all()


GOOD = content(2, bytes(3))


DAMAGED = {
    "empty": b"",
    "not compressed": b"NGSP",
    "without end": GOOD[:-12],
    "cut": GOOD[:20],
    "version 4": content(4, bytes(3)),
    "version 1": content(1, bytes(3)),
    "without rotations": content(2, b""),
    "degree 9": content(2, bytes(3), 9),
    "2^32 splats": gzip.compress(struct.pack(HEADER, 0x5053474E, 2, 2**32 - 1, 3, 12, 0, 0)),
}


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED)
def test_damaged_data_are_rejected(data):
    with pytest.raises(ValueError):
        unpack_spz(data, 1000)
