"""The walk of ``make window WALK=1``, inside Blender: from photographs to a shot, as artists do.

``tools/window.py`` starts it with ``--walk``; see ``window_tour``. Everything that is done with the splats is
undone once, step by step, and done again.
"""
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false, reportOptionalMemberAccess=false
# pyright: reportArgumentType=false

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.rig import LANTERN
from tools.window_hands import (
    OUT,
    PLAN,
    Steps,
    changed,
    click_at,
    drag,
    look_from,
    module,
    open_panels,
    press,
    press_f12,
    region,
    scroll,
    settle,
    start,
    take,
    type_in,
    until,
    viewport,
)

JOB = {"max_splats": 60_000, "steps": (150, 250, 300, 450, 1000)} if PLAN["long"] else {
    "max_splats": 20_000, "levels": 3, "steps": (60, 90, 800), "densify_until": (0.5,) * 3,
    "densify_interval": (20,) * 3, "budget_ratio": 0.35, "footprint": 8.0,
}  # fmt: skip
TABLE_TOP, TABLE_ENDS = 0.78, ((-0.95, 0.0), (0.95, 0.0))
"""Of the example's table, in metres, as ``LANTERN``: how high, and where its ends are."""
PUMPKIN, FIGURE = (-0.2, 0.1, 0.87), (-0.36, -0.22)
"""What is brushed over, and where on the table something is put."""


def walk() -> Steps:
    """Everything in order. An assertion that fails ends the walk with its sentence."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.placement", "panels.clean_up", "panels.look", "panels.rendering")
    viewport()[0].spaces.active.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    yield from settle()
    take("empty")
    press("lodgs.import_colmap", directory=PLAN["scene"])
    yield from settle()
    take("imported")
    yield from train()
    yield from search()
    begun = state()
    steps = yield from edit()
    yield from undo(steps, begun)
    yield from click()
    yield from shoot()


def scene_root() -> bpy.types.Object:
    """The splat scene, which undo replaces by another object of its name."""
    (root,) = module("data.scenes").roots(bpy.context.scene)
    return root


def place_of(*place: float) -> Vector:
    """Where a place of the photographed scene is in Blender's world."""
    return scene_root().lodgs.axes.matrix_world @ Vector(place)


def pixel_of(*place: float) -> tuple[int, int]:
    """Where in the window it is seen."""
    seen = location_3d_to_region_2d(region(), viewport()[1], place_of(*place))
    return round(region().x + seen.x), round(region().y + seen.y)


def train() -> Steps:
    jobs, status, root = module("runs.jobs"), module("panels.status"), scene_root()
    watch = jobs.start(root, PLAN["run"], JOB)
    jobs.follow(watch)
    yield from until(lambda: not watch.running or len(watch.levels) >= 1, 900)
    yield from settle()
    take("training", watch.message)
    yield from until(lambda: not watch.running, 1200)
    assert watch.state == "done", watch.problem or watch.message
    root.lodgs.cameras.hide_viewport = True
    root.lodgs.points.hide_set(True)
    press("ed.undo_push", message="Hide")
    yield from settle()
    noticed = take("trained", f"{len(root.lodgs.levels)} levels")
    seen = bool(status.visible_work(time.monotonic()))  # or drawing that took longer than it stands
    yield from until(lambda: not status.visible_work(time.monotonic()), 200)
    yield 2.0
    gone = take("notice-gone", redrawn=False)
    assert not seen or changed(noticed, gone, part="STATUSBAR") > 0, "The notice stays."


def search() -> Steps:
    """Blender's search finds the verbs by what they are called."""
    for word in ("worst", "ground"):
        press("wm.search_menu", way="INVOKE_DEFAULT")
        yield 0.5
        yield from type_in(word)
        yield from settle()
        take(f"search-{word}")
        yield from type_in("\x1b")


def edit() -> Steps:
    """Placed, cropped, cleaned and in another look; returns how many steps that was."""
    look_from(place_of(-1.7, -2.5, 1.15), place_of(0.0, 0.3, 0.8))
    press("lodgs.set_ground", by="FOUND")
    for number, (x, y) in enumerate(TABLE_ENDS):
        press("object.empty_add", way="EXEC_DEFAULT", radius=0.1, location=place_of(x, y, TABLE_TOP))
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
    press("lodgs.set_scale", way="INVOKE_DEFAULT")
    yield from settle()
    take("scale")
    yield from type_in("\r")
    press("lodgs.set_scale", length=1.9)
    yield from settle()
    low = min(place_of(x, y, 0).z for x, y in TABLE_ENDS)
    assert abs(low) < 0.05, f"The table's feet are {low:.2f} m off the ground."
    take("placed", f"the lantern is {place_of(*LANTERN).z:.2f} m above the ground")

    press("lodgs.add_crop", shape="SPHERE")
    crop = bpy.context.active_object
    crop.matrix_world.translation, crop.scale = place_of(0.0, 0.05, 0.8), [1.4] * 3
    press("ed.undo_push", message="Scale")
    press("lodgs.hide_splats", test="FLOATERS")
    scroll(26)
    yield from settle()
    take("cropped", left())

    look_from(place_of(-0.5, -1.7, 1.35), place_of(-0.05, 0.1, 0.9))
    press("wm.tool_set_by_id", way="EXEC_DEFAULT", name="lodgs.brush")
    yield from settle()
    x, y = pixel_of(*PUMPKIN)
    yield from drag([(x + along, y) for along in (-30, -10, 10, 30)])
    yield from settle()
    selected = sum(module("data.cleaning").count_selected(scene_root()).values())
    assert selected, "The brush selects nothing."
    take("brushed", f"{selected:,} splats selected")
    press("lodgs.hide_splats", test="SELECTED")
    press("wm.tool_set_by_id", way="EXEC_DEFAULT", name="builtin.select_box")
    yield from settle()
    take("brushed-away", left())
    return 11


def undo(steps: int, begun: tuple) -> Steps:
    done = state()
    for _ in range(steps):
        press("ed.undo", way="EXEC_DEFAULT")
    yield from settle()
    assert state() == begun, "It is not undone to where it began."
    take("undone", left())
    for _ in range(steps):
        press("ed.redo", way="EXEC_DEFAULT")
    yield from settle()
    assert state() == done, "It is not done again."
    take("redone", left())


def state() -> tuple:
    """What editing changes."""
    bpy.context.view_layer.update()
    root = scene_root()
    counts = module("data.cleaning").count_left(root, bpy.context.evaluated_depsgraph_get())
    names = sorted(obj.name for obj in bpy.data.objects)
    return counts, [*map(tuple, root.lodgs.axes.matrix_world)], names


def left() -> str:
    counts = state()[0]
    return ", ".join(f"level {n}: {some:,} of {count:,} left" for n, (some, count) in counts.items())


def click() -> Steps:
    """A click on nothing deselects; one on the splats selects their scene, also before a mesh; one on a mesh
    before them the mesh."""
    look_from(place_of(-1.0, -4.5, 2.2), place_of(0.3, 0.1, 0.7))
    yield from settle()
    press("mesh.primitive_cube_add", way="EXEC_DEFAULT", size=0.2, location=place_of(0.0, 0.9, 0.8))
    behind = bpy.context.active_object
    away = pixel_of(*LANTERN)
    nothing = region().x + 120, region().y + 3 * region().height // 5  # left of what is left of the scene
    for place, chosen in ((nothing, None), (away, scene_root())):
        yield from click_at(*place)
        selected = bpy.context.view_layer.objects.selected[:]
        assert selected == ([chosen] if chosen else []), f"A click at {place} selects {selected}."
    eye = viewport()[1].view_matrix.inverted().translation
    behind.location = eye.lerp(place_of(*LANTERN), 1.1)
    yield from settle()
    yield from click_at(*nothing)
    yield from click_at(*away)
    assert bpy.context.view_layer.objects.selected[:] == [scene_root()], "The mesh behind is selected."
    take("clicked")
    behind.location = eye.lerp(place_of(*LANTERN), 0.8)
    yield from settle()
    yield from click_at(*away)
    assert bpy.context.view_layer.objects.selected[:] == [behind], "The mesh before it is not selected."
    behind.location = eye.lerp(place_of(*LANTERN), 1.1)
    for tool in ("builtin.select", "builtin.move", "builtin.select_box"):
        behind.select_set(True)
        press("wm.tool_set_by_id", way="EXEC_DEFAULT", name=tool)
        yield from settle()
        yield from click_at(*away)
        selected = bpy.context.view_layer.objects.selected[:]
        assert selected == [scene_root()], f"With {tool} a click on splats selects {selected}."
    bpy.data.objects.remove(behind)


def shoot() -> Steps:
    """The rest grey and dark around the still life; then a figure on the table, and the picture of both."""
    root, scene = scene_root(), bpy.context.scene
    for crop in module("data.crops").crops_of(root):
        crop.lodgs_crop.use = False
    press("lodgs.show_hidden_splats")
    look_from(place_of(-0.55, -2.6, 1.5), place_of(0.05, 0.3, 1.0))
    press("lodgs.add_crop", shape="SPHERE", keep="ALL")
    there = bpy.context.active_object
    there.matrix_world.translation, there.scale = place_of(0.0, 0.05, 0.75), [1.05, 0.75, 0.7]
    look = there.lodgs_look
    look.outside, look.exposure, look.saturation, look.temperature = True, -1.6, 0.35, 5200
    scroll(14)
    yield from settle()
    take("looked")
    look.outside = False
    press("lodgs.reset_look", name=there.name)
    bpy.data.objects.remove(there)

    set_figure()
    set_lights()
    press("lodgs.use_engine")
    press("lodgs.combine_with_meshes")
    scene.lodgs_render.meshes.cycles.samples = 96 if PLAN["long"] else 16
    root.lodgs.active_view = 4
    press("lodgs.look_through", step=0)
    scene.render.resolution_percentage = 200
    press("lodgs.combine_with_meshes")
    looks = viewport()[1]
    looks.view_perspective, looks.view_camera_zoom, looks.view_camera_offset = "CAMERA", 10, (0.12, 0)
    scroll(60)
    yield from settle()
    take("shot")
    bpy.context.preferences.view.render_display_type = "AREA"  # this display has no window manager
    assert (yield from press_f12(600)) == "complete", "F12 was cancelled."
    bpy.data.images["Render Result"].save_render(str(OUT / "shot.png"))
    yield from settle()
    take("f12")


def set_figure() -> None:
    """A glazed figure on the table, and a shadow catcher under it."""
    size = 0.11
    press("mesh.primitive_monkey_add", way="EXEC_DEFAULT", size=2 * size)
    figure = bpy.context.active_object
    figure.location = place_of(*FIGURE, TABLE_TOP + 0.9 * size)
    figure.rotation_euler = math.radians(-28), 0, math.radians(12)
    figure.modifiers.new("Smooth", "SUBSURF").render_levels = 3
    press("object.shade_smooth", way="EXEC_DEFAULT")
    glaze = bpy.data.materials.new("Glaze")
    glaze.use_nodes = True
    shader = next(node for node in glaze.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = 0.01, 0.16, 0.2, 1
    shader.inputs["Roughness"].default_value = 0.18
    figure.data.materials.append(glaze)
    press("mesh.primitive_plane_add", way="EXEC_DEFAULT", size=0.6)
    catcher = bpy.context.active_object
    catcher.location, catcher.is_shadow_catcher = place_of(*FIGURE, TABLE_TOP + 0.004), True
    catcher.hide_set(True)


def set_lights() -> None:
    """As in the photographs: a low warm sun from the left behind them, a blue sky, the lantern's glow."""
    for kind, energy, color, place in (
        ("SUN", 3.0, (1.0, 0.72, 0.44), (-2.0, -2.5, 2.2)),
        ("POINT", 4.0, (1.0, 0.6, 0.2), (LANTERN[0], LANTERN[1] - 0.1, LANTERN[2])),
    ):
        data = bpy.data.lights.new(kind.title(), kind)
        data.energy, data.color = energy, color
        light = bpy.data.objects.new(data.name, data)
        bpy.context.scene.collection.objects.link(light)
        light.location = place_of(*place)
        light.rotation_euler = (
            (light.location - place_of(*FIGURE, TABLE_TOP)).to_track_quat("Z", "Y").to_euler()
        )
    world = bpy.context.scene.world
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (
        (0.5, 0.62, 0.8, 1),
        0.5,
    )


start(walk())
