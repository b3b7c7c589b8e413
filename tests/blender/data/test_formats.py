"""Export and import of other file formats by operators."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from tests.checkout import ROOT, copy_checkout, recipe_code
from tests.training.splats.ksplat_files import FILES
from tests.training.splats.ksplat_files import source as splats_of_file
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level
from training.splats.sog import encode_sog

pytestmark = pytest.mark.one_blender


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    levels = [Level(number, splats(40 * number), {"s_min": 0.1 * (2 - number)}) for number in (1, 2)]
    write_bundle(tmp_path / "in.ply", Bundle("made", levels, "bands"))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")
    bpy.context.view_layer.update()
    return root


def means(obj):
    positions = np.empty((len(obj.data.points), 3), np.float32)
    obj.data.attributes["position"].data.foreach_get("vector", positions.reshape(-1))
    return positions[np.lexsort(positions.round(2).T)]


def import_levels(bpy, lodgs, path):
    root = lodgs("data.importing").import_splats(bpy.context, path)
    return [item.object for item in root.lodgs.levels]


@pytest.mark.parametrize("ending", [".splat", ".spz", ".compressed.ply"])
def test_level_round_trip(bpy, lodgs, root, tmp_path, ending):
    path = tmp_path / f"out{ending}"
    result = bpy.ops.lodgs.export_plain(filepath=str(path), source="LEVEL", level=1)
    assert result == {"FINISHED"} and path.exists()
    (obj,) = import_levels(bpy, lodgs, path)
    np.testing.assert_allclose(means(obj), means(root.lodgs.levels[0].object), atol=0.01)
    assert obj.name.startswith("out level 1")


def test_streamed_levels_round_trip(bpy, lodgs, root, tmp_path):
    assert bpy.ops.lodgs.export_streamed(directory=str(tmp_path / "web")) == {"FINISHED"}
    for path in (tmp_path / "web", tmp_path / "web" / "lod-meta.json"):
        objects = import_levels(bpy, lodgs, path)
        for obj, item in zip(objects, root.lodgs.levels, strict=True):
            np.testing.assert_allclose(means(obj), means(item.object), atol=0.01)


@pytest.mark.parametrize("measured", [False, True])
def test_level_errors_are_written_on_request(bpy, lodgs, root, tmp_path, measured):
    folder = tmp_path / "web"
    assert bpy.ops.lodgs.export_streamed(directory=str(folder), lod_errors=measured) == {"FINISHED"}
    assert json.loads((folder / "lod-meta.json").read_text("utf-8"))["lodErrors"] == measured


def test_sog_in_a_folder_is_named_after_it(bpy, lodgs, tmp_path):
    pytest.importorskip("PIL", reason="Pillow reads WebP")
    (tmp_path / "garden").mkdir()
    for name, data in encode_sog(splats(40)).items():
        (tmp_path / "garden" / name).write_bytes(data)
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "garden" / "meta.json")) == {"FINISHED"}
    (root,) = lodgs("data.roots").roots(bpy.context.scene)
    assert root.name == "garden" and len(means(root.lodgs.levels[0].object)) == 40


def test_estimated_size_of_tiles_is_that_of_their_compression(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "in.ply", Bundle("made", [Level(1, splats(4000), {"s_min": 0.0})], "bands"))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")
    assert bpy.ops.lodgs.export_tiles(directory=str(tmp_path / "tiles")) == {"FINISHED"}
    export = lodgs("operators.export")
    number, unit = export._size(bpy.context, export.LODGS_OT_export_tiles.kind, -1).split()
    estimate = float(number.replace(",", "")) * {"MB": 1e6, "kB": 1e3}[unit]
    actual = sum(path.stat().st_size for path in (tmp_path / "tiles").iterdir())
    assert 0.4 < estimate / actual < 2.5


@pytest.mark.skipif(
    not (Path(__file__).parents[3] / "training/viewer").is_dir(),
    reason="tools/viewer.py has not downloaded the viewer",
)
def test_page_has_the_levels(bpy, lodgs, root, tmp_path):
    assert bpy.ops.lodgs.export_page(directory=str(tmp_path / "page")) == {"FINISHED"}
    text = (tmp_path / "page" / "index.html").read_text("utf-8")
    assert f"<title>{root.name}</title>" in text
    assert (tmp_path / "page" / "levels" / "lod-meta.json").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["out.sog", "out.usdc", "web"])
def test_trainer_reads_what_blender_cannot(bpy, lodgs, root, tmp_path, monkeypatch, name):
    python = os.environ.get("LODGS_TRAINER_PYTHON")
    if not python:
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    levels = root.lodgs.levels
    if name == "web":
        assert bpy.ops.lodgs.export_streamed(directory=str(tmp_path / name)) == {"FINISHED"}
    elif name.endswith(".sog"):
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / name), source="LEVEL", level=2)
        levels = levels[1:]
    else:
        bpy.ops.lodgs.export_levels(filepath=str(tmp_path / name))
    monkeypatch.setitem(sys.modules, "PIL", None)  # as in Blender
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / name))
    imported = lodgs("data.roots").active_root(bpy.context)
    assert imported != root and Path(imported.lodgs.source.file).name == name
    for item, original in zip(imported.lodgs.levels, levels, strict=True):
        np.testing.assert_allclose(means(item.object), means(original.object), atol=0.01)


def test_missing_trainer_is_reported(bpy, lodgs, root, tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        archive.writestr("meta.json", '{"version": 2, "count": 16}')
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    monkeypatch.setattr(lodgs("runs.environment"), "ready_environments", list)
    with pytest.raises(RuntimeError, match=r"b.sog without the trainer\.\s+Press Install Trainer"):
        bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "b.sog"))
    assert {path.name for path in tmp_path.iterdir()} == {"in.ply", "b.sog"}


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_ksplat_is_imported(bpy, lodgs, tmp_path, compression):
    (tmp_path / "a.ksplat").write_bytes(FILES[compression])
    (imported,) = import_levels(bpy, lodgs, tmp_path / "a.ksplat")
    expected = splats_of_file().means
    np.testing.assert_allclose(means(imported), expected[np.lexsort(expected.round(2).T)], atol=5e-5)


SCRIPT = """
import sys
import zipfile
from pathlib import Path
import numpy as np
from tools import blender_module

folder = blender_module.REPOSITORY = Path(sys.argv[1])
bpy = blender_module.start_blender()
bpy.ops.lodgs.import_splats(filepath=str(folder / "in.ply"))
properties = bpy.ops.lodgs.export_plain.get_rna_type().properties
assert properties["kind"].enum_items[".xyz"].name == "XYZ" and "*.xyz" in properties["filter_glob"].default
assert properties["kind"].default == ".ply"
bpy.ops.lodgs.export_plain(filepath=str(folder / "out.xyz"), source="LEVEL", level=1)
assert len(np.loadtxt(folder / "out.xyz")) == 40
"""


def test_recipe_adds_a_format_to_the_operator(tmp_path):
    copy_checkout(tmp_path, "training")
    (tmp_path / "training/splats/formats/xyz.py").write_text(recipe_code("Add an export format"))
    write_bundle(tmp_path / "in.ply", Bundle("made", [Level(1, splats(40))]))
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path], capture_output=True, text=True, timeout=600, check=False,
        cwd=ROOT,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
