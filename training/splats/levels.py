"""Levels of detail of one scene in memory.

Constraints that a method applies outside the parameters (FLoD's s_min, the filters of Mip-Splatting and
LODGE) are baked into the scales and opacities here. ``log_scales`` are final; facts about such constraints
only record their origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import LodgsError
from .batches import batch_slices
from .gaussians import SplatRows, Splats
from .georeference import Georeference
from .origin import NO_ORIGIN
from .ply import Columns

MAX_LEVELS = 12
"""Maximum number of levels of a job or a scene; a header has no room for many more."""
MAX_READ_LEVELS = 64
"""Maximum number of levels in a file that is read."""
META_SHAPES = {"camera_center": (3,), "up_rotation": (3, 3), "view": (2, 3), "origin": (3,)}
"""Required shapes of entries of meta, whose numbers must not exceed MAX_COORDINATE."""
META_LENGTHS = ("scene_extent", "median_depth", "voxel", "distances")
"""Keys of meta, at any depth, whose values are lengths in scene units."""

NO_SPLATS = Splats(
    np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32),
    np.zeros(0, np.float32), np.zeros((0, 1, 3), np.float32),
)  # fmt: skip


@dataclass
class Level:
    """One level of detail.

    Attributes:
        number: 1 is the coarsest.
        splats: the level's splats with final scales and opacities.
        facts: numbers about this level that its rule needs, by name, such as FLoD's ``s_min``.
        on_disk: source that replaces ``splats`` if the level is not in memory but read in batches, or None.
    """

    number: int
    splats: Splats
    facts: dict[str, float] = field(default_factory=dict)
    on_disk: SplatRows | None = None

    @property
    def rows(self) -> SplatRows:
        """Splats in memory or on disk."""
        return self.splats if self.on_disk is None else self.on_disk

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return self.rows.select(slice(0, 0)).sh_degree


@dataclass
class Bundle:
    """Levels of detail of one scene.

    Attributes:
        method: name of the training method ("flod", "3dgs", ...); "" if unknown.
        levels: levels in ascending number, all of one SH degree.
        rule: name of the rule that selects levels by distance (``training.lod.rule``); "" for none.
        facts: numbers about the scene that the rule needs, by name.
        controls: initial values of the rule's controls, by name.
        cumulative: False if each level is complete; True if each level only holds its additions to the
            coarser ones, so that levels 1 to n are drawn together as level n.
        meta: further information, of JSON types (numpy scalars and arrays are converted).
        tables: further tables by name, of columns (rows,) of PLY types by name.
    """

    method: str
    levels: list[Level]
    rule: str = ""
    facts: dict[str, float] = field(default_factory=dict)
    controls: dict[str, float] = field(default_factory=dict)
    cumulative: bool = False
    meta: dict = field(default_factory=dict)
    tables: dict[str, Columns] = field(default_factory=dict)

    @property
    def antialias(self) -> bool:
        """True if the splats were trained, and are drawn, with Mip-Splatting's 2D filter."""
        return bool(self.meta.get("antialias"))

    @property
    def up_rotation(self) -> np.ndarray:
        """Rotation to a scene with z up, (3, 3) float64, from ``meta``; by default from -y up, as in most
        files."""
        return np.array(self.meta.get("up_rotation", ((1, 0, 0), (0, 0, 1), (0, -1, 0))), np.float64)

    @property
    def origin(self) -> np.ndarray:
        """Local origin (``origin.py``): the original place of the splats' (0, 0, 0), (3,) float64."""
        return np.array(self.meta.get("origin", NO_ORIGIN), np.float64)

    @property
    def georeference(self) -> Georeference | None:
        """Place of the splats' coordinates, relative to the local origin, on Earth; None if unknown."""
        values = self.meta.get("georeference")
        if values is None:
            return None
        shift = np.eye(4)
        shift[:3, 3] = self.origin
        return Georeference.from_json(values).after(shift)

    @property
    def on_disk(self) -> bool:
        """True if the splats of a level are not in memory."""
        return any(level.on_disk is not None for level in self.levels)

    def drawn_levels(self, number: int) -> list[Level]:
        """Return the levels that are drawn as level ``number``: with coarser ones if levels are
        cumulative."""
        return [
            level
            for level in self.levels
            if level.number == number or (self.cumulative and level.number < number)
        ]

    def check(self) -> None:
        """Check the levels before they are written.

        Raises:
            ValueError: the bundle has no levels, or their numbers do not ascend.
            LodgsError: the levels have different SH degrees.
        """
        numbers = [level.number for level in self.levels]
        if not numbers or numbers != sorted(set(numbers)):
            raise ValueError(f"a bundle needs levels in ascending number, not {numbers}")
        degrees = {level.sh_degree for level in self.levels}
        if len(degrees) > 1:
            raise LodgsError(
                f"Cannot write levels whose spherical harmonics have different degrees {sorted(degrees)}.",
                "Give all levels one degree, or export each level as a plain PLY.",
            )


def bounding_box(sets: Sequence[SplatRows]) -> list[list[float]]:
    """Return the smallest and largest x, y, z of the finite means of all sets; zeros if there are none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in sets:
        for batch in batch_slices(len(rows)):
            means = rows.select(batch).means
            means = means[np.isfinite(means).all(axis=1)]
            low = np.minimum(low, means.min(axis=0, initial=np.inf))
            high = np.maximum(high, means.max(axis=0, initial=-np.inf))
    return [low.tolist(), high.tolist()] if (low <= high).all() else [[0.0] * 3] * 2
