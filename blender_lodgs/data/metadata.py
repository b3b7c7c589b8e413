"""Metadata that a splat scene stores as JSON: facts of its rule, and the local origin."""

from __future__ import annotations

import json

import bpy
import numpy as np

from ...training.splats.bundle_header import INCONSISTENCIES, check_meta
from ...training.splats.levels import Bundle


def read_json(text: str) -> dict:
    """Parse a property with a JSON object; {} if the text is invalid."""
    try:
        content = json.loads(text or "{}")
        json.dumps(content, allow_nan=False)  # files allow no other numbers
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def meta_of(root: bpy.types.Object) -> dict:
    """Return the meta of a splat scene's bundle; {} if a damaged file has an invalid one."""
    meta = read_json(root.lodgs.meta)
    try:
        check_meta(meta)
    except INCONSISTENCIES:
        return {}
    return meta


def origin_of(root: bpy.types.Object) -> np.ndarray:
    """Return the local origin of a splat scene, (3,) float64 (``training.splats.origin``)."""
    return Bundle("", [], meta=meta_of(root)).origin


def read_facts(text: str) -> dict[str, float]:
    """Return the numbers of :func:`read_json`, by name."""
    return {name: value for name, value in read_json(text).items() if isinstance(value, int | float)}
