"""Which datablocks' points have changed: for all who keep what they have made of them.

Blender reports what has been tagged when it evaluates a view layer, and every operator has it do so first. It
reports nothing of what no view layer of a window shows.
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
_only = ""


def version(datablock: bpy.types.ID) -> Version:
    """Another one after the points of a datablock, or of an object as modifiers leave it, have changed in
    anything but their paint."""
    return _files, _reported[datablock.session_uid]


def paint(cloud: bpy.types.PointCloud) -> Version:
    """Another one after points have been painted (``painting``)."""
    return _files, _painted[cloud.session_uid]


@contextmanager
def selecting() -> Iterator[None]:
    """In the block only selections change. To Blender that is a change of points, to :func:`version` none:
    what was made of them stays."""
    try:
        with _nothing_but("selection"):
            yield
    finally:
        others_selected()


def painting() -> AbstractContextManager[None]:
    """In the block points are painted, which :func:`version` tells of what modifiers make of them alone."""
    return _nothing_but("paint")


@contextmanager
def _nothing_but(what: str) -> Iterator[None]:
    global _only
    bpy.context.view_layer.update()  # what has changed before is more
    _only = what
    try:
        yield
        bpy.context.view_layer.update()
    finally:
        _only = ""


def others_painted(cloud: bpy.types.PointCloud) -> None:
    """Says that points have been painted."""
    _painted[cloud.session_uid] += 1


def others_selected() -> None:
    """Says that viewports are to show other points as selected."""
    global _selections
    _selections += 1


def selection() -> Version:
    """Another one after other points are to be shown as selected."""
    return _files, _selections


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if _only == "selection" or depsgraph.mode == "RENDER":  # where at first everything counts as new
        return
    changed = [update.id.original for update in depsgraph.updates if update.is_updated_geometry]
    if _only == "paint":
        changed = [each for each in changed if isinstance(each, bpy.types.Object)]
    _reported.update(each.session_uid for each in changed)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    """Another file, or another state of it: nothing is known of anything."""
    global _files
    _files += 1
    _reported.clear()
    _painted.clear()


def register() -> None:
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.append(_on_update)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.append(_on_load)


def unregister() -> None:
    handlers = bpy.app.handlers
    for changes in (handlers.depsgraph_update_post, handlers.frame_change_post):
        changes.remove(_on_update)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.remove(_on_load)
