"""Script of ``make window`` with ``--speed``: measure the redraws of a moving viewport.

``tools/window.py --speed SPLATS --cameras DIR`` runs it inside Blender: open a splat file, fly along the
cameras, then walk with Blender's walk navigation. Logs wall and CPU seconds per redraw, those of all threads.
Use it on an idle machine.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Generator
from itertools import pairwise
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_actions import (
    PLAN,
    Steps,
    log,
    module,
    pose,
    press,
    redraw,
    region,
    screenshot,
    show,
    start,
    training,
    until,
    viewport,
)

SECONDS = 12.0
"""Length of each measurement."""
FRAMES = 10
"""Frames of the flight between two cameras."""


class Redraws:
    """Times of the viewport's redraws since the start."""

    def __init__(self) -> None:
        self.times: list[tuple[float, float]] = []
        self._handle = bpy.types.SpaceView3D.draw_handler_add(self._add, (), "WINDOW", "POST_PIXEL")

    def _add(self) -> None:
        self.times.append((time.monotonic(), time.process_time()))

    def clear(self) -> None:
        self.times.clear()

    def report(self, title: str) -> None:
        """Log the mean and the longest time between redraws."""
        wall, cpu = np.diff(self.times, axis=0).T
        log(
            f"{title}: {len(wall)} redraws, {1e3 * wall.mean():.0f} ms each"
            f" ({1e3 * np.median(wall):.0f} median, {1e3 * wall.max():.0f} longest),"
            f" {1e3 * cpu.mean():.0f} ms of CPU time; {drawn()}"
        )

    def close(self) -> None:
        bpy.types.SpaceView3D.draw_handler_remove(self._handle, "WINDOW")


def speed() -> Steps:
    """Run all steps."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    space.clip_start, space.clip_end = 0.05, 5000.0
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    press("lodgs.import_splats", filepath=PLAN["speed"], upright=False)
    paths = sorted(Path(PLAN["cameras"]).glob("*.json"))
    cameras = [training("scenes.cameras").read_camera(path)[0] for path in paths]
    show(pose(cameras[0]))
    space.clip_start, space.clip_end = 0.05, 5000.0
    yield from loaded()
    screenshot("rest")
    redraws = Redraws()
    try:
        yield from rest(redraws)
        yield from fly(redraws, cameras)
        yield from walk(redraws, cameras)
    finally:
        redraws.close()


def rest(redraws: Redraws) -> Steps:
    """Measure redraws of a view at rest."""
    for _ in range(4):
        redraw()
    redraws.report("rest")
    yield 0.1


def fly(redraws: Redraws, cameras: list) -> Steps:
    """Move the view along the cameras."""
    poses = [pose(*pair, share / FRAMES) for pair in pairwise(cameras) for share in range(FRAMES)]
    for title in ("flight, first", "flight"):  # the first one measures how many splats a moving view draws
        redraws.clear()
        end = time.monotonic() + SECONDS / (2 if title != "flight" else 1)
        for matrix in poses:
            show(matrix)
            yield 0.001
            if time.monotonic() > end:
                break
        redraws.report(title)
        if title == "flight":
            screenshot("flight", redraw_first=False)
    yield from loaded()


def walk(redraws: Redraws, cameras: list) -> Steps:
    """Walk with Blender's navigation: forward, turning."""
    show(pose(cameras[0]))
    yield from loaded()
    window = bpy.context.window_manager.windows[0]
    middle = [round(region().x + region().width / 2), round(region().y + region().height / 2)]
    window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=middle[0], y=middle[1])
    yield 0.5
    press("view3d.walk")
    window.event_simulate(type="W", value="PRESS")
    yield 0.5
    redraws.clear()
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        middle[0] += 1
        window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=middle[0], y=middle[1])
        yield 0.1
    redraws.report("walk")
    screenshot("walk", redraw_first=False)
    window.event_simulate(type="W", value="RELEASE")
    yield 0.2
    window.event_simulate(type="LEFTMOUSE", value="PRESS", x=middle[0], y=middle[1])
    window.event_simulate(type="LEFTMOUSE", value="RELEASE", x=middle[0], y=middle[1])
    began = time.monotonic()
    yield from loaded()
    log(f"complete {time.monotonic() - began:.1f} s after the walk")
    screenshot("arrived", redraw_first=False)


def loaded() -> Generator[float, None, None]:
    """Wait until the view is complete."""
    views = module("viewport.views")

    def is_loaded() -> bool:
        states = views._views.values()
        return bool(states) and all(
            view.count and not (view.pending or view.loading or view.resolution < 1) for view in states
        )

    yield 0.5
    yield from until(is_loaded, 300)
    yield 1.0


def drawn() -> str:
    """Return the number of splats of the last redraw."""
    counts = [view.count for view in module("viewport.views")._views.values()]
    return f"{max(counts, default=0):,} splats drawn"


start(speed())
