"""A LoD of Gaussians (Windisch et al. 2026): a tree over splats, whose cuts are trained and drawn."""

from dataclasses import dataclass, replace

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, parameter
from ..threedgs import ThreedgsParameters


@dataclass(frozen=True)
class TreeParameters(ThreedgsParameters):
    """Those of A LoD of Gaussians; ``steps`` are the first ones, those of 3DGS, which makes the leaves where
    there is no base; its schedules are of all steps."""

    tune_steps: int = parameter(
        600, "Steps that train the cut which each view sees of the tree; 0 leaves it as built.", unit="steps"
    )
    pixels: float = parameter(
        0.5,
        "Granularity of these cuts, in pixels of the training images; pictures begin with the same.",
        low=0.1,
        high=100,
        unit="px",
    )
    lod_noise: float = parameter(
        10.0,
        "Each step's granularity is larger by this times r⁴, r random from 0 to 1: most cuts are fine, some "
        "are coarse.",
        high=100,
    )
    node_rate: float = parameter(
        2.0,
        "Learning rates of nodes above leaves, in multiples of those that 3DGS has by then, or, with a base, "
        "ends with.",
        high=100,
    )
    leaf_rate: float = parameter(
        0.5,
        "The same of leaves, which falls to 0.03 of it, so that they come to rest; 0 leaves all as they are.",
        high=100,
    )
    resize_interval: int = parameter(
        1000,
        "Steps after which cuts follow the sizes that nodes have by then; 0: those that the tree was built "
        "with.",
        unit="steps",
    )

    grow_interval: int = parameter(
        0,
        "Steps between two density controls of the tree, after which leaves are split where the product of "
        "'max_threshold' says so, as far as 'max_splats' leaves have room; 0: none.",
        unit="steps",
    )
    grow_until: float = parameter(
        0.85, "Share of 'tune_steps' after which the tree no longer changes its shape.", high=1
    )
    unseen_epochs: float = parameter(
        0.0,
        "With density control, leaves go that were in no image for so many times as many steps as there are "
        "photographs; 0: none does.",
    )

    @property
    def total_steps(self) -> int:
        return self.steps + self.base_steps

    @property
    def base_steps(self) -> int:
        return 1 + self.tune_steps


_DRAFT = TreeParameters()
_STANDARD = replace(
    _DRAFT,
    **STANDARD,
    steps=30_000,
    densify_interval=100,
    tune_steps=10_000,
    grow_interval=1000,
    leaf_rate=1.0,  # those that grow have to learn
)
_PAPER = replace(
    _STANDARD,
    **PAPER,
    pixels=3.0,
    lod_noise=5.0,
    node_rate=1.0,
    sh_degree=1,
    tune_steps=150_000,
    max_threshold=0.0075,
    densify_until=0.083,  # 15,000 steps, as in 3DGS; all are six times as many as 3DGS makes
    unseen_epochs=2.0,
)

METHOD = MethodInfo(
    name="tree",
    number=6,
    label="A LoD of Gaussians",
    about="a tree over a finished model, drawn at the detail that each place needs",
    parameters=TreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="cut",
    panel_parameters=("max_splats", "tune_steps", "pixels"),
    from_base=True,
    streams_base=True,
    suggested_for_base=True,
    capture_values={"leaf_rate": 0.0, "random_background": False},  # leaves are right, and black is nothing
    cell_method="3dgs",
)
