"""What is at work, in the status bar of every workspace: how far it is, and that it has ended."""

from __future__ import annotations

import bpy

from ..render import compare
from ..runs import capturing, making
from ..runs.watch import root_by_uid, watches


def _draw(self, context: bpy.types.Context) -> None:
    row = self.layout.row(align=True)
    for work in (making.current, capturing.current):
        if work is not None and work.running:
            _draw_progress(row, work.message, work.fraction)
    measuring = compare.measurement
    if measuring is not None and measuring.running:
        _draw_progress(row, "Measuring", measuring.done / measuring.total)
    for watch in list(watches.values()):
        root = root_by_uid(watch.root)
        if root is not None and watch.running:
            _draw_progress(row, f"{root.name}: {watch.message}", watch.share)
        elif root is not None and watch.unread:
            icon = "CHECKMARK" if watch.state == "done" else "ERROR" if watch.problem else "PAUSE"
            row.label(text=f"{root.name}: {watch.message}", icon=icon)
            row.operator("lodgs.dismiss_notice", text="", icon="X", emboss=False)


def _draw_progress(row: bpy.types.UILayout, message: str, share: float) -> None:
    bar = row.row()
    bar.ui_units_x = 14
    bar.progress(text=f"{message} · {share:.0%}" if share else message, factor=share)


CLASSES = ()


def register() -> None:
    bpy.types.STATUSBAR_HT_header.append(_draw)


def unregister() -> None:
    bpy.types.STATUSBAR_HT_header.remove(_draw)
