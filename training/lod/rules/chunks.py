"""LODGE's rule (2025, Sec. 3): levels by distance from the camera, or fixed sets of splats per chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from ...splats.batches import batch_slices
from ...splats.dialects import MAX_COORDINATE
from ..rule import NO_COLUMNS, NO_FINER, NO_TABLES, Control, Region, Rule, Tables, Values, distances

COLUMNS = ("x", "y", "z", "radius")
"""Columns of the table of chunks."""
BITS, MAX_CHUNKS = 24, 96
"""Chunks per column (float32 holds 24 bits exactly), and maximum number of chunks in a scene."""
MEMBER_COLUMNS = tuple(f"chunks_{number}" for number in range(MAX_CHUNKS // BITS))
"""Columns of splats: bit c % BITS of column c // BITS is set if the splat is in the set of chunk c."""
TABLE = "chunks"
"""Table of chunks, one per row: centres x, y, z, and radius, in scene units."""
_BLOCK = 1 << 14
"""Positions compared with all centres at a time."""
FADE_SHARE = 0.25
"""Outside its radius, a chunk's set fades out over this fraction of the radius."""


class Chunks(Rule):
    """Level l is drawn where d_l <= d < d_(l of the next coarser level) (Eq. 2).

    The finest level begins at 0, the coarsest has no end. If the scene has chunks and they are enabled, d is
    measured from the two chunk centres nearest to the camera: each chunk has a fixed set of splats
    (``MEMBER_COLUMNS``), and the sets fade into each other (Eq. 4). Outside a chunk's radius, its set gives
    way to selection by the camera's own distances; the paper does not cover such positions.
    """

    name = "chunks"
    level_facts = ("d_l",)
    columns = MEMBER_COLUMNS
    block_bounds = {name: (name, np.bitwise_or) for name in MEMBER_COLUMNS}
    tables = (TABLE,)
    plain_values = {"chunks": 0}
    lengths = ("d_l", "radius")
    places = (("x", "y", "z"),)
    controls = (
        Control(
            "distance_scale", 1.0, 0.01, 100.0, "Distance Scale",
            "Factor on distances: larger is coarser. Does not affect the fixed sets of chunks",
            soft=(0.1, 10.0),
        ),
        Control(
            "chunks", 1, 0, 1, "Chunks",
            "Show the fixed sets of the two nearest chunks. If disabled, select levels by camera distance",
            integer=True,
        ),
        Control(
            "fade", 1, 0, 1, "Fade",
            "Fade between neighbouring chunks. If disabled, switch to the set of the nearest one",
            integer=True,
        ),
    )  # fmt: skip

    def distance_band(
        self, focal_px: float, facts: Mapping[str, float], values: Values, highest=NO_COLUMNS
    ) -> tuple[float, float]:
        """Return near and far end of a level's camera distances, in scene units; (0, inf) with chunks."""
        if values["chunks"]:
            return 0.0, inf
        near, far = _ends(facts)
        return near / values["distance_scale"], far / values["distance_scale"]

    def fills_band(self, values: Values) -> bool:
        """Return whether sets of chunks are disabled."""
        return not values["chunks"]

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        near_chunks = self.near_chunks(position, values, tables)
        inside = sum(share for _, share in near_chunks)
        weights = np.zeros(len(means), np.float32)
        for chunk, share in near_chunks:
            weights += np.float32(share) * in_chunk(columns, chunk)
        if inside < 1:
            near, far = _ends(facts)
            distance = distances(means, position) * np.float32(values["distance_scale"])
            in_band = (distance >= np.float32(near)) & (distance < np.float32(far))
            weights += np.float32(1 - inside) * in_band
        return np.minimum(weights, 1, out=weights)

    def check(self, tables: Tables) -> None:
        table = tables.get(TABLE, {})
        if missing := [name for name in COLUMNS if table and name not in table]:
            raise ValueError(f"its table '{TABLE}' has no {', '.join(missing)}")
        if _rows(tables) > MAX_CHUNKS:
            raise ValueError(f"it has {_rows(tables):,} chunks, more than {MAX_CHUNKS}")
        if not all((np.abs(table[name]) <= MAX_COORDINATE).all() for name in COLUMNS if table):
            raise ValueError("the position or radius of a chunk is out of range")

    def region(self, position, values: Values, tables: Tables) -> Region | None:
        near_chunks = self.near_chunks(position, values, tables)
        if sum(share for _, share in near_chunks) < 1:
            return None
        return tuple(sorted(chunk for chunk, _ in near_chunks))

    def visible_in_region(self, columns, region: Region) -> np.ndarray:
        visible = in_chunk(columns, region[0])
        for chunk in region[1:]:
            visible |= in_chunk(columns, chunk)
        return visible

    def region_label(self, position, values: Values, tables: Tables) -> str:
        if not values["chunks"] or not _rows(tables):
            return ""
        near_chunks = self.near_chunks(position, values, tables)
        inside = sum(share for _, share in near_chunks)
        if not inside:
            return "Outside the chunks"
        label = " and ".join(str(number) for number, _ in near_chunks)
        if len(near_chunks) > 1:
            label += f", {100 * near_chunks[1][1] / inside:.0f} %"
        if inside < 1:
            label += f", {100 * (1 - inside):.0f} % outside"
        return f"Chunk{'s'[: len(near_chunks) > 1]} {label}"

    def inactive_controls(self, position, values: Values, tables: Tables) -> Mapping[str, str]:
        if not _rows(tables):
            return dict.fromkeys(("chunks", "fade"), "These splats have no chunks.")
        if not values["chunks"]:
            return {"fade": "Only chunks fade."}
        if self.region(position, values, tables) is None:
            return {}
        return {"distance_scale": "The sets of chunks are fixed. The distance scale applies outside of them."}

    def part_numbers(self, means, tables: Tables) -> np.ndarray:
        if not _rows(tables):
            return super().part_numbers(means, tables)
        centers = np.stack([tables[TABLE][axis] for axis in "xyz"]).astype(np.float32)
        squares = (centers * centers).sum(axis=0)
        numbers = np.empty(len(means), np.float32)
        for block in batch_slices(len(means), _BLOCK):
            numbers[block] = (squares - 2 * means[block] @ centers).argmin(axis=1) + 1
        return numbers

    def near_chunks(self, position, values: Values, tables: Tables) -> list[tuple[int, float]]:
        """Return the nearest chunk A and, if sets fade, the next one B, each as its number and share.

        B has the largest t = (c - A)·(B - A) / |B - A|² (Eq. 4) for the camera position c; t is 0 at A and
        1/2 where B becomes the nearest. B's share is t, as in the paper, while the next chunk's t' is at most
        t / 2. Beyond that, the share is (t - s) / (1 - 2 s) with s = 2 t' - t, which falls to 0 where the
        next chunk replaces B and avoids a jump (not in the paper).

        Shares sum to 1 within the radius of A or B, and to 0 far from both. The list is empty without chunks.
        """
        if not values["chunks"] or not _rows(tables):
            return []
        table = tables[TABLE]
        centers = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
        radii = np.asarray(table["radius"], np.float64)
        position = np.asarray(position, np.float64)
        distance = np.linalg.norm(centers - position, axis=1)
        first = int(distance.argmin())
        along = centers - centers[first]
        t = along @ (position - centers[first]) / np.maximum(np.square(along).sum(axis=1), 1e-40)
        second, *third = np.argsort(-t, kind="stable")[:2] if len(t) > 2 else [int(t.argmax())]
        near, share = [first], 0.0
        if values["fade"] and t[second] > 0:
            s = max(2 * float(t[third[0]]) - float(t[second]), 0.0) if third else 0.0
            near.append(int(second))
            share = (float(t[second]) - s) / max(1 - 2 * s, 1e-20)
        outside = (distance[near] / np.maximum(radii[near], 1e-20) - 1) / FADE_SHARE
        inside = float(np.clip(1 - outside, 0, 1).max()) if values["fade"] else float(outside.min() <= 0)
        shares = [inside * (1 - share), inside * share]
        return list(zip(near, shares, strict=False)) if inside else []

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        if values["chunks"]:
            return {**values, "chunks": 0}
        return self.raise_control(values, "distance_scale")


def _rows(tables: Tables) -> int:
    """Return the number of chunks."""
    return len(tables.get(TABLE, {}).get("x", ()))


def _ends(facts: Mapping[str, float]) -> tuple[float, float]:
    """Return the distances where a level begins and ends, without any scale."""
    near = 0.0 if facts["finer"] == NO_FINER else facts["d_l"]
    return near, facts["coarser_d_l"] if facts["coarser"] else inf


def in_chunk(columns: Mapping[str, np.ndarray], chunk: int) -> np.ndarray:
    """Return a mask (N,) of the splats in the set of a chunk."""
    bits = columns[MEMBER_COLUMNS[chunk // BITS]].astype(np.int32)
    bits &= 1 << (chunk % BITS)
    return bits != 0


def member_columns(sets: np.ndarray) -> dict[str, np.ndarray]:
    """Return as many MEMBER_COLUMNS as the sets need, (N,) float32 each.

    Args:
        sets: (chunks, N) bool.
    """
    columns = {}
    for name, first in zip(MEMBER_COLUMNS, range(0, len(sets), BITS), strict=False):
        bits = np.zeros(sets.shape[1], np.int32)
        for bit, members in enumerate(sets[first : first + BITS]):
            bits |= members.astype(np.int32) << bit
        columns[name] = bits.astype(np.float32)
    return columns


RULE = Chunks()
