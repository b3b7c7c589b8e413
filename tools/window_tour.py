"""Script of ``make window``: the main workflow in Blender, checked step by step with screenshots.

``tools/window.py`` runs it inside Blender. A timer runs the steps of :func:`tour`, so that Blender redraws,
handles events and trains between steps.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_actions import (
    LODGS,
    OUT,
    PLAN,
    Steps,
    changed_share,
    check_installation,
    leave_camera,
    look_at,
    module,
    open_panels,
    pixels,
    press,
    press_f12,
    psnr,
    region,
    screenshot,
    scroll,
    settle,
    start,
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
"""Parameters of a tiny job, and additional ones for methods that train level by level."""
LONGER = {"max_splats": 60_000, "steps": 3000}
LONGER_BY_LEVEL = {"steps": (150, 250, 300, 450, 1000)}
"""Parameters of a job of some minutes."""


def tour() -> Steps:
    """Run all steps. A failed assertion ends the script with its message."""
    yield from preferences()
    root = yield from import_scene()
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
    report = yield from check_installation()
    assert report.ok, f"No trainer found: {report.problems}"
    screenshot("preferences", report.versions["torch"])
    area.type = "VIEW_3D"
    yield 0.5
    for name in ("Cube", "Light", "Camera"):  # as in the guide: the import adds cameras
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.rendering", "panels.compare")
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    yield from settle()
    screenshot("tab")


def import_scene() -> Iterator[float]:
    press("lodgs.import_colmap", directory=PLAN["scene"])
    root = module("data.roots").active_root(bpy.context)
    views = module("data.photographs").views(root)
    photos = list(Path(PLAN["scene"], "images").iterdir())
    assert len(views) == len(photos), f"Imported {len(views)} of {len(photos)} cameras."
    assert len(root.lodgs.points.data.points), "No points were imported."
    look_at(views[0].matrix_world @ Vector((1.0, 0, -2)), distance=11)
    yield from settle()
    screenshot("import", f"{len(views)} cameras, {len(root.lodgs.points.data.points):,} points")
    press("lodgs.look_through")
    view = viewport()[1]
    view.view_perspective = "CAMERA"
    view.view_camera_zoom, view.view_camera_offset = 10, (0.12, 0)  # left of the sidebar
    yield from settle()
    assert viewport()[1].view_perspective == "CAMERA"
    screenshot("look-through", bpy.context.scene.camera.name)
    return root


def train(root: bpy.types.Object) -> Steps:
    jobs = module("runs.jobs")
    root.lodgs.training.method = METHOD
    watch = jobs.start(root, PLAN["run"], job())
    jobs.follow(watch)

    def levels_trained() -> bool:  # all levels except the last
        return bool(watch.progress) and len(watch.levels) >= watch.progress["levels"] - 1

    yield from until(lambda: not watch.running or levels_trained(), 900)
    assert watch.running, f"No level was imported during training: {watch.problem}"
    yield from settle()
    screenshot(
        "training", f"{len(root.lodgs.levels)} of {watch.progress['levels']} levels imported during training"
    )
    press("lodgs.cancel_training")
    yield from until(lambda: not watch.running, 120)
    yield from settle()
    assert watch.state == "cancelled", watch.problem or f"Not cancelled: {watch.message}."
    screenshot("cancelled", watch.message)
    press("lodgs.resume_training")
    watch = module("runs.watch").watch_of(root)
    yield from until(lambda: not watch.running, 1200)
    yield from settle()
    assert watch.state == "done", watch.problem or watch.message
    assert len(root.lodgs.levels) == watch.progress["levels"], "Not all levels were imported."
    counts = splat_counts(root)
    assert counts == sorted(set(counts)), f"Finer levels should have more splats: {counts}"
    screenshot("trained", f"{len(counts)} levels of {', '.join(f'{n:,}' for n in counts)} splats")


def levels(root: bpy.types.Object) -> Steps:
    root.lodgs.cameras.hide_viewport = True
    settings = bpy.context.scene.lodgs_viewport
    images = {}
    finest = len(root.lodgs.levels)
    for number in sorted({1, finest}):
        press("lodgs.show_only_level", level=number)
        yield from settle()
        visible, _ = module("data.scenes").count_visible(bpy.context, root)
        assert visible == splat_counts(root)[number - 1], f"{visible} splats are visible."
        images[number] = screenshot(f"level-{number}", f"{visible:,} splats")
    if finest > 1:
        assert changed_share(images[1], images[finest]) > 0.2, "Level 1 looks like the finest level."
    settings.splats = False
    yield from settle()
    points = screenshot("points")
    settings.splats = True
    yield from settle()
    splats = screenshot("splats")
    assert changed_share(points, splats) > 0.2, "Points look like splats."
    assert changed_share(images[finest], splats) < 0.01, "The same splats look different after switching."


def distances(root: bpy.types.Object) -> Steps:
    """Use the rule's defaults, then coarser controls until a quarter fewer splats are visible."""
    count_visible = module("data.scenes").count_visible
    controls, levels = root.lodgs.controls, [item.number for item in root.lodgs.levels]
    rule = training("lod.rule").find_rule(root.lodgs.rule)
    root.lodgs.mode = "SELECTIVE"
    scroll(20)
    yield from settle()
    initial, total = count_visible(bpy.context, root)
    assert 0 < initial <= total, f"{initial} of {total} splats are visible by distance."
    screenshot("by-distance", f"{initial:,} of {total:,} splats")
    visible = initial
    while visible > 0.75 * initial:
        values = rule.coarser(
            {control.name: getattr(controls, control.name) for control in rule.controls}, levels
        )
        assert values, f"{visible} of {initial} splats are visible, and no coarser controls exist."
        for name, value in values.items():
            setattr(controls, name, value)
        bpy.context.view_layer.update()
        visible, _ = count_visible(bpy.context, root)
    yield from settle()
    assert visible, "No splats are visible with coarser controls."
    screenshot("by-distance-coarser", f"{visible:,} of {total:,} splats")
    root.lodgs.colors = "LEVELS"
    yield from settle()
    screenshot("by-distance-levels")
    root.lodgs.colors = "OWN"


def orbit(root: bpy.types.Object) -> Steps:
    root.lodgs.camera_choice = "VIEW"
    leave_camera()
    for angle in (-15, 25, 25):
        press("view3d.view_orbit", angle=math.radians(angle), type="ORBITRIGHT")
        yield from settle()
        yield from settle()
        position = viewport()[1].view_matrix.inverted().translation
        distance = (root.lodgs.axes.matrix_world @ Vector(root.lodgs.stored_position) - position).length
        assert distance < 1e-3, f"The selection uses a position {distance:.3f} from the view's."
        visible, _ = module("data.scenes").count_visible(bpy.context, root)
        screenshot("orbit", f"{visible:,} splats")


def freeze(root: bpy.types.Object) -> Steps:
    root.lodgs.freeze, root.lodgs.colors = True, "BANDS"
    frozen = tuple(root.lodgs.stored_position)
    visible = module("data.scenes").count_visible(bpy.context, root)
    press("view3d.view_orbit", angle=math.radians(40), type="ORBITUP")
    viewport()[1].view_distance = 40
    yield from settle()
    yield from settle()
    assert tuple(root.lodgs.stored_position) == frozen, "A frozen camera position changed."
    assert module("data.scenes").count_visible(bpy.context, root) == visible, "A frozen selection changed."
    screenshot("freeze", f"{visible[0]:,} splats")
    root.lodgs.freeze, root.lodgs.colors, root.lodgs.camera_choice = False, "OWN", "CAMERA"


def render(root: bpy.types.Object) -> Steps:
    scene = bpy.context.scene
    press("lodgs.look_through", step=1)
    viewport()[1].view_perspective = "CAMERA"
    active = root.lodgs.cameras.objects[root.lodgs.active_view]
    assert active == scene.camera == module("data.photographs").views(root)[1], "The list shows another view."
    press("lodgs.use_engine")
    scroll(60)
    yield from settle()
    screenshot("rendering")
    area = viewport()[0]
    bpy.context.preferences.view.render_display_type = "AREA"  # this display has no window manager
    result = yield from press_f12(300)
    yield from settle()
    assert result == "complete", "F12 was cancelled."
    file = OUT / "f12.png"
    bpy.data.images["Render Result"].save_render(str(file))
    photo = Path(bpy.path.abspath(scene.camera.data.lodgs.photograph))
    quality = psnr(pixels(file), pixels(photo))
    assert quality > 14, f"F12 differs from the photo: {quality:.1f} dB."
    screenshot("f12", f"{quality:.1f} dB against the photo")
    area.type = "VIEW_3D"
    yield 0.5


def draw_frames() -> Steps:
    """Render frames in Viewport Quality while Blender stays responsive."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 3, str(OUT / "frames" / "####.png")
    press("lodgs.render_quick", mode="INVOKE_DEFAULT", animation=True)
    assert not any((OUT / "frames").glob("*.png")), "Blender is blocked until the frames are rendered."
    yield from until(lambda: (OUT / "frames" / "0002.png").exists(), 300)
    screenshot("frames")
    yield from until(lambda: (OUT / "frames" / "0003.png").exists(), 300)
    yield from settle()


def compare(root: bpy.types.Object) -> Steps:
    module_ = module("render.compare")
    bpy.context.scene.lodgs_viewport.splats = False  # software rendering of each view is slow
    press("lodgs.measure_views")
    yield from until(lambda: not module_.measurement.running, 600)
    assert not module_.measurement.problem, module_.measurement.problem
    assert module_.measurement.done == len(module("data.photographs").views(root))
    bpy.context.scene.lodgs_viewport.splats = True
    press("lodgs.compare_worst")
    scroll(60)
    yield from settle()
    lowest = min(view.data.lodgs.psnr for view in module("data.photographs").views(root))
    quality = module("viewport.wipe").comparison.psnr
    assert quality == lowest > 10, f"The worst view has {quality:.1f} dB."
    images = [screenshot("compare", f"{bpy.context.scene.camera.name}: {quality:.1f} dB")]
    bpy.context.scene.lodgs_render.wipe = 0.2
    yield from settle()
    images.append(screenshot("compare-wiped"))
    assert changed_share(*images, by=0.02) > 0.02, "Moving the wipe changes nothing."


def overlays() -> Steps:
    press("wm.call_panel", name="VIEW3D_PT_overlay", keep_open=True)
    yield from settle()
    screenshot("overlays")


def splat_counts(root: bpy.types.Object) -> list[int]:
    """Return the number of splats shown for each level; levels of an octree are cumulative."""
    counts = np.array([len(item.object.data.points) for item in root.lodgs.levels])
    return (counts.cumsum() if root.lodgs.cumulative else counts).tolist()


def job() -> dict:
    """Return the changed parameters of the method's draft preset."""
    parameters = training("methods").method_info(METHOD).parameters()
    changes = LONGER if PLAN["long"] else TINY
    if isinstance(parameters.steps, tuple):
        changes = changes | (LONGER_BY_LEVEL if PLAN["long"] else TINY_BY_LEVEL)
    return changes


start(tour())
