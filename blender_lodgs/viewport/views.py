"""What each viewport shows of the splats, kept between drawings.

Splats are uploaded once, and anew only when the points of an object themselves have changed: distances and
fading come from the modifiers' settings (``selection.choice``), so neither time nor view brings an upload. An
object with other modifiers is uploaded as they leave it, whenever they do so anew. Which splats are drawn is
found in a thread when the choice changes, in which order also when the view turns; until then the last
arrangement stays, with the splats that it is of.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import bpy
import gpu
from mathutils import Matrix

from ..data import changes, scenes, selection, shown
from . import splats
from .arranging import Arrangement, Placement, Request, arrange

STILL = 0.2
"""Seconds after which a view that no longer moves is drawn in full resolution."""

uploads = 0
"""How often splats were uploaded since Blender started."""


@dataclass
class ViewState:
    """What one viewport shows.

    Attributes:
        uploaded, arrangement, instances: what is drawn, which belong together.
        pending: the arrangement that is being computed, and of which splats.
        matrix: from the world to clip space when it was last drawn.
        moved: when it last moved.
    """

    canvas: splats.Canvas = field(default_factory=splats.Canvas)
    uploaded: splats.Uploaded | None = None
    arrangement: Arrangement | None = None
    instances: gpu.types.GPUTexture | None = None
    pending: tuple[splats.Uploaded, Request, Future[Arrangement]] | None = None
    matrix: Matrix | None = None
    moved: float = 0.0
    resolution: float = 1.0


_views: dict[int, ViewState] = {}
_thread: ThreadPoolExecutor | None = None

_uploaded: splats.Uploaded | None = None
_keys: dict[int, changes.Version | None] = {}
"""Whose splats are uploaded: point clouds, or objects whose modifiers change them, by ``session_uid``; and in
which version, None for one that only a render shows."""


def draw(context: bpy.types.Context) -> None:
    """Draws all visible splats into the viewport that is being drawn."""
    space, region, region_data = context.space_data, context.region, context.region_data
    view = _views.setdefault(region.as_pointer(), ViewState())
    instances = shown.splat_instances(context.evaluated_depsgraph_get(), space)
    now, matrix = time.monotonic(), region_data.window_matrix @ region_data.view_matrix
    if view.matrix is not None and view.matrix != matrix:
        view.moved = now
    view.matrix = matrix
    settings = context.scene.lodgs_viewport
    view.resolution = settings.moving / 100 if now - view.moved < STILL else 1.0
    draw_splats(
        view, instances, context.evaluated_depsgraph_get(),
        region_data.view_matrix, region_data.window_matrix, settings.budget,
        under_overlays=space.overlay.show_overlays and not _shows_photograph(context),
    )  # fmt: skip
    if view.pending is not None or view.resolution < 1:
        _wake_later()


def _shows_photograph(context: bpy.types.Context) -> bool:
    """Whether a camera's picture fills the view: it lies among the overlays, and would cover the splats."""
    camera = context.space_data.camera or context.scene.camera
    return (
        context.region_data.view_perspective == "CAMERA"
        and camera is not None
        and camera.type == "CAMERA"
        and camera.data.show_background_images
        and any(picture.show_background_image for picture in camera.data.background_images)
    )


def draw_splats(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    view_matrix: Matrix,
    projection: Matrix,
    budget: int,
    *,
    under_overlays: bool = True,
    wait: bool = False,
) -> None:
    """Draws splat instances into the active framebuffer.

    Args:
        view: what was drawn there last; changed.
        view_matrix, projection: from the world to the camera's space, and on to clip space.
        budget, wait: see :func:`prepare`.
        under_overlays: see ``splats.draw``.
    """
    request = prepare(view, instances, depsgraph, view_matrix, budget, wait)
    if view.uploaded is None or view.arrangement is None or view.instances is None:
        return
    if not view.arrangement.count:
        return
    placements = view.arrangement.request.placements
    if _alike(placements, request.placements):  # what moves, moves at once; its order follows
        placements = request.placements
    splats.draw(
        view.uploaded, view.instances, view.arrangement.count, [placement.world for placement in placements],
        view_matrix, projection, view.canvas, antialias=[placement.antialias for placement in placements],
        resolution=view.resolution, under_overlays=under_overlays,
    )  # fmt: skip


def prepare(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    view_matrix: Matrix,
    budget: int,
    wait: bool = False,
) -> Request:
    """All that comes before drawing: what has changed is uploaded, and what has been found taken over.

    Args:
        budget: most splats to draw.
        wait: for the splats' order, rather than going on with the last one that there is.

    Returns:
        What is to be drawn, which ``view.arrangement`` may not answer yet.
    """
    if not instances:
        view.uploaded = view.arrangement = view.instances = view.pending = None
        return Request((), (0.0, 0.0, 1.0), budget)
    uploaded = _upload(instances, depsgraph)
    request = Request(_placements(instances, uploaded, depsgraph), tuple(view_matrix[2][:3]), budget)
    _arrange(view, uploaded, request, wait)
    return request


def left_out() -> int:
    """How many splats viewports left out when they were last drawn, to stay within the budget: the most."""
    return max((view.arrangement.left_out for view in _views.values() if view.arrangement), default=0)


def _plain(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    return selection.only_chosen(instance.evaluated, depsgraph)


def _key(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> int:
    """Whose splats are uploaded for an instance: the object's own, or what its modifiers make of them."""
    return (instance.object.data if _plain(instance, depsgraph) else instance.object).session_uid


def _upload(instances: list[shown.SplatInstance], depsgraph: bpy.types.Depsgraph) -> splats.Uploaded:
    """The splats of all instances on the graphics card; they go there only where some have changed."""
    global _uploaded, _keys, uploads
    clouds: dict[int, bpy.types.PointCloud] = {}
    versions: dict[int, changes.Version | None] = {}
    for instance in instances:
        plain, key = _plain(instance, depsgraph), _key(instance, depsgraph)
        clouds.setdefault(key, instance.object.data if plain else instance.evaluated.data)
        versions[key] = changes.version(instance.object.data if plain else instance.object)
        if not plain and depsgraph.mode == "RENDER":  # modifiers may do otherwise in viewports
            versions[key] = None
    if _uploaded is None or any(_keys.get(key) != each or each is None for key, each in versions.items()):
        # A level that is hidden just now stays: artists step through levels.
        there = {cloud.session_uid: cloud for cloud in bpy.data.pointclouds if shown.is_splats(cloud)}
        stay = {key: there[key] for key in _keys if key in there and key not in clouds}
        versions |= {key: changes.version(cloud) for key, cloud in stay.items()}
        clouds |= stay
        _uploaded, _keys = splats.upload(list(clouds.values())), {key: versions[key] for key in clouds}
        uploads += 1
    return _uploaded


def _placements(
    instances: list[shown.SplatInstance],
    uploaded: splats.Uploaded,
    depsgraph: bpy.types.Depsgraph,
) -> tuple[Placement, ...]:
    roots = {item.object: root for root in scenes.roots(depsgraph.scene) for item in root.lodgs.levels}
    numbers, found = {key: number for number, key in enumerate(_keys)}, []
    for instance in instances:
        number = numbers[_key(instance, depsgraph)]
        plain, root = _plain(instance, depsgraph), roots.get(instance.object)
        found.append(
            Placement(
                first=uploaded.starts[number],
                count=uploaded.counts[number],
                matrix=instance.matrix_world.tobytes(),
                level=instance.level,
                choice=selection.choice(instance.evaluated, depsgraph) if plain else None,
                scene=(root or instance.object).session_uid,
                tell=root.lodgs.tell if root else "OWN",
                antialias=instance.antialias,
            )
        )
    return tuple(found)


def _arrange(view: ViewState, uploaded: splats.Uploaded, request: Request, wait: bool) -> None:
    """Takes over an arrangement that has been found, and asks for another where one is wanted."""
    global _thread
    if view.pending is not None and (wait or view.pending[2].done()):
        of, _, found = view.pending
        view.pending = None
        _take(view, of, found.result())
    current = view.arrangement is not None and view.uploaded is uploaded
    if (current and view.arrangement.request == request) or view.pending is not None:
        return
    if _thread is None:
        _thread = ThreadPoolExecutor(1, "lodgs-order")
    view.pending = (uploaded, request, _thread.submit(arrange, uploaded.pool, request))
    if wait:
        _, _, found = view.pending
        view.pending = None
        _take(view, uploaded, found.result())


def _take(view: ViewState, uploaded: splats.Uploaded, arrangement: Arrangement) -> None:
    view.uploaded, view.arrangement = uploaded, arrangement
    view.instances = splats.instances_texture(arrangement)


def _alike(one: tuple[Placement, ...], other: tuple[Placement, ...]) -> bool:
    """Whether placements are of the same splats, wherever they stand."""
    return [(p.first, p.count, p.level) for p in one] == [(p.first, p.count, p.level) for p in other]


def _wake_later() -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(_wake):
        bpy.app.timers.register(_wake, first_interval=0.01)


def _wake() -> float | None:
    """Redraws viewports for which something is ready; asks to be called again while there is more to come."""
    now, waiting = time.monotonic(), False
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                view = _views.get(region.as_pointer())
                if view is None:
                    continue
                still = view.resolution < 1 and now - view.moved >= STILL
                if still or (view.pending is not None and view.pending[2].done()):
                    region.tag_redraw()
                waiting |= view.pending is not None or view.resolution < 1
    return 0.01 if waiting else None


def clear() -> None:
    """Frees everything that is kept between drawings."""
    global _uploaded, _keys
    _views.clear()
    _uploaded, _keys = None, {}


def stop() -> None:
    """Ends the thread."""
    global _thread
    if _thread is not None:
        _thread.shutdown(wait=False, cancel_futures=True)
    _thread = None
