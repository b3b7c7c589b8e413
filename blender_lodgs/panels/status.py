"""The status bar: how far programs beside Blender are, in every workspace, and a notice at their end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import bpy

from .. import extension
from ..runs import background_capture, environment_setup, photo_preparation
from ..runs.watch import root_by_uid, watches

NOTICE = 60.0
"""Seconds for which it is said that something has ended."""


@dataclass(frozen=True)
class Work:
    """One thing that is done beside Blender.

    Attributes:
        source: what does it.
        text: what is done, or how it ended.
        share: how much of it, 0 to 1.
        running: whether it is at work.
        failed: whether it ended with a problem.
    """

    source: object
    text: str
    share: float
    running: bool
    failed: bool


_seen: dict[int, tuple[object, float]] = {}
"""What was seen at work, by its identity, and when it was seen to have ended: 0 where it is at work.

The source itself is held, as the identity of one that is gone may come back as another's."""


def works() -> Iterator[Work]:
    """All that is at work, or was last."""
    for uid, watch in watches.items():
        root = root_by_uid(uid)
        name = "Splats" if root is None else root.name
        yield Work(watch, f"{name}: {watch.message}", watch.share, watch.running, bool(watch.problem))
    for each in (background_capture.current, photo_preparation.current, environment_setup.current):
        if each is not None:
            yield Work(each, each.message, each.fraction, each.running, bool(each.problem))


def shown(now: float) -> list[Work]:
    """What the status bar shows: what is at work, and what has ended since it was seen at work."""
    found, all_works = [], list(works())
    for gone in _seen.keys() - {id(work.source) for work in all_works}:
        del _seen[gone]
    for work in all_works:
        _, ended = _seen.get(id(work.source), (None, None))
        if work.running:
            ended = 0.0
        elif ended == 0.0:
            ended = now
            bpy.app.timers.register(extension.redraw, first_interval=NOTICE, persistent=True)
        if ended is not None:
            _seen[id(work.source)] = work.source, ended
        if work.running or (ended is not None and now - ended < NOTICE):
            found.append(work)
    return found


def _draw(self, context: bpy.types.Context) -> None:
    for work in shown(time.monotonic()):
        row = self.layout.row(align=True)
        if work.running:
            row.ui_units_x = 16
            row.progress(text=work.text, factor=work.share)
        else:
            row.label(text=work.text, icon="ERROR" if work.failed else "CHECKMARK")


def register() -> None:
    bpy.types.STATUSBAR_HT_header.append(_draw)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(_draw)
