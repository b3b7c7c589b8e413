"""Drawing of splats in viewports.

All splats to draw are in one pool in memory (``resident``). They are read again only if the points of an
object change: levels of detail come from the settings of modifiers (``selection.evaluated_query``), so time
and views do not change splats. Objects with other modifiers are read after evaluation. A worker thread
selects the splats when a query changes and sorts them when the view turns (``arrangement``); ``view_state``
uploads them in small steps.

For streamed files (``streaming``), the worker thread also copies new pages, while no viewport uploads them.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import inf

import bpy
import numpy as np
from mathutils import Matrix

from .. import extension
from ..data import changes, roots, selection, shown
from ..nodes import display
from . import resident, splats, view_camera, view_state
from .arrangement import Placement, Request, arrange
from .resident import Cloud, PoolReader, Resident
from .streaming import Direction, Stream
from .view_state import ViewState, active_views

REST = 0.2
"""Seconds without movement after which a view is at rest."""
ROUNDING = 1e-4
"""Relative difference below which positions count as equal."""
NOT_REQUESTED = -1
"""Value of ``ViewState.arrived`` that makes the viewport redraw until streams are requested."""

reads = 0
"""Number of times the pool was read since Blender started, for tests."""


_views: dict[int, ViewState] = {}
_executor: ThreadPoolExecutor | None = None

_resident: Resident | None = None
_versions: dict[int, changes.Version | Stream | None] = {}
"""Versions of the read splats, by the ``session_uid`` of a point cloud, of an object with other modifiers, or
of the root of a streamed scene; None for objects that only a render shows."""
_reader: tuple[tuple, PoolReader] | None = None
"""Unfinished reader of the next pool, and a key of its splats."""
_streams: dict[int, Stream] = {}
"""Streams by the ``session_uid`` of their roots."""
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
    if _is_loading(view) or view.pending is not None or view.moving or _is_streaming():
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
    instances = _with_streams(view, instances, depsgraph, view_matrix, moving, wait)
    read = _read(instances, depsgraph, wait)
    if read is None:
        view.arrived = NOT_REQUESTED
        return empty
    source, clouds = read
    update = wait or not any(other.uses(source) for other in active_views if other is not view)
    arrived = _arrived()
    placements = _placements(instances, source, depsgraph, moving, update)
    request = replace(empty, placements=placements)
    position = tuple(view_matrix.inverted().translation)
    if sum(placement.count for placement in placements) > budget:
        request = replace(request, position=position)
    if not wait and (limit := view.motion_limit()) is not None:
        request = replace(request, motion=(limit, position), moving=view.moving)
    is_requested = _arrange(view, source, request, wait, update)
    if view.arrived != NOT_REQUESTED:  # an older value makes the view redraw
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


def stream(root: bpy.types.Object) -> Stream | None:
    """Return the stream of a splat scene; None if it is not streamed."""
    return _streams.get(root.session_uid)


def _with_streams(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    view_matrix: Matrix,
    moving: bool,
    wait: bool,
) -> list[shown.SplatInstance]:
    """Return the instances with streams in place of their levels where streams are ready.

    Request the pages that the camera needs, and start missing streams.
    """
    ready = []
    for instance, query in view_camera.nearest_streamed(instances, depsgraph, moving):
        source = instance.source
        assert source is not None
        current = _streams.get(source.scene)
        if current is None or current.source != source:
            if current is not None:
                current.stop()
            current = _streams[source.scene] = Stream(source)
        if query is not None and not (current.problem and not current.ready):
            current.request(query, _direction(instance, query, view_matrix))
            while wait and current.busy and not current.problem:
                if current.ready:
                    _worker().submit(current.take).result()
                time.sleep(0.01)
            # draw the splats of the scene first, which are in memory
            replaces_levels = wait or current in _versions.values() or (view.arrangement and not view.loading)
            if current.ready and replaces_levels:
                ready.append(source)
            elif current.ready:
                view.arrived = NOT_REQUESTED
    return shown.drop_streamed_levels(
        [instance if instance.source in ready else replace(instance, source=None) for instance in instances]
    )


def _direction(
    instance: shown.SplatInstance, query: selection.LodQuery, view_matrix: Matrix
) -> Direction | None:
    """Return the view direction in the splats' space; None if the query is for another camera position."""
    camera_to_local = np.linalg.pinv(instance.matrix_world) @ np.array(view_matrix.inverted(), np.float64)
    distance = np.linalg.norm(camera_to_local[:3, 3] - query.position)
    if distance > ROUNDING * (1 + np.linalg.norm(camera_to_local[:3, 3])):
        return None
    x, y, z = (-camera_to_local[:3, 2] / max(np.linalg.norm(camera_to_local[:3, 2]), 1e-30)).tolist()
    return x, y, z


def _streamed_clouds(instances: list[shown.SplatInstance]) -> Iterator[bpy.types.PointCloud]:
    """Yield the point clouds of levels that streams replace."""
    for instance in instances:
        root = roots.root_of(instance.object) if instance.source is not None else None
        for item in root.lodgs.levels if root is not None else ():
            if item.exists:
                yield item.object.data


def _is_streaming() -> bool:
    return any(stream.busy for stream in _streams.values())


def _arrived() -> int:
    """Return a number that grows whenever streams have brought splats."""
    return sum(stream.ready + stream.arrived for stream in _streams.values())


def _is_unmodified(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    return selection.only_lodgs_modifiers(instance.evaluated, depsgraph)


def _key(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> int:
    """Return the key of an instance's splats: that of its point cloud, modified object or streamed scene."""
    if instance.source is not None:
        return instance.source.scene
    return (instance.object.data if _is_unmodified(instance, depsgraph) else instance.object).session_uid


def _read(
    instances: list[shown.SplatInstance], depsgraph: bpy.types.Depsgraph, wait: bool
) -> tuple[Resident, list[Cloud | None]] | None:
    """Read the splats of all instances if some have changed.

    Returns:
        The splats and their clouds. None if reading continues at the next redraw.
    """
    global _resident, _versions, _reader, reads
    clouds: dict[int, Cloud] = {}
    versions: dict[int, changes.Version | Stream | None] = {}
    for instance in instances:
        if instance.source is not None:
            key = instance.source.scene
            clouds[key] = versions[key] = _streams[key]
            continue
        unmodified = _is_unmodified(instance, depsgraph)
        key = _key(instance, depsgraph)
        clouds.setdefault(key, instance.object.data if unmodified else instance.evaluated.data)
        versions[key] = changes.version(instance.object.data if unmodified else instance.object)
        if not unmodified and depsgraph.mode == "RENDER":  # modifiers may differ in viewports
            versions[key] = None
    if _resident is None or any(
        version is None or _versions.get(key) != version for key, version in versions.items()
    ):
        # hidden levels stay in the pool: artists step through levels
        all_clouds = {cloud.session_uid: cloud for cloud in bpy.data.pointclouds if shown.is_splats(cloud)}
        for cloud in _streamed_clouds(instances):  # their stream takes the memory
            all_clouds.pop(cloud.session_uid, None)
        hidden = {key: all_clouds[key] for key in _versions if key in all_clouds and key not in clouds}
        versions |= {key: changes.version(cloud) for key, cloud in hidden.items()}
        clouds |= hidden
        clouds = {key: clouds[key] for key in _versions | clouds if key in clouds}
        pool_versions = {key: versions[key] for key in clouds}
        cloud_list = list(clouds.values())
        reader_key = pool_versions, list(pool_versions), list(map(resident.splat_count, cloud_list))
        if _reader is None or _reader[0] != reader_key:
            _reader = reader_key, PoolReader(cloud_list, _resident if [*_versions] == [*clouds] else None)
        start = time.monotonic()
        pool = _reader[1].advance(cloud_list, inf if wait else start + view_state.LOADING[1])
        if pool is None:
            return None
        reads += pool is not _resident
        _resident, _versions, _reader = pool, pool_versions, None
        close_streams({obj.session_uid for obj in bpy.data.objects if obj.lodgs.is_root})
        if not wait and time.monotonic() > start + view_state.LOADING[0]:
            return None
    return _resident, [clouds.get(key) for key in _versions]


def _placements(
    instances: list[shown.SplatInstance],
    source: Resident,
    depsgraph: bpy.types.Depsgraph,
    moving: bool,
    update: bool,
) -> tuple[Placement, ...]:
    """Return the rows of each instance in ``source``, with its transform and query."""
    root_of_level = {
        item.object: root for root in roots.roots(depsgraph.scene) for item in root.lodgs.existing_levels
    }
    numbers = {key: number for number, key in enumerate(_versions)}
    placements = []
    for instance in instances:
        number = numbers[_key(instance, depsgraph)]
        root = root_of_level.get(instance.object)
        if root is None and instance.level:  # in an instance of another file's scene
            root = roots.root_of(instance.object)
        paged = instance.source and _streams[instance.source.scene]
        placements.append(
            Placement(
                first=source.starts[number],
                count=source.counts[number],
                matrix=instance.matrix_world.tobytes(),
                level=instance.level,
                query=view_camera.view_query(instance, depsgraph, moving),
                scene=(root or instance.object).session_uid,
                colors=root.lodgs.colors if root else "OWN",
                antialias=instance.antialias,
                arrived=(paged.arrived if update else paged.copied_updates) if paged else 0,
                looks=instance.looks,
            )
        )
    return tuple(placements)


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
    view.pending = (source, request, _worker().submit(arrange, source.pool, request, update))
    if wait:
        arrangement = view.pending[2].result()
        view.pending = None
        view.accept(source, arrangement)
    return True


def _worker() -> ThreadPoolExecutor:
    """Return the single worker thread, which arranges splats and copies streamed pages."""
    global _executor
    if _executor is None:
        _executor = ThreadPoolExecutor(1, "lodgs-order")
    return _executor


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
    return view.loading is not None or view.arrived != _arrived()


def _wake() -> float | None:
    """Redraw viewports with new splats. Return the delay to the next call while splats are loading."""
    global _panel_state
    now = time.monotonic()
    waiting = _is_streaming()
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
    state = [(stream.splats, stream.busy, stream.short) for stream in _streams.values()]
    if state != _panel_state:
        _panel_state = state
        extension.redraw()
    return 0.01 if waiting else None


def clear() -> None:
    """Free all splats and viewport states."""
    global _resident, _versions, _reader
    _views.clear()
    active_views.clear()
    _resident, _versions, _reader = None, {}, None


def forget_datablocks() -> None:
    """Drop references to point clouds, which an undo replaces. All splats are read again."""
    global _reader
    _reader = None


def close_streams(keep: Collection[int] = ()) -> None:
    """Stop all streams except those of these roots (``session_uid``)."""
    for key in _streams.keys() - keep:
        _streams.pop(key).stop()


def stop() -> None:
    """Stop the threads."""
    global _executor
    close_streams()
    if _executor is not None:
        _executor.shutdown(wait=False, cancel_futures=True)
    _executor = None
