"""Octree-GS (Ren et al. 2024) with explicit anchors: levels of an octree that add up, faded in one by one."""

from dataclasses import dataclass, replace

from ...errors import LodgsError
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import AS_PUBLISHED, STANDARD, Parameters, parameter
from ...splats.levels import MAX_LEVELS


@dataclass(frozen=True)
class OctreeParameters(Parameters):
    """Those of Octree-GS; explicit and neural anchors share them."""

    max_splats: int = parameter(
        90_000,
        "Most splats of all levels together, which add up; FLoD's five levels are over 110,000.",
        above=0,
    )
    grad_threshold: float = parameter(
        5e-5, "Mean image-plane gradient (3DGS units) above which anchors grow, at one megapixel."
    )
    levels: int = parameter(
        0,
        "Number of levels (Octree-GS: K); 0 takes it from the range of distances (Eq. 3).",
        high=MAX_LEVELS,
    )
    nearest: float = parameter(
        0.05,
        "Quantile of the distances from views to points that counts as the smallest (Octree-GS: d_min).",
        high=1,
    )
    farthest: float = parameter(
        0.95,
        "Quantile that counts as the largest (Octree-GS: d_max), from where on level 1 alone is drawn.",
        high=1,
    )
    coarser_levels: int = parameter(
        3, "Levels before those of Eq. 3, for views from farther away than any photograph."
    )
    footprint: float = parameter(
        1.0,
        "Pixels that the voxel of a level covers where the level is just wanted; sets the voxels' size.",
        above=0,
        unit="px",
    )
    narrowest: float = parameter(
        0.8,
        "Pixels that a splat's largest standard deviation covers at least where its level is just wanted; "
        "narrower splats move to a finer level, up to the first one after 'coarser_levels'.",
        unit="px",
    )
    widest: float = parameter(
        26.0, "Pixels that it covers at most; wider splats move to a coarser level.", above=0, unit="px"
    )
    visible_share: float = parameter(
        0.0,
        "Anchors that fewer than this share of the views want are dropped; those that none wants always are.",
        high=1,
    )
    coarse_share: float = parameter(
        0.25,
        "Share of the steps in which levels join one by one; then anchors also grow into the next level.",
        high=1,
    )
    coarse_factor: float = parameter(
        1.5, "How many times longer a level trains alone than the next one (Octree-GS: 1/omega).", above=0
    )
    grow_interval: int = parameter(50, "Steps between two growings.", above=0, unit="steps")
    grow_until: float = parameter(
        0.55,
        "Share of the steps after which anchors are no longer added, nor removed but at the end.",
        high=1,
    )
    least_weight: float = parameter(
        0.02,
        "Splats whose largest blending weight in any training view is below this go when growing ends and "
        "once more at the end; 0 keeps all. Not in the paper, but in RadSplat.",
        high=1,
    )
    candidates: int = parameter(
        2, "Places that each splat with a large gradient proposes in a growing.", above=0
    )
    grow_harder: float = parameter(
        0.2,
        "The gradient's threshold is 2 to this power higher from level to level (Octree-GS: beta), counted "
        "from the first level after 'coarser_levels'.",
    )
    bias_rate: float = parameter(
        0.0025,
        "What a level's bias gains in a growing where the gradient is a quarter of the threshold or more.",
    )
    far_share: float = parameter(
        0.05,
        "Share of the steps that see a photograph made smaller, as from 2, 4, ... times the distance; if it "
        "is not 0, so do all steps before the finest level has joined.",
        high=1,
    )
    full_share: float = parameter(
        0.4,
        "Share of the other steps that draw every level wherever it is, as a view at full detail does.",
        high=1,
    )
    lr_end: float = parameter(
        0.1,
        "What is left of the learning rates at the end: they fall from when growing ends; 1 leaves them, as "
        "in the paper. Positions have a rule of their own.",
        high=1,
    )
    volume_weight: float = parameter(
        0.0, "Weight of the mean of the splats' volumes in the loss, lengths in median depths."
    )

    def check(self) -> None:
        if self.nearest >= self.farthest:
            raise LodgsError(
                f"nearest = {self.nearest} is not possible with farthest = {self.farthest}.",
                "Give a smaller number.",
            )


_DRAFT = OctreeParameters(lr_means=4e-4, lr_sh=5e-3)
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, lr_sh=2.5e-3, grow_interval=100)
_PAPER = replace(
    _STANDARD,
    **AS_PUBLISHED,
    steps=40_000,
    coarser_levels=0,
    narrowest=0.0,
    widest=1e9,
    grow_until=0.625,
    grad_threshold=2e-4,
    max_splats=5_000_000,
    far_share=0.0,
    full_share=0.0,
    least_weight=0.0,
    lr_end=1.0,
    bias_rate=0.01,
    candidates=1,
)

METHOD = MethodInfo(
    name="octree",
    number=1,
    label="Octree-GS",
    about="levels of an octree that add up, faded in one by one as the eye comes nearer",
    parameters=OctreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="octree",
    panel_parameters=("levels", "max_splats"),
    cell_method="octree",
)
