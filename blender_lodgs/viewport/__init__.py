"""What 3D viewports draw of splat scenes: Gaussians as they are (``splats``), or points (``discs``).

Splats are drawn in every shading mode but Wireframe where ``Scene.lodgs_viewport.splats`` is on. Otherwise
they are points like those of COLMAP: discs in Solid shading, Blender's own points elsewhere. Blender 5.3 and
later draw splats themselves where the scene says so (``Scene.lodgs_viewport.drawn_by``).

- ``arranging`` decides which splats are drawn in which order, ``views`` keeps what each viewport shows.
- ``eye`` follows a viewport's view.
- ``frusta`` shows the views of training or of a capture, ``coverage`` how well they cover a Blender scene.
- ``cells`` shows the cells of a large scene.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import bpy

from ...training.lod.colors import level_color
from .. import extension
from ..data import roots
from . import cells, coverage, discs, eye, frusta, splats, views

if TYPE_CHECKING:
    from ..data.properties import SplatScene

_handle: Any = None

problem = ""
"""What went wrong when a viewport was drawn last; empty where nothing did."""


def draws_splats(scene: bpy.types.Scene, viewport: bpy.types.SpaceView3D) -> bool:
    """Whether a viewport draws a Blender scene's splats as Gaussians, by our own shaders."""
    settings = scene.lodgs_viewport
    return settings.splats and not settings.native and viewport.shading.type != "WIREFRAME"


def _draw() -> None:
    """One drawing of one viewport. What goes wrong ends it, and the panel tells it; the next tries anew."""
    global problem
    try:
        _draw_view(bpy.context)
        failed = ""
    except Exception as error:
        failed = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        if failed != problem:  # once, not at every redraw
            traceback.print_exc()
        splats.reset_state()
    if failed != problem:
        problem = failed
        bpy.app.timers.register(extension.redraw, first_interval=0)  # not while it is drawn


def _draw_view(context: bpy.types.Context) -> None:
    space, region, view = context.space_data, context.region, context.region_data
    with_splats = draws_splats(context.scene, space)
    eye.on_draw(region, context.scene, view, splats=with_splats)
    if space.shading.type == "SOLID" and space.shading.color_type not in {"OBJECT", "RANDOM", "SINGLE"}:
        points = [
            (obj, tint)
            for root in roots.roots(context.scene)
            for obj, tint in _points(root.lodgs, not with_splats and not context.scene.lodgs_viewport.native)
            if obj is not None and obj.visible_get(view_layer=context.view_layer, viewport=space)
        ]
        if points:
            depsgraph = context.evaluated_depsgraph_get()
            discs.draw(points, depsgraph, view.view_matrix, view.window_matrix, region.height)
    if with_splats:
        views.draw(context)
    if space.overlay.show_overlays:
        coverage.draw(context.scene)
        frusta.draw(context)
        cells.draw(context.scene)


def _points(
    settings: SplatScene, levels: bool
) -> Iterator[tuple[bpy.types.Object | None, tuple[float, float, float, float]]]:
    """What of a splat scene is drawn as points, and in which colour; alpha 0 is each point's own."""
    yield settings.points, (0, 0, 0, 0)
    if levels:
        for item in settings.levels:
            yield item.object, (*level_color(item.number), float(settings.tell in ("LEVELS", "BANDS")))


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.mode == "RENDER":  # a render's first evaluation: everything counts as new there
        return
    discs.on_update(depsgraph)


@bpy.app.handlers.persistent
def _on_file(*_) -> None:
    views.close_streams()


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    global problem
    problem = ""
    coverage.clear()
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
    handlers.load_pre.append(_on_file)


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.remove(_on_update)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.remove(_on_load)
    handlers.load_pre.remove(_on_file)
    _on_load()
    splats.clear()
    views.stop()
    _handle = None
