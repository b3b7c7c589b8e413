"""The flight of ``make window``, inside Blender: how long LODGS holds the main thread while a tree streams.

``tools/window.py --flight`` starts it. A tree larger than its budget is opened, flown through, saved, opened
again, and a render region and F12 are begun. All that LODGS has Blender call in its main thread is timed, and
what Blender evaluates because of it. Drawing pixels is told apart: it is software's here, not a graphics
card's.
"""
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false

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
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.window_hands import (
    LODGS,
    OUT,
    PLAN,
    Steps,
    module,
    press,
    press_f12,
    region,
    say,
    scroll,
    start,
    take,
    training,
    until,
    viewport,
)

FRAMES = 6
"""Of the flight, from each camera to the next."""
PICTURES = 4
"""Pictures taken by the way."""

PIXELS, EVALUATION = "drawing pixels", "Blender's evaluation"
NOT_OURS = (PIXELS, EVALUATION)


class Stopwatch:
    """How long what LODGS does holds the main thread: each outermost call, without what draws pixels in it.

    Attributes:
        blocks: of each, what it was, seconds by the clock, and seconds of the processor.
    """

    def __init__(self) -> None:
        self.blocks: list[tuple[str, float, float]] = []
        self._depth, self._apart, self._apart_own = 0, 0.0, 0.0
        self._replaced: list[tuple[list, Callable, Callable]] = []

    @contextmanager
    def block(self, name: str, *, apart: bool = False) -> Iterator[None]:
        """Times what is done in it; ``apart``: as a block of its own, wherever it is."""
        if threading.current_thread() is not threading.main_thread() or (self._depth and not apart):
            yield
            return
        if not apart:
            self._depth, self._apart, self._apart_own = 1, 0.0, 0.0
        wall, own = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            wall, own = time.perf_counter() - wall, time.thread_time() - own
            if apart:
                self._apart, self._apart_own = self._apart + wall, self._apart_own + own
            else:
                self._depth, wall, own = 0, wall - self._apart, own - self._apart_own
            self.blocks.append((name, wall, own))

    def over(self, function: Callable, name: str, *, apart: bool = False) -> Callable:
        """The function, timed."""

        def timed(*args, **options):
            with self.block(name, apart=apart):
                return function(*args, **options)

        timed.__name__ = function.__name__
        return timed

    def watch(self) -> None:
        """Times from now on all that LODGS has Blender call."""
        for owner, function, name, apart in (
            (module("viewport.splats"), "draw", PIXELS, True),
            (module("viewport.discs"), "draw", PIXELS, True),
            (module("viewport"), "_draw_view", "redraw", False),
            (module("viewport.views"), "_wake", "looking for what is ready", False),
            (module("viewport.eye"), "_hand_on", "handing the eye on", False),
        ):
            setattr(owner, function, self.over(getattr(owner, function), name, apart=apart))
        for each in [*_below(bpy.types.Operator), *_below(bpy.types.Panel)]:
            for function in ("execute", "invoke", "modal", "draw"):
                if getattr(getattr(each, function, None), "__module__", "").startswith(LODGS):
                    setattr(each, function, self._over_method(each, function))
        for name in dir(bpy.app.handlers):
            functions = getattr(bpy.app.handlers, name)
            for i, function in enumerate(functions if isinstance(functions, list) else ()):
                if getattr(function, "__module__", "").startswith(LODGS):
                    part = function.__module__.rpartition(".")[2]
                    functions[i] = bpy.app.handlers.persistent(self.over(function, f"{name} of {part}"))
                    self._replaced.append((functions, functions[i], function))

    def _over_method(self, owner: type, name: str) -> Callable:
        """A method, timed. Blender counts the arguments that methods have."""
        function, label = getattr(owner, name), f"{owner.__name__}.{name}"

        def with_event(own, context, event):
            with self.block(label):
                return function(own, context, event)

        def without(own, context):
            with self.block(label):
                return function(own, context)

        return with_event if name in ("invoke", "modal") else without

    def stop(self) -> None:
        """Gives the handlers back."""
        for functions, timed, function in self._replaced:
            functions[functions.index(timed)] = function

    def evaluations(self) -> None:
        """Times from now on what Blender evaluates."""
        begun: list[float] = []

        @bpy.app.handlers.persistent
        def before(*_) -> None:
            begun[:] = [time.perf_counter()]

        @bpy.app.handlers.persistent
        def after(*_) -> None:
            if begun:
                wall = time.perf_counter() - begun.pop()
                self.blocks.append((EVALUATION, wall, wall))

        bpy.app.handlers.depsgraph_update_pre.append(before)
        bpy.app.handlers.depsgraph_update_post.insert(0, after)

    def tell(self, title: str) -> None:
        """Says the longest blocks since it last did."""
        blocks, self.blocks = self.blocks, []
        names = dict.fromkeys(name for name, _, _ in blocks)
        rows = []
        for name in names:
            wall, own = 1e3 * np.array([each[1:] for each in blocks if each[0] == name]).T
            rows.append((wall.max(), f"{wall.max():6.1f} ms ({own[wall.argmax()]:.1f} of the processor), "
                        f"99 % {np.quantile(wall, 0.99):.1f}, {len(wall):4} times: {name}"))  # fmt: skip
        rows.sort(reverse=True)
        ours = max((wall for name, wall, _ in blocks if name not in NOT_OURS), default=0)
        say(f"{title}: longest {1e3 * ours:.1f} ms")
        for _, row in rows[:7]:
            say(f"    {row}")


def _below(kind: type) -> list[type]:
    """All classes that inherit from one."""
    return [each for own in kind.__subclasses__() for each in (own, *_below(own))]


def flight() -> Steps:
    """Opened, flown through, saved, opened again."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    space: bpy.types.SpaceView3D = viewport()[0].spaces.active  # type: ignore[assignment]
    space.show_region_ui = True
    yield 1.0
    region("UI").active_panel_category = "LODGS"
    bpy.context.scene.lodgs_viewport.budget = PLAN["budget"]
    yield 1.0
    watch = Stopwatch()
    watch.watch()
    watch.evaluations()
    try:
        yield from flown(watch, space)
        yield from saved(watch)
        yield from region_and_f12(watch)
    finally:
        watch.stop()


def flown(watch: Stopwatch, space: bpy.types.SpaceView3D) -> Steps:
    cameras = all_cameras()
    roots = module("data.scenes").roots
    opened = time.monotonic()
    press(
        "lodgs.import_splats",
        way="INVOKE_DEFAULT",
        filepath=PLAN["flight"],
        upright=False,
        budget=PLAN["budget"],
    )
    yield from until(lambda: bool(roots(bpy.context.scene)), 60)
    came = time.monotonic() - opened
    space.clip_start, space.clip_end = 0.05, 5000.0
    look(cameras[0])
    yield from all_there()
    watch.tell(f"opened: in the scene after {came:.1f} s, all there after {time.monotonic() - opened:.1f}")
    take("opened")
    scroll(8)
    take("panels")
    watch.blocks.clear()
    begun, frames = time.monotonic(), 0
    way = list(pairwise(cameras))
    for number, (one, other) in enumerate(way):
        for share in np.arange(FRAMES) / FRAMES:
            look(one, other, float(share))
            frames += 1
            yield 0.01
        if number % max(len(way) // PICTURES, 1) == 0:
            drawn = len(watch.blocks)
            take(f"flight-{number}")
            del watch.blocks[drawn:]
    seconds = time.monotonic() - begun
    begun = time.monotonic()
    yield from all_there()
    watch.tell(
        f"flown: {frames} places in {seconds:.0f} s, all there {time.monotonic() - begun:.1f} s after it"
    )
    take("arrived")


def saved(watch: Stopwatch) -> Steps:
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "flight.blend"))
    yield 1.0
    watch.blocks.clear()
    bpy.ops.wm.open_mainfile(filepath=str(OUT / "flight.blend"))
    yield 0.5
    yield from all_there()
    watch.tell("saved and opened again")
    take("again")


def region_and_f12(watch: Stopwatch) -> Steps:
    """A render region on and off, and F12 until it draws."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.matrix_world = pose(all_cameras()[2])
    scene.render.resolution_x, scene.render.resolution_y = 480, 270
    module("render.engine").use(scene)
    yield 0.5
    yield from all_there()
    watch.blocks.clear()
    viewport()[1].view_perspective = "CAMERA"
    for use in (True, False, True, False):
        scene.render.use_border = use
        yield 0.3
    yield from all_there()
    watch.tell("render region on and off")
    bpy.context.preferences.view.render_display_type = "NONE"
    ended = yield from press_f12(120)
    yield from all_there()
    watch.tell(f"F12 {ended}")


def all_cameras() -> list:
    """Those to fly along, in the order of their names."""
    paths = sorted(Path(PLAN["cameras"]).glob("*.json"))
    return [training("scenes.cameras").read_camera(path)[0] for path in paths]


def all_there() -> Steps:
    """Wait until nothing is on its way."""
    views, (root,) = module("viewport.views"), module("data.scenes").roots(bpy.context.scene)

    def there() -> bool:
        stream, shown = views.stream(root), views._views.values()
        moving = any(view.pending or view.resolution < 1 or views.wants_redraw(view) for view in shown)
        return bool(shown) and not moving and stream is not None and not stream.busy

    until_ = time.monotonic() + 150
    while not there():
        assert time.monotonic() < until_, "Not all comes."
        yield 0.02
    yield 0.6  # the view rests, and modifiers follow


def pose(one, other=None, share: float = 0.0) -> Matrix:
    """Where a camera stands in Blender's world, or so far on the way to another."""
    place, turn, _ = _own(one).decompose()
    if other is not None:
        to, turned, _ = _own(other).decompose()
        place, turn = place.lerp(to, share), turn.slerp(turned, share)
    return Matrix.Translation(place) @ turn.to_matrix().to_4x4()  # type: ignore[arg-type]


def _own(camera) -> Matrix:
    found = np.linalg.inv(np.array(camera.world_to_camera, np.float64)) @ np.diag([1.0, -1, -1, 1])
    return Matrix(found.tolist())


def look(one, other=None, share: float = 0.0) -> None:
    """Have the viewport look from there."""
    where, looks = pose(one, other, share), viewport()[1]
    looks.view_perspective, looks.view_distance = "PERSP", 3.0
    looks.view_rotation = where.to_quaternion()
    looks.view_location = where @ Vector((0, 0, -3.0))
    viewport()[0].tag_redraw()


start(flight())
