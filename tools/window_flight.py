"""Script of ``make window`` with ``--flight``: measure how long streaming blocks Blender's main thread.

``tools/window.py --flight`` runs it inside Blender: open a tree larger than its budget, fly through it, save
and reopen the file, and use a render region and F12. It times all calls from Blender to LODGS in the main
thread, and Blender's evaluations. Drawing pixels is timed separately: this display uses software rendering.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_actions import (
    LODGS,
    OUT,
    PLAN,
    Steps,
    log,
    module,
    pose,
    press,
    press_f12,
    region,
    screenshot,
    scroll,
    show,
    start,
    training,
    until,
    viewport,
)

FRAMES = 6
"""Frames of the flight between two cameras."""
SCREENSHOTS = 4
"""Screenshots during the flight."""

PIXELS, EVALUATION = "drawing pixels", "Blender's evaluation"
NOT_OURS = (PIXELS, EVALUATION)


class CallTimer:
    """Times outermost calls to LODGS in the main thread, without separately timed calls inside.

    Attributes:
        blocks: name, wall time and CPU time of each call, in seconds.
    """

    def __init__(self) -> None:
        self.blocks: list[tuple[str, float, float]] = []
        self._depth = 0
        self._separate_wall = self._separate_cpu = 0.0
        self._replaced: list[tuple[list, Callable, Callable]] = []

    @contextmanager
    def block(self, name: str, *, separate: bool = False) -> Iterator[None]:
        """Time the block; with ``separate``, exclude it from the enclosing block."""
        if threading.current_thread() is not threading.main_thread() or (self._depth and not separate):
            yield
            return
        if not separate:
            self._depth = 1
            self._separate_wall = self._separate_cpu = 0.0
        wall, cpu = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
            if separate:
                self._separate_wall += wall
                self._separate_cpu += cpu
            else:
                self._depth = 0
                wall -= self._separate_wall
                cpu -= self._separate_cpu
            self.blocks.append((name, wall, cpu))

    def wrap(self, function: Callable, name: str, *, separate: bool = False) -> Callable:
        """Return the function with timing."""

        def timed(*args, **options):
            with self.block(name, separate=separate):
                return function(*args, **options)

        timed.__name__ = function.__name__
        return timed

    def watch(self) -> None:
        """Start timing all calls from Blender to LODGS."""
        for owner, function, name, separate in (
            (module("viewport.splats"), "draw", PIXELS, True),
            (module("viewport.discs"), "draw", PIXELS, True),
            (module("viewport"), "_draw_view", "redraw", False),
            (module("viewport.views"), "_wake", "polling for loaded data", False),
            (module("viewport.view_camera"), "_store_pending", "updating the camera", False),
        ):
            setattr(owner, function, self.wrap(getattr(owner, function), name, separate=separate))
        for cls in [*_subclasses(bpy.types.Operator), *_subclasses(bpy.types.Panel)]:
            for function in ("execute", "invoke", "modal", "draw"):
                if getattr(getattr(cls, function, None), "__module__", "").startswith(LODGS):
                    setattr(cls, function, self._wrap_method(cls, function))
        for name in dir(bpy.app.handlers):
            functions = getattr(bpy.app.handlers, name)
            for i, function in enumerate(functions if isinstance(functions, list) else ()):
                if getattr(function, "__module__", "").startswith(LODGS):
                    part = function.__module__.rpartition(".")[2]
                    functions[i] = bpy.app.handlers.persistent(self.wrap(function, f"{name} of {part}"))
                    self._replaced.append((functions, functions[i], function))

    def _wrap_method(self, owner: type, name: str) -> Callable:
        """Return a method with timing and the same number of arguments, which Blender checks."""
        function, label = getattr(owner, name), f"{owner.__name__}.{name}"

        def with_event(instance, context, event):
            with self.block(label):
                return function(instance, context, event)

        def without_event(instance, context):
            with self.block(label):
                return function(instance, context)

        return with_event if name in ("invoke", "modal") else without_event

    def stop(self) -> None:
        """Restore the handlers."""
        for functions, timed, function in self._replaced:
            functions[functions.index(timed)] = function

    def watch_evaluations(self) -> None:
        """Start timing Blender's evaluations."""
        starts: list[float] = []

        @bpy.app.handlers.persistent
        def on_start(*_) -> None:
            starts[:] = [time.perf_counter()]

        @bpy.app.handlers.persistent
        def on_end(*_) -> None:
            if starts:
                wall = time.perf_counter() - starts.pop()
                self.blocks.append((EVALUATION, wall, wall))

        bpy.app.handlers.depsgraph_update_pre.append(on_start)
        bpy.app.handlers.depsgraph_update_post.insert(0, on_end)

    def report(self, title: str) -> None:
        """Log the longest calls since the last report."""
        blocks, self.blocks = self.blocks, []
        names = dict.fromkeys(name for name, _, _ in blocks)
        rows = []
        for name in names:
            wall, cpu = 1e3 * np.array([block[1:] for block in blocks if block[0] == name]).T
            rows.append((wall.max(), f"{wall.max():6.1f} ms ({cpu[wall.argmax()]:.1f} CPU), "
                        f"99 % {np.quantile(wall, 0.99):.1f}, {len(wall):4} times: {name}"))  # fmt: skip
        rows.sort(reverse=True)
        ours = max((wall for name, wall, _ in blocks if name not in NOT_OURS), default=0)
        log(f"{title}: longest {1e3 * ours:.1f} ms")
        for _, row in rows[:7]:
            log(f"    {row}")


def _subclasses(cls: type) -> list[type]:
    """Return all direct and indirect subclasses."""
    return [c for child in cls.__subclasses__() for c in (child, *_subclasses(child))]


def flight() -> Steps:
    """Run all steps."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    bpy.context.scene.lodgs_viewport.budget = PLAN["budget"]
    yield 1.0
    timer = CallTimer()
    timer.watch()
    timer.watch_evaluations()
    try:
        yield from fly(timer, space)
        yield from reopen(timer)
        yield from region_and_f12(timer)
    finally:
        timer.stop()


def fly(timer: CallTimer, space: bpy.types.SpaceView3D) -> Steps:
    cameras = all_cameras()
    roots = module("data.roots").roots
    opened = time.monotonic()
    press(
        "lodgs.import_splats",
        mode="INVOKE_DEFAULT",
        filepath=PLAN["flight"],
        upright=False,
        budget=PLAN["budget"],
    )
    yield from until(lambda: bool(roots(bpy.context.scene)), 60)
    imported = time.monotonic() - opened
    space.clip_start, space.clip_end = 0.05, 5000.0
    show(pose(cameras[0]))
    yield from loaded()
    timer.report(f"opened: imported after {imported:.1f} s, loaded after {time.monotonic() - opened:.1f}")
    screenshot("opened")
    scroll(8)
    screenshot("panels")
    timer.blocks.clear()
    flight_start = time.monotonic()
    frames = 0
    legs = list(pairwise(cameras))
    for number, (first, second) in enumerate(legs):
        for share in np.arange(FRAMES) / FRAMES:
            show(pose(first, second, float(share)))
            frames += 1
            yield 0.01
        if number % max(len(legs) // SCREENSHOTS, 1) == 0:
            count = len(timer.blocks)
            screenshot(f"flight-{number}")
            del timer.blocks[count:]
    seconds = time.monotonic() - flight_start
    flight_end = time.monotonic()
    yield from loaded()
    timer.report(
        f"flight: {frames} frames in {seconds:.0f} s, loaded {time.monotonic() - flight_end:.1f} s later"
    )
    screenshot("arrived")


def reopen(timer: CallTimer) -> Steps:
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "flight.blend"))
    yield 1.0
    timer.blocks.clear()
    bpy.ops.wm.open_mainfile(filepath=str(OUT / "flight.blend"))
    yield 0.5
    yield from loaded()
    timer.report("saved and reopened")
    screenshot("again")


def region_and_f12(timer: CallTimer) -> Steps:
    """Toggle a render region, and press F12."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("flight", bpy.data.cameras.new("flight"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.matrix_world = pose(all_cameras()[2])
    scene.render.resolution_x, scene.render.resolution_y = 480, 270
    module("render.engine").use(scene)
    yield 0.5
    yield from loaded()
    timer.blocks.clear()
    viewport()[1].view_perspective = "CAMERA"
    for use in (True, False, True, False):
        scene.render.use_border = use
        yield 0.3
    yield from loaded()
    timer.report("render region on and off")
    bpy.context.preferences.view.render_display_type = "NONE"
    result = yield from press_f12(120)
    yield from loaded()
    timer.report(f"F12 {result}")


def all_cameras() -> list:
    """Return the cameras of the flight, in the order of their names."""
    paths = sorted(Path(PLAN["cameras"]).glob("*.json"))
    return [training("scenes.cameras").read_camera(path)[0] for path in paths]


def loaded() -> Steps:
    """Wait until all data is loaded."""
    views, sources = module("viewport.views"), module("viewport.sources")
    (root,) = module("data.roots").roots(bpy.context.scene)

    def is_loaded() -> bool:
        stream = sources.stream(root)
        states = views._views.values()
        busy = any(view.pending or view.resolution < 1 or views.wants_redraw(view) for view in states)
        return bool(states) and not busy and stream is not None and not stream.busy

    deadline = time.monotonic() + 150
    while not is_loaded():
        assert time.monotonic() < deadline, "Loading does not finish."
        yield 0.02
    yield 0.6  # modifiers update once the view rests


start(flight())
