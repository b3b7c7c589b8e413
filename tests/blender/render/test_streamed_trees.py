"""Renders of a streamed tree: equal to renders of the fully loaded tree."""

import numpy as np
import pytest

from tests.training.lod.tree.trees import random_leaves, tree_of, write_in_pages

pytestmark = pytest.mark.usefixtures("renderer")
LEAVES, BUDGET = 9000, 3000


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "town.ply"
    write_in_pages(path, tree_of(random_leaves(LEAVES, np.random.default_rng(3), degree=1)))
    return path


@pytest.fixture
def camera(bpy):
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.location, camera.rotation_euler = (3.0, -18.0, 6.0), (1.3, 0, 0.1)
    scene.render.resolution_x, scene.render.resolution_y = 160, 120
    scene.render.resolution_percentage = 100
    return camera


@pytest.fixture
def frame(bpy, lodgs):
    def render(root, pixels=2.0):
        root.lodgs.controls.pixels = pixels
        root.location, root.scale, root.rotation_euler = (0.3, 0.2, -1), (1.2,) * 3, (0.1, 0.2, 0.7)
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        planes = lodgs("render.engine").render_frame(depsgraph, 160, 120, (0, 0, 160, 120)).planes
        return np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2)

    return render


def test_frames_of_a_streamed_tree_are_complete(bpy, lodgs, path, camera, frame):
    """Frames depend neither on the viewport's camera nor on its budget."""
    importing = lodgs("data.importing")
    root = importing.import_splats(bpy.context, path, budget=BUDGET)
    assert sum(len(item.object.data.points) for item in root.lodgs.levels) <= BUDGET
    assert root.lodgs.camera_choice == "VIEW"
    lodgs("data.selection").store_camera(root, (500, 500, 500), 20.0)
    streamed = {pixels: frame(root, pixels) for pixels in (1.0, 8.0)}
    root.lodgs.stream.file = ""
    without_file = frame(root, 1.0)
    lodgs("data.removal").remove(root)
    loaded = importing.import_splats(bpy.context, path)
    assert (loaded.lodgs.camera_choice, loaded.lodgs.stream.file) == ("CAMERA", "")
    for pixels, image in streamed.items():
        np.testing.assert_allclose(image, frame(loaded, pixels), atol=1e-4)
    assert np.abs(without_file - streamed[1.0]).max() > 0.05
    assert np.abs(streamed[8.0] - streamed[1.0]).max() > 0.01


def test_frozen_camera_selects_the_nodes(bpy, lodgs, path, camera, frame):
    importing = lodgs("data.importing")
    images = []
    for budget in (BUDGET, 0):
        root = importing.import_splats(bpy.context, path, budget=budget)
        root.lodgs.camera_choice, root.lodgs.freeze = "CAMERA", True
        lodgs("data.selection").store_camera(root, (9, 9, 1), 100.0)
        images.append(frame(root, 2.0))
        lodgs("data.removal").remove(root)
    np.testing.assert_allclose(*images, atol=1e-4)


def test_missing_file_is_reported(bpy, lodgs, path, camera, frame):
    root = lodgs("data.importing").import_splats(bpy.context, path, budget=BUDGET)
    path.rename(path.with_name("moved.ply"))
    with pytest.raises(lodgs("training.errors").LodgsError, match=r"town\.ply.*Streaming"):
        frame(root)
    root.lodgs.stream.file = str(path.with_name("moved.ply"))
    assert frame(root).max() > 0.1
    write_in_pages(path, tree_of(random_leaves(50, np.random.default_rng(3), degree=1)))


def test_viewport_quality_waits_for_streaming(bpy, lodgs, path, camera, frame):
    gpu = pytest.importorskip("gpu")
    if not hasattr(gpu, "init"):
        pytest.skip("no graphics in background before Blender 5.2")
    sources = lodgs("viewport.sources")
    views = lodgs("viewport.views")
    images = []
    for budget in (16_000, 0):
        root = lodgs("data.importing").import_splats(bpy.context, path, budget=budget)
        frame(root, 20.0)
        lodgs("render.viewport_quality").render(bpy.context)
        if budget:
            assert sources.stream(root).ready and sources.stream(root).splats <= budget
        depsgraph = bpy.context.evaluated_depsgraph_get()
        render = lodgs("render.viewport_quality")._render_frame
        planes = render(depsgraph, 160, 120, (0, 0, 160, 120), lambda *_: True).planes
        images.append(np.stack([planes[f"Combined.{channel}"] for channel in "RGB"], axis=2))
        views.clear()
        sources.close_streams()
        lodgs("data.removal").remove(root)
    np.testing.assert_allclose(*images, atol=2e-3)
    assert images[0].max() > 0.1
