"""What each viewport shows of the splats, kept between drawings.

Splats are brought to the graphics card when they are first drawn, some at each redraw so that no window waits
for them, and anew only when the points of an object themselves have changed: distances and fading come from
the modifiers' settings (``selection.choice``), so neither time nor view changes a splat. An object with other
modifiers is read as they leave it, whenever they do so anew. Which splats are drawn is found in a thread when
the choice changes, in which order also when the view turns; until all that is drawn is there, the last
arrangement stays. Only where there is none to stay is the new one drawn as far as it has come.

Of a tree that is read from its file (``streaming``) that thread takes over what has come, while no viewport
reads it to bring it to the graphics card.
"""

from __future__ import annotations

import time
import weakref
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from math import inf

import bpy
import gpu
import numpy as np
from mathutils import Matrix

from .. import extension
from ..data import changes, roots, selection, shown
from ..nodes import display
from . import eye, resident, splats
from .arranging import Arrangement, Placement, Request, arrange
from .resident import Cloud, Reading, Resident, Store
from .streaming import Direction, Stream

STILL = 0.2
"""Seconds after which a view that no longer moves is drawn in full resolution."""
LOADING = 0.01, 0.02
"""Seconds after which a redraw leaves further splats to the next one: at least, and at most. What is begun is
finished: no redraw is to be held up for 0.05 seconds."""
GROWTH = 1.5
"""By how much more splats a picture that is not complete is drawn again."""

ROUNDING = 1e-4
"""Share by which places may differ that are the same."""
NOTHING = -1
"""Of what has come from files, until a viewport has drawn what the scene itself holds."""

reads = 0
"""How often all splats were read since Blender started."""


@dataclass(eq=False)
class ViewState:
    """What one viewport shows.

    Attributes:
        resident, arrangement: what is drawn, or what the drawn part is of.
        store: where its splats are.
        instances, count: the list of those that are drawn.
        pending: the arrangement that is being computed, and of which splats.
        loading: the arrangement whose splats are on their way to the store.
        missing: those of them (M,) that are not there yet, and in which store.
        loaded: when some of them were brought there last.
        matrix: from the world to clip space when it was last drawn.
        moved: when it last moved.
        arrived: how much had come from files when it last asked for an arrangement with all of it.
        selected: of what it draws what has the colour of what is selected, see ``resident.Resident``.
        tells_selected: whether it shows that.
    """

    canvas: splats.Canvas = field(default_factory=splats.Canvas)
    resident: Resident | None = None
    arrangement: Arrangement | None = None
    store: Store | None = None
    instances: gpu.types.GPUTexture | None = None
    count: int = 0
    pending: tuple[Resident, Request, Future[Arrangement]] | None = None
    loading: Arrangement | None = None
    missing: tuple[Store, np.ndarray] | None = None
    loaded: float = 0.0
    matrix: Matrix | None = None
    moved: float = 0.0
    arrived: int = 0
    resolution: float = 1.0
    selected: np.ndarray | None = None
    tells_selected: bool = False

    def reads(self, of: Resident) -> bool:
        """Whether splats are on their way, or will be, so that they must stay what they are."""
        on_their_way = self.loading is not None and self.loading.serial == of.pool.serial
        return on_their_way or (self.pending is not None and self.pending[0] is of)

    def lists(self, of: Resident) -> list[np.ndarray]:
        """The splats (M,) that it draws, and those that are on their way."""
        drawn = self.arrangement if self.resident is of else None
        both = drawn, self.loading if self.loading is not drawn else None
        return [each.splats for each in both if each is not None]


_views: dict[int, ViewState] = {}
_all: weakref.WeakSet[ViewState] = weakref.WeakSet()
"""Those for which there are splats in the store: of viewports, and of renders while they last."""
_thread: ThreadPoolExecutor | None = None

_resident: Resident | None = None
_keys: dict[int, changes.Version | Stream | None] = {}
"""Whose splats were read: point clouds, or objects whose modifiers change them, by ``session_uid``; and in
which version, None for one that only a render shows. Roots of scenes that are read from a file."""
_reading: tuple[tuple, Reading] | None = None
"""What is being read in their place: whose splats and how many, and what there is of them."""
_streams: dict[int, Stream] = {}
"""Those files, by the roots' ``session_uid``."""
_told: list[tuple[int, bool, bool]] = []
"""What panels say of them."""


def draw(context: bpy.types.Context) -> None:
    """Draws all visible splats into the viewport that is being drawn."""
    space, region, region_data = context.space_data, context.region, context.region_data
    if region.as_pointer() not in _views:
        _forget_closed()
    view = _views.setdefault(region.as_pointer(), ViewState())
    instances = [
        instance
        for instance in shown.splat_instances(context.evaluated_depsgraph_get(), space)
        if not display.is_drawn_by_blender(instance.evaluated)
    ]
    now, matrix = time.monotonic(), region_data.window_matrix @ region_data.view_matrix
    if view.matrix is not None and view.matrix != matrix:
        view.moved = now
    view.matrix = matrix
    settings = context.scene.lodgs_viewport
    view.resolution = settings.moving / 100 if now - view.moved < STILL else 1.0
    view.tells_selected = space.overlay.show_overlays
    camera = eye.looked_through(context)
    draw_splats(
        view, instances, context.evaluated_depsgraph_get(),
        region_data.view_matrix, region_data.window_matrix, settings.budget, moving=True,
        under_overlays=space.overlay.show_overlays and not _shows_photograph(camera),
        frame=splats.WHOLE if camera is None else eye.frame(camera, context.scene, matrix),
    )  # fmt: skip
    if _unfinished(view) or view.pending is not None or view.resolution < 1 or _busy():
        _wake_later()


def _forget_closed() -> None:
    """Frees what viewports keep that no window shows any more."""
    there = {
        region.as_pointer()
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        for region in area.regions
    }
    for key in _views.keys() - there:
        _all.discard(_views.pop(key))


def _shows_photograph(camera: bpy.types.Object | None) -> bool:
    """Whether a camera's picture fills the view: it lies among the overlays, and would cover the splats."""
    return (
        camera is not None
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
    frame: splats.Frame = splats.WHOLE,
    wait: bool = False,
    moving: bool = False,
) -> None:
    """Draws splat instances into the active framebuffer.

    Args:
        view: what was drawn there last; changed.
        view_matrix, projection: from the world to the camera's space, and on to clip space.
        budget, wait, moving: see :func:`prepare`.
        under_overlays, frame: see ``splats.draw``.
    """
    request = prepare(view, instances, depsgraph, view_matrix, budget, wait, moving)
    if view.arrangement is None or view.store is None or view.instances is None or not view.count:
        return
    placements = view.arrangement.request.placements
    if _alike(placements, request.placements):  # what moves, moves at once; its order follows
        placements = request.placements
    splats.draw(
        view.store.textures, view.store.part, view.store.higher, view.instances, view.count,
        [placement.world for placement in placements], view_matrix, projection, view.canvas,
        antialias=[placement.antialias for placement in placements],
        looks=[placement.looks for placement in placements], resolution=view.resolution,
        under_overlays=under_overlays, frame=frame,
    )  # fmt: skip


def prepare(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    view_matrix: Matrix,
    budget: int,
    wait: bool = False,
    moving: bool = False,
) -> Request:
    """All that comes before drawing: what has changed is read, and what has been found taken over.

    Args:
        budget: most splats to draw.
        wait: for the splats and their order, rather than going on with the last ones that there are.
        moving: choose for the eye that is the viewport's own from where it is now, see ``eye.moved``.

    Returns:
        What is to be drawn, which ``view.arrangement`` may not answer yet.
    """
    nothing = Request((), tuple(view_matrix[2][:3]), budget)
    if not instances:
        view.resident = view.arrangement = view.store = view.instances = None
        view.pending = view.loading = view.missing = None
        return nothing
    _all.add(view)
    before, view.arrived = view.arrived, 0
    instances = _from_files(view, instances, depsgraph, view_matrix, moving, wait)
    read = _read(instances, depsgraph, wait)
    if read is None:
        view.arrived = NOTHING
        return nothing
    of, clouds = read
    take_over = wait or not any(other.reads(of) for other in _all if other is not view)
    arrived = _arrived()
    placements = _placements(instances, of, depsgraph, moving, take_over)
    request = replace(nothing, placements=placements)
    asked = _arrange(view, of, request, wait, take_over)
    if view.arrived != NOTHING:  # what is not asked for yet has the view redrawn again
        view.arrived = arrived if take_over and asked else before
    of.see_selection(clouds)
    of.see_paint(clouds)
    _load(view, of, clouds, wait)
    if view.arrangement is not None and view.selected is not _selected(view):
        _list(view)
    return request


def left_out() -> int:
    """How many splats viewports left out when they were last drawn, to stay within the budget: the most."""
    return max((view.arrangement.left_out for view in _views.values() if view.arrangement), default=0)


def stream(root: bpy.types.Object) -> Stream | None:
    """What viewports read of a splat scene's file; None where they do not."""
    return _streams.get(root.session_uid)


def _from_files(
    view: ViewState,
    instances: list[shown.SplatInstance],
    depsgraph: bpy.types.Depsgraph,
    view_matrix: Matrix,
    moving: bool,
    wait: bool,
) -> list[shown.SplatInstance]:
    """The instances, in which what is read from a file stands for a scene's levels as soon as it can; and
    files are asked for what the eye needs."""
    ready = []
    for instance in shown.without_coarser(instances):
        if (source := instance.source) is None:
            continue
        there = _streams.get(source.scene)
        if there is None or there.source != source:
            if there is not None:
                there.stop()
            there = _streams[source.scene] = Stream(source)
        choice = choice_of_view(instance, depsgraph, moving)
        if choice is not None and not (there.problem and not there.ready):
            there.ask(choice, _direction(instance, choice, view_matrix))
            while wait and there.busy and not there.problem:
                if there.ready:
                    _beside().submit(there.take).result()
                time.sleep(0.01)
            # at first what the scene holds is drawn, which is there at once
            begun = wait or there in _keys.values() or (view.arrangement and not view.loading)
            if there.ready and begun:
                ready.append(source)
            elif there.ready:
                view.arrived = NOTHING
    kept = [each if each.source in ready else replace(each, source=None) for each in instances]
    return shown.without_coarser(kept)


def _direction(
    instance: shown.SplatInstance, choice: selection.LodQuery, view_matrix: Matrix
) -> Direction | None:
    """In which direction, in the splats' own space, an eye looks that is where the view is; None for one that
    is elsewhere."""
    to_own = np.linalg.pinv(instance.matrix_world) @ np.array(view_matrix.inverted(), np.float64)
    apart = np.linalg.norm(to_own[:3, 3] - choice.eye)
    if apart > ROUNDING * (1 + np.linalg.norm(to_own[:3, 3])):
        return None
    x, y, z = (-to_own[:3, 2] / max(np.linalg.norm(to_own[:3, 2]), 1e-30)).tolist()
    return x, y, z


def _stood_for(instances: list[shown.SplatInstance]) -> Iterator[bpy.types.PointCloud]:
    """The levels in whose place what is read from a file is drawn."""
    for instance in instances:
        root = roots.root_of(instance.object) if instance.source is not None else None
        for item in root.lodgs.levels if root is not None else ():
            if item.exists:
                yield item.object.data


def _busy() -> bool:
    return any(stream.busy for stream in _streams.values())


def _arrived() -> int:
    return sum(stream.ready + stream.arrived for stream in _streams.values())


def _plain(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    return selection.only_chosen(instance.evaluated, depsgraph)


def _key(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> int:
    """Whose splats are uploaded for an instance: the object's own, what its modifiers make of them, or its
    scene's from a file."""
    if instance.source is not None:
        return instance.source.scene
    return (instance.object.data if _plain(instance, depsgraph) else instance.object).session_uid


def _read(
    instances: list[shown.SplatInstance], depsgraph: bpy.types.Depsgraph, wait: bool
) -> tuple[Resident, list[Cloud | None]] | None:
    """The splats of all instances, read anew only where some have changed; and their clouds.

    None where that takes longer than a redraw may, which is not to wait for it: the next one goes on.
    """
    global _resident, _keys, _reading, reads
    clouds: dict[int, Cloud] = {}
    versions: dict[int, changes.Version | Stream | None] = {}
    for instance in instances:
        if instance.source is not None:
            key = instance.source.scene
            clouds[key] = versions[key] = _streams[key]
            continue
        plain, key = _plain(instance, depsgraph), _key(instance, depsgraph)
        clouds.setdefault(key, instance.object.data if plain else instance.evaluated.data)
        versions[key] = changes.version(instance.object.data if plain else instance.object)
        if not plain and depsgraph.mode == "RENDER":  # modifiers may do otherwise in viewports
            versions[key] = None
    if _resident is None or any(_keys.get(key) != each or each is None for key, each in versions.items()):
        # A level that is hidden just now stays: artists step through levels.
        there = {cloud.session_uid: cloud for cloud in bpy.data.pointclouds if shown.is_splats(cloud)}
        for cloud in _stood_for(instances):  # nor do those that a file stands for, which takes its room
            there.pop(cloud.session_uid, None)
        stay = {key: there[key] for key in _keys if key in there and key not in clouds}
        versions |= {key: changes.version(cloud) for key, cloud in stay.items()}
        clouds |= stay
        keys, each = {key: versions[key] for key in clouds}, list(clouds.values())
        whose = keys, list(keys), list(map(resident.count_of, each))
        if _reading is None or _reading[0] != whose:
            _reading = whose, resident.Reading(each)
        begun = time.monotonic()
        found = _reading[1].go_on(each, inf if wait else begun + LOADING[1])
        if found is None:
            return None
        _resident, _keys, _reading = found, keys, None
        reads += 1
        close_streams({obj.session_uid for obj in bpy.data.objects if obj.lodgs.is_root})
        if not wait and time.monotonic() > begun + LOADING[0]:
            return None
    return _resident, [clouds.get(key) for key in _keys]


def _placements(
    instances: list[shown.SplatInstance],
    of: Resident,
    depsgraph: bpy.types.Depsgraph,
    moving: bool,
    take_over: bool,
) -> tuple[Placement, ...]:
    root_of_level = {item.object: root for root in roots.roots(depsgraph.scene) for item in root.lodgs.levels}
    numbers, found = {key: number for number, key in enumerate(_keys)}, []
    for instance in instances:
        number = numbers[_key(instance, depsgraph)]
        root, paged = root_of_level.get(instance.object), instance.source and _streams[instance.source.scene]
        found.append(
            Placement(
                first=of.starts[number],
                count=of.counts[number],
                matrix=instance.matrix_world.tobytes(),
                level=instance.level,
                choice=choice_of_view(instance, depsgraph, moving),
                scene=(root or instance.object).session_uid,
                tell=root.lodgs.tell if root else "OWN",
                antialias=instance.antialias,
                arrived=(paged.arrived if take_over else paged.taken) if paged else 0,
                looks=instance.looks,
            )
        )
    return tuple(found)


def choice_of_view(
    instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph, moving: bool = True
) -> selection.LodQuery | None:
    """By what an instance's splats are chosen, from where the eye is now.

    Args:
        moving: see :func:`prepare`.
    """
    if not _plain(instance, depsgraph):
        return None
    if not moving:
        return shown.choice_of_picture(instance, depsgraph)
    choice, root = selection.choice(instance.evaluated, depsgraph), roots.root_of(instance.object)
    seen = eye.moved(depsgraph.scene, root) if root is not None else None
    return (
        choice
        if choice is None or not choice.rule or seen is None
        else replace(choice, eye=seen[0], focal_px=seen[1])
    )


def _arrange(view: ViewState, of: Resident, request: Request, wait: bool, take_over: bool) -> bool:
    """Takes over an arrangement that has been found, and asks for another where one is wanted.

    Returns:
        Whether the request has been answered, or will be.
    """
    if view.loading is not None and view.loading.serial != of.pool.serial:  # of splats that are others now
        view.loading = view.missing = None
    if view.pending is not None and (wait or view.pending[2].done()):
        found_of, _, found = view.pending
        view.pending = None
        if found_of is of:
            _found(view, of, found.result())
    current = view.loading or (view.arrangement if view.resident is of else None)
    if current is not None and current.request == request:
        return True
    if view.pending is not None:
        return view.pending[1] == request
    if view.loading is not None and not wait:  # what comes now, comes whole
        return False
    view.pending = (of, request, _beside().submit(arrange, of.pool, request, take_over))
    if wait:
        found, view.pending = view.pending[2].result(), None
        _found(view, of, found)
    return True


def _beside() -> ThreadPoolExecutor:
    """The one thread that arranges, and takes over what has come from files."""
    global _thread
    if _thread is None:
        _thread = ThreadPoolExecutor(1, "lodgs-order")
    return _thread


def _found(view: ViewState, of: Resident, arrangement: Arrangement) -> None:
    """Goes on with an arrangement, unless others are where its splats were."""
    while of.pool.changed:  # whoever had it taken over
        changed = of.pool.changed.pop()
        if of.store is not None:
            of.store.forget(changed)
    if arrangement.serial == of.pool.serial:
        view.loading, view.missing = arrangement, None


def _load(view: ViewState, of: Resident, clouds: Sequence[bpy.types.PointCloud | None], wait: bool) -> None:
    """Brings splats of an arrangement to the graphics card, and takes it over when they all are there."""
    now = time.monotonic()
    idle = view.loading is None and not any(other.pending for other in _all)
    if idle and view.resident is of and view.store is not of.store:
        view.loading = view.arrangement  # into the store that another viewport has made
    loading = view.loading
    if loading is None or loading.serial != of.pool.serial:
        view.loading = None
        return
    store, missing = view.missing or (None, None)
    if not (begun := store is not None and store is of.store):
        store = of.hold([each for other in _all for each in other.lists(of)])
        missing = store.missing(loading.splats)
    # where redraws take long, as much is loaded in each
    end = now + min(max(now - view.loaded if begun else 0, LOADING[0]), LOADING[1])
    view.loaded, begin = now, 0
    shown = begun and _show(view, of, loading, store, missing)  # what redraws before this one have brought
    while begin < len(missing) and (wait or (begun and not shown and not begin) or time.monotonic() < end):
        piece = missing[begin : begin + resident.PIECE]
        piece = piece[: of.of_one_cloud(piece)]
        records = of.read(clouds, piece)
        if records is None:  # what there is now is asked for
            view.loading = view.arrangement = view.missing = None
            return
        store.put(piece, records)
        begin += len(piece)
    missing = missing[begin:]
    view.missing = store, missing
    if wait or (not shown and not len(missing) and time.monotonic() < end):
        _show(view, of, loading, store, missing)


def _show(view: ViewState, of: Resident, loading: Arrangement, store: Store, missing: np.ndarray) -> bool:
    """Draws an arrangement from now on: as soon as none of its splats (M,) is missing, or where there is
    nothing else to draw as much of it as is there, if that is worth it. Whether it does."""
    part = view.arrangement is loading and view.store is store
    part = part and len(loading.splats) - len(missing) > GROWTH * view.count
    if len(missing) and not part and view.arrangement is not None:
        return False
    view.resident, view.arrangement, view.store = of, loading, store
    _list(view)
    drawn = [other.arrangement for other in _all if other.store is store and other.arrangement]
    if all(each.serial == loading.serial for each in drawn):
        store.release()
    if not len(missing):
        view.loading = view.missing = None
    return True


def _list(view: ViewState) -> None:
    """Brings the list of what a view draws to the graphics card."""
    assert view.arrangement is not None and view.store is not None
    view.selected = _selected(view)
    view.instances, view.count = splats.instances_texture(view.arrangement, view.store.places, view.selected)


def _selected(view: ViewState) -> np.ndarray | None:
    return view.resident.selected if view.resident is not None and view.tells_selected else None


def _alike(one: tuple[Placement, ...], other: tuple[Placement, ...]) -> bool:
    """Whether placements are of the same splats, wherever they stand."""
    return [(p.first, p.count, p.level) for p in one] == [(p.first, p.count, p.level) for p in other]


def _wake_later() -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(_wake):
        bpy.app.timers.register(_wake, first_interval=0.01)


def wants_redraw(view: ViewState) -> bool:
    """Whether drawing a view again would show more, or have more come."""
    return _unfinished(view) or (view.pending is not None and view.pending[2].done())


def _unfinished(view: ViewState) -> bool:
    return view.loading is not None or view.arrived != _arrived()


def _wake() -> float | None:
    """Redraws viewports for which something is ready; asks to be called again while there is more to come."""
    global _told
    now, waiting = time.monotonic(), _busy()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions if area.type == "VIEW_3D" else ():
                view = _views.get(region.as_pointer())
                if view is None:
                    continue
                still = view.resolution < 1 and now - view.moved >= STILL
                if still or wants_redraw(view):
                    region.tag_redraw()
                waiting |= _unfinished(view) or view.pending is not None or view.resolution < 1
    if (told := [(each.splats, each.busy, each.short) for each in _streams.values()]) != _told:
        _told = told
        extension.redraw()
    return 0.01 if waiting else None


def clear() -> None:
    """Frees everything that is kept between drawings."""
    global _resident, _keys, _reading
    _views.clear()
    _all.clear()
    _resident, _keys, _reading = None, {}, None


def close_streams(but: Collection[int] = ()) -> None:
    """Ends reading from files, but of those roots (``session_uid``)."""
    for key in _streams.keys() - but:
        _streams.pop(key).stop()


def stop() -> None:
    """Ends the threads."""
    global _thread
    close_streams()
    if _thread is not None:
        _thread.shutdown(wait=False, cancel_futures=True)
    _thread = None
