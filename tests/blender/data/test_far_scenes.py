"""Georeferenced scenes in Blender: shown about a local origin, and exported at the original place."""

import json
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from training.scenes.cameras import read_camera
from training.scenes.colmap import read_scene
from training.scenes.lenses import make_intrinsics
from training.scenes.write_colmap import write_model
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle, Level

from ..fake_trainer import COUNTS, ORIGIN, splats

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
OFFSET = np.array(ORIGIN)
META = {"origin": OFFSET.tolist()}


@pytest.fixture(scope="module")
def far(tmp_path_factory) -> Path:
    """The garden moved in float64, with links to its photos."""
    folder = tmp_path_factory.mktemp("far")
    (folder / "images").symlink_to(GARDEN / "images")
    scene = read_scene(GARDEN)
    cameras = [camera.moved(OFFSET) for camera in scene.cameras]
    lenses = [
        make_intrinsics("PINHOLE", c.width, c.height, np.array([c.fx, c.fy, c.cx, c.cy])) for c in cameras
    ]
    poses = [(camera.name, camera.world_to_camera) for camera in cameras]
    write_model(folder / "sparse" / "0", lenses, poses, scene.points + OFFSET, scene.point_colors)
    return folder


def positions(obj) -> np.ndarray:
    values = np.empty(3 * len(obj.data.points), np.float32)
    obj.data.attributes["position"].data.foreach_get("vector", values)
    return values.reshape(-1, 3)


def test_scene_is_imported_near_0_and_keeps_its_origin(bpy, lodgs, far, capfd, tmp_path):
    assert bpy.ops.lodgs.import_colmap(directory=str(far)) == {"FINISHED"}
    assert "relative to the local origin (500000, 4200000, 300)" in capfd.readouterr().out
    root, truth = lodgs("data.roots").active_root(bpy.context), read_scene(GARDEN)
    np.testing.assert_allclose(positions(root.lodgs.points), truth.points, atol=1e-5)
    for view, camera in zip(lodgs("data.photographs").views(root), truth.cameras, strict=True):
        np.testing.assert_allclose(view.matrix_basis.to_translation(), camera.center, atol=1e-5)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    root = lodgs("data.roots").active_root(bpy.context)
    assert lodgs("data.metadata").origin_of(root).tolist() == OFFSET.tolist()


def test_exported_cameras_have_the_original_place(bpy, lodgs, far, tmp_path):
    lodgs("data.importing").import_colmap(bpy.context, far, photographs=False)
    assert bpy.ops.lodgs.export_camera(filepath=str(tmp_path / "a.json")) == {"FINISHED"}
    name = bpy.context.scene.camera.name
    expected = next(camera for camera in read_scene(GARDEN).cameras if camera.name == name)
    np.testing.assert_allclose(
        read_camera(tmp_path / "a.json")[0].center, expected.center + OFFSET, rtol=0, atol=1e-5
    )


def test_levels_of_another_origin_are_rejected(bpy, lodgs, far):
    root = lodgs("data.importing").import_colmap(bpy.context, far, photographs=False)
    scenes, error = lodgs("data.scenes"), lodgs("training.errors").LodgsError
    with pytest.raises(error, match="local origin"):
        scenes.set_bundle_facts(root, Bundle("3dgs", []))
    scenes.set_bundle_facts(root, Bundle("3dgs", [], meta=META))


@pytest.mark.one_blender
def test_levels_arrive_while_training(bpy, lodgs, far, fake, tmp_path):
    root = lodgs("data.importing").import_colmap(bpy.context, far, photographs=False)
    fake("far")
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "run")) == {"FINISHED"}
    assert [len(item.object.data.points) for item in root.lodgs.levels] == list(COUNTS.values())
    np.testing.assert_array_equal(positions(root.lodgs.levels[1].object), splats(COUNTS[2]).means)
    assert lodgs("data.metadata").origin_of(root).tolist() == ORIGIN
    fake()  # a trainer that ignores the origin
    with pytest.raises(RuntimeError, match="local origin"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "other"))
    assert lodgs("data.metadata").origin_of(root).tolist() == ORIGIN


def test_exports_name_the_origin_or_add_it(bpy, lodgs, tmp_path, capfd):
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats(50))], meta=META))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    assert json.loads(root.lodgs.meta)["origin"] == OFFSET.tolist()
    local, original, placed = (tmp_path / f"{name}.ply" for name in ("local", "there", "placed"))
    assert bpy.ops.lodgs.export_plain(filepath=str(local)) == {"FINISHED"}
    assert "relative to the local origin" in capfd.readouterr().out
    assert read_bundle(local).origin.tolist() == OFFSET.tolist()
    assert bpy.ops.lodgs.export_plain(filepath=str(original), original_place=True) == {"FINISHED"}
    vertex = PlyData.read(original)["vertex"]
    expected = splats(50).means.astype(np.float64) + OFFSET
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), expected)
    assert bpy.ops.lodgs.export_bundle(filepath=str(placed), placed=True) == {"FINISHED"}
    assert not read_bundle(placed).origin.any()
    with pytest.raises(RuntimeError, match="As Placed"):
        bpy.ops.lodgs.export_plain(filepath=str(original), original_place=True, placed=True)
