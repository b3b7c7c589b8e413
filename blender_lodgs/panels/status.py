"""Progress of background work in the status bar of every workspace, with a notice when it ends."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import bpy

from .. import extension
from ..runs import background_capture, environment_setup, method_comparison, photo_preparation
from ..runs.watch import root_by_uid, watches

NOTICE = 60.0
"""Seconds for which the notice of finished work is shown."""


@dataclass(frozen=True)
class Work:
    """One piece of background work.

    Attributes:
        source: object that does the work.
        text: current step, or the result.
        share: progress, 0 to 1.
        running: True while the work runs.
        failed: True if the work ended with a problem.
    """

    source: object
    text: str
    share: float
    running: bool
    failed: bool


_observed: dict[int, tuple[object, float]] = {}
"""Source and end time of each work that was observed running, by the source's ``id``; 0 while it runs.

The reference to the source keeps Python from reusing its ``id``."""


def all_work() -> Iterator[Work]:
    """Yield all current work, and the last of each kind that ended."""
    for uid, watch in watches.items():
        root = root_by_uid(uid)
        name = "Splats" if root is None else root.name
        message = watch.message.partition(" (")[0]  # the bar has room for a few words
        yield Work(watch, f"{name}: {message}", watch.fraction, watch.running, bool(watch.problem))
    modules = (background_capture, photo_preparation, environment_setup, method_comparison)
    for job in [module.current for module in modules]:
        if job is not None:
            yield Work(job, job.message, job.fraction, job.running, bool(job.problem))


def visible_work(now: float) -> list[Work]:
    """Return the work that the status bar shows: running, or ended within the last ``NOTICE`` seconds."""
    visible = []
    current = list(all_work())
    for removed in _observed.keys() - {id(work.source) for work in current}:
        del _observed[removed]
    for work in current:
        _, ended = _observed.get(id(work.source), (None, None))
        if work.running:
            ended = 0.0
        elif ended == 0.0:
            ended = now
            bpy.app.timers.register(extension.redraw, first_interval=NOTICE, persistent=True)
        if ended is not None:
            _observed[id(work.source)] = work.source, ended
        if work.running or (ended is not None and now - ended < NOTICE):
            visible.append(work)
    return visible


def _draw(self, context: bpy.types.Context) -> None:
    for work in visible_work(time.monotonic()):
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
