"""Base splats of a training."""

import numpy as np
import pytest

from training.errors import LodgsError
from training.lod.selection import complete_splats
from training.runs import base
from training.runs.base import read_base
from training.splats import file_rows
from training.splats.bundle import read_bundle, write_bundle
from training.splats.dialects import comments_from_meta
from training.splats.gaussians import Splats
from training.splats.level_folder import write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply


def splats(count: int) -> Splats:
    rng = np.random.default_rng(count)
    return Splats(
        rng.normal(size=(count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(size=(count, 3)).astype(np.float32), rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 4, 3)).astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("cumulative", [False, True])
def test_base_from_exported_folder_equals_base_from_bundle(tmp_path, cumulative):
    bundle = Bundle("", [Level(1, splats(10)), Level(2, splats(30))], cumulative=cumulative)
    write_bundle(tmp_path / "b.ply", bundle)
    write_folder(tmp_path / "folder", bundle)
    expected, _ = read_base(tmp_path / "b.ply")
    splats_read, _ = read_base(tmp_path / "folder")
    assert len(splats_read) == (40 if cumulative else 30)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(splats_read, name), getattr(expected, name))


def test_base_reports_antialiasing(tmp_path):
    for meta in ({}, {"antialias": True}):
        write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats(3))], meta=meta))
        write_ply(tmp_path / "p.ply", splats(3), comments_from_meta(meta))
        assert [read_base(tmp_path / name)[1] for name in ("b.ply", "p.ply")] == [bool(meta)] * 2


def test_unrelated_folder_is_rejected_as_base(tmp_path):
    with pytest.raises(LodgsError, match="is not a finished run"):
        read_base(tmp_path)


@pytest.mark.parametrize("kind", ["plain", "finest_first", "stream", "cumulative", "smoothed"])
def test_base_opened_on_disk_equals_base_read_into_memory(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(file_rows, "BATCH_ROWS", 7)
    path = tmp_path / "b.ply"
    warnings = []
    finest = splats(50)
    finest.means[20] = np.nan
    finest.extras["size"] = np.arange(50, dtype=np.float32)
    if kind in ("plain", "smoothed"):
        finest.extras |= {"filter_3D": np.full(50, 0.3, np.float32)} if kind == "smoothed" else {}
        write_ply(path, finest)
    else:
        bundle = Bundle("", [Level(1, splats(10)), Level(2, finest)], cumulative=kind == "cumulative")
        write_bundle(path, bundle, "stream" if kind == "stream" else "finest_first")
    expected = read_bundle(path)
    expected = complete_splats(expected, expected.levels[-1])
    rows, _ = base.open_base(path, warnings.append)
    assert len(rows) == len(expected) == (59 if kind == "cumulative" else 49)
    assert len(warnings) == 1 and warnings[0].startswith("1 splats of")
    for selection in (slice(None), slice(17, 23), slice(40, 90)):
        part, expected_part = rows.select(selection), expected.select(selection)
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            np.testing.assert_array_equal(getattr(part, name), getattr(expected_part, name))
    assert kind == "cumulative" or "size" in rows.select(slice(3)).extras
