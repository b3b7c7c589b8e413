"""Compressed PLY against words that splat-transform 3.7.0 wrote, its rounding, and damaged files."""

import os
import sys

import numpy as np
import pytest

from tests.training.splats.test_formats import random_splats
from training.errors import LodgsError
from training.splats.bundle import read_bundle
from training.splats.compressed_ply import read_compressed_ply, write_compressed_ply
from training.splats.formats import open_as_ply
from training.splats.gaussians import SH_C0, Splats
from training.splats.ply import Element, read_elements, write_elements

WORDS = [
    (0x00000000, 0x20080200, 0x00000000, 0x8C00E080),
    (0x4CCB3233, 0x9B55AD21, 0x4CDCC8F6, 0x00FFFF45),
    (0xFFFFFFFF, 0xCA8D5CA8, 0xFFFFFFFF, 0xFF3600E1),
]
HARMONICS = [
    (128,) * 9,
    (255, 128, 128, 0, 128, 128, 131, 128, 128),
    (96, 120, 144, 104, 128, 152, 112, 136, 160),
]
"""Content that splat-transform 3.7.0 wrote for :func:`three_splats`; it sorted them as 0, 2, 1."""
ORDER = [0, 2, 1]
POSITIONS = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
SCALES = [name.replace("_", "_scale_") for name in POSITIONS]
COLORS = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]


def three_splats() -> Splats:
    sh = np.zeros((3, 4, 3), np.float32)
    sh[:, 0] = [[0.1, 0.1, 0.1], [1, 0.5, -1], [-1, 2, 0.25]]
    sh[1, 1:], sh[2, 1] = np.arange(9).reshape(3, 3) / 4 - 1, [5, -5, 0.1]
    return Splats(
        np.float32([[0, 0, 0], [1, 2, 4], [0.3, 0.7, 1.1]]),
        np.float32([[1, 0, 0, 0], [0.5, -0.5, 0.5, -0.6], [0.1, 0.2, -0.9, 0.3]]),
        np.float32([[-3, -4, -5], [-2, -1, 0], [-2.7, -1.3, -4.4]]), np.float32([0, 2, -1]), sh,
    )  # fmt: skip


def test_words_are_those_of_splat_transform(tmp_path):
    write_compressed_ply(tmp_path / "a.compressed.ply", three_splats(), {})
    elements, _ = read_elements(tmp_path / "a.compressed.ply", splats=False)
    assert list(elements) == ["chunk", "vertex", "sh"]
    assert elements["chunk"].dtype.names == (*POSITIONS, *SCALES, *COLORS)
    assert elements["vertex"].tolist() == WORDS and elements["sh"].tolist() == HARMONICS


@pytest.mark.parametrize("colors", [True, False])
def test_words_of_splat_transform_are_read(tmp_path, colors):
    """Files of older programs have no ranges of colours."""
    ranges = {name: [value] for name, value in zip(POSITIONS, (0, 0, 0, 1, 2, 4), strict=True)}
    ranges |= {name: [value] for name, value in zip(SCALES, (-3, -4, -5, -2, -1, 0), strict=True)}
    if colors:
        ends = 0.2179052, 0.5282095, 0.2179052, 0.7820948, 1.0641896, 0.5705237
        ranges |= {name: [value] for name, value in zip(COLORS, ends, strict=True)}
    names = "packed_position", "packed_rotation", "packed_scale", "packed_color"
    elements = [
        Element.from_columns("chunk", {name: np.float32(value) for name, value in ranges.items()}),
        Element.from_columns("vertex", dict(zip(names, np.uint32(WORDS).T, strict=True))),
        Element.from_columns("sh", {f"f_rest_{i}": column for i, column in enumerate(np.uint8(HARMONICS).T)}),
    ]
    write_elements(tmp_path / "a.ply", elements)
    rows, _ = read_compressed_ply(tmp_path / "a.ply")
    actual, expected = rows.select(slice(None)), three_splats().select(ORDER)
    np.testing.assert_allclose(actual.means, expected.means, atol=4 / 2047 / 2)
    np.testing.assert_allclose(actual.log_scales, expected.log_scales, atol=5 / 2047)
    unit = expected.quats / np.linalg.norm(expected.quats, axis=1, keepdims=True)
    assert np.abs((actual.quats * unit).sum(axis=1)).min() > 1 - 1e-5
    np.testing.assert_allclose(actual.opacity_logits, expected.opacity_logits, atol=0.02)
    np.testing.assert_allclose(actual.sh[:, 1:], expected.sh[:, 1:].clip(-4, 4), atol=8 / 256)
    if colors:
        np.testing.assert_allclose(actual.sh[:, 0], expected.sh[:, 0], atol=1 / 255 / SH_C0)
    else:
        codes = np.array([[0x8C, 0x00, 0xE0], [0x00, 0xFF, 0xFF], [0xFF, 0x36, 0x00]])
        np.testing.assert_allclose(0.5 + SH_C0 * actual.sh[:, 0], codes / 255, atol=1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_errors_are_at_most_half_a_step(tmp_path, degree):
    """Steps are those of the ranges of each chunk of 256 splats, bytes of opacity and of coefficients."""
    splats = random_splats(1000, degree, seed=degree)
    splats.extras["label"] = np.arange(1000, dtype=np.float32)
    write_compressed_ply(tmp_path / "a.compressed.ply", splats, {"antialias": True})
    chunks = read_elements(tmp_path / "a.compressed.ply", splats=False)[0]["chunk"]
    assert len(chunks) == 4
    with open_as_ply(tmp_path / "a.compressed.ply") as ply:
        bundle = read_bundle(ply)
    actual = bundle.levels[0].splats
    assert bundle.antialias and actual.sh_degree == degree
    parts = np.arange(1000) // 256
    low, high = (np.array(chunks[names].tolist())[parts] for names in (POSITIONS[:3], POSITIONS[3:]))
    steps = (high - low) / (2047, 1023, 2047)
    matches = [np.linalg.norm(splats.means - mean, axis=1).argmin() for mean in actual.means]
    assert len(set(matches)) == 1000
    expected = splats.select(matches)
    assert (np.abs(actual.means - expected.means) <= steps / 2 + 1e-6).all()
    low, high = (np.array(chunks[names].tolist())[parts] for names in (SCALES[:3], SCALES[3:]))
    steps = (high - low) / (2047, 1023, 2047)
    assert (np.abs(actual.log_scales - expected.log_scales) <= steps / 2 + 1e-5).all()
    low, high = (np.array(chunks[names].tolist())[parts] for names in (COLORS[:3], COLORS[3:]))
    errors = SH_C0 * np.abs(actual.sh[:, 0] - expected.sh[:, 0])
    assert (errors <= (high - low) / 255 / 2 + 1e-6).all()
    assert (np.abs(actual.sh[:, 1:] - expected.sh[:, 1:].clip(-4, 4)) <= 8 / 256 / 2 + 1e-6).all()
    alphas, others = (1 / (1 + np.exp(-part.opacity_logits)) for part in (actual, expected))
    assert np.abs(alphas - others).max() <= 0.5 / 255 + 1e-6
    unit = expected.quats / np.linalg.norm(expected.quats, axis=1, keepdims=True)
    cosines = np.abs((unit * actual.quats).sum(axis=1) / np.linalg.norm(actual.quats, axis=1))
    assert np.degrees(2 * np.arccos(cosines.clip(0, 1))).max() < 0.4


def test_file_without_splats_round_trips(tmp_path):
    write_compressed_ply(tmp_path / "a.compressed.ply", random_splats(0, 1), {})
    assert len(read_compressed_ply(tmp_path / "a.compressed.ply")[0]) == 0


def test_degree_4_is_refused(tmp_path):
    with pytest.raises(LodgsError, match="degree 4"):
        write_compressed_ply(tmp_path / "a.compressed.ply", random_splats(3, 4), {})


def header(chunks="chunk 1", vertex="vertex 2", word="uint", sh="sh 2", rest=9, last="packed_color") -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element {chunks}"]
    lines += [f"property float {name}" for name in (*POSITIONS, *SCALES, *COLORS)] + [f"element {vertex}"]
    names = "packed_position", "packed_rotation", "packed_scale", last
    lines += [f"property {word} {name}" for name in names] + [f"element {sh}"]
    return "\n".join(
        [*lines, *(f"property uchar f_rest_{i}" for i in range(rest)), "end_header", ""]
    ).encode()


GOOD = header() + bytes(72 + 32 + 18)
DAMAGED = {
    "cut": (GOOD[:-1], "truncated"),
    "few chunks": (header(chunks="chunk 0") + bytes(200), "too few"),
    "many splats": (header(vertex="vertex 999999999") + bytes(200), "truncated"),
    "words of float": (header(word="float") + bytes(200), "types"),
    "without colours": (header(last="color") + bytes(200), "lacks columns"),
    "other harmonics": (header(rest=10) + bytes(200), "harmonics"),
    "few harmonics": (header(sh="sh 1") + bytes(200), "harmonics"),
    "other element": (header(chunks="pieces 1") + bytes(200), "lacks columns"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_give_one_sentence(tmp_path, name):
    content, reason = DAMAGED[name]
    (tmp_path / "a.compressed.ply").write_bytes(content)
    with pytest.raises(LodgsError, match=reason), open_as_ply(tmp_path / "a.compressed.ply"):
        pass


def test_complete_file_is_read(tmp_path):
    (tmp_path / "a.ply").write_bytes(GOOD)
    with open_as_ply(tmp_path / "a.ply") as ply:
        assert len(read_bundle(ply).levels[0].splats) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
def test_file_that_another_program_truncates_is_reported(tmp_path):
    write_compressed_ply(tmp_path / "a.ply", random_splats(3000), {})
    rows, _ = read_compressed_ply(tmp_path / "a.ply")
    os.truncate(tmp_path / "a.ply", 5000)
    with pytest.raises(LodgsError, match="another program has truncated it"):
        rows.select(slice(2990, 3000))


def test_files_with_long_comments_are_recognised(tmp_path):
    write_compressed_ply(tmp_path / "a.ply", three_splats(), {"georeference": {"crs": "x" * 5000}})
    with open_as_ply(tmp_path / "a.ply") as ply:
        assert len(read_bundle(ply).levels[0].splats) == 3
