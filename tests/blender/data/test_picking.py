"""Picking of splat scenes at known positions."""

from types import SimpleNamespace

import numpy as np
import pytest

from training.splats.gaussians import Splats
from training.splats.levels import Level

SIZE = 200, 100


def single_splat(opacity: float, position) -> Splats:
    return Splats(
        means=np.float32([position]), quats=np.float32([[1, 0, 0, 0]]),
        log_scales=np.full((1, 3), np.log(0.2)), opacity_logits=np.float32([np.log(opacity / (1 - opacity))]),
        sh=np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip


@pytest.fixture
def scene_of(bpy, lodgs):
    """``scene_of(name, opacity, position)``: return the root of a scene with one splat."""

    def make(name, opacity, position):
        collection = bpy.data.collections.new(name)
        bpy.context.scene.collection.children.link(collection)
        root = bpy.data.objects.new(name, None)
        collection.objects.link(root)
        root.lodgs.is_root = True
        lodgs("data.scenes").set_level(root, Level(1, single_splat(opacity, position)))
        return root

    return make


@pytest.fixture
def pick(bpy, lodgs):
    """``pick(x, y)``: pick a scene in an orthographic view along -z, 4 units wide and 2 high."""
    from mathutils import Matrix

    view, clip = Matrix.Identity(4), Matrix.Diagonal((0.5, 1, -0.1, 1))

    def pick_at(x, y):
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return lodgs("data.picking").scene_at(depsgraph, None, view, clip, SIZE, (x, y))

    return pick_at


def test_nearest_opaque_scene_is_picked(scene_of, pick):
    near, far = scene_of("near", 0.9, (1, 0, 2)), scene_of("far", 0.9, (1, 0, -2))
    assert pick(150, 50) == near
    assert pick(50, 50) is None and pick(150, 95) is None
    near.location.x = -2
    assert pick(50, 50) == near and pick(150, 50) == far
    near.scale, near.location = (0.1, 0.1, 0.1), (0.9, 0, -0.9)  # nearer, and in other units
    assert pick(150, 50) == near


def test_fog_is_not_picked(scene_of, pick):
    scene_of("fog", 0.3, (0, 0, 2))
    assert pick(100, 50) is None
    opaque = scene_of("opaque", 0.9, (0, 0, -2))
    assert pick(100, 50) == opaque


@pytest.fixture
def window(bpy):
    """Override the context with the region of the 3D viewport and return its space."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        yield area.spaces.active


@pytest.mark.parametrize("fraction", [0.4, 0.6])
def test_unobstructed_mesh_is_picked(bpy, lodgs, scene_of, window, fraction):
    """Blender selected a ball; splats are in front of it or behind it."""
    view, region = window.region_3d, bpy.context.region
    camera = view.view_matrix.inverted().translation
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1, location=camera.lerp(view.view_location, 0.5))
    ball = bpy.context.active_object
    root = scene_of("splats", 0.9, camera.lerp(view.view_location, fraction))
    bpy.context.view_layer.update()
    middle = region.width / 2, region.height / 2
    select, hidden = lodgs("operators.pick").select, fraction < 0.5
    assert select(bpy.context, middle) == hidden
    assert bpy.context.selected_objects == [root if hidden else ball]
    for obj in (root, ball):  # a selection of several objects was not a click
        obj.select_set(True)
    assert not select(bpy.context, middle)
    root.select_set(False)
    window.shading.type = "WIREFRAME"  # draws no splats, so nothing hides the ball
    assert not select(bpy.context, middle) and bpy.context.selected_objects == [ball]
    ball.select_set(False)
    assert select(bpy.context, middle) and bpy.context.selected_objects == [root]


@pytest.mark.parametrize("event_type", ["click", "press", "drag"])
def test_click_on_splats_replaces_the_selection(bpy, lodgs, scene_of, window, monkeypatch, event_type):
    pick, region = lodgs("operators.pick"), bpy.context.region
    other, root = scene_of("other", 0.9, (50, 0, 0)), scene_of("splats", 0.9, window.region_3d.view_location)
    bpy.context.view_layer.update()

    def blender_click(pixel):  # Blender's own click needs a window
        bpy.ops.object.select_all(action="DESELECT")
        return True

    monkeypatch.setattr(pick, "_blender_click", blender_click)
    bpy.ops.object.select_all(action="DESELECT")
    if event_type == "click":
        other.select_set(True)
    operator = SimpleNamespace(pressed=event_type != "click")
    x, y = region.width // 2, region.height // 2
    event = SimpleNamespace(
        mouse_region_x=x, mouse_region_y=y, mouse_x=x, mouse_y=y,
        mouse_prev_press_x=x - 40 * (event_type == "drag"), mouse_prev_press_y=y,
    )  # fmt: skip
    result = pick.LODGS_OT_select_clicked.invoke(operator, bpy.context, event)
    assert result == ({"CANCELLED", "PASS_THROUGH"} if event_type == "drag" else {"FINISHED"})
    assert bpy.context.selected_objects == ([] if event_type == "drag" else [root])
