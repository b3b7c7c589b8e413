"""Matryoshka's rule (arXiv 2603.19234): the first splats of an ordered set, fewer at larger distances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...splats.gaussians import Splats
from ...splats.levels import MAX_LEVELS, Bundle, Level
from ...splats.ply import Columns
from ..rule import (
    MIN_SPLATS,
    NO_TABLES,
    THINNING,
    Control,
    Masks,
    Relations,
    Rule,
    Values,
    collect_facts,
    distances,
)

RANK = "prefix_rank"
"""Column of each splat's position in the order of all levels, from 0 on."""
VIEW_DISTANCE = "view_distance"
"""Column of each splat's mean distance in the training views that contain it."""


class PrefixRelations(Relations):
    """The order of the splats. Removals close its gaps, so that budgets stay exact."""

    columns = (RANK,)

    def __init__(self, columns: Mapping[int, Columns]) -> None:
        self._ranks = {number: level[RANK] for number, level in columns.items()}

    def pruned(self, masks: Masks) -> tuple[Masks, Mapping[int, Columns]]:
        ranks = {number: self._ranks[number][mask] for number, mask in masks.items()}
        order = np.argsort(np.concatenate([np.zeros(0), *ranks.values()]), kind="stable")
        renumbered = np.empty(len(order), np.float32)
        renumbered[order] = np.arange(len(order))
        ends = np.cumsum([len(level) for level in ranks.values()])[:-1]
        parts = np.split(renumbered, ends)
        return masks, {number: {RANK: part} for number, part in zip(ranks, parts, strict=True)}


class Prefix(Rule):
    """Weight 1 for the first n splats of the order, else 0.

    n is ``at_most`` or, if smaller, the number that a splat's distance d needs: the fraction ``share`` of all
    at the splat's mean distance in the training views (VIEW_DISTANCE), and proportional to 1 / d², as the
    area on screen. Distances are multiplied by ``distance_scale`` and divided by the focal length in units
    of ``share_focal``. The dependence on distance is not in the paper. Ranks are float32, so that budgets
    are exact up to 2^24 splats.
    """

    name = "prefix"
    cumulative = True
    scene_facts = ("share", "share_focal", "splats")
    lengths = (VIEW_DISTANCE,)
    columns = (RANK, VIEW_DISTANCE)
    relations = PrefixRelations
    controls = (
        Control(
            "distance_scale", 1.0, 0.01, 100.0, "Distance Scale",
            "Factor on distances: larger is coarser",
            soft=(0.1, 10.0),
        ),
        Control(
            "at_most", 0, 0, 2**30, "Splat Limit",
            "Maximum number of splats. 0 disables",
            integer=True, step=1000,
        ),
    )  # fmt: skip
    sweep = ("distance_scale", (0.5, 1.0, 1.5, 2.0, 3.0))

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        limit = self._limit(means, position, focal_px, columns, facts, values)
        if values["at_most"]:
            np.minimum(limit, np.float32(values["at_most"]), out=limit)
        return (columns[RANK] < limit).astype(np.float32)

    def _limit(self, means, position, focal_px, columns, facts, values) -> np.ndarray:
        """Return the number of splats (N,) that the distance of each splat needs."""
        scale = focal_px / max(facts["share_focal"], 1e-20) / values["distance_scale"]
        nearness = columns[VIEW_DISTANCE] * np.float32(facts["share"] ** 0.5 * scale)
        nearness /= np.maximum(distances(means, position), np.float32(1e-20))
        return np.float32(facts["splats"]) * np.minimum(nearness, np.float32(1)) ** 2

    def nested_levels(self, bundle: Bundle) -> Bundle:
        """Return the splats with the longest reach as levels of the rule ``bands``.

        Each coarser level has 1 / THINNING of the finer one's splats, down to MIN_SPLATS. It is used from the
        distance from which on the rule selects no other splats.
        """
        values = self.resolve_controls({}, [level.number for level in bundle.levels], bundle.controls)
        facts = collect_facts(self, bundle.facts, [(1, {})], 1)
        rows = [level.rows for level in bundle.levels]
        splats = Splats.concatenated([level.select(slice(0, len(level))) for level in rows])
        zeros = np.zeros(len(splats))
        rank, distance = (splats.extras.pop(name, zeros).astype(np.float64) for name in self.columns)
        if values["at_most"]:
            first = rank < values["at_most"]
            splats, rank, distance = splats.select(first), rank[first], distance[first]
        # rank = splats · nearness², solved for the distance per pixel of focal length
        scale = facts["share"] ** 0.5 / max(facts["share_focal"], 1e-20) / values["distance_scale"]
        reach = distance * scale * np.sqrt(facts["splats"] / np.maximum(rank, 0.5))
        order = np.argsort(-reach, kind="stable")
        levels, count = [(splats, 0.0)], len(splats) // THINNING
        while count >= MIN_SPLATS and len(levels) < MAX_LEVELS:
            part = splats.select(np.sort(order[:count]))
            levels.append((part, max(float(reach[order[count]]), levels[-1][1])))
            count //= THINNING
        return replace(
            bundle,
            levels=[
                Level(number, part, {"s_min": size}) for number, (part, size) in enumerate(levels[::-1], 1)
            ],
            rule="bands", facts={}, controls={"gamma": 1.0, "first": 1}, cumulative=False,
        )  # fmt: skip

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        return self.raise_control(values, "distance_scale")


RULE = Prefix()
