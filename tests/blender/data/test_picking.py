"""Picking of splat scenes, compared with the known positions of two scenes."""

from types import SimpleNamespace

import numpy as np
import pytest

from training.splats.gaussians import Splats
from training.splats.levels import Level

SIZE = 200, 100


def one(opacity: float, place) -> Splats:
    return Splats(
        means=np.float32([place]), quats=np.float32([[1, 0, 0, 0]]), log_scales=np.full((1, 3), np.log(0.2)),
        opacity_logits=np.float32([np.log(opacity / (1 - opacity))]), sh=np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip


@pytest.fixture
def scene_of(bpy, lodgs):
    """``scene_of(name, opacity, place)``: a splat scene of one splat at a place."""

    def made(name, opacity, place):
        collection = bpy.data.collections.new(name)
        bpy.context.scene.collection.children.link(collection)
        root = bpy.data.objects.new(name, None)
        collection.objects.link(root)
        root.lodgs.is_root = True
        lodgs("data.scenes").set_level(root, Level(1, one(opacity, place)))
        return root

    return made


@pytest.fixture
def at(bpy, lodgs):
    """What is at a pixel, seen along -z without perspective, 4 units wide and 2 high."""
    from mathutils import Matrix

    view, clip = Matrix.Identity(4), Matrix.Diagonal((0.5, 1, -0.1, 1))

    def found(x, y):
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return lodgs("data.picking").scene_at(depsgraph, None, view, clip, SIZE, (x, y))

    return found


def test_nearest_opaque_scene_is_picked(scene_of, at):
    near, far = scene_of("near", 0.9, (1, 0, 2)), scene_of("far", 0.9, (1, 0, -2))
    assert at(150, 50) == near
    assert at(50, 50) is None and at(150, 95) is None
    near.location.x = -2
    assert at(50, 50) == near and at(150, 50) == far
    near.scale, near.location = (0.1, 0.1, 0.1), (0.9, 0, -0.9)  # the same place but nearer, in other units
    assert at(150, 50) == near


def test_fog_is_not_picked(scene_of, at):
    scene_of("fog", 0.3, (0, 0, 2))
    assert at(100, 50) is None
    behind = scene_of("behind", 0.9, (0, 0, -2))
    assert at(100, 50) == behind


@pytest.fixture
def window(bpy):
    """The 3D viewport: the context of its region."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        yield area.spaces.active


@pytest.mark.parametrize("away", [0.4, 0.6])
def test_unobstructed_mesh_is_picked(bpy, lodgs, scene_of, window, away):
    """Blender's own click has selected it: a ball before the middle, and splats before or behind."""
    looks, region = window.region_3d, bpy.context.region
    eye = looks.view_matrix.inverted().translation
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1, location=eye.lerp(looks.view_location, 0.5))
    ball = bpy.context.active_object
    root = scene_of("splats", 0.9, eye.lerp(looks.view_location, away))
    bpy.context.view_layer.update()
    middle = region.width / 2, region.height / 2
    select, hidden = lodgs("operators.pick").select, away < 0.5
    assert select(bpy.context, middle) == hidden
    assert bpy.context.selected_objects == [root if hidden else ball]
    for obj in (root, ball):  # several: no click has made that alone
        obj.select_set(True)
    assert not select(bpy.context, middle)
    root.select_set(False)
    window.shading.type = "WIREFRAME"  # no splats are drawn, and nothing hides the ball
    assert not select(bpy.context, middle) and bpy.context.selected_objects == [ball]
    ball.select_set(False)
    assert select(bpy.context, middle) and bpy.context.selected_objects == [root]


@pytest.mark.parametrize("tool", ["selects by a click", "selects where it is pressed", "was dragged"])
def test_a_click_on_splats_selects_them_whatever_was_selected(
    bpy, lodgs, scene_of, window, monkeypatch, tool
):
    pick, region = lodgs("operators.pick"), bpy.context.region
    other, root = scene_of("other", 0.9, (50, 0, 0)), scene_of("splats", 0.9, window.region_3d.view_location)
    bpy.context.view_layer.update()

    def blenders_own(at):  # draws, which takes a window
        bpy.ops.object.select_all(action="DESELECT")
        return True

    monkeypatch.setattr(pick, "_blender_click", blenders_own)
    bpy.ops.object.select_all(action="DESELECT")
    if tool == "selects by a click":
        other.select_set(True)
    at = region.width // 2, region.height // 2
    verb = SimpleNamespace(pressed=tool != "selects by a click")
    x, y = at
    event = SimpleNamespace(
        mouse_region_x=x, mouse_region_y=y, mouse_x=x, mouse_y=y,
        mouse_prev_press_x=x - 40 * (tool == "was dragged"), mouse_prev_press_y=y,
    )  # fmt: skip
    done = pick.LODGS_OT_select_clicked.invoke(verb, bpy.context, event)
    assert done == ({"CANCELLED", "PASS_THROUGH"} if tool == "was dragged" else {"FINISHED"})
    assert bpy.context.selected_objects == ([] if tool == "was dragged" else [root])
