"""Drawing of splats in viewports.

A worker thread selects the splats when a query changes and sorts them when the view turns (``arrangement``);
``view_state`` uploads them in small steps. All splats are in ``sources``.
"""

from __future__ import annotations

import time
from dataclasses import replace

import bpy
from mathutils import Matrix

from .. import extension
from ..data import shown
from ..nodes import display
from . import sources, splats, view_camera, view_state
from .arrangement import Placement, Request, arrange
from .resident import Resident
from .view_state import ViewState, active_views

REST = 0.2
"""Seconds without movement after which a view is at rest."""

_views: dict[int, ViewState] = {}
_panel_state: list[tuple[int, bool, bool]] = []
"""State of the streams in panels at their last redraw."""


def draw(context: bpy.types.Context) -> None:
    """Draw all visible splats into the viewport that is being drawn."""
    space, region, region_data = context.space_data, context.region, context.region_data
    if region.as_pointer() not in _views:
        _remove_closed()
    view = _views.setdefault(region.as_pointer(), ViewState())
    instances = [
        instance
        for instance in shown.splat_instances(context.evaluated_depsgraph_get(), space)
        if not display.is_drawn_by_blender(instance.evaluated)
    ]
    now = time.monotonic()
    matrix = region_data.window_matrix @ region_data.view_matrix
    if view.matrix is not None and view.matrix != matrix:
        view.moved = now
    view.matrix = matrix
    settings = context.scene.lodgs_viewport
    view.moving = context.screen.is_animation_playing or now - view.moved < REST
    view.resolution = view.motion_resolution(settings.moving / 100)
    view.shows_marks = space.overlay.show_overlays
    camera = view_camera.active_camera(context)
    frame = splats.FULL_FRAME
    if camera is not None:
        frame = view_camera.camera_frame(camera, context.scene, region_data.window_matrix)
    under_overlays = space.overlay.show_overlays and not _shows_photo(camera)
    target = splats.DrawTarget(region_data.view_matrix, region_data.window_matrix, under_overlays, frame)
    depsgraph = context.evaluated_depsgraph_get()
    draw_splats(view, instances, depsgraph, target, settings.budget, moving=True, timed=True)
    if (stated := (reduced_counts(region), view_state.simplified_counts(), view.cost)) != view.stated:
        view.stated = stated
        for other in context.area.regions:
            if other.type in ("HEADER", "UI"):
                other.tag_redraw()
    if _is_loading(view) or view.pending is not None or view.moving or sources.is_streaming():
        _wake_later()


def _remove_closed() -> None:
    """Free the state of closed viewports."""
    open_regions = {
        region.as_pointer()
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        for region in area.regions
    }
    for key in _views.keys() - open_regions:
        active_views.discard(_views.pop(key))


def _shows_photo(camera: bpy.types.Object | None) -> bool:
    """Return True if a camera's background image fills the view; as an overlay it would cover the splats."""
    return (
        camera is not None
        and camera.data.show_background_images
        and any(image.show_background_image for image in camera.data.background_images)
    )


def draw_splats(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    target: splats.DrawTarget,
    budget: int,
    *,
    wait: bool = False,
    moving: bool = False,
    timed: bool = False,
) -> None:
    """Draw splat instances into the active framebuffer.

    Args:
        view: state since the last redraw; updated.
        target: view to draw.
        budget, wait, moving: see :func:`prepare`.
        timed: measure the cost of the view if it is outdated.
    """
    request = prepare(view, instances, depsgraph, target.view, budget, wait, moving)
    if view.arrangement is None or view.store is None or view.instances is None or not view.count:
        return
    view.choose_list()
    timed &= view.loading is None and splats.is_compiled(view.store, view.resolution)
    timed &= view.is_cost_outdated()
    placements = view.arrangement.request.placements
    if _same_splats(placements, request.placements):  # objects move at once; their order follows
        placements = request.placements
    seconds = splats.draw(
        view.store, view.instances, view.count, placements, target, view.canvas,
        resolution=view.resolution, timed=timed,
    )  # fmt: skip
    if timed:
        view.set_cost(seconds)


def prepare(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    view_matrix: Matrix,
    budget: int,
    wait: bool = False,
    moving: bool = False,
) -> Request:
    """Prepare a redraw: read changed splats, accept a finished arrangement and upload splats.

    Args:
        budget: maximum number of splats.
        wait: wait for splats and their order instead of drawing the previous ones.
        moving: select from the current view, see ``view_camera.current_camera``.

    Returns:
        The request of this redraw; ``view.arrangement`` may still answer an earlier one.
    """
    empty = Request((), tuple(view_matrix[2][:3]), budget)
    if not instances:
        view.reset()
        return empty
    active_views.add(view)
    previous_arrived = view.arrived
    view.arrived = 0
    instances = sources.with_streams(view, instances, depsgraph, view_matrix, moving, wait)
    read = sources.read(instances, depsgraph, wait)
    if read is None:
        view.arrived = sources.NOT_REQUESTED
        return empty
    source, clouds = read
    update = wait or not any(other.uses(source) for other in active_views if other is not view)
    arrived = sources.arrived()
    placements = sources.placements(instances, source, depsgraph, moving, update)
    request = replace(empty, placements=placements)
    position = tuple(view_matrix.inverted().translation)
    if sum(placement.count for placement in placements) > budget:
        request = replace(request, position=position)
    if not wait and (limit := view.motion_limit()) is not None:
        request = replace(request, motion=(limit, position), moving=view.moving)
    is_requested = _arrange(view, source, request, wait, update)
    if view.arrived != sources.NOT_REQUESTED:  # an older value makes the view redraw
        view.arrived = arrived if update and is_requested else previous_arrived
    source.update_marks(clouds)
    source.update_paint(clouds)
    view.load(source, clouds, wait)
    if view.arrangement is not None and view.marks is not view.displayed_marks():
        view.list_instances()
    return request


def reduced_counts(region: bpy.types.Region | None = None) -> tuple[int, int] | None:
    """Return the number of drawn splats, and of those without the budget, of a viewport at its last redraw.

    Args:
        region: region of a viewport; None for the viewport from which the budget excludes the most splats.

    Returns:
        None if the budget excludes no splats.
    """
    views = _views.values() if region is None else filter(None, [_views.get(region.as_pointer())])
    arrangements = [view.arrangement for view in views if view.arrangement]
    largest = max(arrangements, key=lambda arrangement: arrangement.excluded, default=None)
    return (
        (largest.count, largest.count + largest.excluded)
        if largest is not None and largest.excluded
        else None
    )


def _arrange(view: ViewState, source: Resident, request: Request, wait: bool, update: bool) -> bool:
    """Accept a finished arrangement, and request another one if needed.

    Returns:
        True if the request is answered or submitted.
    """
    if view.loading is not None and view.loading.serial != source.pool.serial:  # its splats were replaced
        view.loading = view.missing = None
    if view.pending is not None and (wait or view.pending[2].done()):
        pending_source, _, future = view.pending
        view.pending = None
        if pending_source is source:
            view.accept(source, future.result())
    current = view.loading or (view.arrangement if view.resident is source else None)
    if current is not None and current.request == request:
        return True
    if view.pending is not None:
        return view.pending[1] == request
    if view.loading is not None and not wait:  # load the current one completely first
        return False
    if current is not None and not wait:  # a waiting render depends on nothing before
        request = replace(request, coarsened=current.coarsened)
    view.pending = (source, request, sources.worker().submit(arrange, source.pool, request, update))
    if wait:
        arrangement = view.pending[2].result()
        view.pending = None
        view.accept(source, arrangement)
    return True


def _same_splats(first: tuple[Placement, ...], second: tuple[Placement, ...]) -> bool:
    """Return True if placements have the same splats, with any transforms."""
    return [(p.first, p.count, p.level) for p in first] == [(p.first, p.count, p.level) for p in second]


def _wake_later() -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(_wake):
        bpy.app.timers.register(_wake, first_interval=0.01)


def wants_redraw(view: ViewState) -> bool:
    """Return True if a redraw would show or load more splats."""
    return _is_loading(view) or (view.pending is not None and view.pending[2].done())


def _is_loading(view: ViewState) -> bool:
    return view.loading is not None or view.arrived != sources.arrived()


def _wake() -> float | None:
    """Redraw viewports with new splats. Return the delay to the next call while splats are loading."""
    global _panel_state
    now = time.monotonic()
    waiting = sources.is_streaming()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                view = _views.get(region.as_pointer())
                if view is None:
                    continue
                rests = view.moving and now - view.moved >= REST and not window.screen.is_animation_playing
                if rests or wants_redraw(view):
                    region.tag_redraw()
                waiting |= _is_loading(view) or view.pending is not None or view.moving
    state = sources.stream_states()
    if state != _panel_state:
        _panel_state = state
        extension.redraw()
    return 0.01 if waiting else None


def clear() -> None:
    """Free all splats and viewport states."""
    _views.clear()
    active_views.clear()
    sources.clear()
