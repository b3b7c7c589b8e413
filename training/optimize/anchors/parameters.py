"""Parameters of methods with anchors in an octree. Does not import torch."""

from dataclasses import dataclass

from ...errors import LodgsError
from ...settings import setting
from ...splats.levels import MAX_LEVELS
from ..merged_parameters import MergedParameters, refining_steps
from ..parameters import FarViewParameters


@dataclass(frozen=True)
class OctreeParameters(FarViewParameters):
    """Parameters of Octree-GS, shared by explicit and neural anchors."""

    max_splats: int = setting(
        90_000,
        "Maximum number of splats of all levels of the octree together, which are the finest level if "
        "coarser levels are merged from it. 0 is unlimited.",
    )
    grad_threshold: float = setting(
        5e-5, "Mean image-plane gradient (3DGS units) above which anchors grow, at one megapixel."
    )
    levels: int = setting(
        0,
        "Number of levels (Octree-GS: K). 0 derives it from the range of distances (Eq. 3).",
        high=MAX_LEVELS,
    )
    nearest: float = setting(
        0.05,
        "Quantile of the distances between views and points used as the smallest distance (Octree-GS: "
        "d_min).",
        high=1,
    )
    farthest: float = setting(
        0.95,
        "Quantile used as the largest distance (Octree-GS: d_max), beyond which only level 1 is drawn.",
        high=1,
    )
    coarser_levels: int = setting(
        3, "Additional coarse levels before those of Eq. 3, for views from farther away than any photo."
    )
    footprint: float = setting(
        1.0,
        "Voxel size in pixels, at the distance where the voxel's level appears; of a single level, at the "
        "smallest distance.",
        above=0,
        unit="px",
    )
    narrowest: float = setting(
        0.8,
        "Minimum standard deviation of a splat along its longest axis, in pixels at the distance "
        "where its level appears. Narrower splats move to a finer level, up to the first one after "
        "'coarser_levels'.",
        unit="px",
    )
    widest: float = setting(
        26.0,
        "Maximum standard deviation of a splat along its longest axis, in the same pixels. Wider "
        "splats move to a coarser level.",
        above=0,
        unit="px",
    )
    visible_share: float = setting(
        0.0,
        "Minimum fraction of the views that need an anchor; others are dropped. Anchors that no view "
        "needs are always dropped.",
        high=1,
    )
    coarse_share: float = setting(
        0.25,
        "Fraction of the steps in which levels join one by one. Anchors grow into the next level only "
        "afterwards.",
        high=1,
    )
    joins: str = setting(
        "early",
        "Schedule of the levels. Early: half of them start at once, and the last one joins before "
        "'coarse_share' ends. Published: one more level starts at once, and the last one joins at its end.",
        choices=("early", "published"),
    )
    init_level: int = setting(
        -1,
        "Finest level to train from the start, counted from 0, the coarsest (Octree-GS: initial level). -1 "
        "derives it from the number of levels.",
        low=-1,
        high=MAX_LEVELS - 1,
    )
    coarse_factor: float = setting(
        1.5,
        "Ratio of the steps before a level joins to those before the next one joins (Octree-GS: 1/omega).",
        above=0,
    )
    grow_interval: int = setting(50, "Steps between two growth passes.", above=0, unit="steps")
    stats_from: int = setting(
        0, "Steps before gradients count for growth (Octree-GS: start_stat).", unit="steps"
    )
    grow_from: int = setting(0, "Steps before the first growth pass (Octree-GS: update_from).", unit="steps")
    grow_next: bool = setting(
        True,
        "Let anchors with large gradients grow into the next level, once all levels have joined "
        "(Octree-GS: next level growing).",
    )
    room_exponent: float = setting(
        2.0,
        "The maximum number of anchors rises to 'max_splats' with this power of the steps, which reserves "
        "room for finer levels. 0 starts with 'max_splats'. Not in the paper.",
        high=8,
    )
    grow_until: float = setting(
        0.55,
        "Fraction of the steps in which anchors are added and removed; after it they are only removed "
        "at the end.",
        high=1,
    )
    least_weight: float = setting(
        0.02,
        "Minimum blending weight of a splat in any training view; splats below it are removed when "
        "growth ends and at the end. 0 keeps all. Not in the paper; from RadSplat.",
        high=1,
    )
    candidates: int = setting(
        2, "New positions that each splat with a large gradient proposes in a growth pass.", above=0
    )
    grow_harder: float = setting(
        0.2,
        "Exponent of the gradient threshold: it grows by 2 to this power from level to level, after "
        "'coarser_levels' (Octree-GS: beta).",
    )
    bias_rate: float = setting(
        0.0025,
        "Increase of a splat's level bias in each growth pass where its gradient is at least a "
        "quarter of the threshold.",
    )
    full_share: float = setting(
        0.4,
        "Fraction of the steps on full-size images that draw all levels at every distance, like a view at "
        "full detail.",
        high=1,
    )
    lr_end: float = setting(
        0.1,
        "Final learning rates, as a fraction of the initial ones; they fall once growth ends. 1 keeps "
        "them constant, as in the paper. Positions have their own schedule.",
        high=1,
    )
    volume_weight: float = setting(
        0.0, "Loss weight of the mean splat volume, with lengths in median depths."
    )

    def check(self) -> None:
        if self.nearest >= self.farthest:
            raise LodgsError(
                f"'nearest' is {self.nearest}, but must be less than 'farthest', {self.farthest}.",
                "Give a smaller number.",
            )


@dataclass(frozen=True)
class ExplicitOctreeParameters(MergedParameters, OctreeParameters):
    """Parameters of Octree-GS with explicit anchors. ``steps`` train the anchors of all levels."""

    levels_from: str = setting(
        "merged",
        "Source of the levels. 'merged' takes the anchors of all levels as the finest level, then merges "
        "each coarser level from the next finer one and refines it; levels replace one another. 'anchors' "
        "keeps the levels of the octree, which add up, as in the paper, and is always used in cells.",
        choices=("merged", "anchors"),
    )
    merged_levels: int = setting(
        4, "Number of levels that are merged from the finest.", low=1, high=MAX_LEVELS - 1
    )

    @property
    def merges(self) -> bool:
        return self.levels_from == "merged"

    @property
    def stages(self) -> list[tuple[int, int]]:
        """Levels in the order of their training, with their numbers of steps; one without merged levels."""
        if not self.merges:
            return [(1, self.steps)]
        refining = refining_steps(self.refine_steps, self.merged_levels)
        coarser = zip(range(self.merged_levels, 0, -1), refining, strict=True)
        return [(self.merged_levels + 1, self.steps), *coarser]

    @property
    def total_steps(self) -> int:
        return sum(steps for _, steps in self.stages)
