"""Training cells of a large scene in the viewport."""

import numpy as np
import pytest


@pytest.fixture
def root(bpy, lodgs):
    """Create two adjacent cells with one view each."""
    camera = lodgs("training.scenes.cameras").Camera
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        root.lodgs.cameras = bpy.data.collections.new("cameras")
        bpy.context.scene.collection.children.link(root.lodgs.cameras)
        for index in range(2):
            pose = np.eye(4)
            pose[:3, 3] = -np.array([2.0 * index, 1, 3])
            view = lodgs("data.photographs").new_camera(
                camera(f"{index}.jpg", 40, 20, 80, 40, 20, 10, pose), 10.0, 0.1, photograph=False
            )
            view.parent, view.data.lodgs.model_index = root, index
            root.lodgs.cameras.objects.link(view)
    settings = root.lodgs.training
    for index, (a, b) in enumerate([(-8.0, 0.0), (0.0, 8.0)]):
        cell = settings.planned_cells.add()
        cell.outline = np.ravel([(a, -4, 0), (b, -4, 0), (b, 4, 0), (a, 4, 0)])
        cell.enlarged = np.ravel([(a - 1, -5, 0), (b + 1, -5, 0), (b + 1, 5, 0), (a - 1, 5, 0)])
        cell.view_indices = str([index])
    bpy.context.view_layer.update()
    return root


@pytest.fixture
def draw_cells(bpy, lodgs, frame):
    """``draw_cells()``: draw the cells from above, (64, 64, 4), 20 units wide."""
    import gpu
    from mathutils import Matrix

    def draw():
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_identity()
            gpu.matrix.load_projection_matrix(Matrix.Diagonal((0.1, 0.1, 0.01, 1)))
            lodgs("viewport.cells").draw(bpy.context.scene)

    return lambda: frame(64, draw)


def test_frames_of_cell_cameras_match_their_views(lodgs, root):
    cell = root.lodgs.training.planned_cells[0]
    positions, corners = lodgs("data.cells").cell_cameras(root, cell)
    np.testing.assert_allclose(positions, [[0, 1, 3]], atol=1e-6)
    distance = 10.0 / 20  # display size of the camera
    # 40x20 pixels, focal lengths 80 and 40; the view looks along z with y down
    truth = positions[0] + distance * np.array(
        [(-0.25, -0.25, 1), (0.25, -0.25, 1), (0.25, 0.25, 1), (-0.25, 0.25, 1)]
    )
    np.testing.assert_allclose(corners, truth[None], atol=1e-6)
    cell.view_indices = "[7]"  # its camera was deleted
    positions, corners = lodgs("data.cells").cell_cameras(root, cell)
    assert positions.shape == (0, 3) and corners.shape == (0, 4, 3)


def test_cells_have_colours_and_the_active_one_is_filled(lodgs, root, draw_cells):
    settings, color = root.lodgs.training, lodgs("training.splats.level_colors").level_color
    image = draw_cells()
    inside = {1: image[32, 20, :3], 2: image[32, 44, :3]}
    assert inside[1].any() and not inside[2].any(), "only the active cell is filled"
    for number, column in ((1, 7), (2, 57)):  # outer borders at -8 and 8
        border = image[28:36, column - 1 : column + 2, :3].max(axis=(0, 1))
        np.testing.assert_allclose(border, color(number), atol=0.15)
    settings.active_cell = 1
    image = draw_cells()
    assert not image[32, 20, :3].any() and image[32, 44, :3].any()
    settings.show_cells = False
    assert not draw_cells().any()
    settings.show_cells = True
    settings.planned_cells.clear()
    assert not draw_cells().any()
