"""Script of ``make window`` with ``--cells``: plan and train a large scene in cells in Blender.

``tools/window.py --cells`` runs it inside Blender: show the plan, train two cells at a time, cancel and
resume one, reopen the file meanwhile, and import the levels.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
from mathutils import Euler, Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_actions import (
    OUT,
    PLAN,
    Steps,
    module,
    open_panels,
    press,
    region,
    screenshot,
    scroll,
    settle,
    start,
    until,
    viewport,
)

TINY = {
    "levels": 3, "steps": (60, 100, 160), "densify_until": (0.5,) * 3, "densify_interval": (20,) * 3,
    "max_splats": 20_000,
}  # fmt: skip


def tour() -> Steps:
    """Run all steps. A failed assertion ends the script with its message."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.training_cells")
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    press("lodgs.import_colmap", directory=PLAN["scene"], photographs=False)
    root = module("data.roots").active_root(bpy.context)
    _look_down(root)
    yield from plan(root)
    yield from train(root)


def plan(root: bpy.types.Object) -> Steps:
    settings = root.lodgs.training
    settings.columns = settings.rows = settings.at_once = 2
    yield from settle()
    screenshot("large-scene")
    press("lodgs.plan_cells", "INVOKE_DEFAULT")
    yield from until(lambda: len(settings.planned_cells) == 4, 120)
    settings.active_cell = 1
    scroll(9)
    yield from settle()
    screenshot("plan", ", ".join(f"{cell.views} views" for cell in settings.planned_cells))


def train(root: bpy.types.Object) -> Steps:
    root.lodgs.training.image_scale = 0.25
    jobs = module("runs.jobs")
    watch = jobs.start(root, PLAN["run"], TINY)
    jobs.follow(watch)

    def states() -> list[str]:
        return [part.state for number in range(1, watch.cells + 1) if (part := watch.part(number))]

    yield from until(lambda: not watch.running or states().count("running") == 2, 400)
    assert watch.running, watch.problem
    number = states().index("running") + 1
    scroll(4)
    yield from settle()
    screenshot("cells", f"{states()}")
    press("lodgs.cancel_cell", cell=number)
    yield from until(lambda: states()[number - 1] == "cancelled", 120)
    yield from settle()
    screenshot("one-cancelled", f"{states()}")

    blend = str(OUT / "town.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    press("wm.read_homefile", "EXEC_DEFAULT")
    yield 1.0
    press("wm.open_mainfile", "EXEC_DEFAULT", filepath=blend)
    yield 2.0
    root = module("data.roots").active_root(bpy.context)
    watch = module("runs.watch").watch_of(root)
    assert watch is not None and watch.running and watch.process is None, (
        "The run is not found after reopening the file."
    )
    assert states()[number - 1] == "cancelled", f"{states()}"
    press("lodgs.resume_cell", cell=number)
    yield from until(lambda: states()[number - 1] in ("waiting", "running"), 60)
    yield from settle()
    screenshot("found-and-resumed", f"{states()}")

    yield from until(lambda: not watch.running, 1500)
    yield from settle()
    assert watch.state == "done", watch.problem or watch.message
    assert len(root.lodgs.levels) == TINY["levels"], "Not all levels were imported."
    screenshot("trained", ", ".join(f"{len(item.object.data.points):,}" for item in root.lodgs.levels))


def _look_down(root: bpy.types.Object) -> None:
    """Look from above at an angle, with all cameras visible."""
    positions = [view.matrix_world.translation for view in module("data.photographs").views(root)]
    center = sum(positions, Vector()) / len(positions)
    view = viewport()[1]
    view.view_perspective = "PERSP"
    view.view_rotation = Euler((math.radians(30), 0, math.radians(20))).to_quaternion()
    radius = max((position - center).length for position in positions)
    view.view_location = center + view.view_rotation @ Vector((0.35 * radius, 0, 0))  # left of the sidebar
    view.view_distance = 2.9 * radius


start(tour())
