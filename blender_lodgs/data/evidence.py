"""Heat map of the evidence for each splat in the viewports: the number and directions of its photos."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.editing.clutter import KINDS
from ...training.scenes.splat_evidence import measure_splat_evidence
from .. import extension
from ..attributes import BASE, SCALE
from . import cleaning, clutter, photographs

TINTS = ("red", "orange", "yellow", "green")
"""Colours of the grades of evidence, see ``splat_evidence.GRADES``."""
_MARKS = np.array([
    next(cleaning.mark_of(name) for name, kind in KINDS.items() if kind.tint == tint) for tint in TINTS
], np.uint8)  # fmt: skip

_heat_maps: dict[int, np.ndarray] = {}
"""Marks of each point cloud with a heat map, by its ``session_uid``."""


def show(root: bpy.types.Object) -> None:
    """Measure the evidence for the splats of each level, and show it in the viewports.

    Raises:
        LodgsError: a level has no splats.
    """
    if root.lodgs_clutter.preview:
        clutter.stop(root)
    held_out = photographs.held_out(root)
    views = [view for view in photographs.views_with_photo(root) if view not in held_out]
    cameras = [photographs.camera_of(view) for view in views]
    _heat_maps.clear()
    for item in root.lodgs.existing_levels:
        cloud = item.object.data
        evidence = measure_splat_evidence(
            cameras,
            cleaning.splat_attribute(cloud, "position"),
            cleaning.splat_attribute(cloud, SCALE).max(axis=1, initial=0),
            cleaning.splat_attribute(cloud, BASE)[:, 3],
        )
        _heat_maps[cloud.session_uid] = _MARKS[evidence.grades]
    cleaning.show_marks(_heat_maps)
    extension.redraw()


def hide() -> None:
    """Show the splats' own colours."""
    _heat_maps.clear()
    cleaning.show_marks({})
    extension.redraw()


def grade_shares(root: bpy.types.Object) -> np.ndarray | None:
    """Return the share of the finest level's visible splats of each grade; None without a heat map."""
    levels = root.lodgs.existing_levels
    if not levels:
        return None
    cloud = levels[-1].object.data
    marks = _heat_maps.get(cloud.session_uid)
    if marks is None or not cleaning.shows_marks(cloud, marks):
        return None
    visible = marks[~cleaning.hidden_mask(cloud)]
    return np.array([np.count_nonzero(visible == mark) for mark in _MARKS]) / max(len(visible), 1)
