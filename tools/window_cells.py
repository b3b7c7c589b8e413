"""The tour of a large scene, inside Blender: planned, trained in cells, put together.

``tools/window.py --cells`` starts it. The plan over the scene, two cells at once, one stopped and gone on
with, the file closed and opened meanwhile, and levels that arrive.
"""
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
from mathutils import Euler, Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_hands import (
    OUT,
    PLAN,
    Steps,
    module,
    open_panels,
    press,
    region,
    scroll,
    settle,
    start,
    take,
    until,
    viewport,
)

TINY = {
    "levels": 3, "steps": (60, 100, 160), "densify_until": (0.5,) * 3, "densify_interval": (20,) * 3,
    "max_splats": 20_000,
}  # fmt: skip


def tour() -> Steps:
    """Everything in order. An assertion that fails ends the tour with its sentence."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    open_panels("panels.training_cells")
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    press("lodgs.import_colmap", directory=PLAN["scene"], photographs=False)
    root = module("data.scenes").active_root(bpy.context)
    _look_down(root)
    yield from plan(root)
    yield from train(root)


def plan(root: bpy.types.Object) -> Steps:
    settings = root.lodgs.training
    settings.columns = settings.rows = settings.at_once = 2
    yield from settle()
    take("large-scene")
    press("lodgs.plan_cells", "INVOKE_DEFAULT")
    yield from until(lambda: len(settings.planned_cells) == 4, 120)
    settings.active_cell = 1
    scroll(9)
    yield from settle()
    take("plan", ", ".join(f"{cell.views} views" for cell in settings.planned_cells))


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
    take("cells", f"{states()}")
    press("lodgs.cancel_block", block=number)
    yield from until(lambda: states()[number - 1] == "cancelled", 120)
    yield from settle()
    take("one-cancelled", f"{states()}")

    blend = str(OUT / "town.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    press("wm.read_homefile", "EXEC_DEFAULT")
    yield 1.0
    press("wm.open_mainfile", "EXEC_DEFAULT", filepath=blend)
    yield 2.0
    root = module("data.scenes").active_root(bpy.context)
    watch = module("runs.watch").watch_of(root)
    assert watch is not None and watch.running and watch.process is None, "The run is not found again."
    assert states()[number - 1] == "cancelled", f"{states()}"
    press("lodgs.resume_block", block=number)
    yield from until(lambda: states()[number - 1] in ("waiting", "running"), 60)
    yield from settle()
    take("found-and-resumed", f"{states()}")

    yield from until(lambda: not watch.running, 1500)
    yield from settle()
    assert watch.state == "done", watch.problem or watch.message
    assert len(root.lodgs.levels) == TINY["levels"], "Not all levels came."
    take("trained", ", ".join(f"{len(item.object.data.points):,}" for item in root.lodgs.levels))


def _look_down(root: bpy.types.Object) -> None:
    """From above and aside, with all cameras in sight."""
    places = [view.matrix_world.translation for view in module("data.photographs").views(root)]
    middle = sum(places, Vector()) / len(places)
    looks = viewport()[1]
    looks.view_perspective = "PERSP"
    looks.view_rotation = Euler((math.radians(30), 0, math.radians(20))).to_quaternion()
    reach = max((place - middle).length for place in places)
    looks.view_location = middle + looks.view_rotation @ Vector((0.35 * reach, 0, 0))  # left of the sidebar
    looks.view_distance = 2.9 * reach


start(tour())
