"""Actions and checks in a real Blender window, shared by the scripts of ``make window``.

Runs inside Blender. A timer runs one step after the other, so that Blender redraws and handles events between
steps.
"""

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
from typing import Any

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Matrix, Vector

LODGS = "bl_ext.user_default.lodgs"
PLAN = json.loads(sys.argv[-1])
OUT = Path(PLAN["out"])

Steps = Iterator[float]
"""Yields the seconds to wait before the next step."""


def module(name: str):
    """Import a module of the installed extension."""
    return importlib.import_module(f"{LODGS}.blender_lodgs.{name}")


def training(name: str):
    """Import a module of the extension's trainer package."""
    return importlib.import_module(f"{LODGS}.training.{name}")


def viewport() -> tuple[bpy.types.Area, bpy.types.RegionView3D]:
    """Return the 3D viewport and its view."""
    for area in bpy.context.window_manager.windows[0].screen.areas:
        if area.type == "VIEW_3D":
            return area, area.spaces.active.region_3d
    raise AssertionError("No 3D viewport found.")


def region(kind: str = "WINDOW") -> bpy.types.Region:
    return next(part for part in viewport()[0].regions if part.type == kind)


def press(operator: str, mode: str = "", **settings) -> None:
    """Run an operator as a button does. Operator errors raise."""
    group, name = operator.split(".")
    window = bpy.context.window_manager.windows[0]
    area = next((area for area in window.screen.areas if area.type == "VIEW_3D"), window.screen.areas[0])
    part = next(part for part in area.regions if part.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=part):
        mode = mode or ("EXEC_DEFAULT" if group == "lodgs" else "INVOKE_DEFAULT")
        getattr(getattr(bpy.ops, group), name)(mode, True, **settings)  # True: add an undo step


def open_panels(*names: str) -> None:
    """Open panels of these modules that are closed by default, for the screenshots."""
    for module_ in map(module, names):
        panels = [cls for cls in module_.CLASSES if issubclass(cls, bpy.types.Panel)]
        for panel in reversed(panels):  # subpanels first
            bpy.utils.unregister_class(panel)
        for panel in panels:
            panel.bl_options = set(getattr(panel, "bl_options", ())) - {"DEFAULT_CLOSED"}
            bpy.utils.register_class(panel)


def scroll(times: int) -> None:
    """Scroll the sidebar to its top, then down by a number of wheel steps."""
    with bpy.context.temp_override(
        window=bpy.context.window_manager.windows[0], area=viewport()[0], region=region("UI")
    ):
        for _ in range(100):
            bpy.ops.view2d.scroll_up(deltay=40)
        for _ in range(times):
            bpy.ops.view2d.scroll_down(deltay=40)


def scene_root() -> bpy.types.Object:
    """Return the splat scene. Undo replaces the object, so do not keep it."""
    (root,) = module("data.roots").roots(bpy.context.scene)
    return root


def world_position(*position: float) -> Vector:
    """Transform a position of the example scene to Blender's world."""
    return scene_root().lodgs.axes.matrix_world @ Vector(position)


def window_pixel(*position: float) -> tuple[int, int]:
    """Project a position of the example scene to a pixel of the window."""
    pixel = location_3d_to_region_2d(region(), viewport()[1], world_position(*position))
    return round(region().x + pixel.x), round(region().y + pixel.y)


def check_installation() -> Generator[float, None, Any]:
    """Show the extension's preferences and check the trainer; return ``runs.environment.report``."""
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "LODGS"
    press("preferences.addon_expand", module=LODGS)
    press("lodgs.check_environment")
    yield from settle()
    return module("runs.environment").report


def look_at(target: Vector, distance: float) -> None:
    """Look at a position in the world from a distance, keeping the view's direction."""
    view = viewport()[1]
    view.view_location, view.view_distance = target, distance


def look_from(position: Vector, target: Vector) -> None:
    """Look from one position in the world at another."""
    view = viewport()[1]
    view.view_perspective, view.view_rotation = "PERSP", (position - target).to_track_quat("Z", "Y")
    view.view_location, view.view_distance = target, (position - target).length


def click_at(x: int, y: int) -> Steps:
    """Click with the left button at a pixel of the window."""
    yield from drag([(x, y)])
    yield from settle()


def drag(pixels: Sequence[Sequence[int]]) -> Steps:
    """Press the left button at the first pixel of the window, and release it at the last."""
    window = bpy.context.window_manager.windows[0]
    for number, (x, y) in enumerate(pixels):
        assert (covering := covering_region(int(x), int(y))) is None, (
            f"{covering} covers the scene at {x}, {y}."
        )
        window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=int(x), y=int(y))
        yield 0.3
        if not number:
            window.event_simulate(type="LEFTMOUSE", value="PRESS", x=int(x), y=int(y))
            yield 0.1
    window.event_simulate(type="LEFTMOUSE", value="RELEASE", x=int(x), y=int(y))
    yield 0.3


def covering_region(x: int, y: int) -> str | None:
    """Return the region that covers the scene at a pixel of the window, such as the sidebar, or None."""
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
            character = {"unicode": letter} if letter.isalpha() and value == "PRESS" else {}
            window.event_simulate(type=key, value=value, **character)
        yield 0.2


def leave_camera() -> None:
    """Leave the camera view, keeping its position, with the orbit centre 3 m ahead."""
    camera = bpy.context.scene.camera
    view = viewport()[1]
    pose: Matrix = camera.matrix_world.normalized()
    view.view_perspective = "PERSP"
    view.view_rotation = pose.to_quaternion()
    view.view_distance = 3.0
    view.view_location = pose @ Vector((0, 0, -3.0))


def settle() -> Steps:
    """Wait until the viewport is complete: splats sorted, full resolution, modifiers updated."""
    for _ in range(2):
        yield 0.6
        redraw()


def redraw() -> None:
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def until(condition: Callable[[], bool], seconds: float) -> Steps:
    """Wait for a condition."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"Nothing happened within {seconds:.0f} seconds."
        yield 0.2


def press_f12(seconds: float) -> Generator[float, None, str]:
    """Press F12 and wait; return ``complete`` or ``cancelled``."""
    results: list[str] = []
    handler_lists = (bpy.app.handlers.render_complete, bpy.app.handlers.render_cancel)
    for handlers, result in zip(handler_lists, ("complete", "cancelled"), strict=True):
        handlers.append(lambda *_, result=result: results.append(result))
    press("render.render")
    yield from until(lambda: bool(results), seconds)
    return results[0]


screenshots: list[str] = []


def screenshot(name: str, fact: str = "", redraw_first: bool = True) -> np.ndarray:
    """Save a screenshot and log a fact; return pixels (H, W, 3) float32, rows from the top."""
    screenshots.append(name)
    title = f"{len(screenshots):02}-{name}"
    path = OUT / f"{title}.png"
    if redraw_first:
        redraw()
    subprocess.run([*PLAN["camera"], str(path)], check=True)
    log(f"{title}: {fact}" if fact else title)
    return pixels(path)


def pixels(path: Path) -> np.ndarray:
    """Read an image file as (H, W, 3) float32 display values, rows from the top."""
    image = bpy.data.images.load(str(path))
    width, height = image.size  # pyrefly: ignore[not-iterable]
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, 4)[::-1, :, :3]


def changed_share(first: np.ndarray, second: np.ndarray, by: float = 0.1, part: str = "WINDOW") -> float:
    """Return the share of pixels of a region that differ by more than ``by`` between two screenshots.

    Args:
        first, second: screenshots.
        by: minimum difference of a channel.
        part: region of the viewport, or STATUSBAR.
    """
    if part == "STATUSBAR":
        area = slice(first.shape[0] - 20, None), slice(None)
    else:
        bounds = region(part)
        top = first.shape[0] - bounds.y - bounds.height
        area = slice(top, top + bounds.height), slice(bounds.x, bounds.x + bounds.width)
    return float((np.abs(first[area] - second[area]).max(axis=2) > by).mean())


def psnr(image: np.ndarray, photo: np.ndarray) -> float:
    """Return the PSNR in dB."""
    assert image.shape == photo.shape, f"The image has shape {image.shape}, the photo {photo.shape}."
    return -10 * math.log10(float(np.square(image - photo).mean()) + 1e-12)


def log(line: str) -> None:
    with open(OUT / "facts.txt", "a", encoding="utf-8") as facts:
        facts.write(f"{line}\n")


def start(steps: Steps) -> None:
    """Run all steps, then quit Blender. The last line of facts.txt is the result."""
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.view.smooth_view = 0
    bpy.context.preferences.use_preferences_save = False

    def step() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            log("passed")
        except Exception as error:
            traceback.print_exc()
            last = screenshots[-1] if screenshots else "the start"
            log(f"failed after {last}: {error or type(error).__name__}")
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(step, first_interval=3.0, persistent=True)


def pose(first, second=None, share: float = 0.0) -> Matrix:
    """Return a camera's pose in Blender's world, interpolated towards a second camera by ``share``."""
    position, rotation, _ = _blender_matrix(first).decompose()
    if second is not None:
        end_position, end_rotation, _ = _blender_matrix(second).decompose()
        position = position.lerp(end_position, share)
        rotation = rotation.slerp(end_rotation, share)
    return Matrix.Translation(position) @ rotation.to_matrix().to_4x4()  # type: ignore[arg-type]


def _blender_matrix(camera) -> Matrix:
    matrix = np.linalg.inv(np.array(camera.world_to_camera, np.float64)) @ np.diag([1.0, -1, -1, 1])
    return Matrix(matrix.tolist())


def show(matrix: Matrix) -> None:
    """Set the viewport to a pose."""
    view = viewport()[1]
    view.view_perspective, view.view_distance = "PERSP", 3.0
    view.view_rotation = matrix.to_quaternion()
    view.view_location = matrix @ Vector((0, 0, -3.0))
    viewport()[0].tag_redraw()
