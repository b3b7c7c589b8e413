"""Renders of cropped and hidden splats: equal to renders of the remaining splats."""

import numpy as np
import pytest

from tests.training.editing.test_cleaning import bundle_of
from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages
from training.lod.crop import Crop
from training.splats.bundle import write_bundle


@pytest.fixture
def camera(bpy):
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.location, camera.rotation_euler = (2, -20.0, 1.0), (1.5, 0, 0.1)
    scene.render.resolution_x, scene.render.resolution_y = 96, 64
    scene.render.resolution_percentage = 100
    return camera


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize("name", ["bands", "octree", "chunks", "decay"])
@pytest.mark.parametrize("mode", ["SINGLE", "SELECTIVE"])
def test_frames_show_the_remaining_splats(bpy, lodgs, camera, tmp_path, name, mode):
    bundle = bundle_of(name, np.random.default_rng(0))
    for level in bundle.levels:
        level.splats.sh[:] *= 0.2
    write_bundle(tmp_path / "in.ply", bundle)
    importing, engine = lodgs("data.importing"), lodgs("render.engine")

    def frame(root):
        root.lodgs.mode, root.lodgs.single_level = mode, 3
        root.location, root.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.7)
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        planes = engine.render_frame(depsgraph, 96, 64, (0, 0, 96, 64)).planes
        return np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2)

    root = importing.import_splats(bpy.context, tmp_path / "in.ply", upright=False)
    full = frame(root)
    bpy.ops.lodgs.add_crop(shape="SPHERE")
    crop = bpy.context.active_object
    crop.location, crop.scale = (1, -1, 0.5), (4, 5, 3)
    bpy.ops.lodgs.hide_splats(test="LARGE", size=0.3)
    cropped = frame(root)
    crop.location.x += 2
    moved = frame(root)
    crop.location.x -= 2
    np.testing.assert_array_equal(frame(root), cropped)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    lodgs("data.removal").remove(root)
    exported = frame(importing.import_splats(bpy.context, tmp_path / "out.ply", upright=False))
    np.testing.assert_allclose(cropped, exported, atol=1e-5)
    assert np.abs(full - cropped).max() > 0.05 and np.abs(moved - cropped).max() > 0.05


@pytest.mark.usefixtures("renderer")
def test_streamed_tree_is_cropped(bpy, lodgs, camera, tmp_path):
    write_in_pages(tmp_path / "tree.ply", tree_of(random_leaves(6000, np.random.default_rng(3), degree=1)))
    importing, engine = lodgs("data.importing"), lodgs("render.engine")

    def frame(root):
        root.lodgs.controls.pixels = 0.1  # leaves
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        planes = engine.render_frame(depsgraph, 96, 64, (0, 0, 96, 64)).planes
        return np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2)

    images = []
    for budget in (3000, 0):
        root = importing.import_splats(bpy.context, tmp_path / "tree.ply", budget=budget, upright=False)
        assert bool(lodgs("data.streams").file_of(root)) == bool(budget)
        full = frame(root)
        bpy.ops.lodgs.add_crop(shape="BOX")
        box = bpy.context.active_object
        box.location, box.scale = (0.5, -1, 0), (3, 2, 2)
        images.append(frame(root))
        if budget:
            placed = engine.placed_splats(bpy.context.evaluated_depsgraph_get())
            (crop,) = placed[0].query.crops
            assert isinstance(placed[0], lodgs("render.renderer").PlacedFile)
            assert (crop.shape, crop.outside) == ("BOX", False)
            expected = Crop.from_matrix("BOX", np.array(box.matrix_world))
            np.testing.assert_allclose(crop.to_local, expected.to_local, rtol=1e-5)
        lodgs("data.removal").remove(root)
        assert "Crop Box" not in bpy.data.objects
    np.testing.assert_allclose(*images, atol=1e-4)
    assert np.abs(full - images[0]).max() > 0.05
