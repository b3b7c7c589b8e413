"""Check of scenes before training, and its last findings for the panel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.scenes.check import Finding, check_folder

_findings: dict[int, list[Finding]] = {}
"""Findings by the session uid of the scene root."""


def read_findings(root: bpy.types.Object) -> Callable[[], list[Finding]]:
    """Return a function that checks the photos of a scene root. It does not use Blender's data.

    Raises:
        LodgsError: the root has no COLMAP folder.
    """
    settings = root.lodgs
    if not settings.scene_folder:
        raise LodgsError(f"Cannot check '{root.name}': it has no photos.", "Import a COLMAP scene.")
    folder, model, images = (
        Path(bpy.path.abspath(path)) if path else None
        for path in (settings.scene_folder, settings.training.model, settings.training.images)
    )
    return partial(check_folder, folder, model, images, image_scale=settings.training.image_scale)


def store_findings(uid: int, findings: list[Finding]) -> None:
    """Keep the findings about the scene root with a session uid for the panel."""
    _findings[uid] = findings


def last_findings(root: bpy.types.Object) -> list[Finding] | None:
    """Return the findings of the last check of a scene; None if it was not checked."""
    return _findings.get(root.session_uid)
