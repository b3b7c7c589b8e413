"""Hands and eyes in a real Blender window: what :mod:`window_tour` and :mod:`window_flight` press and see.

Runs inside Blender, where a timer takes one step after the other, so that it draws and listens between them.
"""
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false

from __future__ import annotations

import importlib
import json
import math
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

LODGS = "bl_ext.user_default.lodgs"
PLAN = json.loads(sys.argv[-1])
OUT = Path(PLAN["out"])

Steps = Iterator[float]
"""Seconds to wait before each further step."""


def module(name: str):
    """A module of the installed extension."""
    return importlib.import_module(f"{LODGS}.blender_lodgs.{name}")


def training(name: str):
    """A module of what it shares with the trainer."""
    return importlib.import_module(f"{LODGS}.training.{name}")


def viewport() -> tuple[bpy.types.Area, bpy.types.RegionView3D]:
    """The 3D viewport and what it looks through."""
    for area in bpy.context.window_manager.windows[0].screen.areas:
        if area.type == "VIEW_3D":
            return area, area.spaces.active.region_3d
    raise AssertionError("There is no 3D viewport.")


def region(kind: str = "WINDOW") -> bpy.types.Region:
    return next(part for part in viewport()[0].regions if part.type == kind)


def press(operator: str, way: str = "", **settings) -> None:
    """What a button does. Errors that Blender would show become the tour's."""
    group, name = operator.split(".")
    window = bpy.context.window_manager.windows[0]
    area = next((area for area in window.screen.areas if area.type == "VIEW_3D"), window.screen.areas[0])
    part = next(part for part in area.regions if part.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=part):
        way = way or ("EXEC_DEFAULT" if group == "lodgs" else "INVOKE_DEFAULT")
        getattr(getattr(bpy.ops, group), name)(way, True, **settings)  # True: undoable, as by hand


def open_panels(*names: str) -> None:
    """Panels of these modules that begin closed begin open here: the pictures are to show them."""
    for module_ in map(module, names):
        panels = [cls for cls in module_.CLASSES if issubclass(cls, bpy.types.Panel)]
        for panel in reversed(panels):  # a panel's own before it
            bpy.utils.unregister_class(panel)
        for panel in panels:
            panel.bl_options = set(getattr(panel, "bl_options", ())) - {"DEFAULT_CLOSED"}
            bpy.utils.register_class(panel)


def scroll(times: int) -> None:
    """Turn the mouse wheel over the sidebar, from its top on downwards."""
    with bpy.context.temp_override(
        window=bpy.context.window_manager.windows[0], area=viewport()[0], region=region("UI")
    ):
        for _ in range(100):
            bpy.ops.view2d.scroll_up(deltay=40)
        for _ in range(times):
            bpy.ops.view2d.scroll_down(deltay=40)


def look_at(place: Vector, back: float) -> None:
    """Look at a place in the world from some way off, in the direction in which one looks already."""
    looks = viewport()[1]
    looks.view_location, looks.view_distance = place, back


def look_from(eye: Vector, target: Vector) -> None:
    """Look from one place in the world at another."""
    looks = viewport()[1]
    looks.view_perspective, looks.view_rotation = "PERSP", (eye - target).to_track_quat("Z", "Y")
    looks.view_location, looks.view_distance = target, (eye - target).length


def click_at(x: int, y: int) -> Steps:
    """Click with the left button at a pixel of the window."""
    yield from drag([(x, y)])
    yield from settle()


def drag(pixels: Sequence[Sequence[int]]) -> Steps:
    """Press the left button at the first of some pixels of the window, and release it at the last."""
    window = bpy.context.window_manager.windows[0]
    for number, (x, y) in enumerate(pixels):
        assert (covering := covered(int(x), int(y))) is None, f"{covering} lies over the scene at {x}, {y}."
        window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=int(x), y=int(y))
        yield 0.3
        if not number:
            window.event_simulate(type="LEFTMOUSE", value="PRESS", x=int(x), y=int(y))
            yield 0.1
    window.event_simulate(type="LEFTMOUSE", value="RELEASE", x=int(x), y=int(y))
    yield 0.3


def covered(x: int, y: int) -> str | None:
    """What of the viewport lies over the scene at a pixel of the window, such as its sidebar."""
    for part in viewport()[0].regions:
        inside = 0 <= x - part.x < part.width and 0 <= y - part.y < part.height
        if part.type != "WINDOW" and min(part.width, part.height) > 1 and inside:
            return part.type
    return None


def type_in(text: str) -> Steps:
    """Type letters, Return or Escape."""
    window = bpy.context.window_manager.windows[0]
    for letter in text:
        key = {"\r": "RET", "\x1b": "ESC"}.get(letter, letter.upper())
        for value in ("PRESS", "RELEASE"):
            known = {"unicode": letter} if letter.isalpha() and value == "PRESS" else {}
            window.event_simulate(type=key, value=value, **known)
        yield 0.2


def leave_camera() -> None:
    """Go on from the camera's place with a view of one's own that turns about what is in its middle."""
    camera, looks = bpy.context.scene.camera, viewport()[1]
    pose: Matrix = camera.matrix_world.normalized()
    looks.view_perspective = "PERSP"
    looks.view_rotation = pose.to_quaternion()
    looks.view_distance = 3.0
    looks.view_location = pose @ Vector((0, 0, -3.0))


def settle() -> Steps:
    """Wait until the picture is complete: sorted splats in full resolution, and what follows the view."""
    for _ in range(2):
        yield 0.6
        redraw()


def redraw() -> None:
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def until(condition: Callable[[], bool], seconds: float) -> Steps:
    """Wait for something that comes by itself."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"Nothing came in {seconds:.0f} seconds."
        yield 0.2


def press_f12(seconds: float) -> Generator[float, None, str]:
    """Press F12 and wait for its picture; which returns ``complete`` or ``cancelled``."""
    done: list[str] = []
    ended = (bpy.app.handlers.render_complete, bpy.app.handlers.render_cancel)
    for handlers, word in zip(ended, ("complete", "cancelled"), strict=True):
        handlers.append(lambda *_, word=word: done.append(word))
    press("render.render")
    yield from until(lambda: bool(done), seconds)
    return done[0]


taken: list[str] = []


def take(name: str, fact: str = "", redrawn: bool = True) -> np.ndarray:
    """Photograph the screen, drawn anew or as it is; return it as (H, W, 3) float32, rows from the top."""
    taken.append(name)
    title = f"{len(taken):02}-{name}"
    path = OUT / f"{title}.png"
    if redrawn:
        redraw()
    subprocess.run([*PLAN["camera"], str(path)], check=True)
    say(f"{title}: {fact}" if fact else title)
    return pixels(path)


def pixels(path: Path) -> np.ndarray:
    """A picture file as (H, W, 3) float32 with rows from the top, as the display shows it."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, 4)[::-1, :, :3]


def changed(before: np.ndarray, after: np.ndarray, by: float = 0.1, part: str = "WINDOW") -> float:
    """The share of the viewport's pixels, or of the status bar's, that differ by more than this between two
    pictures of the screen."""
    if part == "STATUSBAR":
        clear = slice(before.shape[0] - 20, None), slice(None)
    else:
        seen = region(part)
        top = before.shape[0] - seen.y - seen.height
        clear = slice(top, top + seen.height), slice(seen.x, seen.x + seen.width)
    return float((np.abs(before[clear] - after[clear]).max(axis=2) > by).mean())


def alike(picture: np.ndarray, photograph: np.ndarray) -> float:
    """PSNR in dB."""
    assert picture.shape == photograph.shape, f"{picture.shape} is not the photograph's {photograph.shape}."
    return -10 * math.log10(float(np.square(picture - photograph).mean()) + 1e-12)


def say(line: str) -> None:
    with open(OUT / "facts.txt", "a", encoding="utf-8") as facts:
        facts.write(f"{line}\n")


def start(steps: Steps) -> None:
    """Take all steps, then close Blender. The last line of facts.txt says how it ended."""
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.view.smooth_view = 0
    bpy.context.preferences.use_preferences_save = False

    def step() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            say("passed")
        except Exception as error:
            traceback.print_exc()
            say(f"failed after {taken[-1] if taken else 'the start'}: {error or type(error).__name__}")
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(step, first_interval=3.0, persistent=True)
