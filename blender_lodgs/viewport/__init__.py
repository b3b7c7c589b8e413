"""What 3D viewports draw of splat scenes: Gaussians as they are (``splats``), or points (``discs``).

Splats are drawn in all shadings but Wireframe where ``Scene.lodgs_viewport.splats`` is on; otherwise they are
points like those of COLMAP: discs in Solid shading, Blender's own points elsewhere. Where Blender draws
splats by itself, it is left to it. ``arranging`` decides which are drawn in which order, ``views`` keeps what
each viewport shows, and ``eye`` follows a viewport's view.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import bpy

from ...training.lod.colors import level_color
from .. import compat
from ..data import scenes
from . import discs, eye, splats, views

if TYPE_CHECKING:
    from ..data.properties import SplatScene

_handle: Any = None


def draws_splats(scene: bpy.types.Scene) -> bool:
    """Whether viewports draw a Blender scene's splats as Gaussians, by our own shaders."""
    return scene.lodgs_viewport.splats and not compat.NATIVE_SPLATS


def _draw() -> None:
    context = bpy.context
    space, region, view = context.space_data, context.region, context.region_data
    eye.on_draw(region, context.scene, view)
    with_splats = draws_splats(context.scene) and space.shading.type != "WIREFRAME"
    if space.shading.type == "SOLID" and space.shading.color_type not in {"OBJECT", "RANDOM", "SINGLE"}:
        points = [
            (obj, tint)
            for root in scenes.roots(context.scene)
            for obj, tint in _points(root.lodgs, levels=not with_splats)
            if obj is not None and obj.visible_get(view_layer=context.view_layer, viewport=space)
        ]
        if points:
            depsgraph = context.evaluated_depsgraph_get()
            discs.draw(points, depsgraph, view.view_matrix, view.window_matrix, region.height)
    if with_splats:
        try:
            views.draw(context)
        except Exception as error:  # no splats rather than an error at every redraw
            print(f"LODGS: this computer's graphics cannot draw splats, points are shown instead: {error}")
            bpy.app.timers.register(_give_up, first_interval=0)


def _give_up() -> None:
    for scene in bpy.data.scenes:
        scene.lodgs_viewport.splats = False


def _points(
    settings: SplatScene, levels: bool
) -> Iterator[tuple[bpy.types.Object | None, tuple[float, float, float, float]]]:
    """What of a splat scene is drawn as points, and in which colour; alpha 0 is each point's own."""
    yield settings.points, (0, 0, 0, 0)
    if levels and not compat.NATIVE_SPLATS:
        for item in settings.levels:
            yield item.object, (*level_color(item.number), float(settings.tell != "OWN"))


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    discs.on_update(depsgraph)
    views.on_update(depsgraph)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    discs.clear()
    views.clear()
    eye.clear()


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.append(_on_update)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.append(_on_load)


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.remove(_on_update)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.remove(_on_load)
    _on_load()
    splats.clear()
    views.stop()
    _handle = None
