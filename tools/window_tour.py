"""The tour of ``make window``, inside Blender: what an artist does, checked and photographed step by step.

``tools/window.py`` starts it and says where everything is. A timer takes the steps of :func:`tour`, so that
Blender draws, listens and trains between them.
"""
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_hands import (
    LODGS,
    OUT,
    PLAN,
    Steps,
    alike,
    changed,
    leave_camera,
    look_at,
    module,
    open_panels,
    pixels,
    press,
    press_f12,
    region,
    scroll,
    settle,
    start,
    take,
    training,
    until,
    viewport,
)

METHOD = PLAN["method"]
TINY = {"max_splats": 20_000, "sh_interval": 100, "steps": 1000}
TINY_BY_LEVEL = {
    "levels": 3, "steps": (60, 90, 800), "densify_until": (0.5,) * 3, "densify_interval": (20,) * 3,
    "budget_ratio": 0.35, "footprint": 8.0,
}  # fmt: skip
"""What makes a tiny job of a method's draft; of one that trains its levels one after the other."""
LONGER = {"max_splats": 60_000, "steps": 3000}
LONGER_BY_LEVEL = {"steps": (150, 250, 300, 450, 1000)}
"""What makes half of it: minutes."""


def tour() -> Steps:
    """Everything in order. An assertion that fails ends the tour with its sentence."""
    yield from preferences()
    root = yield from bring_in()
    yield from train(root)
    yield from levels(root)
    yield from distances(root)
    yield from orbit(root)
    yield from freeze(root)
    yield from render(root)
    yield from draw_frames()
    yield from compare(root)
    yield from overlays()


def preferences() -> Steps:
    assert LODGS in bpy.context.preferences.addons, "The extension is not enabled."
    area = viewport()[0]
    area.type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "LODGS"
    press("preferences.addon_expand", module=LODGS)
    press("lodgs.check_environment")
    yield from settle()
    report = module("runs.environment").report
    assert report.ok, f"No trainer: {report.problems}"
    take("preferences", report.versions["torch"])
    area.type = "VIEW_3D"
    yield 0.5
    for name in ("Cube", "Light", "Camera"):  # as the guide says: the first photograph's is the camera
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.rendering", "panels.compare")
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    yield from settle()
    take("tab")


def bring_in() -> Iterator[float]:
    press("lodgs.import_colmap", directory=PLAN["scene"])
    root = module("data.scenes").active_root(bpy.context)
    views = module("data.photographs").views(root)
    photographs = list(Path(PLAN["scene"], "images").iterdir())
    assert len(views) == len(photographs), f"{len(views)} of {len(photographs)} cameras came."
    assert len(root.lodgs.points.data.points), "No points came."
    look_at(views[0].matrix_world @ Vector((1.0, 0, -2)), back=11)
    yield from settle()
    take("import", f"{len(views)} cameras, {len(root.lodgs.points.data.points):,} points")
    press("lodgs.look_through")
    looks = viewport()[1]
    looks.view_perspective = "CAMERA"
    looks.view_camera_zoom, looks.view_camera_offset = 10, (0.12, 0)  # left of the sidebar
    yield from settle()
    assert viewport()[1].view_perspective == "CAMERA"
    take("look-through", bpy.context.scene.camera.name)
    return root


def train(root: bpy.types.Object) -> Steps:
    jobs = module("runs.jobs")
    root.lodgs.training.method = METHOD
    watch = jobs.start(root, PLAN["run"], job())
    jobs.follow(watch)

    def early() -> bool:  # all levels but the last are there, or all
        return bool(watch.progress) and len(watch.levels) >= watch.progress["levels"] - 1

    yield from until(lambda: not watch.running or early(), 900)
    assert watch.running, f"No level comes while others train: {watch.problem}"
    yield from settle()
    take(
        "training", f"{len(root.lodgs.levels)} of {watch.progress['levels']} levels are there while it trains"
    )
    press("lodgs.cancel_training")
    yield from until(lambda: not watch.running, 120)
    yield from settle()
    assert watch.state == "cancelled", watch.problem or f"Not cancelled: {watch.message}."
    take("cancelled", watch.message)
    press("lodgs.resume_training")
    watch = module("runs.watch").watch_of(root)
    yield from until(lambda: not watch.running, 1200)
    yield from settle()
    assert watch.state == "done", watch.problem or watch.message
    assert len(root.lodgs.levels) == watch.progress["levels"], "Not all levels came."
    counts = drawn(root)
    assert counts == sorted(set(counts)), f"Finer levels should have more splats: {counts}"
    take("trained", f"{len(counts)} levels of {', '.join(f'{n:,}' for n in counts)} splats")


def levels(root: bpy.types.Object) -> Steps:
    root.lodgs.cameras.hide_viewport = True
    settings = bpy.context.scene.lodgs_viewport
    pictures = {}
    finest = len(root.lodgs.levels)
    for number in sorted({1, finest}):
        press("lodgs.show_only_level", level=number)
        yield from settle()
        shown, _ = module("data.scenes").count_shown(bpy.context, root)
        assert shown == drawn(root)[number - 1], f"{shown} splats are shown."
        pictures[number] = take(f"level-{number}", f"{shown:,} splats")
    if finest > 1:
        assert changed(pictures[1], pictures[finest]) > 0.2, "Level 1 looks like the finest level."
    settings.splats = False
    yield from settle()
    points = take("points")
    settings.splats = True
    yield from settle()
    again = take("splats")
    assert changed(points, again) > 0.2, "Points look like splats."
    assert changed(pictures[finest], again) < 0.01, "The same splats look different the second time."


def distances(root: bpy.types.Object) -> Steps:
    """As the rule begins, then coarser by itself until a quarter fewer splats are shown."""
    count_shown = module("data.scenes").count_shown
    controls, levels = root.lodgs.controls, [item.number for item in root.lodgs.levels]
    rule = training("lod.rule").find_rule(root.lodgs.rule)
    root.lodgs.mode = "SELECTIVE"
    scroll(20)
    yield from settle()
    begun, everything = count_shown(bpy.context, root)
    assert 0 < begun <= everything, f"{begun} of {everything} splats are shown by distance."
    take("by-distance", f"{begun:,} of {everything:,} splats")
    shown = begun
    while shown > 0.75 * begun:
        values = rule.coarser(
            {control.name: getattr(controls, control.name) for control in rule.controls}, levels
        )
        assert values, f"{shown} of {begun} splats are shown, and nothing is coarser."
        for name, value in values.items():
            setattr(controls, name, value)
        bpy.context.view_layer.update()
        shown, _ = count_shown(bpy.context, root)
    yield from settle()
    assert shown, "Coarser is nothing at all."
    take("by-distance-coarser", f"{shown:,} of {everything:,} splats")
    root.lodgs.tell = "LEVELS"
    yield from settle()
    take("by-distance-levels")
    root.lodgs.tell = "OWN"


def orbit(root: bpy.types.Object) -> Steps:
    root.lodgs.eye = "VIEW"
    leave_camera()
    for angle in (-15, 25, 25):
        press("view3d.view_orbit", angle=math.radians(angle), type="ORBITRIGHT")
        yield from settle()
        yield from settle()
        eye = viewport()[1].view_matrix.inverted().translation
        away = (root.lodgs.axes.matrix_world @ Vector(root.lodgs.held_eye) - eye).length
        assert away < 1e-3, f"The viewport's eye is {away:.3f} from the view's."
        shown, _ = module("data.scenes").count_shown(bpy.context, root)
        take("orbit", f"{shown:,} splats")


def freeze(root: bpy.types.Object) -> Steps:
    root.lodgs.freeze, root.lodgs.tell = True, "BANDS"
    held, shown = tuple(root.lodgs.held_eye), module("data.scenes").count_shown(bpy.context, root)
    press("view3d.view_orbit", angle=math.radians(40), type="ORBITUP")
    viewport()[1].view_distance = 40
    yield from settle()
    yield from settle()
    assert tuple(root.lodgs.held_eye) == held, "A frozen eye moved."
    assert module("data.scenes").count_shown(bpy.context, root) == shown, "A frozen choice changed."
    take("freeze", f"{shown[0]:,} splats")
    root.lodgs.freeze, root.lodgs.tell, root.lodgs.eye = False, "OWN", "CAMERA"


def render(root: bpy.types.Object) -> Steps:
    scene = bpy.context.scene
    press("lodgs.look_through", step=1)
    viewport()[1].view_perspective = "CAMERA"
    chosen = root.lodgs.cameras.objects[root.lodgs.active_view]
    assert chosen == scene.camera == module("data.photographs").views(root)[1], "The list shows another view."
    press("lodgs.use_engine")
    scroll(60)
    yield from settle()
    take("rendering")
    area = viewport()[0]
    bpy.context.preferences.view.render_display_type = "AREA"  # this display has no window manager
    ended = yield from press_f12(300)
    yield from settle()
    assert ended == "complete", "F12 was cancelled."
    file = OUT / "f12.png"
    bpy.data.images["Render Result"].save_render(str(file))
    photograph = Path(bpy.path.abspath(scene.camera.data.lodgs.photograph))
    psnr = alike(pixels(file), pixels(photograph))
    assert psnr > 14, f"F12 gives nothing like the photograph: {psnr:.1f} dB."
    take("f12", f"{psnr:.1f} dB against the photograph")
    area.type = "VIEW_3D"
    yield 0.5


def draw_frames() -> Steps:
    """In Viewport Quality, while Blender goes on listening."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 3, str(OUT / "frames" / "####.png")
    press("lodgs.render_quick", way="INVOKE_DEFAULT", animation=True)
    assert not any((OUT / "frames").glob("*.png")), "Blender waits for the frames."
    yield from until(lambda: (OUT / "frames" / "0002.png").exists(), 300)
    take("frames")
    yield from until(lambda: (OUT / "frames" / "0003.png").exists(), 300)
    yield from settle()


def compare(root: bpy.types.Object) -> Steps:
    module_ = module("render.compare")
    bpy.context.scene.lodgs_viewport.splats = False  # each view measured is drawn, slowly by software
    press("lodgs.measure_views")
    yield from until(lambda: not module_.measurement.running, 600)
    assert not module_.measurement.problem, module_.measurement.problem
    assert module_.measurement.done == len(module("data.photographs").views(root))
    bpy.context.scene.lodgs_viewport.splats = True
    press("lodgs.compare_worst")
    scroll(60)
    yield from settle()
    least = min(view.data.lodgs.psnr for view in module("data.photographs").views(root))
    psnr = module("viewport.wipe").comparison.psnr
    assert psnr == least > 10, f"The worst view has {psnr:.1f} dB."
    wiped = [take("compare", f"{bpy.context.scene.camera.name}: {psnr:.1f} dB")]
    bpy.context.scene.lodgs_render.wipe = 0.2
    yield from settle()
    wiped.append(take("compare-wiped"))
    assert changed(*wiped, by=0.02) > 0.02, "The wipe moves nothing."


def overlays() -> Steps:
    press("wm.call_panel", name="VIEW3D_PT_overlay", keep_open=True)
    yield from settle()
    take("overlays")


def drawn(root: bpy.types.Object) -> list[int]:
    """How many splats each level shows alone; those of an octree add up."""
    counts = np.array([len(item.object.data.points) for item in root.lodgs.levels])
    return (counts.cumsum() if root.lodgs.cumulative else counts).tolist()


def job() -> dict:
    """What the tour trains with, beside the method's draft."""
    parameters = training("methods").method_info(METHOD).parameters()
    changes = LONGER if PLAN["long"] else TINY
    if isinstance(parameters.steps, tuple):
        changes = changes | (LONGER_BY_LEVEL if PLAN["long"] else TINY_BY_LEVEL)
    return changes


start(tour())
