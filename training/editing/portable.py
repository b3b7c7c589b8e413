"""Levels of any rule in the form that formats of other programs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..errors import LodgsError, printable
from ..lod.rule import Rule, collect_facts
from ..lod.selection import check_rule, require_rule, standalone_levels
from ..scenes.view_tables import read_view_tables
from ..splats.gaussians import SplatRows
from ..splats.levels import NO_SPLATS, Bundle, Level
from ..splats.origin import NO_ORIGIN
from ..splats.portable_levels import (
    DEFAULT_FOCAL,
    DISTANCE,
    DISTANCE_RULE,
    ConcatenatedRows,
    PortableLevels,
    PortableView,
)

_SAMPLE = 20_000
"""Approximate number of splats whose columns determine the distance of a level."""


def portable_levels(bundle: Bundle, original_place: bool = False) -> tuple[PortableLevels, list[str]]:
    """Return the levels of a bundle as complete scenes that are selected by distance.

    Args:
        original_place: place the splats at their original coordinates, instead of relative to the local
            origin.

    Returns:
        The levels, and a sentence about each difference from the bundle's rule.

    Raises:
        LodgsError: the bundle contradicts its rule, or its views are damaged.
    """
    rule = check_rule(bundle)
    views = _views(bundle)
    origin = bundle.origin if original_place else NO_ORIGIN
    if rule is None:
        levels, _ = _with_splats(_complete(bundle), ())
        plain = replace(bundle, levels=levels, rule="", cumulative=False, tables={})
        return PortableLevels(plain, views=views, origin=origin), []
    focal = float(np.median([min(view.fx, view.fy) for view in views])) if views else DEFAULT_FOCAL
    nested, notes = rule.nested_levels(bundle), []
    if nested is not bundle:
        counts = ", ".join(f"{len(level.rows):,}" for level in nested.levels)
        notes.append(
            f"The rule '{rule.name}' selects single splats. Other programs get complete levels of {counts} "
            "splats instead."
        )
        rule = require_rule(nested)
    elif any(name in bundle.tables for name in rule.tables):
        notes.append("Fixed sets of splats per chunk are replaced by levels by distance.")
    if rule.cumulative:
        notes.append("Each level is written with the coarser ones, to which it adds.")
    notes.append(f"Distances of levels are for a focal length of {focal:,.0f} pixels.")
    levels, distances = _with_splats(_complete(nested), level_distances(rule, nested, focal))
    nested = replace(nested, tables={})
    if rule.cumulative:
        levels = [
            replace(level, facts={DISTANCE: distance})
            for level, distance in zip(levels, distances, strict=True)
        ]
        nested = replace(nested, rule=DISTANCE_RULE, facts={}, controls={}, cumulative=False)
    nested = replace(nested, levels=levels)
    return PortableLevels(nested, distances, focal, rule.fade_factor, views, origin), notes


def _with_splats(levels: list[Level], distances: Sequence[float]) -> tuple[list[Level], tuple[float, ...]]:
    """Return the levels that have splats and are used at some distance, and their distances.

    Raises:
        LodgsError: no level has splats.
    """
    used = np.isfinite(distances) if distances else np.ones(len(levels), bool)
    remaining = [index for index, level in enumerate(levels) if len(level.rows) and used[index]]
    if not remaining:
        raise LodgsError("Cannot export levels: they contain no splats.", "Make some splats visible.")
    limits = [distances[index] for index in remaining[:-1]] + [0.0] if distances else []
    return [levels[index] for index in remaining], tuple(limits)


def level_distances(rule: Rule, bundle: Bundle, focal_px: float) -> list[float]:
    """Return the camera distance from which on each level replaces the finer ones.

    All levels are in use. If the rule has columns, distances are those of their medians.

    Returns:
        Distances from coarse to fine, descending; the last is 0.
    """
    numbers = [level.number for level in bundle.levels]
    follow = {"coarsest": numbers[0], "finest": numbers[-1]}
    values = dict(rule.resolve_controls({}, numbers, bundle.controls)) | dict(rule.plain_values)
    values |= {control.name: follow[control.follows] for control in rule.controls if control.follows}
    facts = [(level.number, level.facts) for level in bundle.levels]
    ends = []
    for level in bundle.levels:
        level_facts = collect_facts(rule, bundle.facts, facts, level.number)
        near, far = rule.distance_band(focal_px, level_facts, values, _medians(rule, level.rows))
        ends.append((float(near), float(np.max(far))))
    if rule.cumulative:  # a level is complete where the next finer one has faded out
        ends = [*((far, 0.0) for _, far in ends[1:]), (0.0, 0.0)]
    limited = np.minimum.accumulate([near for near, _ in ends])
    return limited.tolist()


def _medians(rule: Rule, rows: SplatRows) -> dict[str, np.ndarray]:
    """Return the median (1,) of each of the rule's columns that the splats have."""
    extras = rows.select(np.arange(0, len(rows), max(1, len(rows) // _SAMPLE))).extras
    zero = np.zeros(1, np.float32)
    return {
        name: np.median(extras[name], keepdims=True) if name in extras and len(rows) else zero
        for name in rule.columns
    }


def _complete(bundle: Bundle) -> list[Level]:
    """Return the levels that are complete scenes, each with the coarser ones if levels add up."""
    levels = standalone_levels(bundle)
    if not bundle.cumulative:
        return levels
    return [
        Level(
            level.number,
            NO_SPLATS,
            level.facts,
            ConcatenatedRows([part.rows for part in bundle.drawn_levels(level.number)]),
        )
        for level in levels
    ]


def _views(bundle: Bundle) -> list[PortableView]:
    """Return the views of a bundle."""
    cameras, near, _ = read_view_tables(bundle.tables)
    return [
        PortableView(
            printable(camera.name), camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
            np.linalg.inv(camera.world_to_camera), near,
        )
        for camera in cameras
    ]  # fmt: skip
