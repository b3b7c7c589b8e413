"""A LoD of Gaussians (Windisch et al. 2026): a tree over splats; training and rendering use its cuts."""

from dataclasses import dataclass, replace

from ...errors import LodgsError
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, SplatParameters
from ...settings import setting


@dataclass(frozen=True)
class TreeParameters(SplatParameters):
    """Parameters of A LoD of Gaussians.

    Without a base, the first ``steps`` train the leaves by 3DGS.
    """

    sky_points: int = setting(
        0,
        "Number of additional points on a sphere around the scene, for outdoor scenes whose points do not "
        "cover the sky. 'max_splats' does not count them. A base has none.",
        high=1_000_000,
        label="Sky Points",
    )
    merge_by: str = setting(
        "error",
        "Order in which neighbours merge to nodes, and size of nodes, which decides the cuts: by the error "
        "of the merge, which is not in the paper, or by the size of the merged splat.",
        choices=("error", "size"),
    )
    tune_steps: int = setting(
        1500,
        "Training steps for cuts of the tree, one view per step. 0 keeps the tree as built.",
        unit="steps",
    )
    pixels: float = setting(
        0.5,
        "Granularity of the cuts in training, in pixels of the training images; also the initial "
        "value for rendering.",
        low=0.1,
        high=100,
        unit="px",
    )
    lod_noise: float = setting(
        10.0,
        "Random coarsening in training: granularity is multiplied by 1 + this value times r⁴, with r "
        "uniform from 0 to 1. Most cuts are fine, some coarse. Applies if 'octaves' is 0.",
        high=100,
    )
    octaves: float = setting(
        5.0,
        "Random coarsening in training: granularity is multiplied by up to 2 to this power, evenly in "
        "octaves. 0 uses 'lod_noise'. Not in the paper.",
        high=8,
    )
    node_rate: float = setting(
        8.0,
        "Learning rates of inner nodes, as multiples of the final rates of 3DGS.",
        high=100,
    )
    node_end: float = setting(
        0.1, "Final learning rates of inner nodes, as a fraction of the initial ones.", above=0, high=1
    )
    leaf_rate: float = setting(
        0.1,
        "Learning rates of leaves, as multiples of the same rates. 0 freezes the leaves.",
        high=100,
    )
    leaf_end: float = setting(
        0.03, "Final learning rates of leaves, as a fraction of the initial ones.", above=0, high=1
    )
    resize_interval: int = setting(
        1000,
        "Steps between two updates of node sizes, which decide the cuts. 0 keeps the sizes of the "
        "built tree.",
        unit="steps",
    )

    grow_interval: int = setting(
        0,
        "Steps between two density controls of the tree: leaves above 'max_threshold' split while "
        "'max_splats' allows. 0 disables.",
        unit="steps",
    )
    grow_until: float = setting(
        0.85, "Fraction of 'tune_steps' after which the tree keeps its shape.", high=1
    )
    unseen_epochs: float = setting(
        0.0,
        "Epochs after which density control removes leaves that were in no training image. 0 disables.",
    )

    @property
    def max_trained_splats(self) -> int:
        return self.max_splats and self.max_splats + self.sky_points

    @property
    def total_steps(self) -> int:
        return self.steps + self.base_steps

    @property
    def base_steps(self) -> int:
        return 1 + self.tune_steps

    @property
    def growth_rounds(self) -> float | None:
        return None  # leaves grow, too

    def check(self) -> None:
        super().check()
        if self.max_trained_splats == 1:
            raise LodgsError(
                "Cannot build a tree: 'max_splats' is 1, but it needs at least two splats.",
                "Give a larger number.",
            )


_DRAFT = TreeParameters()
_STANDARD = replace(
    _DRAFT,
    **STANDARD,
    steps=30_000,
    densify_interval=100,
    tune_steps=10_000,
    node_rate=4.0,
    grow_interval=1000,
    leaf_rate=1.0,  # new leaves have to learn
)
_PAPER = replace(
    _STANDARD,
    **PAPER | {"opacity_reset_interval": 0},
    merge_by="size",
    pixels=3.0,
    lod_noise=5.0,
    octaves=0.0,
    node_rate=1.0,
    node_end=1.0,
    leaf_end=1.0,
    sh_degree=1,
    tune_steps=150_000,
    max_threshold=0.0075,
    steps=60_000,
    densify_until=0.0,
    unseen_epochs=2.0,
)

METHOD = MethodInfo(
    name="tree",
    number=6,
    label="A LoD of Gaussians",
    about="a tree over a trained model, cut at the detail that each region needs",
    parameters=TreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="cut",
    panel_parameters=("max_splats", "tune_steps", "pixels"),
    from_base=True,
    streams_base=True,
    suggested_for_base=True,
    capture_values={"leaf_rate": 0.0, "random_background": False},  # leaves are exact, and black means empty
    cell_method="3dgs",
)
