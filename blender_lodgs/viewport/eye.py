"""The eye that is the viewport's own view: distances follow whoever orbits.

No driver sees a viewport's view. Drawing reports here where it looks from, and a timer hands the view that
moved last to the splat scenes whose eye is the viewport, some times a second: what draws may not change what
it draws.
"""

from __future__ import annotations

import bpy
from mathutils import Matrix, Vector

from ..data import scenes, selection

Place = tuple[float, float, float]

PAUSE = 0.08
"""Seconds between two changes of the eye while the view moves: each chooses the detail anew."""

_last: dict[int, Matrix] = {}
"""What each viewport's region looked through when it was last drawn."""
_newest: tuple[str, Place, float] | None = None
"""Of the view that moved last, until it is handed on: Blender scene, eye in the world, focal length."""


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


def on_draw(region: bpy.types.Region, scene: bpy.types.Scene, view: bpy.types.RegionView3D) -> None:
    """A viewport is being drawn; where its view has moved it is the eye from now on."""
    global _newest
    if not any(_follows(root) for root in scenes.roots(scene)):
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
    if not bpy.app.timers.is_registered(_hand_on):
        bpy.app.timers.register(_hand_on, first_interval=PAUSE)


def follow(scene: bpy.types.Scene, eye: Place, focal_px: float) -> None:
    """Has all splat scenes whose eye is the viewport measure distances from a place in the world."""
    for root in scenes.roots(scene):
        if _follows(root):
            selection.hold(root, tuple(root.matrix_world.inverted_safe() @ Vector(eye)), focal_px)


def _follows(root: bpy.types.Object) -> bool:
    return root.lodgs.eye == "VIEW" and not root.lodgs.freeze


def _hand_on() -> None:
    global _newest
    newest, _newest = _newest, None
    if newest is not None and (scene := bpy.data.scenes.get(newest[0])) is not None:
        follow(scene, *newest[1:])


def clear() -> None:
    """Forgets all views."""
    global _newest
    _last.clear()
    _newest = None
