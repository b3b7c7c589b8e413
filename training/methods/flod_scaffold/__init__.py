"""FLoD on Scaffold-GS (Seo et al. 2025, Sec. 4.4): independent levels of neural anchors, baked."""

from dataclasses import dataclass, fields
from typing import Any

from ...optimize.flod_parameters import (
    PAPER_FOOTPRINT,
    PAPER_INTERVALS,
    PAPER_STEPS,
    PAPER_UNTIL,
    FlodLevels,
)
from ...optimize.method_info import MethodInfo
from ...settings import setting
from ..octree_neural import METHOD as NEURAL_OCTREE
from ..octree_neural import NeuralOctreeParameters

ONE_LEVEL: dict[str, Any] = {
    "levels": 1,
    "coarser_levels": 0,
    "coarse_share": 0.0,
    "room_exponent": 0.0,
    "bias_rate": 0.0,
    "far_share": 0.0,
    "full_share": 0.0,
}
"""Parameters of an octree with one level, as each level of FLoD has it."""
LEVEL_SELECTION = (
    "nearest",
    "narrowest",
    "widest",
    "visible_share",
    "joins",
    "init_level",
    "coarse_factor",
    "grow_next",
    "grow_harder",
    *(name for name in ONE_LEVEL if name != "levels"),
)
"""Parameters of several levels in one octree, which are not used."""


@dataclass(frozen=True)
class FlodScaffoldParameters(FlodLevels, NeuralOctreeParameters):
    """Parameters of FLoD on Scaffold-GS. Tuples have one entry per level, coarse to fine."""

    max_splats: int = setting(100_000, "Maximum number of Gaussians of the last level. 0 is unlimited.")
    coarsest: float = setting(
        16.0,
        "Minimum splat size of level 1, in pixels at the scene's median depth. Sets lambda and the "
        "screen size (gamma) that selects levels by distance.",
        label="Coarsest Detail",
        above=0,
        unit="px",
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

    @property
    def total_steps(self) -> int:
        return sum(self.steps)

    def of_level(self, number: int) -> NeuralOctreeParameters:
        """Return the parameters that train a level (1-based): those of an octree with one level."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(NeuralOctreeParameters)}
        values |= {name: values[name][number - 1] for name in ("steps", "grow_until", "grow_interval")}
        share = int(self.max_splats * self.budget_ratio ** (self.levels - number))
        limit = min(max(share, 2 * self.offsets), self.max_splats)  # at least one anchor besides margins
        values |= ONE_LEVEL | {"max_splats": limit}
        return NeuralOctreeParameters(**values)


def _preset(name: str, **changes: Any) -> FlodScaffoldParameters:
    """Return a preset of Octree-GS with the given changes and the defaults of FLoD's own parameters."""
    octree, own = NEURAL_OCTREE.preset(name), FlodScaffoldParameters.__annotations__.keys() | {"levels"}
    shared = {f.name: getattr(octree, f.name) for f in fields(octree) if f.name not in own}
    return FlodScaffoldParameters(**shared | changes)


_DRAFT = _preset("draft")
_STANDARD = _preset(
    "standard", max_splats=2_000_000, steps=(1_500, 2_000, 3_000, 4_500, 19_000), grow_interval=(100,) * 5
)
_PAPER = _preset(
    "paper",
    max_splats=0,
    coarsest=PAPER_FOOTPRINT,
    steps=PAPER_STEPS,
    grow_until=PAPER_UNTIL,
    grow_interval=PAPER_INTERVALS,
    budget_ratio=1.0,
    appearance=0,
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
