"""Points in Solid shading, drawn offscreen."""

import numpy as np
import pytest

from training.splats.gaussians import Splats
from training.splats.levels import Level

SIZE = 64
WHITE, RED, GREEN = (255, 255, 255), (255, 0, 0), (0, 255, 0)


@pytest.fixture
def draw_points(bpy, lodgs, frame):
    """``draw_points(clouds)``: linear colours (SIZE, SIZE, 4) along -z, 2 units wide, bottom row first."""
    from mathutils import Matrix

    view, projection = Matrix.Translation((0, 0, -5)), Matrix.Diagonal((1, 1, -0.1, 1))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return lambda clouds: frame(
        SIZE, lambda: lodgs("viewport.discs").draw(clouds, depsgraph, view, projection, SIZE)
    )


def _points(bpy, lodgs, positions, colors, radius):
    obj = lodgs("data.objects").new_points("p", np.float32(positions), np.uint8(colors), radius)
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    return obj


def _placed(obj, tint=(0, 0, 0, 0)):
    return [(obj, obj.matrix_world, tint)]


def test_discs_match_colour_position_and_size(bpy, lodgs, draw_points):
    obj = _points(bpy, lodgs, [(-0.5, 0.5, 0), (0.5, -0.5, 0)], [RED, (0, 0, 188)], 0.25)
    image = draw_points(_placed(obj))
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) * 2 / SIZE - 1
    red, blue = (np.hypot(x - a, y - b) for a, b in ((-0.5, 0.5), (0.5, -0.5)))
    pixel = 2 / SIZE
    assert (image[red < 0.25] == (1, 0, 0, 1)).all()
    assert np.allclose(image[blue < 0.25], (0, 0, ((188 / 255 + 0.055) / 1.055) ** 2.4, 1), atol=1e-5)
    assert (image[np.minimum(red, blue) > 0.25 + 2 * pixel] == 0).all()


def test_nearer_points_occlude_and_changes_are_drawn(bpy, lodgs, draw_points):
    obj = _points(bpy, lodgs, [(0, 0, 1), (0, 0, 0)], [RED, GREEN], 0.3)
    middle = SIZE // 2
    assert tuple(draw_points(_placed(obj))[middle, middle]) == (1, 0, 0, 1)
    obj.data.attributes["position"].data.foreach_set("vector", np.float32([0, 0, 0, 0, 0, 1]))
    obj.data.update_tag()
    bpy.context.view_layer.update()
    assert tuple(draw_points(_placed(obj))[middle, middle]) == (0, 1, 0, 1)
    obj.location.x = 0.7  # moves without a new upload
    bpy.context.view_layer.update()
    assert draw_points(_placed(obj))[middle, middle, 3] == 0


def test_tints_colour_points(bpy, lodgs, draw_points):
    obj = _points(bpy, lodgs, [(0, 0, 0)], [WHITE], 0.3)
    image = draw_points(_placed(obj, (1, 0.5, 0, 1)))[SIZE // 2, SIZE // 2]
    assert image == pytest.approx((1, 0.5**2.2, 0, 1), abs=1e-4)


def test_instances_of_a_scene_are_points(bpy, lodgs, instance_of):
    """Blender draws the points of instances in grey, too."""
    collection = bpy.data.collections.new("scene")
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new("scene", None)
    collection.objects.link(root)
    root.lodgs.is_root = True
    splats = Splats(
        means=np.zeros((1, 3)), quats=np.float32([[1, 0, 0, 0]]), log_scales=np.zeros((1, 3)),
        opacity_logits=np.zeros(1), sh=np.zeros((1, 1, 3)),
    )  # fmt: skip
    lodgs("data.scenes").set_level(root, Level(1, splats))
    level = root.lodgs.levels[0].object
    carrier = instance_of(lodgs("data.roots").levels_collection(root), (3, 0, 0))
    window = bpy.context.window_manager.windows[0]
    space = next(area.spaces.active for area in window.screen.areas if area.type == "VIEW_3D")

    def visible(levels=True):
        depsgraph = bpy.context.evaluated_depsgraph_get()
        points = lodgs("viewport").visible_points(depsgraph, space, levels)
        return sorted((obj.name, matrix.translation.x) for obj, matrix, _ in points)

    assert visible() == [(level.name, 0), (level.name, 3)]
    assert visible(levels=False) == []
    level.hide_set(True)
    assert visible() == [(level.name, 3)]
    carrier.hide_set(True)
    assert visible() == []
