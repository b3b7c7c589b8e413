"""Script of ``make pictures``: the documentation's pictures of the product, from the example scene.

``tools/pictures.py`` runs it inside Blender. The 3D viewport fills the window. Each picture shows the LODGS
tab with the panels that its page describes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.rig import LANTERN
from tools.window_actions import (
    LODGS,
    OUT,
    PLAN,
    Steps,
    check_installation,
    drag,
    look_from,
    module,
    pixels,
    press,
    press_f12,
    region,
    scene_root,
    screenshot,
    settle,
    start,
    type_in,
    until,
    viewport,
    window_pixel,
    world_position,
)

TABLE = (0.0, 0.05, 0.8)
"""Position of the table in the example scene."""

_generation = 0


def take_all() -> Steps:
    """Take all pictures. A failed assertion ends the script with its message."""
    bpy.ops.wm.save_as_mainfile(filepath=PLAN["file"])
    area = viewport()[0]
    area.type = "PREFERENCES"
    yield from preferences()
    viewport_area = next(
        a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == "PREFERENCES"
    )
    viewport_area.type = "VIEW_3D"
    yield 0.5
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=viewport_area):
        bpy.ops.screen.screen_full_area()
    yield 1.0
    viewport()[0].spaces.active.show_region_ui = True
    viewport()[0].spaces.active.show_region_toolbar = False
    yield 1.0
    yield from show_panels("capture")
    yield from capture()
    for name in [obj.name for obj in bpy.data.objects]:
        bpy.data.objects.remove(bpy.data.objects[name])
    yield from import_scene()
    yield from train()
    yield from detail()
    yield from place_and_clean()
    yield from look()
    yield from render()
    yield from compare()
    yield from export()
    yield from cells()
    yield from restore_panels()


def picture(name: str) -> None:
    """Take the picture ``docs/images/<name>.jpg``."""
    screenshot(name)


def show_panels(*names: str) -> Steps:
    """Show the LODGS tab with only the panels of these modules open, such as "levels".

    Blender keeps panels open or closed once it has drawn them, so copies of all panels take their place.
    """
    global _generation
    _generation += 1
    package = f"{LODGS}.blender_lodgs.panels."
    panels = unregister_panels()
    for cls in panels:
        is_open = cls.__module__.removeprefix(package) in names or cls.__name__ in names
        content = {"bl_idname": f"{cls.__name__}_{_generation}"}
        content["bl_options"] = set() if is_open else {"DEFAULT_CLOSED"}
        if hasattr(cls, "bl_parent_id"):
            content["bl_parent_id"] = f"{cls.bl_parent_id}_{_generation}"
        bpy.utils.register_class(type(content["bl_idname"], (cls,), content))
    yield 0.5
    region("UI").active_panel_category = "LODGS"
    yield from settle()


def unregister_panels() -> list[type[bpy.types.Panel]]:
    """Unregister all panels of the tab and their copies; return the panels in the order of registration."""
    parts = module("panels.parts")
    classes = [cls for part in module("panels").MODULES for cls in getattr(part, "CLASSES", ())]
    panels = [cls for cls in classes if issubclass(cls, (parts.Panel, parts.LevelsPanel))]
    for cls in reversed(panels):  # subpanels first
        for registered in (cls, *cls.__subclasses__()):
            if registered.is_registered:
                bpy.utils.unregister_class(registered)
    return panels


def restore_panels() -> Steps:
    """Register the extension's own panels again, which it unregisters when Blender quits."""
    for cls in unregister_panels():
        bpy.utils.register_class(cls)
    yield 0.2


def overview() -> None:
    """Look at the table from in front of it, with the sidebar's width in mind."""
    look_from(world_position(-1.5, -2.6, 1.5), world_position(0.35, 0.2, 0.85))


def preferences() -> Steps:
    report = yield from check_installation()
    report.python = (
        "/home/artist/.config/blender/5.2/extensions/.user/user_default/lodgs/trainer/1/bin/python"
    )
    yield from settle()
    picture("preferences")


def capture() -> Steps:
    settings = bpy.context.scene.lodgs_capture
    settings.views_from = "DOME"
    look_from(Vector((9, -11, 8)), Vector((1.5, 0, 0)))
    press("lodgs.show_coverage")
    yield from settle()
    picture("capture-panel")
    press("lodgs.show_coverage")


def import_scene() -> Steps:
    yield from show_panels("scene", "LODGS_PT_training")
    press("lodgs.import_colmap", directory=PLAN["scene"])
    overview()
    yield from settle()
    picture("first-scene-import")
    yield from show_panels("scene")
    press("lodgs.look_through")
    view = viewport()[1]
    view.view_perspective = "CAMERA"
    view.view_camera_zoom, view.view_camera_offset = 10, (0.12, 0)  # left of the sidebar
    yield from settle()
    picture("scene-panel")
    yield from show_panels("LODGS_PT_training", "LODGS_PT_training_advanced")
    scene_root().lodgs.training.parameters.use_max_splats = True
    yield from settle()
    picture("training-advanced")
    scene_root().lodgs.training.parameters.use_max_splats = False


def train() -> Steps:
    jobs, root = module("runs.jobs"), scene_root()
    yield from show_panels("LODGS_PT_training")
    view = viewport()[1]
    view.view_perspective = "PERSP"
    overview()
    watch = jobs.start(root, PLAN["run"], PLAN["parameters"])
    jobs.follow(watch)
    root.lodgs.cameras.hide_viewport = True
    yield from until(lambda: not watch.running or len(watch.levels) >= 4, 1500)
    assert watch.running, watch.problem
    yield 6.0
    yield from settle()
    picture("training-running")
    yield from until(lambda: not watch.running, 1500)
    assert watch.state == "done", watch.problem or watch.message
    root.lodgs.points.hide_set(True)
    yield from show_panels("LODGS_PT_training", "levels")
    yield from settle()
    picture("training-done")


def detail() -> Steps:
    root = scene_root()
    yield from show_panels("LODGS_PT_levels", "LODGS_PT_detail")
    yield from settle()
    picture("levels-panel")
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "VIEW"
    yield from show_panels("LODGS_PT_detail")
    yield from settle()
    picture("detail-by-distance")
    root.lodgs.colors = "LEVELS"
    yield from show_panels("LODGS_PT_detail", "viewport")
    yield from settle()
    picture("viewport-colours")
    root.lodgs.colors, root.lodgs.mode, root.lodgs.camera_choice = "OWN", "SINGLE", "CAMERA"


def place_and_clean() -> Steps:
    yield from show_panels("placement")
    overview()
    press("lodgs.set_ground", by="DETECT")
    for number, x in enumerate((-0.95, 0.95)):
        press("object.empty_add", mode="EXEC_DEFAULT", radius=0.1, location=world_position(x, 0, 0.78))
        bpy.context.active_object.name = f"Table {number + 1}"
    ends = [obj for obj in bpy.context.scene.objects if obj.name.startswith("Table")]
    for obj in (*ends, root := scene_root()):
        obj.select_set(True)
    bpy.context.view_layer.objects.active = root
    overview()
    yield from settle()
    window = bpy.context.window_manager.windows[0]
    window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=430, y=560)
    press("lodgs.set_scale", mode="INVOKE_DEFAULT")
    yield from settle()
    picture("placement-scale")
    yield from type_in("\r")
    for obj in ends:
        bpy.data.objects.remove(obj)
    yield from show_panels("clean_up")
    press("lodgs.add_crop", shape="SPHERE")
    crop = bpy.context.active_object
    crop.matrix_world.translation, crop.scale = world_position(*TABLE), [1.4 * scene_scale()] * 3
    press("lodgs.hide_splats", test="FLOATERS")
    overview()
    yield from settle()
    picture("clean-up-crop")
    look_from(world_position(-0.5, -1.7, 1.35), world_position(0.15, 0.1, 0.9))
    press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name="lodgs.brush")
    yield from settle()
    x, y = window_pixel(-0.2, 0.1, 0.87)
    yield from drag([(x + offset, y) for offset in (-30, -10, 10, 30)])
    yield from settle()
    picture("clean-up-brush")
    press("lodgs.find_clutter")
    root = scene_root()
    root.lodgs_clutter.size = 0.5 * scene_scale()
    overview()
    yield from settle()
    picture("clean-up-clutter")
    press("lodgs.cancel_clutter")
    press("lodgs.select_all_splats", action="DESELECT")
    press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name="builtin.select_box")
    crop.lodgs_crop.use = False
    press("lodgs.show_hidden_splats")
    bpy.data.objects.remove(crop)


def scene_scale() -> float:
    """Return Blender units per unit of the example scene."""
    return scene_root().lodgs.axes.matrix_world.to_scale()[0]


def look() -> Steps:
    root = scene_root()
    yield from show_panels("look")
    overview()
    press("lodgs.add_crop", shape="SPHERE", keep="ALL")
    crop = bpy.context.active_object
    crop.matrix_world.translation = world_position(*LANTERN)
    crop.scale = [0.5 * scene_scale()] * 3
    settings = crop.lodgs_look
    settings.outside, settings.exposure, settings.saturation = True, -1.6, 0.35
    yield from settle()
    picture("look-regions")
    bpy.data.objects.remove(crop)
    bpy.context.view_layer.objects.active = root
    look_from(world_position(-0.5, -1.7, 1.35), world_position(0.1, 0.1, 0.95))
    bpy.context.scene.lodgs_brush.color = 0.9, 0.05, 0.02
    press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name="lodgs.paint")
    yield from settle()
    x, y = window_pixel(-0.2, 0.1, 0.87)
    yield from drag([(x + offset, y) for offset in (-40, -20, 0, 20, 40)])
    yield from settle()
    picture("look-paint")
    press("lodgs.remove_paint")
    press("wm.tool_set_by_id", mode="EXEC_DEFAULT", name="builtin.select_box")


def render() -> Steps:
    root = scene_root()
    press("lodgs.use_engine")
    root.lodgs.active_view = 4
    press("lodgs.look_through", step=0)
    view = viewport()[1]
    view.view_perspective, view.view_camera_zoom, view.view_camera_offset = "CAMERA", 10, (0.12, 0)
    yield from show_panels("rendering")
    yield from settle()
    picture("rendering-panel")
    bpy.context.preferences.view.render_display_type = "NONE"
    assert (yield from press_f12(300)) == "complete", "F12 was cancelled."
    file = OUT / "f12.png"
    bpy.data.images["Render Result"].save_render(str(file))
    assert pixels(file).std() > 0.05, "F12 is empty."


def compare() -> Steps:
    module_ = module("render.compare")
    yield from show_panels("compare")
    bpy.context.scene.lodgs_viewport.splats = False  # software rendering of each view is slow
    press("lodgs.measure_views")
    yield from until(lambda: not module_.measurement.running, 900)
    assert not module_.measurement.problem, module_.measurement.problem
    bpy.context.scene.lodgs_viewport.splats = True
    press("lodgs.compare_worst")
    bpy.context.scene.lodgs_render.wipe = 0.4
    yield from settle()
    picture("compare-wipe")
    bpy.context.scene.lodgs_render.show_comparison = False
    viewport()[1].view_perspective = "PERSP"


def export() -> Steps:
    yield from show_panels("export")
    overview()
    yield from settle()
    picture("export-panel")


def cells() -> Steps:
    root = scene_root()
    settings = root.lodgs.training
    settings.divide_by, settings.columns, settings.rows = "GRID", 2, 2
    root.lodgs.cameras.hide_viewport = True
    press("lodgs.plan_cells")
    yield from until(lambda: bool(settings.planned_for), 300)
    settings.show_cells = True
    bpy.context.scene.lodgs_viewport.splats = False
    root.lodgs.points.hide_set(False)
    look_from(world_position(-7, -12, 14), world_position(2.5, 0, 0))
    yield from show_panels("LODGS_PT_training", "LODGS_PT_training_cells")
    yield from settle()
    picture("large-scenes-plan")


start(take_all())
