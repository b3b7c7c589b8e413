"""Blender's own PLY importer reads the finest level of LODGS files.

Before Blender 5.3 it creates a mesh with the file's columns as attributes, since 5.3 a point cloud of splats.
"""

import numpy as np
import pytest

from tests.blender.fake_trainer import splats


@pytest.fixture
def bundle(lodgs):
    """Two levels with an extra column; the finest has 700 splats."""
    files, gaussians = lodgs("training.splats.bundle"), lodgs("training.splats.gaussians")
    random = np.random.default_rng(3)

    def splats(count):
        shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 16, 3))
        arrays = [random.standard_normal(shape, dtype=np.float32) for shape in shapes]
        return gaussians.Splats(*arrays, {"decay": np.arange(count, dtype="f4")})

    return files.Bundle(
        "flod", [files.Level(1, splats(50), 0.25), files.Level(2, splats(700), 0.0)], {"gamma": 1.0}
    )


def import_with_blender(bpy, path):
    """Import a PLY with Blender; return positions and a reader of float attributes of its one object."""
    before = set(bpy.data.objects)
    assert bpy.ops.wm.ply_import(filepath=str(path), import_attributes=True) == {"FINISHED"}
    (obj,) = set(bpy.data.objects) - before
    attributes = obj.data.attributes

    def values(name):
        column = np.empty(len(attributes[name].data), np.float32)
        attributes[name].data.foreach_get("value", column)
        return column

    positions = np.empty(3 * len(attributes["position"].data), np.float32)
    attributes["position"].data.foreach_get("vector", positions)
    return positions.reshape(-1, 3), values


@pytest.mark.parametrize("order,number", [("finest_first", 2), ("stream", 1)])
def test_blender_imports_the_first_level_of_a_bundle(bpy, lodgs, tmp_path, bundle, order, number):
    lodgs("training.splats.bundle").write_bundle(tmp_path / "bundle.ply", bundle, order)
    positions, values = import_with_blender(bpy, tmp_path / "bundle.ply")
    check(bpy, lodgs, positions, values, bundle.levels[number - 1].splats)


def test_blender_imports_a_plain_file(bpy, lodgs, tmp_path, bundle):
    lodgs("training.splats.ply").write_ply(tmp_path / "plain.ply", bundle.levels[1].splats)
    positions, values = import_with_blender(bpy, tmp_path / "plain.ply")
    check(bpy, lodgs, positions, values, bundle.levels[1].splats)
    np.testing.assert_array_equal(values("decay"), np.arange(700))


def check(bpy, lodgs, positions, values, splats):
    assert len(positions) == len(splats)
    if lodgs("compat").NATIVE_SPLATS:
        read = lodgs("data.objects").read_splats(bpy.context.object)
        np.testing.assert_array_equal(read.means, splats.means)
        np.testing.assert_array_equal(read.sh, splats.sh)
        np.testing.assert_allclose(read.log_scales, splats.log_scales, atol=1e-6)
        np.testing.assert_allclose(read.opacity_logits, splats.opacity_logits, atol=1e-5)
        unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
        np.testing.assert_allclose(read.quats, unit, atol=1e-6)
        return
    # The importer rotates the axes, so compare sorted absolute coordinates.
    coordinates = np.sort(np.abs(positions), axis=1)
    np.testing.assert_allclose(coordinates, np.sort(np.abs(splats.means), axis=1), rtol=1e-6)
    np.testing.assert_array_equal(values("rot_3"), splats.quats[:, 3])
    np.testing.assert_array_equal(values("f_rest_16"), splats.sh[:, 2, 1])
    np.testing.assert_array_equal(values("opacity"), splats.opacity_logits)


def test_new_level_replaces_an_object_in_edit_mode(bpy, lodgs):
    scenes, bundles = lodgs("data.scenes"), lodgs("training.splats.bundle")
    root = lodgs("data.importing").import_colmap(bpy.context, "examples/lantern_walk", photographs=False)

    def level(count):
        names = ("means", "quats", "log_scales", "opacity_logits", "sh")
        arrays = {name: getattr(splats(count), name) for name in names}
        return bundles.Level(1, lodgs("training.splats.gaussians").Splats(**arrays))

    obj = scenes.set_level(root, level(5)) or root.lodgs.levels[0].object
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="EDIT")
    scenes.set_level(root, level(9))
    assert root.lodgs.levels[0].object == obj and len(obj.data.points) == 9 and obj.mode == "OBJECT"
