"""Exports and imports by the trainer."""

import os
import sys
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from tests.blender.fake_trainer import splats

TRAINER = os.environ.get("LODGS_TRAINER_PYTHON", "")


@pytest.fixture
def file(bpy, lodgs, tmp_path):
    """Import a bundle of two levels; return its path."""
    bundles = lodgs("training.splats.bundle")
    levels = [bundles.Level(1, splats(300), {"s_min": 0.1}), bundles.Level(2, splats(900), {"s_min": 0.0})]
    path = tmp_path / "levels.ply"
    bundles.write_bundle(path, bundles.Bundle("flod", levels, "bands", controls={"gamma": 2.0}))
    bpy.ops.lodgs.import_splats(filepath=str(path))
    return path


@pytest.fixture
def commands(lodgs, monkeypatch):
    """Commands of the trainer, which a short program replaces."""
    module, commands = lodgs("runs.conversion"), []
    start = module.processes.spawn
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", sys.executable)
    monkeypatch.setattr(module.environment, "require", lambda python: None)

    def spawn(command, log, output):
        commands.append(command)
        program = os.environ.get("COMPRESSION", "print('level 1'); print('small.ply: 0.1 MB')")
        return start([sys.executable, "-c", program], log, output)

    monkeypatch.setattr(module.processes, "spawn", spawn)
    return commands


@pytest.mark.skipif(not TRAINER, reason="no trainer; set LODGS_TRAINER_PYTHON")
@pytest.mark.slow
@pytest.mark.one_blender
def test_trainer_writes_a_file_that_blender_opens(bpy, file, tmp_path):
    out = tmp_path / "small.ply"
    assert bpy.ops.lodgs.export_compressed(filepath=str(out)) == {"FINISHED"}
    assert out.stat().st_size < 0.35 * file.stat().st_size  # splats have no spherical harmonics
    assert bpy.ops.lodgs.import_splats(filepath=str(out)) == {"FINISHED"}
    root = bpy.context.view_layer.objects.active
    first, finest = (item.object.data for item in root.lodgs.levels)
    assert (len(first.points), len(finest.points)) == (300, 900)
    assert (root.lodgs.rule, root.lodgs.bands.gamma) == ("bands", 2)
    positions = np.empty(2700, np.float32)
    finest.attributes["position"].data.foreach_get("vector", positions)
    np.testing.assert_allclose(positions.reshape(-1, 3), splats(900).means, atol=1e-3)


def test_compression_uses_views_of_the_run_unless_splats_are_moved(bpy, lodgs, file, tmp_path, commands):
    root, out = bpy.context.view_layer.objects.active, str(tmp_path / "small.ply")
    run = tmp_path / "run"
    run.mkdir()
    root.lodgs.training.run = str(run)
    bpy.ops.lodgs.export_compressed(filepath=out)  # the run has no bundle yet
    (run / "bundle.ply").touch()
    bpy.ops.lodgs.export_compressed(filepath=out, prune=0.99, distill_steps=7, codes=99)
    bpy.ops.lodgs.export_compressed(filepath=out, placed=True)
    unfinished, trained, placed = commands
    assert trained[1:4] == ["-m", "training", "compress"] and trained[5:7] == ["--out", out]
    assert trained[7:] == ["--prune=0.99", "--distill-steps=7", "--sh-degree=3", "--codes=99", f"--run={run}"]
    assert not [word for word in unfinished + placed if word.startswith("--run")]
    assert not Path(trained[4]).exists(), "temporary files are removed"


def test_error_of_the_trainer_is_reported(bpy, file, tmp_path, commands, monkeypatch):
    program = "import sys; sys.exit('error: Cannot write small.ply: no space. Free some.')"
    monkeypatch.setenv("COMPRESSION", program)
    with pytest.raises(RuntimeError, match=r"Error: Cannot write small.ply: no space. Free some.\n$"):
        bpy.ops.lodgs.export_compressed(filepath=str(tmp_path / "small.ply"))


def test_cancelled_compression_stops_the_trainer(lodgs, file, tmp_path, commands, monkeypatch):
    monkeypatch.setenv("COMPRESSION", "import time; time.sleep(60)")
    bundle = lodgs("training.splats.bundle").read_bundle(file)
    steps = lodgs("runs.conversion").compress_steps(bundle, tmp_path / "small.ply", {}, None)
    assert next(steps) == ""
    folder = Path(commands[0][4]).parent
    steps.close()
    assert not folder.exists() and not (tmp_path / "small.ply").exists()


def test_stopped_import_ends_the_trainer(lodgs, tmp_path, commands, monkeypatch):
    monkeypatch.setenv("COMPRESSION", "import time; time.sleep(60)")
    stop = Event()
    convert = lodgs("runs.conversion").make_converter(stop)
    stop.set()
    with pytest.raises(lodgs("training.errors").LodgsError, match=r"Reading a\.sog was stopped\."):
        convert(tmp_path / "a.sog", tmp_path / "a.ply")
    assert len(commands) == 1 and not (tmp_path / "a.ply").exists()
