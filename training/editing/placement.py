"""Transforms of bundles by similarities: splats, facts, tables and metadata. numpy only."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..lod.blocks import BLOCKS, block_table
from ..lod.rule import find_rule
from ..lod.selection import unknown_rule_error
from ..scenes import view_tables
from ..scenes.ground import find_ground, ground_placement
from ..splats.batches import read_batches
from ..splats.dialects import MAX_COORDINATE
from ..splats.gaussians import SplatRows, Splats
from ..splats.georeference import Georeference
from ..splats.levels import META_LENGTHS, NO_SPLATS, Bundle, Level
from ..splats.portable_levels import ConcatenatedRows
from ..splats.similarity import Similarity, TransformedRows
from .cleaning import read_relations
from .clutter import near_cameras


def transform_bundle(bundle: Bundle, placement: Similarity) -> Bundle:
    """Return a bundle with splats and all positions and lengths transformed.

    Levels on disk stay there until they are written. Columns of related splats (``lod.rule.Relations``) are
    loaded into memory.

    Raises:
        LodgsError: unknown rule, whose lengths are unknown, or positions that no reader accepts.
    """
    rule = find_rule(bundle.rule)
    if rule is None and bundle.rule:
        raise LodgsError(
            unknown_rule_error(bundle.rule)[0], "Update LODGS, or export one level as a plain PLY."
        )
    lengths, places = (rule.lengths, rule.places) if rule else ((), ())

    def transform(splats: Splats) -> Splats:
        with np.errstate(over="ignore"):
            transformed = placement.transform_splats(splats, lengths, places)
        if (np.abs(transformed.means) > MAX_COORDINATE).any():
            raise LodgsError(
                f"Cannot transform splats: positions would exceed {MAX_COORDINATE:g}.",
                "Use a smaller scale or translation, or crop distant splats.",
            )
        return transformed

    def scale(facts: dict[str, float]) -> dict[str, float]:
        return {n: value * placement.scale if n in lengths else value for n, value in facts.items()}

    new_columns = read_relations(bundle).transformed(placement)
    levels = []
    for level in bundle.levels:
        columns = new_columns.get(level.number, {})
        if level.on_disk is None:
            splats = transform(level.splats)
            splats.extras |= columns
            levels.append(Level(level.number, splats, scale(level.facts)))
        else:
            rows = TransformedRows(level.on_disk, transform, columns)
            levels.append(Level(level.number, NO_SPLATS, scale(level.facts), rows))
    tables = dict(bundle.tables)
    for name in rule.tables if rule else ():
        if name in tables:
            tables[name] = placement.transform_columns(tables[name], lengths, places)
    if view_tables.VIEWS in tables:
        tables[view_tables.VIEWS] = view_tables.transform_views(tables[view_tables.VIEWS], placement)
    if rule and new_columns and BLOCKS in tables:
        tables[BLOCKS] = block_table(rule.block_bounds, new_columns.items())
    meta = _transform_meta(bundle.meta, placement, bundle.georeference)
    return replace(bundle, levels=levels, facts=scale(bundle.facts), tables=tables, meta=meta)


def upright_placement(
    bundle: Bundle, upright: bool = False, ground: bool = False, points: np.ndarray | None = None
) -> Similarity:
    """Return the transform that aligns a bundle's scene with z up or with its ground.

    Args:
        upright: turn the scene so that its up axis is z.
        ground: turn the scene upright and move its ground to z = 0.
        points: (P, 3) for ground detection; None means the means of the finest level's opaque splats.

    Raises:
        LodgsError: no ground detected.
    """
    left, _, right = np.linalg.svd(bundle.up_rotation)  # makes the rounded matrix orthogonal
    rotation = Similarity(left @ right if upright or ground else np.eye(3), 1.0, np.zeros(3))
    if not ground:
        return rotation
    if points is None:
        points = _opaque_means(ConcatenatedRows.of_level(bundle, bundle.levels[-1].number))
    near = near_cameras(points, bundle)
    try:
        plane = find_ground(rotation.transform_points(near), np.array([0.0, 0.0, 1.0]))
    except LodgsError as error:
        raise LodgsError(
            error.what, "Add the photos' folder with --scene, or use --rotate and --translate instead."
        ) from error
    return ground_placement(*plane).compose(rotation)


def _opaque_means(rows: SplatRows) -> np.ndarray:
    """Return the means (P, 3) float32 of splats with an opacity above 1/2."""
    return np.concatenate([splats.means[splats.opacity_logits > 0] for splats in read_batches(rows)])


def _transform_meta(meta: dict, placement: Similarity, place: Georeference | None) -> dict:
    """Return a bundle's metadata with transformed positions, directions and lengths.

    The result has other coordinates than the original scene, so it has no local origin. Its georeference
    leads from the new coordinates to the same place.
    """
    transformed = dict(meta) if placement.scale == 1 else _scale_lengths(meta, placement.scale)
    transformed.pop("origin", None)
    if place is not None:
        transformed["georeference"] = place.after(np.linalg.inv(placement.matrix)).to_json()
    for name in ("camera_center", "view"):
        if name in meta:
            points = placement.transform_points(np.asarray(meta[name], np.float64).reshape(-1, 3))
            transformed[name] = points.reshape(np.shape(meta[name])).tolist()
    if "up_rotation" in meta:
        rotation = np.asarray(meta["up_rotation"]) @ placement.rotation.T
        transformed["up_rotation"] = rotation.round(9).tolist()
    return transformed


def _scale_lengths(value: Any, scale: float, is_length: bool = False) -> Any:
    """Return a JSON value with scaled lengths, rounded to six digits to keep headers small."""
    match value:
        case dict():
            return {name: _scale_lengths(item, scale, name in META_LENGTHS) for name, item in value.items()}
        case list():
            return [_scale_lengths(item, scale, is_length) for item in value]
        case int() | float() if is_length:
            return float(f"{value * scale:.6g}")
    return value
