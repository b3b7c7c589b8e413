"""LODGE's rule (2025, Sec. 3): levels by distance, from the eye or as sets that are fixed for each chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from ...splats.dialects import MAX_COORDINATE
from ..rule import NO_COLUMNS, NO_FINER, NO_TABLES, Control, Region, Rule, Tables, Values, distances

COLUMNS = ("x", "y", "z", "radius")
"""Of the table of chunks."""
BITS, MAX_CHUNKS = 24, 96
"""Chunks that one column tells of, as single precision holds so many bits; and chunks of a scene."""
MEMBER_COLUMNS = tuple(f"chunks_{number}" for number in range(MAX_CHUNKS // BITS))
"""Columns of splats: bit c % BITS of column c // BITS is set where chunk c has the splat in its set."""
TABLE = "chunks"
"""The table of chunks, one a row: centres x, y, z, and radius, in scene units."""
_BLOCK = 1 << 14
"""Places that are compared with all centres at a time."""
FADE_SHARE = 0.25
"""Beyond its radius a chunk's set counts less and less, until nothing after this share of the radius."""


class Chunks(Rule):
    """Level l is drawn where d_l <= d < d_(l of the next coarser level) (Eq. 2).

    The finest level that there is begins at 0, the coarsest has no end. Where the scene has chunks, and they
    are in use, d is not the eye's but that of the two chunks whose centres are nearest to it: each has a set
    of splats (``MEMBER_COLUMNS``), and they fade into each other (Eq. 4). Farther from a chunk than its radius its
    set, made for eyes within, gives way to what the eye's own distances choose; the paper has no such places.
    """

    name = "chunks"
    level_facts = ("d_l",)
    columns = MEMBER_COLUMNS
    tables = (TABLE,)
    lengths = ("d_l", "radius")
    places = (("x", "y", "z"),)
    controls = (
        Control(
            "distance_scale", 1.0, 0.01, 100.0, "Distance Scale",
            "As if everything were so many times farther away. Smaller is finer. Sets of chunks are fixed",
            soft=(0.1, 10.0),
        ),
        Control(
            "chunks", 1, 0, 1, "Chunks",
            "Show the fixed sets of the two nearest chunks; without it (0) distances are measured from the "
            "eye",
            whole=True,
        ),
        Control(
            "fade", 1, 0, 1, "Fade",
            "Neighbouring chunks fade into each other; without it (0) the nearest one's set is there at once",
            whole=True,
        ),
    )  # fmt: skip

    def distance_band(
        self, focal_px: float, facts: Mapping[str, float], values: Values, highest=NO_COLUMNS
    ) -> tuple[float, float]:
        """Near and far end of a level's distances from the eye, in scene units; any, where chunks count."""
        if values["chunks"]:
            return 0.0, inf
        near, far = _ends(facts)
        return near / values["distance_scale"], far / values["distance_scale"]

    def weights(self, means, eye, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        near_chunks = self.near_chunks(eye, values, tables)
        inside = sum(share for _, share in near_chunks)
        weights = np.zeros(len(means), np.float32)
        for chunk, share in near_chunks:
            weights += np.float32(share) * in_chunk(columns, chunk)
        if inside < 1:
            near, far = _ends(facts)
            away = distances(means, eye) * np.float32(values["distance_scale"])
            seen = (away >= np.float32(near)) & (away < np.float32(far))
            weights += np.float32(1 - inside) * seen
        return np.minimum(weights, 1, out=weights)

    def check(self, tables: Tables) -> None:
        table = tables.get(TABLE, {})
        if missing := [name for name in COLUMNS if table and name not in table]:
            raise ValueError(f"its table '{TABLE}' has no {', '.join(missing)}")
        if _rows(tables) > MAX_CHUNKS:
            raise ValueError(f"there are {_rows(tables):,} chunks, of at most {MAX_CHUNKS}")
        if not all((np.abs(table[name]) <= MAX_COORDINATE).all() for name in COLUMNS if table):
            raise ValueError("a chunk is nowhere")

    def region(self, eye, values: Values, tables: Tables) -> Region | None:
        near_chunks = self.near_chunks(eye, values, tables)
        if sum(share for _, share in near_chunks) < 1:
            return None
        return tuple(sorted(chunk for chunk, _ in near_chunks))

    def visible_in_region(self, columns, region: Region) -> np.ndarray:
        found = in_chunk(columns, region[0])
        for chunk in region[1:]:
            found |= in_chunk(columns, chunk)
        return found

    def region_label(self, eye, values: Values, tables: Tables) -> str:
        if not values["chunks"] or not _rows(tables):
            return ""
        near_chunks = self.near_chunks(eye, values, tables)
        inside = sum(share for _, share in near_chunks)
        if not inside:
            return "Outside the chunks"
        said = " and ".join(str(number) for number, _ in near_chunks)
        if len(near_chunks) > 1:
            said += f", {100 * near_chunks[1][1] / inside:.0f} %"
        if inside < 1:
            said += f", {100 * (1 - inside):.0f} % outside"
        return f"Chunk{'s'[: len(near_chunks) > 1]} {said}"

    def inactive_controls(self, eye, values: Values, tables: Tables) -> Mapping[str, str]:
        if not _rows(tables):
            return dict.fromkeys(("chunks", "fade"), "These splats have no chunks.")
        if not values["chunks"]:
            return {"fade": "Only chunks fade into each other."}
        if self.region(eye, values, tables) is None:
            return {}
        return {"distance_scale": "The sets of chunks are fixed: a distance scale counts outside of them."}

    def parts(self, means, tables: Tables) -> np.ndarray:
        if not _rows(tables):
            return super().parts(means, tables)
        centres = np.stack([tables[TABLE][axis] for axis in "xyz"]).astype(np.float32)
        squares = (centres * centres).sum(axis=0)
        found = np.empty(len(means), np.float32)
        for start in range(0, len(means), _BLOCK):
            block = means[start : start + _BLOCK]
            found[start : start + _BLOCK] = (squares - 2 * block @ centres).argmin(axis=1) + 1
        return found

    def near_chunks(self, eye, values: Values, tables: Tables) -> list[tuple[int, float]]:
        """The nearest chunk A and, where sets fade, the next one B, each as its number and its share.

        B is the one with the largest t = (eye - A)·(B - A) / |B - A|² (Eq. 4), which is 0 at A and 1/2 where
        B becomes the nearest. Its share is t, as in the paper, as long as the next chunk's t' is at most half
        of it. Nearer to where that one takes B's place, which would be a jump, the share falls to 0: it is
        (t - s) / (1 - 2 s) with s = 2 t' - t.

        Shares sum up to 1 within the radius of one of the two, to 0 far from both; none without chunks.
        """
        if not values["chunks"] or not _rows(tables):
            return []
        table = tables[TABLE]
        centres = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
        eye, radii = np.asarray(eye, np.float64), np.asarray(table["radius"], np.float64)
        away = np.linalg.norm(centres - eye, axis=1)
        first = int(away.argmin())
        along = centres - centres[first]
        t = along @ (eye - centres[first]) / np.maximum(np.square(along).sum(axis=1), 1e-40)
        second, *third = np.argsort(-t, kind="stable")[:2] if len(t) > 2 else [int(t.argmax())]
        near, share = [first], 0.0
        if values["fade"] and t[second] > 0:
            s = max(2 * float(t[third[0]]) - float(t[second]), 0.0) if third else 0.0
            near.append(int(second))
            share = (float(t[second]) - s) / max(1 - 2 * s, 1e-20)
        left = (away[near] / np.maximum(radii[near], 1e-20) - 1) / FADE_SHARE
        inside = float(np.clip(1 - left, 0, 1).max()) if values["fade"] else float(left.min() <= 0)
        shares = [inside * (1 - share), inside * share]
        return [each for each in zip(near, shares, strict=False) if inside]

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        if values["chunks"]:
            return {**values, "chunks": 0}
        return self.raise_control(values, "distance_scale")


def _rows(tables: Tables) -> int:
    """How many chunks there are."""
    return len(tables.get(TABLE, {}).get("x", ()))


def _ends(facts: Mapping[str, float]) -> tuple[float, float]:
    """The distance from which on a level is shown, and that from which on it is not, before any scale."""
    near = 0.0 if facts["finer"] == NO_FINER else facts["d_l"]
    return near, facts["coarser_d_l"] if facts["coarser"] else inf


def in_chunk(columns: Mapping[str, np.ndarray], chunk: int) -> np.ndarray:
    """(N,) bool, which splats are in the set of a chunk."""
    found = columns[MEMBER_COLUMNS[chunk // BITS]].astype(np.int32)
    found &= 1 << (chunk % BITS)
    return found != 0


def member_columns(sets: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of sets, (N,) float32 each, as many as needed.

    Args:
        sets: (chunks, N) bool.
    """
    columns = {}
    for name, first in zip(MEMBER_COLUMNS, range(0, len(sets), BITS), strict=False):
        bits = np.zeros(sets.shape[1], np.int32)
        for bit, one in enumerate(sets[first : first + BITS]):
            bits |= one.astype(np.int32) << bit
        columns[name] = bits.astype(np.float32)
    return columns


RULE = Chunks()
