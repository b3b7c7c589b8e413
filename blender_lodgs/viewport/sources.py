"""Splats that viewports draw: the pool of all splats in memory, and streams of files.

All splats to draw are in one pool (``resident``). They are read again only if the points of an object change:
levels of detail come from the settings of modifiers (``selection.evaluated_query``), so time and views do not
change splats. Objects with other modifiers are read after evaluation. For streamed files (``streaming``), a
worker thread copies new pages, while no viewport uploads them.
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

from ..data import changes, roots, selection, shown
from . import resident, view_camera, view_state
from .arrangement import Placement
from .resident import Cloud, PoolReader, Resident
from .streaming import Direction, Stream
from .view_state import ViewState

ROUNDING = 1e-4
"""Relative difference below which positions count as equal."""
NOT_REQUESTED = -1
"""Value of ``ViewState.arrived`` that makes the viewport redraw until streams are requested."""

reads = 0
"""Number of times the pool was read since Blender started, for tests."""

_executor: ThreadPoolExecutor | None = None
_resident: Resident | None = None
_versions: dict[int, changes.Version | Stream | None] = {}
"""Versions of the read splats, by the ``session_uid`` of a point cloud, of an object with other modifiers, or
of the root of a streamed scene; None for objects that only a render shows."""
_reader: tuple[tuple, PoolReader] | None = None
"""Unfinished reader of the next pool, and a key of its splats."""
_streams: dict[int, Stream] = {}
"""Streams by the ``session_uid`` of their roots."""


def stream(root: bpy.types.Object) -> Stream | None:
    """Return the stream of a splat scene; None if it is not streamed."""
    return _streams.get(root.session_uid)


def with_streams(
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
                    worker().submit(current.take).result()
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


def is_streaming() -> bool:
    """Return True while a stream is busy."""
    return any(stream.busy for stream in _streams.values())


def stream_states() -> list[tuple[int, bool, bool]]:
    """Return the state of each stream that panels show: number of splats, busy, short."""
    return [(stream.splats, stream.busy, stream.short) for stream in _streams.values()]


def arrived() -> int:
    """Return a number that grows whenever streams have brought splats."""
    return sum(stream.ready + stream.arrived for stream in _streams.values())


def _is_unmodified(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> bool:
    return selection.only_lodgs_modifiers(instance.evaluated, depsgraph)


def _key(instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph) -> int:
    """Return the key of an instance's splats: that of its point cloud, modified object or streamed scene."""
    if instance.source is not None:
        return instance.source.scene
    return (instance.object.data if _is_unmodified(instance, depsgraph) else instance.object).session_uid


def read(
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


def placements(
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


def worker() -> ThreadPoolExecutor:
    """Return the single worker thread, which arranges splats and copies streamed pages."""
    global _executor
    if _executor is None:
        _executor = ThreadPoolExecutor(1, "lodgs-order")
    return _executor


def clear() -> None:
    """Free all splats."""
    global _resident, _versions, _reader
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
