"""Scratch files and bundles written from disk, bit for bit."""

from pathlib import Path

import numpy as np
import pytest

from training.errors import LodgsError
from training.splats.batches import BATCH_ROWS
from training.splats.bundle import open_bundle, write_bundle
from training.splats.file_rows import open_ply
from training.splats.gaussians import Splats
from training.splats.levels import NO_SPLATS, Bundle, Level
from training.splats.ply import read_ply, write_ply
from training.splats.scratch import ScratchFile


def random_splats(count, seed=0):
    rng = np.random.default_rng(seed)
    shapes = ((3,), (4,), (3,), (), (4, 3))
    columns = [rng.normal(size=(count, *shape)).astype(np.float32) for shape in shapes]
    return Splats(
        *columns, extras={"size": rng.random(count).astype(np.float32), "kind": np.arange(count) % 200}
    )


def assert_same(actual, expected):
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    assert all(np.array_equal(getattr(actual, name), getattr(expected, name)) for name in names)
    assert actual.extras.keys() == expected.extras.keys()
    assert all(np.array_equal(actual.extras[name], expected.extras[name]) for name in actual.extras)


def test_rows_are_read_in_any_order(tmp_path):
    splats = random_splats(40_000)
    splats.extras["kind"] = splats.extras["kind"].astype(np.uint8)
    with ScratchFile(tmp_path) as file:
        file.write(30_000, splats.select(slice(30_000, None)))
        file.write(0, splats.select(slice(0, 17)))
        file.write(17, splats.select(slice(17, 30_000)))
        assert len(file) == 40_000 and not list(tmp_path.iterdir())
        rng = np.random.default_rng(1)
        for rows in (slice(5, 9), slice(0, 0), slice(None), rng.integers(0, 40_000, 3000), np.array([], int)):
            assert_same(file.select(rows), splats.select(rows))
        file.write(99, splats.select(slice(3, 4)))
        assert_same(file.select(slice(99, 101)), splats.select(np.array([3, 100])))
        file.append(splats.select(slice(0, 2)))
        assert_same(file.select(slice(-2, None)), splats.select(slice(0, 2)))


def test_missing_folder_raises_one_sentence(tmp_path):
    with pytest.raises(LodgsError, match="Cannot read or write"):
        ScratchFile(tmp_path / "none")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device here")
def test_full_disk_raises_one_sentence(tmp_path):
    with ScratchFile(tmp_path) as file:
        file.append(splats := random_splats(5))
        file._file.close()
        file._file = open("/dev/full", "r+b", buffering=0)  # noqa: SIM115
        with pytest.raises(LodgsError, match="No space left"):
            file.append(splats)


def test_levels_on_disk_are_written_like_those_in_memory(tmp_path):
    levels = [random_splats(700, 1), random_splats(BATCH_ROWS + 900, 2)]
    for splats in levels:
        splats.extras["kind"] = splats.extras["kind"].astype(np.int16)
    for number, splats in enumerate(levels, 1):
        write_ply(tmp_path / f"{number}.ply", splats)
    for cumulative in (False, True):
        in_memory = [Level(n, splats) for n, splats in enumerate(levels, 1)]
        write_bundle(tmp_path / "memory.ply", Bundle("a", in_memory, cumulative=cumulative))
        on_disk = [Level(n, NO_SPLATS, on_disk=open_ply(tmp_path / f"{n}.ply")) for n in (1, 2)]
        write_bundle(tmp_path / "disk.ply", Bundle("a", on_disk, cumulative=cumulative))
        assert (tmp_path / "memory.ply").read_bytes() == (tmp_path / "disk.ply").read_bytes()
    _, rows = open_bundle(tmp_path / "disk.ply")
    assert_same(rows[2].select(slice(100, 200)), levels[1].select(slice(100, 200)))
    write_ply(tmp_path / "again.ply", rows[2])
    assert_same(read_ply(tmp_path / "again.ply"), levels[1])
