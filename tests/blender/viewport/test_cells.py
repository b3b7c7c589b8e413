"""The cells of a large scene, as the viewport shows them on its ground."""

import numpy as np
import pytest


@pytest.fixture
def root(bpy, lodgs):
    """Two cells side by side, and two views: the first cell's sees ahead, the other's is none of ours."""
    camera = lodgs("training.scenes.cameras").Camera
    with lodgs("data.scenes").new_scene(bpy.context, "scene") as root:
        root.lodgs.cameras = bpy.data.collections.new("cameras")
        bpy.context.scene.collection.children.link(root.lodgs.cameras)
        for place in range(2):
            pose = np.eye(4)
            pose[:3, 3] = -np.array([2.0 * place, 1, 3])
            view = lodgs("data.photographs").new_camera(
                camera(f"{place}.jpg", 40, 20, 80, 40, 20, 10, pose), 10.0, 0.1, photograph=False
            )
            view.parent, view.data.lodgs.place = root, place
            root.lodgs.cameras.objects.link(view)
    settings = root.lodgs.training
    for place, (a, b) in enumerate([(-8.0, 0.0), (0.0, 8.0)]):
        cell = settings.planned_cells.add()
        cell.outline = np.ravel([(a, -4, 0), (b, -4, 0), (b, 4, 0), (a, 4, 0)])
        cell.enlarged = np.ravel([(a - 1, -5, 0), (b + 1, -5, 0), (b + 1, 5, 0), (a - 1, 5, 0)])
        cell.places = str([place])
    bpy.context.view_layer.update()
    return root


@pytest.fixture
def drawn(bpy, lodgs, frame):
    """What is drawn, seen from above: (64, 64, 4), 20 units wide."""
    import gpu
    from mathutils import Matrix

    def draw():
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_identity()
            gpu.matrix.load_projection_matrix(Matrix.Diagonal((0.1, 0.1, 0.01, 1)))
            lodgs("viewport.cells").draw(bpy.context.scene)

    return lambda: frame(64, draw)


def test_cameras_of_a_cell_are_framed_as_they_see(lodgs, root):
    cell = root.lodgs.training.planned_cells[0]
    eyes, corners = lodgs("data.cells").eyes(root, cell)
    np.testing.assert_allclose(eyes, [[0, 1, 3]], atol=1e-6)
    away = 10.0 / 20  # as large as the camera shows itself
    # 40 by 20 pixels of focal lengths 80 and 40; it looks along z, with y downwards
    truth = eyes[0] + away * np.array(
        [(-0.25, -0.25, 1), (0.25, -0.25, 1), (0.25, 0.25, 1), (-0.25, 0.25, 1)]
    )
    np.testing.assert_allclose(corners, truth[None], atol=1e-6)
    cell.places = "[7]"  # whose camera was deleted
    eyes, corners = lodgs("data.cells").eyes(root, cell)
    assert eyes.shape == (0, 3) and corners.shape == (0, 4, 3)


def test_cells_are_drawn_in_their_colours_and_the_chosen_one_is_marked(lodgs, root, drawn):
    settings, color = root.lodgs.training, lodgs("training.lod.colors").level_color
    picture = drawn()
    inside = {1: picture[32, 20, :3], 2: picture[32, 44, :3]}
    assert inside[1].any() and not inside[2].any(), "the ground of the chosen one is tinted"
    for number, column in ((1, 7), (2, 57)):  # their far borders, at -8 and 8
        found = picture[28:36, column - 1 : column + 2, :3].max(axis=(0, 1))
        np.testing.assert_allclose(found, color(number), atol=0.15)
    settings.active_cell = 1
    picture = drawn()
    assert not picture[32, 20, :3].any() and picture[32, 44, :3].any()
    settings.show_cells = False
    assert not drawn().any()
    settings.show_cells = True
    settings.planned_cells.clear()
    assert not drawn().any()
