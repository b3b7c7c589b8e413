"""FLoD on Scaffold-GS (Seo et al. 2025, Sec. 4.4): independent levels of neural anchors, baked."""

from dataclasses import dataclass, fields, replace
from typing import Any

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import AS_PUBLISHED
from ...settings import setting
from ...splats.levels import MAX_LEVELS
from ..octree_neural import METHOD as NEURAL_OCTREE
from ..octree_neural import NeuralOctreeParameters

LEVEL_SELECTION = (
    "nearest",
    "coarser_levels",
    "narrowest",
    "widest",
    "visible_share",
    "coarse_share",
    "joins",
    "init_level",
    "coarse_factor",
    "grow_next",
    "grow_harder",
    "room_exponent",
    "bias_rate",
    "far_share",
    "full_share",
)
"""Parameters of several levels in one octree, which here has one."""


@dataclass(frozen=True)
class FlodScaffoldParameters(NeuralOctreeParameters):
    """Parameters of FLoD on Scaffold-GS. Tuples have one entry per level, coarse to fine."""

    max_splats: int = setting(100_000, "Maximum number of Gaussians of the last level. 0 is unlimited.")
    levels: int = setting(5, "Number of levels (FLoD: L_max).", low=1, high=MAX_LEVELS)
    rho: float = setting(
        4.0, "Ratio of the minimum splat sizes of two neighbouring levels (FLoD: rho).", above=1
    )
    coarsest: float = setting(
        16.0,
        "Minimum splat size of level 1, in pixels at the scene's median depth. Sets lambda and the "
        "screen size (gamma) that selects levels by distance.",
        label="Coarsest Detail",
        above=0,
        unit="px",
    )
    s_min_1: float = setting(
        0.0, "Minimum splat size of level 1 in scene units (FLoD: lambda). 0 derives it from 'coarsest'."
    )
    steps: tuple[int, ...] = setting(
        (200, 300, 450, 650, 2700), "Training steps of each level.", above=0, unit="steps"
    )
    grow_until: tuple[float, ...] = setting(
        (0.55,) * 5, "Fraction of a level's steps in which anchors are added and removed.", high=1
    )
    grow_interval: tuple[int, ...] = setting(
        (50,) * 5, "Steps between two growth passes.", above=0, unit="steps"
    )
    budget_ratio: float = setting(
        0.6,
        "Maximum number of Gaussians of a level, as a fraction of the next finer level's. Not in the paper.",
        above=0,
        high=1,
    )

    @property
    def total_steps(self) -> int:
        return sum(self.steps)

    def of_level(self, number: int) -> NeuralOctreeParameters:
        """Return the parameters that train a level (1-based): those of an octree with one level."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(NeuralOctreeParameters)}
        values |= {name: values[name][number - 1] for name in ("steps", "grow_until", "grow_interval")}
        limit = self.max_splats and int(self.max_splats * self.budget_ratio ** (self.levels - number))
        values |= {"levels": 1, "max_splats": limit}
        return NeuralOctreeParameters(**values)


_DRAFT = FlodScaffoldParameters(
    footprint=2.0,
    coarser_levels=0,
    coarse_share=0.0,
    room_exponent=0.0,
    bias_rate=0.0,
    far_share=0.0,
    full_share=0.0,
    least_weight=0.03,
    volume_weight=0.01,
    antialias=False,
    dropout=0.0,
)
_STANDARD = replace(
    _DRAFT,
    steps=(1_500, 2_000, 3_000, 4_500, 19_000),
    max_splats=2_000_000,
    offsets=10,
    grow_interval=(100,) * 5,
)
_PAPER = replace(
    _STANDARD,
    **AS_PUBLISHED,
    coarsest=40.0,
    footprint=1.0,
    steps=(10_000, 15_000, 20_000, 25_000, 30_000),
    grow_until=(0.499, 0.399, 0.399, 0.399, 0.499),
    grow_interval=(2000, 1000, 500, 500, 200),
    budget_ratio=1.0,
    grad_threshold=2e-4,
    stats_from=500,
    grow_from=1500,
    success_threshold=0.8,
    least_weight=0.0,
    lr_end=1.0,
    scale_offset_rate=True,
    direct=False,
    view_shapes=True,
)

METHOD = MethodInfo(
    name="flod_scaffold",
    number=7,
    label="FLoD on Scaffold-GS",
    about="independent levels of anchors with small neural networks, each with a minimum splat size",
    parameters=FlodScaffoldParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="bands",
    panel_parameters=("levels", "coarsest", "max_splats"),
    unused=NEURAL_OCTREE.unused + LEVEL_SELECTION,
)
