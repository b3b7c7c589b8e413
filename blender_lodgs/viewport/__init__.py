"""Drawing of splat scenes in 3D viewports, as Gaussians (``splats``) or points (``discs``).

If ``Scene.lodgs_viewport.splats`` is on, Gaussians are drawn in all shading modes except Wireframe. Otherwise
splats are points like those of COLMAP: discs in Solid shading, Blender's point clouds elsewhere. Blender 5.3
and later can draw splats natively (``Scene.lodgs_viewport.drawn_by``).

- ``views`` draws a viewport, ``view_state`` loads its splats, ``arrangement`` selects and sorts them.
- ``sources`` reads changed splats and starts streams.
- ``resident`` uploads splats, ``streaming`` reads them from disk, ``shaders`` draws them.
- ``view_camera`` tracks the camera of a viewport's view.
- ``frusta`` draws training and capture views, ``coverage`` the coverage of a Blender scene by capture views.
- ``cells`` draws the training cells of a large scene.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import bpy

from ...training.splats.level_colors import level_color
from .. import extension
from ..data import roots, visited
from . import cells, coverage, discs, frusta, shaders, sources, splats, view_camera, views

if TYPE_CHECKING:
    from ..data.scene_properties import SplatScene

_handle: Any = None

problem = ""
"""Error of the last redraw; empty if there was none."""


def draws_splats(scene: bpy.types.Scene, viewport: bpy.types.SpaceView3D) -> bool:
    """Return True if a viewport draws Gaussians with the shaders of LODGS."""
    settings = scene.lodgs_viewport
    return settings.splats and not settings.native and viewport.shading.type != "WIREFRAME"


def _draw() -> None:
    """Draw a viewport. Errors end the redraw and are displayed in the panel; the next redraw tries again."""
    global problem
    try:
        _draw_view(bpy.context)
        message = ""
    except Exception as error:
        message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        if message != problem:  # only once, not at every redraw
            traceback.print_exc()
        splats.reset_state()
    if message != problem:
        problem = message
        bpy.app.timers.register(extension.redraw, first_interval=0)  # not during a redraw


def _draw_view(context: bpy.types.Context) -> None:
    space, region, view = context.space_data, context.region, context.region_data
    with_splats = draws_splats(context.scene, space)
    _follow_shading(context.scene)
    view_camera.track(region, context.scene, view, splats=with_splats)
    visited.track(region, context.scene, view)
    if space.shading.type == "SOLID" and space.shading.color_type not in {"OBJECT", "RANDOM", "SINGLE"}:
        depsgraph = context.evaluated_depsgraph_get()
        levels = not with_splats and not context.scene.lodgs_viewport.native
        points = visible_points(depsgraph, space, levels)
        if points:
            discs.draw(points, depsgraph, view.view_matrix, view.window_matrix, region.height)
    if with_splats:
        views.draw(context)
    if space.overlay.show_overlays:
        coverage.draw(context.scene)
        frusta.draw(context)
        cells.draw(context.scene)


def _shows_wireframe(scene: bpy.types.Scene) -> bool:
    """Return True if a viewport of a scene shows wireframes."""
    return any(
        area.type == "VIEW_3D" and area.spaces.active.shading.type == "WIREFRAME"
        for window in bpy.context.window_manager.windows
        if window.scene == scene
        for area in window.screen.areas
    )


def _follow_shading(scene: bpy.types.Scene) -> None:
    """Show all points of splat objects while a viewport of the scene shows wireframes."""
    if scene.lodgs_viewport.all_points != _shows_wireframe(scene) and not bpy.app.timers.is_registered(
        _store_shading
    ):
        bpy.app.timers.register(_store_shading, first_interval=0)  # properties are not set during a redraw


def _store_shading() -> None:
    for scene in {window.scene for window in bpy.context.window_manager.windows}:
        wireframe = _shows_wireframe(scene)
        if scene.lodgs_viewport.all_points != wireframe:
            scene.lodgs_viewport.all_points = wireframe


def visible_points(
    depsgraph: bpy.types.Depsgraph, viewport: bpy.types.SpaceView3D, levels: bool
) -> list[discs.Points]:
    """Return the points that a viewport shows, also those of collection instances.

    Args:
        levels: include the splats of levels.
    """
    visible = []
    for instance in depsgraph.object_instances:  # visible ones only
        if instance.object.type != "POINTCLOUD":
            continue
        obj = instance.object.original
        shown_by = (instance.parent if instance.is_instance else instance.object).original
        root = roots.root_of(obj)
        tints = {} if root is None else dict(_points(root.lodgs, levels))
        if obj in tints and shown_by.visible_in_viewport_get(viewport):
            visible.append((obj, instance.matrix_world.copy(), tints[obj]))
    return visible


def _points(
    settings: SplatScene, levels: bool
) -> Iterator[tuple[bpy.types.Object | None, tuple[float, float, float, float]]]:
    """Yield the objects of a splat scene that are drawn as points, with their tints; alpha 0 is no tint."""
    yield settings.points, (0, 0, 0, 0)
    if levels:
        for item in settings.levels:
            yield item.object, (*level_color(item.number), float(settings.colors in ("LEVELS", "BANDS")))


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.mode == "RENDER":  # the first evaluation of a render reports everything
        return
    discs.on_update(depsgraph)


@bpy.app.handlers.persistent
def _on_file(*_) -> None:
    sources.close_streams()


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    _on_undo()
    views.clear()
    visited.clear()


@bpy.app.handlers.persistent
def _on_undo(*_) -> None:
    """Clear the state of datablocks. Viewports draw the previous splats until the new ones are read."""
    global problem
    problem = ""
    coverage.clear()
    discs.clear()
    sources.forget_datablocks()
    view_camera.clear()


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.append(_on_update)
    handlers.load_post.append(_on_load)
    for changes in (handlers.undo_post, handlers.redo_post):
        changes.append(_on_undo)
    handlers.load_pre.append(_on_file)


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.remove(_on_update)
    handlers.load_post.remove(_on_load)
    for changes in (handlers.undo_post, handlers.redo_post):
        changes.remove(_on_undo)
    handlers.load_pre.remove(_on_file)
    if bpy.app.timers.is_registered(_store_shading):
        bpy.app.timers.unregister(_store_shading)
    _on_load()
    shaders.clear()
    sources.stop()
    _handle = None
