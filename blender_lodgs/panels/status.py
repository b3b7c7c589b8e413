"""The status bar: how far programs beside Blender are, in every workspace, and a notice at their end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import bpy

from .. import extension
from ..runs import capturing, making, preparing
from ..runs.watch import root_by_uid, watches

NOTICE = 60.0
"""Seconds for which it is said that something has ended."""


@dataclass(frozen=True)
class Work:
    """One thing that is done beside Blender.

    Attributes:
        key: tells it from others.
        text: what is done, or how it ended.
        share: how much of it, 0 to 1.
        running: whether it is at work.
        failed: whether it ended with a problem.
    """

    key: int
    text: str
    share: float
    running: bool
    failed: bool


_ended: dict[int, float] = {}
"""When what was seen at work was seen to have ended, by its key; 0 where it is at work."""


def works() -> Iterator[Work]:
    """All that is at work, or was last."""
    for uid, watch in watches.items():
        root = root_by_uid(uid)
        name = "Splats" if root is None else root.name
        yield Work(id(watch), f"{name}: {watch.message}", watch.share, watch.running, bool(watch.problem))
    for each in (capturing.current, preparing.current, making.current):
        if each is not None:
            yield Work(id(each), each.message, each.fraction, each.running, bool(each.problem))


def shown(now: float) -> list[Work]:
    """What the status bar shows: what is at work, and what has ended since it was seen at work."""
    found = []
    for work in works():
        if work.running:
            _ended[work.key] = 0.0
        elif _ended.get(work.key) == 0.0:
            _ended[work.key] = now
            bpy.app.timers.register(extension.redraw, first_interval=NOTICE, persistent=True)
        if work.running or (work.key in _ended and now - _ended[work.key] < NOTICE):
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
