"""Script of ``make window WALK=1``: from photos to a rendered shot in Blender, as in the artists' guide.

``tools/window.py --walk`` runs it inside Blender, as ``window_tour``. All edits of splats are undone step by
step and redone.
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.rig import LANTERN
from tools.window_actions import (
    OUT,
    PLAN,
    Steps,
    changed_share,
    click_at,
    drag,
    look_from,
    module,
    open_panels,
    press,
    press_f12,
    region,
    scene_root,
    screenshot,
    scroll,
    settle,
    start,
    type_in,
    until,
    viewport,
    window_pixel,
    world_position,
)

JOB = {"max_splats": 60_000, "steps": (150, 250, 300, 450, 1000)} if PLAN["long"] else {
    "max_splats": 20_000, "levels": 3, "steps": (60, 90, 800), "densify_until": (0.5,) * 3,
    "densify_interval": (20,) * 3, "budget_ratio": 0.35, "footprint": 8.0,
}  # fmt: skip
TABLE_TOP, TABLE_ENDS = 0.78, ((-0.95, 0.0), (0.95, 0.0))
"""Height and ends of the example's table, in metres, in the coordinates of ``LANTERN``."""
PUMPKIN, FIGURE = (-0.2, 0.1, 0.87), (-0.36, -0.22)
"""Positions of the brush stroke, and of the added figure on the table."""


def walk() -> Steps:
    """Run all steps. A failed assertion ends the script with its message."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.placement", "panels.clean_up", "panels.look", "panels.rendering")
    viewport()[0].spaces.active.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    yield from settle()
    screenshot("empty")
    press("lodgs.import_colmap", directory=PLAN["scene"])
    yield from settle()
    screenshot("imported")
    yield from train()
    yield from search()
    initial = state()
    steps = yield from edit()
    yield from undo(steps, initial)
    yield from click()
    yield from shoot()


def train() -> Steps:
    jobs, status, root = module("runs.jobs"), module("panels.status"), scene_root()
    watch = jobs.start(root, PLAN["run"], JOB)
    jobs.follow(watch)
    yield from until(lambda: not watch.running or len(watch.levels) >= 1, 900)
    yield from settle()
    screenshot("training", watch.message)
    yield from until(lambda: not watch.running, 1200)
    assert watch.state == "done", watch.problem or watch.message
    root.lodgs.cameras.hide_viewport = True
    root.lodgs.points.hide_set(True)
    press("ed.undo_push", message="Hide")
    yield from settle()
    with_notice = screenshot("trained", f"{len(root.lodgs.levels)} levels")
    visible = bool(status.visible_work(time.monotonic()))  # False if drawing took longer than the notice
    yield from until(lambda: not status.visible_work(time.monotonic()), 200)
    yield 2.0
    without_notice = screenshot("notice-gone", redraw_first=False)
    changed = changed_share(with_notice, without_notice, part="STATUSBAR")
    assert not visible or changed > 0, "The notice does not disappear."


def search() -> Steps:
    """Find operators in Blender's search by their names."""
    for word in ("worst", "ground"):
        press("wm.search_menu", mode="INVOKE_DEFAULT")
        yield 0.5
        yield from type_in(word)
        yield from settle()
        screenshot(f"search-{word}")
        yield from type_in("\x1b")


def edit() -> Steps:
    """Place, crop and clean the splats; return the number of undo steps."""
    look_from(world_position(-1.7, -2.5, 1.15), world_position(0.0, 0.3, 0.8))
    press("lodgs.set_ground", by="DETECT")
    for number, (x, y) in enumerate(TABLE_ENDS):
        press("object.empty_add", mode="EXEC_DEFAULT", radius=0.1, location=world_position(x, y, TABLE_TOP))
        bpy.context.active_object.name = f"Table {number + 1}"
    ends = [obj for obj in bpy.context.scene.objects if obj.name.startswith("Table")]
    for obj in (*ends, root := scene_root()):
        obj.select_set(True)
    bpy.context.view_layer.objects.active = root
    press("ed.undo_push", message="Select")
    scroll(16)
    yield from settle()
    window = bpy.context.window_manager.windows[0]
    window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=430, y=560)
    press("lodgs.set_scale", mode="INVOKE_DEFAULT")
    yield from settle()
    screenshot("scale")
    yield from type_in("\r")
    press("lodgs.set_scale", length=1.9)
    yield from settle()
    low = min(world_position(x, y, 0).z for x, y in TABLE_ENDS)
    assert abs(low) < 0.05, f"The table is {low:.2f} m above the ground."
    screenshot("placed", f"the lantern is {world_position(*LANTERN).z:.2f} m above the ground")

    press("lodgs.add_crop", shape="SPHERE")
    crop = bpy.context.active_object
    crop.matrix_world.translation, crop.scale = world_position(0.0, 0.05, 0.8), [1.4] * 3
    press("ed.undo_push", message="Scale")
    press("lodgs.hide_splats", test="FLOATERS")
    scroll(26)
    yield from settle()
    screenshot("cropped", remaining())

    look_from(world_position(-0.5, -1.7, 1.35), world_position(-0.05, 0.1, 0.9))
    press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name="lodgs.brush")
    yield from settle()
    x, y = window_pixel(*PUMPKIN)
    yield from drag([(x + offset, y) for offset in (-30, -10, 10, 30)])
    yield from settle()
    selected = sum(module("data.cleaning").count_selected(scene_root()).values())
    assert selected, "The brush selects no splats."
    screenshot("brushed", f"{selected:,} splats selected")
    press("lodgs.hide_splats", test="SELECTED")
    press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name="builtin.select_box")
    yield from settle()
    screenshot("brushed-away", remaining())
    return 11


def undo(steps: int, initial: tuple) -> Steps:
    edited = state()
    for _ in range(steps):
        press("ed.undo", mode="EXEC_DEFAULT")
    yield from settle()
    assert state() == initial, "Undo does not restore the initial state."
    screenshot("undone", remaining())
    for _ in range(steps):
        press("ed.redo", mode="EXEC_DEFAULT")
    yield from settle()
    assert state() == edited, "Redo does not restore the edited state."
    screenshot("redone", remaining())


def state() -> tuple:
    """Return the state that editing changes."""
    bpy.context.view_layer.update()
    root = scene_root()
    counts = module("data.cleaning").count_remaining(root, bpy.context.evaluated_depsgraph_get())
    names = sorted(obj.name for obj in bpy.data.objects)
    return counts, [*map(tuple, root.lodgs.axes.matrix_world)], names


def remaining() -> str:
    counts = state()[0]
    return ", ".join(f"level {n}: {count:,} of {total:,} splats" for n, (count, total) in counts.items())


def click() -> Steps:
    """Check clicks: empty space deselects, splats select their scene, a mesh in front selects the mesh."""
    look_from(world_position(-1.0, -4.5, 2.2), world_position(0.3, 0.1, 0.7))
    yield from settle()
    press("mesh.primitive_cube_add", mode="EXEC_DEFAULT", size=0.2, location=world_position(0.0, 0.9, 0.8))
    cube = bpy.context.active_object
    lantern = window_pixel(*LANTERN)
    empty = region().x + 120, region().y + 3 * region().height // 5  # left of the cropped scene
    for pixel, expected in ((empty, None), (lantern, scene_root())):
        yield from click_at(*pixel)
        selected = bpy.context.view_layer.objects.selected[:]
        assert selected == ([expected] if expected else []), f"A click at {pixel} selects {selected}."
    position = viewport()[1].view_matrix.inverted().translation
    cube.location = position.lerp(world_position(*LANTERN), 1.1)
    yield from settle()
    yield from click_at(*empty)
    yield from click_at(*lantern)
    assert bpy.context.view_layer.objects.selected[:] == [scene_root()], (
        "The mesh behind the splats is selected."
    )
    screenshot("clicked")
    cube.location = position.lerp(world_position(*LANTERN), 0.8)
    yield from settle()
    yield from click_at(*lantern)
    assert bpy.context.view_layer.objects.selected[:] == [cube], (
        "The mesh in front of the splats is not selected."
    )
    cube.location = position.lerp(world_position(*LANTERN), 1.1)
    for tool in ("builtin.select", "builtin.move", "builtin.select_box"):
        cube.select_set(True)
        press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name=tool)
        yield from settle()
        yield from click_at(*lantern)
        selected = bpy.context.view_layer.objects.selected[:]
        assert selected == [scene_root()], f"With {tool} a click on splats selects {selected}."
    bpy.data.objects.remove(cube)


def shoot() -> Steps:
    """Darken the surroundings with a look; then add a figure to the table and render both."""
    root, scene = scene_root(), bpy.context.scene
    for crop in module("data.crops").crops_of(root):
        crop.lodgs_crop.use = False
    press("lodgs.show_hidden_splats")
    look_from(world_position(-0.55, -2.6, 1.5), world_position(0.05, 0.3, 1.0))
    press("lodgs.add_crop", shape="SPHERE", keep="ALL")
    crop = bpy.context.active_object
    crop.matrix_world.translation, crop.scale = world_position(0.0, 0.05, 0.75), [1.05, 0.75, 0.7]
    look = crop.lodgs_look
    look.outside, look.exposure, look.saturation, look.temperature = True, -1.6, 0.35, 5200
    scroll(14)
    yield from settle()
    screenshot("looked")
    look.outside = False
    press("lodgs.reset_look", name=crop.name)
    bpy.data.objects.remove(crop)

    set_figure()
    set_lights()
    press("lodgs.use_engine")
    press("lodgs.combine_with_meshes")
    scene.lodgs_render.meshes.cycles.samples = 96 if PLAN["long"] else 16
    root.lodgs.active_view = 4
    press("lodgs.look_through", step=0)
    scene.render.resolution_percentage = 200
    press("lodgs.combine_with_meshes")
    view = viewport()[1]
    view.view_perspective, view.view_camera_zoom, view.view_camera_offset = "CAMERA", 10, (0.12, 0)
    scroll(60)
    yield from settle()
    screenshot("shot")
    bpy.context.preferences.view.render_display_type = "AREA"  # this display has no window manager
    assert (yield from press_f12(600)) == "complete", "F12 was cancelled."
    bpy.data.images["Render Result"].save_render(str(OUT / "shot.png"))
    yield from settle()
    screenshot("f12")


def set_figure() -> None:
    """Add a glazed figure on the table, and a shadow catcher below it."""
    size = 0.11
    press("mesh.primitive_monkey_add", mode="EXEC_DEFAULT", size=2 * size)
    figure = bpy.context.active_object
    figure.location = world_position(*FIGURE, TABLE_TOP + 0.9 * size)
    figure.rotation_euler = math.radians(-28), 0, math.radians(12)
    figure.modifiers.new("Smooth", "SUBSURF").render_levels = 3
    press("object.shade_smooth", mode="EXEC_DEFAULT")
    glaze = bpy.data.materials.new("Glaze")
    glaze.use_nodes = True
    shader = next(node for node in glaze.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = 0.01, 0.16, 0.2, 1
    shader.inputs["Roughness"].default_value = 0.18
    figure.data.materials.append(glaze)
    press("mesh.primitive_plane_add", mode="EXEC_DEFAULT", size=0.6)
    catcher = bpy.context.active_object
    catcher.location, catcher.is_shadow_catcher = world_position(*FIGURE, TABLE_TOP + 0.004), True
    catcher.hide_set(True)


def set_lights() -> None:
    """Add lights as in the photos: a low warm sun from behind left, a blue sky, the lantern's glow."""
    for kind, energy, color, position in (
        ("SUN", 3.0, (1.0, 0.72, 0.44), (-2.0, -2.5, 2.2)),
        ("POINT", 4.0, (1.0, 0.6, 0.2), (LANTERN[0], LANTERN[1] - 0.1, LANTERN[2])),
    ):
        data = bpy.data.lights.new(kind.title(), kind)
        data.energy, data.color = energy, color
        light = bpy.data.objects.new(data.name, data)
        bpy.context.scene.collection.objects.link(light)
        light.location = world_position(*position)
        light.rotation_euler = (
            (light.location - world_position(*FIGURE, TABLE_TOP)).to_track_quat("Z", "Y").to_euler()
        )
    world = bpy.context.scene.world
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (
        (0.5, 0.62, 0.8, 1),
        0.5,
    )


start(walk())
