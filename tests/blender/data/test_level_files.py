"""The trainer exports all levels as USD and glTF. LODGS and Blender's own importer read them."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from tests.checkout import ROOT
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level

TRAINER = os.environ.get("LODGS_TRAINER_PYTHON", "")
pytestmark = pytest.mark.skipif(not TRAINER, reason="no trainer; set LODGS_TRAINER_PYTHON")


@pytest.fixture
def file(tmp_path):
    levels = [Level(number, splats(40 * number), {"s_min": 0.1 * (2 - number)}) for number in (1, 2)]
    write_bundle(tmp_path / "in.ply", Bundle("made", levels, "bands"))
    return tmp_path / "in.ply"


def positions(obj):
    values = np.empty((len(obj.data.points), 3), np.float32)
    obj.data.attributes["position"].data.foreach_get("vector", values.reshape(-1))
    return values


@pytest.mark.slow
@pytest.mark.one_blender
def test_levels_round_trip_as_usd_and_gltf(bpy, lodgs, file, tmp_path):
    root = lodgs("data.importing").import_splats(bpy.context, file)
    for ending in (".usdc", ".glb"):
        out = tmp_path / f"out{ending}"
        assert bpy.ops.lodgs.export_levels(filepath=str(out)) == {"FINISHED"} and out.exists()
    with pytest.raises(RuntimeError, match="original place"):
        bpy.ops.lodgs.export_levels(filepath=str(out), placed=True, original_place=True)
    assert bpy.ops.lodgs.export_tiles(directory=str(tmp_path / "web")) == {"FINISHED"}
    assert (tmp_path / "web" / "tileset.json").exists()
    reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.glb")
    assert reimported.lodgs.rule == "bands" and len(reimported.lodgs.levels) == 2
    for item, original in zip(reimported.lodgs.levels, root.lodgs.levels, strict=True):
        assert np.array_equal(positions(item.object), positions(original.object))


@pytest.mark.slow
def test_blender_imports_each_level_of_usd(bpy, lodgs, file, tmp_path):
    if bpy.app.version < (5, 3):
        pytest.skip("Blender before 5.3 imports no splats from USD")
    out = tmp_path / "out.usdc"
    command = [TRAINER, "-m", "training", "edit", str(file), "--levels", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert bpy.ops.wm.usd_import(filepath=str(out)) == {"FINISHED"}
    clouds = {obj.name: obj for obj in bpy.data.objects if obj.type == "POINTCLOUD"}
    assert sorted(clouds) == ["Level_1", "Level_2"] and "pxr" not in sys.modules
    for number, obj in enumerate((clouds["Level_1"], clouds["Level_2"]), 1):
        assert obj.data.type == "GAUSSIAN_SPLAT"
        assert np.array_equal(positions(obj), splats(40 * number).means)
        up = np.array(obj.matrix_world)[:3, :3] @ [0, -1, 0]
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)


def test_damaged_usd_is_reported(bpy, lodgs, tmp_path):
    """The trainer reads it: Blender's own process has another USD library."""
    (Path(tmp_path) / "a.usdc").write_bytes(b"PXR-USDC")
    with pytest.raises(lodgs("training.errors").LodgsError, match=r"it is damaged .* Export it again"):
        lodgs("data.importing").import_splats(bpy.context, tmp_path / "a.usdc")
