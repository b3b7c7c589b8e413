"""Levels of detail that stand elsewhere: they look the same there, and are chosen alike. numpy only."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..lod.partial_read import BLOCKS
from ..lod.rule import Rule, find_rule
from ..lod.selection import rule_columns, unknown_rule_error
from ..lod.tree.pages import BOUNDS, page_table
from ..scenes import view_tables
from ..scenes.ground import find_ground, ground_placement, points_near_cameras
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import META_LENGTHS, NO_SPLATS, Bundle, Level
from ..splats.ply import BATCH_ROWS, Columns
from ..splats.similarity import Similarity, TransformedRows


def transform_bundle(bundle: Bundle, placement: Similarity) -> Bundle:
    """A bundle whose splats, and all that it says of places and lengths, stand elsewhere.

    Levels that are in files stay there until they are written. Of a rule whose columns are ``linked_columns`` these
    are in memory, some 150 bytes a splat.

    Raises:
        LodgsError: this version does not know the rule, and so not what it says of lengths.
    """
    rule = find_rule(bundle.rule)
    if rule is None and bundle.rule:
        raise LodgsError(
            unknown_rule_error(bundle.rule)[0], "Update LODGS, or export one level as a plain PLY."
        )
    lengths, places = (rule.lengths, rule.places) if rule else ((), ())

    def of(splats: Splats) -> Splats:
        return placement.transform_splats(splats, lengths, places)

    def facts(known: dict[str, float]) -> dict[str, float]:
        return {n: value * placement.scale if n in lengths else value for n, value in known.items()}

    remade = _agreed(bundle, rule, placement) if rule and rule.linked_columns else [{} for _ in bundle.levels]
    levels = []
    for level, columns in zip(bundle.levels, remade, strict=True):
        if level.on_disk is None:
            splats = of(level.splats)
            splats.extras |= columns
            levels.append(Level(level.number, splats, facts(level.facts)))
        else:
            rows = TransformedRows(level.on_disk, of, columns)
            levels.append(Level(level.number, NO_SPLATS, facts(level.facts), rows))
    tables = dict(bundle.tables)
    for name in rule.tables if rule else ():
        if name in tables:
            tables[name] = placement.transform_columns(tables[name], lengths, places)
    if view_tables.VIEWS in tables:
        tables[view_tables.VIEWS] = view_tables.transform_views(tables[view_tables.VIEWS], placement)
    if BOUNDS[0] in tables.get(BLOCKS, {}):
        tables[BLOCKS] = page_table({x.number: c for x, c in zip(bundle.levels, remade, strict=True)})
    meta = _meta(bundle.meta, placement)
    return replace(bundle, levels=levels, facts=facts(bundle.facts), tables=tables, meta=meta)


def upright_placement(
    bundle: Bundle, upright: bool = False, ground: bool = False, points: np.ndarray | None = None
) -> Similarity:
    """What stands a bundle's scene upright, z up, and where it is asked for its ground on z = 0.

    Args:
        points: (P, 3) among which the ground is looked for; None: where the finest level's opaque splats are,
            which are read some at a time.

    Raises:
        LodgsError: no ground is found.
    """
    left, _, right = np.linalg.svd(bundle.up_rotation)  # of numbers that have been rounded
    stands = Similarity(left @ right if upright or ground else np.eye(3), 1.0, np.zeros(3))
    if not ground:
        return stands
    meta, places = bundle.meta, _opaque(bundle.levels[-1].rows) if points is None else points
    center, depth = meta.get("camera_center"), meta.get("median_depth", 0)
    if center is not None and isinstance(depth, int | float):
        places = points_near_cameras(places, np.asarray(center), depth)
    try:
        plane = find_ground(stands.transform_points(places), np.array([0.0, 0.0, 1.0]))
    except LodgsError as error:
        raise LodgsError(
            error.what, "Name its photographs' folder with --scene, or place it by --rotate and --translate."
        ) from error
    return ground_placement(*plane).compose(stands)


def _opaque(rows: SplatRows) -> np.ndarray:
    """(P, 3) float32, where splats are that are more opaque than not."""
    found = [np.zeros((0, 3), np.float32)]
    for begin in range(0, len(rows), BATCH_ROWS):
        some = rows.select(slice(begin, begin + BATCH_ROWS))
        found.append(some.means[some.opacity_logits > 0])
    return np.concatenate(found)


def _meta(meta: dict, placement: Similarity) -> dict:
    """What a bundle says of places, directions and lengths beside its splats."""
    found = dict(meta) if placement.scale == 1 else _scaled(meta, placement.scale)
    for name in ("camera_center", "view"):
        if name in meta:
            points = placement.transform_points(np.asarray(meta[name], np.float64).reshape(-1, 3))
            found[name] = points.reshape(np.shape(meta[name])).tolist()
    if "up_rotation" in meta:
        found["up_rotation"] = (np.asarray(meta["up_rotation"]) @ placement.rotation.T).round(9).tolist()
    return found


def _scaled(value: Any, scale: float, length: bool = False) -> Any:
    """What JSON holds, its lengths scaled, to six digits: headers have little room."""
    match value:
        case dict():
            return {name: _scaled(each, scale, name in META_LENGTHS) for name, each in value.items()}
        case list():
            return [_scaled(each, scale, length) for each in value]
        case int() | float() if length:
            return float(f"{value * scale:.6g}")
    return value


def _agreed(bundle: Bundle, rule: Rule, placement: Similarity) -> list[Columns]:
    """The rule's columns of each level where they stand then, as they agree with each other."""
    parts, ends = [], []
    for level in bundle.levels:
        for begin in range(0, max(len(level.rows), 1), BATCH_ROWS):
            splats = level.rows.select(slice(begin, begin + BATCH_ROWS))
            parts.append(rule_columns(rule, splats) | dict(zip("xyz", splats.means.T.copy(), strict=True)))
        ends.append(len(level.rows))
    before = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    after = placement.transform_columns(before, rule.lengths, (*rule.places, ("x", "y", "z")))
    after |= rule.reconcile(before, after)
    parts = [np.split(after[name], np.cumsum(ends)[:-1]) for name in rule.columns]
    return [dict(zip(rule.columns, columns, strict=True)) for columns in zip(*parts, strict=True)]
