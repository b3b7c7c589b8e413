"""Partial reads of a region: the same splats as from the full file, with fewer bytes read."""

from dataclasses import replace

import numpy as np
import pytest

from training.errors import LodgsError
from training.lod.blocks import BLOCKS, SIZE, block_table
from training.lod.on_disk import read_part
from training.lod.rule import rules
from training.lod.rules.chunks import in_chunk, member_columns
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.morton import spatial_order

COUNTS = {1: 300, 2: 5 * SIZE, 3: 20 * SIZE + 33}
BYTES = 4 * (3 + 3 + 3 + 1 + 3 + 4 + 2)
"""Bytes of a splat of degree 0 with normals and two columns of bits."""


@pytest.fixture
def bundle():
    """Thirty chunks along a line, each with the nearby splats."""
    rng, levels = np.random.default_rng(0), []
    for number, count in COUNTS.items():
        means = rng.uniform(0, 30, (count, 3)).astype(np.float32) * np.float32([1, 0.1, 0.1])
        means = means[spatial_order(means)]
        sets = np.abs(means[:, 0] - np.arange(30)[:, None] - 0.5) < 1
        splats = Splats(
            means, rng.normal(size=(count, 4)).astype(np.float32),
            rng.normal(size=(count, 3)).astype(np.float32), rng.normal(size=count).astype(np.float32),
            rng.normal(size=(count, 1, 3)).astype(np.float32),
            member_columns(sets),
        )  # fmt: skip
        levels.append(Level(number, splats, {"d_l": 4.0 - number if number < 3 else 0.0}))
    x = np.arange(30, dtype=np.float32) + 0.5
    chunks = {"x": x, "y": 0 * x, "z": 0 * x, "radius": 0 * x + 1}
    blocks = block_table(rules()["chunks"].block_bounds, ((x.number, x.splats.extras) for x in levels))
    return Bundle("lodge", levels, "chunks", tables={"chunks": chunks, BLOCKS: blocks})


@pytest.mark.parametrize("order", ["finest_first", "stream"])
@pytest.mark.parametrize("region", [(3,), (3, 4), (25, 26), (0, 29)])
def test_region_equals_selection_from_the_full_bundle(tmp_path, bundle, order, region):
    write_bundle(tmp_path / "bundle.ply", bundle, order)
    partial, size = read_part(tmp_path / "bundle.ply", COUNTS, region)
    for level, full in zip(partial.levels, read_bundle(tmp_path / "bundle.ply").levels, strict=True):
        subset = np.any([in_chunk(full.splats.extras, chunk) for chunk in region], axis=0)
        np.testing.assert_array_equal(level.splats.means, full.splats.means[subset])
        np.testing.assert_array_equal(level.splats.sh, full.splats.sh[subset])
        assert all(
            in_chunk(level.splats.extras, region[0]) == in_chunk(full.splats.extras, region[0])[subset]
        )
    loaded, total = sum(len(level.splats) for level in partial.levels), sum(COUNTS.values())
    assert loaded * BYTES < size < 0.6 * total * BYTES


def test_files_without_blocks_are_read_completely(tmp_path, bundle):
    without = replace(bundle, tables={"chunks": bundle.tables["chunks"]})
    write_bundle(tmp_path / "a.ply", bundle)
    write_bundle(tmp_path / "b.ply", without)
    (part, subset), (same, size) = (read_part(tmp_path / name, COUNTS, (7, 8)) for name in ("a.ply", "b.ply"))
    assert subset < size >= sum(COUNTS.values()) * BYTES
    for first, second in zip(part.levels, same.levels, strict=True):
        inside = in_chunk(second.splats.extras, 7) | in_chunk(second.splats.extras, 8)
        np.testing.assert_array_equal(first.splats.quats, second.splats.quats[inside])


@pytest.mark.parametrize("numbers", [(2,), (1, 2)])
def test_other_levels_are_not_read(tmp_path, bundle, numbers):
    write_bundle(tmp_path / "bundle.ply", bundle)
    part, size = read_part(tmp_path / "bundle.ply", numbers)
    for level, full in zip(part.levels, bundle.levels, strict=True):
        expected = full.splats if level.number in numbers else full.splats.select(slice(0))
        np.testing.assert_array_equal(level.splats.means, expected.means)
    splats = sum(COUNTS[number] for number in numbers)
    assert splats * BYTES < size < splats * BYTES + 4000  # with the tables


def test_contradicting_blocks_only_lose_rows(tmp_path, bundle):
    table = {name: np.tile(column, 3) for name, column in bundle.tables[BLOCKS].items()}
    write_bundle(tmp_path / "odd.ply", replace(bundle, tables={**bundle.tables, BLOCKS: table}))
    part, _ = read_part(tmp_path / "odd.ply", COUNTS, (3,))
    assert all(len(level.splats) <= COUNTS[level.number] for level in part.levels)
    del table["level"]
    write_bundle(tmp_path / "none.ply", replace(bundle, tables={**bundle.tables, BLOCKS: table}))
    with pytest.raises(LodgsError, match="is inconsistent"):
        read_part(tmp_path / "none.ply", COUNTS, (3,))
