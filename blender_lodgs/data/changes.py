"""Change counters of point data, for caches derived from it.

Blender reports tagged datablocks when it evaluates a view layer; every operator triggers an evaluation first.
Datablocks outside the view layers of all windows are not reported.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import bpy

Version = tuple[int, ...]

_reported: Counter[int] = Counter()
_painted: Counter[int] = Counter()
_files = 0
_selections = 0
_change_kind = ""


def version(datablock: bpy.types.ID) -> Version:
    """Return a value that changes with a datablock's points, except for their paint.

    For an object, it also changes with the result of its modifiers.
    """
    return _files, _reported[datablock.session_uid]


def paint_version(cloud: bpy.types.PointCloud) -> Version:
    """Return a value that changes when points are painted (``painting``)."""
    return _files, _painted[cloud.session_uid]


@contextmanager
def selecting() -> Iterator[None]:
    """Mark the changes in the block as changes of selection.

    Blender treats them as changes of points; :func:`version` ignores them, so that caches stay valid.
    """
    try:
        with _limit_reports("selection"):
            yield
    finally:
        report_selected()


def painting() -> AbstractContextManager[None]:
    """Mark the changes in the block as paint: :func:`version` changes for objects, not for point clouds."""
    return _limit_reports("paint")


@contextmanager
def _limit_reports(kind: str) -> Iterator[None]:
    """Mark the changes in the block as changes of a kind, "selection" or "paint"."""
    global _change_kind
    bpy.context.view_layer.update()  # reports earlier changes under their own kind
    _change_kind = kind
    try:
        yield
        bpy.context.view_layer.update()
    finally:
        _change_kind = ""


def report_painted(cloud: bpy.types.PointCloud) -> None:
    """Report that points were painted."""
    _painted[cloud.session_uid] += 1


def report_selected() -> None:
    """Report that viewports have to update the displayed selection."""
    global _selections
    _selections += 1


def selection_version() -> Version:
    """Return a value that changes with the displayed selection."""
    return _files, _selections


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if _change_kind == "selection" or depsgraph.mode == "RENDER":  # a new render depsgraph reports everything
        return
    changed = [update.id.original for update in depsgraph.updates if update.is_updated_geometry]
    if _change_kind == "paint":
        changed = [datablock for datablock in changed if isinstance(datablock, bpy.types.Object)]
    _reported.update(datablock.session_uid for datablock in changed)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    """Invalidate all versions when a file is loaded, or its state changes by undo or redo."""
    global _files
    _files += 1
    _reported.clear()
    _painted.clear()


def register() -> None:
    handlers = bpy.app.handlers
    for callbacks in (handlers.depsgraph_update_post, handlers.frame_change_post):
        callbacks.append(_on_update)
    for callbacks in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        callbacks.append(_on_load)


def unregister() -> None:
    handlers = bpy.app.handlers
    for callbacks in (handlers.depsgraph_update_post, handlers.frame_change_post):
        callbacks.remove(_on_update)
    for callbacks in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        callbacks.remove(_on_load)
