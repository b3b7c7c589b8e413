"""Compressed bundles: bounds of the errors, everything else bit for bit, partial reads and damaged files."""

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData

from training.cli.info import describe
from training.editing.export import FileOptions, export_finest_level
from training.errors import LodgsError
from training.lod.on_disk import open_if_large, read_part
from training.splats.bundle import open_bundle, read_bundle, write_bundle
from training.splats.coding import Codebook, Range
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply

COUNTS = (40, 3000)


@pytest.fixture
def bundle(make_splats):
    """Two levels with extra columns, normals, facts and a table."""
    levels = []
    for number, count in enumerate(COUNTS, 1):
        extras = {"label": np.arange(count).astype("u1"), "nx": np.ones(count, "f4")}
        levels.append(Level(number, make_splats(count, 2, **extras), {"s_min": 1 / (3 * number)}))
    levels[0].splats.means[0] = 1e5, -3e4, 0  # one far splat
    table = {"chunks": {"x": np.linspace(0, 1, 3, dtype="f4")}}
    return Bundle("flod", levels, "bands", {}, {"gamma": 1.5}, meta={"antialias": True}, tables=table)


@pytest.fixture
def codebook(bundle):
    """256 sets, of which each level's splats use the first ones in turn."""
    sets = np.random.default_rng(1).normal(size=(256, 8, 3)).astype(np.float32)
    return Codebook(sets, {level.number: np.arange(len(level.splats)) % 256 for level in bundle.levels})


@pytest.fixture
def file(tmp_path, bundle, codebook):
    write_bundle(tmp_path / "b.ply", bundle, codebook=codebook)
    return tmp_path / "b.ply"


def test_codes_have_equal_steps_of_an_inverse_hyperbolic_sine():
    """By hand: center 1, width 2; low = 1 - 2 sinh 1, high = 1 + 2 sinh 3, so 256 codes are 4 / 255 apart."""
    span = Range(float(1 - 2 * np.sinh(1)), float(1 + 2 * np.sinh(3)), 1.0, 2.0)
    steps = np.array([-1, -1 + 4 / 255, -1 + 4 / 255 * 63.4, 3])
    values = 1 + 2 * np.sinh(steps)
    assert span.encode(values, 8).tolist() == [0, 1, 63, 255]
    np.testing.assert_allclose(span.table(8)[[0, 1, 255]], values[[0, 1, 3]], rtol=1e-6)


@pytest.mark.parametrize("cumulative", [False, True])
def test_errors_are_within_half_a_step(tmp_path, bundle, codebook, cumulative):
    """A step of a value at distance d from the median m, with median deviation w, is a/codes sqrt(w² + d²),
    where a is the difference of the inverse hyperbolic sines of the ends. Cumulative levels share ranges."""
    bundle.cumulative = cumulative
    write_bundle(tmp_path / "b.ply", bundle, codebook=codebook)
    pairs = list(zip(bundle.levels, read_bundle(tmp_path / "b.ply").levels, strict=True))
    for group in [pairs] if cumulative else [[pair] for pair in pairs]:
        original, decoded = (Splats.concatenated([pair[side].splats for pair in group]) for side in range(2))
        for name, codes in (("means", 65535), ("log_scales", 255), ("opacity_logits", 255)):
            values, result = (
                getattr(splats, name).reshape(len(splats), -1).astype(np.float64)
                for splats in (original, decoded)
            )
            m = np.median(values, axis=0)
            w = np.median(np.abs(values - m), axis=0)
            a = np.ptp(np.arcsinh((values - m) / w), axis=0)
            step = a / codes * np.sqrt(w**2 + (values - m) ** 2)
            assert (np.abs(result - values) <= 0.52 * step + 1e-6 * np.abs(values)).all(), name
        sets = codebook.sets[np.concatenate([codebook.codes[level.number] for level, _ in group])]
        np.testing.assert_allclose(decoded.sh[:, 1:], sets, atol=0.07)
        cosines = np.abs((original.quats * decoded.quats).sum(1)) / np.linalg.norm(original.quats, axis=1)
        assert np.degrees(2 * np.arccos(cosines.clip(0, 1))).max() < 3


def test_no_splat_is_smaller_than_before(bundle, file):
    for level, result in zip(bundle.levels, read_bundle(file).levels, strict=True):
        assert (result.splats.log_scales.min(0) >= level.splats.log_scales.min(0)).all()


def test_rule_facts_extras_and_tables_survive_bit_for_bit(bundle, file):
    result = read_bundle(file)
    for name in ("method", "rule", "facts", "controls", "cumulative", "meta"):
        assert getattr(result, name) == getattr(bundle, name)
    for level, decoded in zip(bundle.levels, result.levels, strict=True):
        assert (decoded.number, decoded.facts, len(decoded.splats)) == (
            level.number, level.facts, len(level.splats)
        )  # fmt: skip
        for name, column in level.splats.extras.items():
            np.testing.assert_array_equal(decoded.splats.extras[name], column)
    np.testing.assert_array_equal(result.tables["chunks"]["x"], bundle.tables["chunks"]["x"])


def test_all_readers_decode_the_same_splats(tmp_path, bundle, file, same):
    """A whole read, parts of it, plain export, and an uncompressed copy."""
    result = read_bundle(file)
    finest = result.levels[-1].splats
    _, rows = open_bundle(file)
    assert same(finest.select(slice(7, 90)), rows[2].select(slice(7, 90)))
    indices = np.array([3, 500, 2999])
    assert same(finest.select(indices), rows[2].select(indices))
    columns = rows[2].columns(indices, ("x", "label", "missing"))
    np.testing.assert_array_equal(columns["x"], finest.means[indices, 0])
    np.testing.assert_array_equal(columns["label"], finest.extras["label"][indices])
    assert same(read_part(file, [2])[0].levels[-1].splats, finest)
    on_disk = open_if_large(file, 10)
    assert on_disk is not None and same(on_disk.levels[1].rows.select(slice(None)), finest)
    np.testing.assert_array_equal(read_ply(file).means, finest.means)
    write_bundle(tmp_path / "copy.ply", result)
    copy = read_bundle(tmp_path / "copy.ply").levels[1].splats
    assert same(replace(copy, extras={}), replace(finest, extras={}))
    export_finest_level(tmp_path / "plain.ply", result, FileOptions(antialiased=True))
    plain = PlyData.read(tmp_path / "plain.ply")["vertex"]
    np.testing.assert_array_equal(plain["scale_1"], finest.log_scales[:, 1])


def test_18_bytes_per_splat_and_24_per_set(file):
    """Three positions of 2 bytes, 10 bytes, and an index of 2 bytes; 8 coefficients of 3 bytes."""
    vertex, codebook = (PlyData.read(file)[name].data for name in ("vertex", "lod_codebook"))
    assert (vertex.dtype.itemsize, codebook.dtype.itemsize, len(codebook)) == (18, 24, 256)
    text = describe(file)
    assert "compressed: 18 bytes per splat, codebook of 256 sets" in text
    size = 18 + 1 + 4  # with its extra columns
    assert f"{3000 * size / 1e6:>8.2f}" in text


def test_unusual_values(tmp_path, make_splats):
    """No harmonics, equal values, an empty level, and infinite numbers."""
    flat = make_splats(5, 0)
    flat.means[:] = 2
    flat.log_scales[0], flat.opacity_logits[:2] = -np.inf, (np.inf, -np.inf)
    flat.quats[0], flat.quats[1] = (0, 0, 0, -2), (-1, 0, 0, 0)
    levels = [Level(1, make_splats(0, 0)), Level(2, flat)]
    codebook = Codebook(np.zeros((1, 0, 3), "f4"), {1: np.zeros(0, int), 2: np.zeros(5, int)})
    write_bundle(tmp_path / "b.ply", Bundle("flod", levels), codebook=codebook)
    empty, result = read_bundle(tmp_path / "b.ply").levels
    assert (len(empty.splats), result.splats.sh_degree) == (0, 0)
    np.testing.assert_array_equal(result.splats.means, flat.means)
    assert result.splats.opacity_logits[:2].tolist() == [12, -12]
    assert np.abs(result.splats.quats[0] @ (0, 0, 0, 1)) > 0.999
    assert np.abs(result.splats.quats[1, 0]) > 0.999


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:-30], "is truncated"),
        (lambda d: d.replace(b"element lod_codebook 256", b"element lod_codebook 100"), "(set|range|splats)"),
        (lambda d: d.replace(b"element lod_ranges 50", b"element lod_ranges 49"), "should have 50 ranges"),
        (lambda d: d.replace(b"property uchar q_rot_1\n", b"property uchar q_rot_9\n"), "other columns"),
        (lambda d: d.replace(b"property uchar q_opacity\n", b""), "other columns"),
        (lambda d: d.replace(b"element lod_ranges", b"element lod_rangez"), "should have 50 ranges"),
        (lambda d: d.replace(b"element lod_codebook", b"element lod_kodebook"), "other columns"),
    ],
)
def test_damaged_files_give_one_sentence(file, change, message):
    data = file.read_bytes()
    assert change(data) != data
    file.write_bytes(change(data))
    with pytest.raises(LodgsError, match=message):
        read_bundle(file)


def test_codes_beyond_the_codebook(file, bundle, codebook):
    codebook.codes[1][5] = 256
    write_bundle(file, bundle, codebook=codebook)
    with pytest.raises(LodgsError, match="has set 256 of a codebook with 256"):
        read_bundle(file)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_invalid_ranges(tmp_path, file, value):
    ply = PlyData.read(file)
    ply["lod_ranges"].data["high"][3] = value
    ply.write(tmp_path / "invalid.ply")
    with pytest.raises(LodgsError, match="a range of its compressed columns is invalid"):
        read_bundle(tmp_path / "invalid.ply")
