"""The walk of ``make window WALK=1``, inside Blender: from photographs to a shot, as artists do.

``tools/window.py`` starts it with ``--walk``; see ``window_tour``.
"""
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false, reportOptionalMemberAccess=false

from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_hands import (
    OUT,
    PLAN,
    Steps,
    changed,
    module,
    open_panels,
    press,
    press_f12,
    region,
    scroll,
    settle,
    start,
    take,
    until,
    viewport,
)

JOB = {"max_splats": 60_000, "steps": (150, 250, 300, 450, 1000)} if PLAN["long"] else {
    "max_splats": 20_000, "levels": 3, "steps": (60, 90, 800), "densify_until": (0.5,) * 3,
    "densify_interval": (20,) * 3, "budget_ratio": 0.35, "footprint": 8.0,
}  # fmt: skip


def walk() -> Steps:
    """Everything in order. An assertion that fails ends the walk with its sentence."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.placement", "panels.clean_up", "panels.rendering")
    viewport()[0].spaces.active.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    yield from settle()
    take("empty")
    press("lodgs.import_colmap", directory=PLAN["scene"])
    yield from settle()
    take("imported")
    root = module("data.scenes").active_root(bpy.context)
    yield from train(root)
    yield from place(root)
    yield from clean(root)
    yield from click(root)
    yield from shoot(root)


def train(root: bpy.types.Object) -> Steps:
    jobs = module("runs.jobs")
    watch = jobs.start(root, PLAN["run"], JOB)
    jobs.follow(watch)
    yield from until(lambda: not watch.running or len(watch.levels) >= 1, 900)
    yield from settle()
    take("training", watch.message)
    yield from until(lambda: not watch.running, 1200)
    assert watch.state == "done", watch.problem or watch.message
    root.lodgs.cameras.hide_viewport = True
    yield from settle()
    take("trained", f"{len(root.lodgs.levels)} levels")


def place(root: bpy.types.Object) -> Steps:
    press("lodgs.set_ground", by="FOUND")
    module("data.photographs").look_at_scene(bpy.context, root, print)
    scroll(16)
    yield from settle()
    take("placed")


def clean(root: bpy.types.Object) -> Steps:
    before = take("uncropped")
    press("lodgs.add_crop", shape="SPHERE")
    eye, target = module("data.photographs").photographed_from(root)
    crop = bpy.context.active_object
    crop.location, crop.scale = target, [(eye - target).length * 0.4] * 3
    scroll(26)
    press("lodgs.hide_splats", test="FLOATERS")
    yield from settle()
    shown, everything = module("data.scenes").count_shown(bpy.context, root)
    assert changed(before, take("cleaned", f"{shown:,} of {everything:,} splats")) > 0.05, "Nothing went."


def click(root: bpy.types.Object) -> Steps:
    """A click on nothing deselects, and one on the splats selects their scene."""
    part, window = region(), bpy.context.window_manager.windows[0]
    middle = part.x + part.width // 2 + 30, part.y + part.height // 2 - 40  # beside the crop's lines
    for place, chosen in (((part.x + 90, part.y + 15), None), (middle, root)):
        window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=place[0], y=place[1])
        yield 0.3
        for value in ("PRESS", "RELEASE"):
            window.event_simulate(type="LEFTMOUSE", value=value, x=place[0], y=place[1])
        yield from settle()
        selected = bpy.context.view_layer.objects.selected[:]
        assert selected == ([chosen] if chosen else []), f"A click at {place} selects {selected}."
    take("clicked")


def shoot(root: bpy.types.Object) -> Steps:
    """A mesh among the splats, and the picture of both."""
    scene, (eye, target) = bpy.context.scene, module("data.photographs").photographed_from(root)
    away = (eye - target).length
    press("mesh.primitive_uv_sphere_add", way="EXEC_DEFAULT", radius=away / 12, location=target)
    press("lodgs.use_engine")
    press("lodgs.combine_with_meshes")
    scene.lodgs_render.meshes.cycles.samples = 16
    press("lodgs.look_through", step=1)
    viewport()[1].view_perspective = "CAMERA"
    scroll(60)
    yield from settle()
    take("shot")
    bpy.context.preferences.view.render_display_type = "AREA"  # this display has no window manager
    assert (yield from press_f12(600)) == "complete", "F12 was cancelled."
    bpy.data.images["Render Result"].save_render(str(OUT / "shot.png"))
    yield from settle()
    take("f12")


start(walk())
