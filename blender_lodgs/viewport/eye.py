"""The eye that is the viewport's own view: distances follow whoever orbits.

No driver sees a viewport's view. Drawing reports here where it looks from, and a timer hands the view that
moved last to the splat scenes whose eye is the viewport: what draws may not change what it draws. Splats that
are drawn as such are chosen from there at once (:func:`moved`), and the modifiers, which take long for
millions, follow when the view rests; where modifiers are what is seen, they do some times a second.
"""

from __future__ import annotations

import time

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..data import roots, selection
from ..data.placement import axes_of

Place = tuple[float, float, float]

PAUSE = 0.08
"""Seconds between two changes of the eye while the view moves, where modifiers are what is seen."""
REST = 0.25
"""Seconds after which a view rests that has not moved."""

_last: dict[int, Matrix] = {}
"""What each viewport's region looked through when it was last drawn."""
_newest: tuple[str, Place, float] | None = None
"""Of the view that moved last, until it is handed on: Blender scene, eye in the world, focal length."""
_due = 0.0
"""When that is to be handed on."""


def place(view: Matrix, projection: Matrix, width: int, distance: float) -> tuple[Place, float]:
    """The eye of a view in the world, and its focal length in pixels.

    Without perspective all depths are as large: as large as with perspective at the point that the view turns
    about, from which Blender puts the eye back.

    Args:
        view, projection: from the world to the camera's space, and on to clip space.
        width: of the region in pixels.
        distance: from the eye to the point that the view turns about.
    """
    eye = tuple(view.inverted().translation)
    focal = projection[0][0] * width / 2
    if projection[3][3] != 0:
        focal *= distance
    return eye, focal


def looked_through(context: bpy.types.Context) -> bpy.types.Object | None:
    """The camera that the viewport looks through; None for a view of its own."""
    camera = context.space_data.camera or context.scene.camera
    is_it = (
        context.region_data.view_perspective == "CAMERA" and camera is not None and camera.type == "CAMERA"
    )
    return camera if is_it else None


def frame(
    camera: bpy.types.Object, scene: bpy.types.Scene, projection: Matrix
) -> tuple[float, float, float, float]:
    """Where in a view a camera's picture lies: left, bottom, right, top in clip space.

    Args:
        projection: from the world to clip space.
    """
    to_clip = projection @ camera.matrix_world.normalized()
    corners = [to_clip @ corner.to_4d() for corner in camera.data.view_frame(scene=scene)]  # type: ignore[union-attr]
    xs, ys = ([corner[axis] / corner.w for corner in corners] for axis in (0, 1))
    return min(xs), min(ys), max(xs), max(ys)


def on_draw(
    region: bpy.types.Region, scene: bpy.types.Scene, view: bpy.types.RegionView3D, *, splats: bool = False
) -> None:
    """A viewport is being drawn; where its view has moved it is the eye from now on.

    Args:
        splats: whether it draws splats as such.
    """
    global _newest, _due
    if not any(_follows(root) for root in roots.roots(scene)):
        _last.clear()
        return
    matrix = view.window_matrix @ view.view_matrix
    key = region.as_pointer()
    if key in _last and _last[key] == matrix:
        return
    first = bool(_last) and key not in _last
    _last[key] = matrix
    if first:  # a viewport that was only just opened has not moved
        return
    _newest = (
        scene.name, *place(view.view_matrix, view.window_matrix, region.width, view.view_distance)
    )  # fmt: skip
    waiting = bpy.app.timers.is_registered(_hand_on)
    if splats or not waiting:
        _due = time.monotonic() + (REST if splats else PAUSE)
    if not waiting:
        bpy.app.timers.register(_hand_on, first_interval=PAUSE)


def moved(scene: bpy.types.Scene, root: bpy.types.Object) -> tuple[Place, float] | None:
    """The eye of a splat scene, in its own space, and its focal length; None where the modifiers know it."""
    if _newest is None or _newest[0] != scene.name or not _follows(root):
        return None
    _, eye, focal_px = _newest
    local = axes_of(root).matrix_world.inverted_safe() @ Vector(eye)
    return tuple(np.float32(local).tolist()), float(np.float32(focal_px))  # as properties will have them


def follow(scene: bpy.types.Scene, eye: Place, focal_px: float) -> None:
    """Has all splat scenes whose eye is the viewport measure distances from a place in the world."""
    for root in roots.roots(scene):
        if _follows(root):
            selection.hold(root, tuple(axes_of(root).matrix_world.inverted_safe() @ Vector(eye)), focal_px)


def _follows(root: bpy.types.Object) -> bool:
    return root.lodgs.eye == "VIEW" and not root.lodgs.freeze


def _hand_on() -> float | None:
    global _newest
    if (wait := _due - time.monotonic()) > 0:
        return wait
    newest, _newest = _newest, None
    if newest is not None and (scene := bpy.data.scenes.get(newest[0])) is not None:
        follow(scene, *newest[1:])
    return None


def clear() -> None:
    """Forgets all views."""
    global _newest
    _last.clear()
    _newest = None
