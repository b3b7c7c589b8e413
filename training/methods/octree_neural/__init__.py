"""Octree-GS (Ren et al. 2024) with neural anchors, as in the paper; baked for Blender."""

from dataclasses import dataclass, replace

from ...errors import LodgsError
from ...optimize.anchors.parameters import OctreeParameters
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import AS_PUBLISHED
from ...settings import setting


@dataclass(frozen=True)
class NeuralOctreeParameters(OctreeParameters):
    """Parameters of Octree-GS with neural anchors. ``sh_degree`` applies to baking."""

    max_splats: int = setting(
        180_000, "Maximum number of Gaussians of all levels together; levels add up. 0 is unlimited."
    )
    min_opacity: float = setting(
        0.005, "Minimum summed opacity of an anchor's Gaussians; anchors below it are removed.", high=1
    )
    lr_scales: float = setting(7e-3, "Learning rate of the anchors' log extents.")
    offsets: int = setting(5, "Gaussians per anchor (Octree-GS: 10).", above=0, high=100)
    features: int = setting(32, "Length of an anchor's feature vector.", high=1024)
    direct: bool = setting(
        True,
        "Give each Gaussian its own shape, colour and opacity, to which the networks' output is "
        "added. Short schedules need it. Not in the paper.",
    )
    view_shapes: bool = setting(
        False,
        "Let opacity and covariance depend on the view direction, as in the paper. Overfits if there "
        "are few photos, and baking cannot represent it.",
    )
    appearance: int = setting(
        0,
        "Length of each view's appearance vector, for photos in changing light. 0 disables.",
        high=1024,
    )
    appearance_of: str = setting(
        "",
        "Photo whose appearance vector renders and baked levels use, by file name. If empty, the mean of all "
        "photos.",
    )
    success_threshold: float = setting(
        0.0,
        "Fraction of 'grow_interval' views that must draw an anchor before it can be removed; Gaussians grow "
        "after half as many (Octree-GS: 0.8). The bias then follows the mean gradient. 0 decides by the "
        "views of each interval alone.",
    )
    lr_features: float = setting(7.5e-3, "Learning rate of the features.")
    lr_offsets: float = setting(
        1e-2,
        "Initial learning rate of the Gaussians' offsets, which are in units of their anchor's extent.",
    )
    lr_offsets_final: float = setting(1e-4, "Final learning rate of the offsets.")
    scale_offset_rate: bool = setting(
        False, "Multiply the offsets' learning rates by the scene extent, as in the published program."
    )
    lr_looks: float = setting(
        1e-2,
        "Learning rate of the Gaussians' own scales and colours; opacities use five times, "
        "quaternions a fifth of it.",
    )
    lr_network: float = setting(
        2e-3,
        "Learning rate of the opacity network; the covariance network uses twice, the colour network "
        "four times this value.",
    )
    lr_network_final: float = setting(
        0.01,
        "Final learning rates of opacity, colour and appearance, as a fraction of the initial ones.",
        high=1,
    )
    lr_appearance: float = setting(5e-2, "Learning rate of the appearance vectors.")
    bake_ridge: float = setting(0.001, "Ridge regularization of the higher harmonics in baking.", above=0)

    def check(self) -> None:
        super().check()
        if self.growth_limit(self.splat_limit) < self.offsets:
            raise LodgsError(
                f"'max_splats' is {self.max_splats}, but one anchor needs {self.offsets} Gaussians, besides "
                "those of margins.",
                "Give a larger number.",
            )


_DRAFT = NeuralOctreeParameters(
    steps=4300,
    max_splats=180_000,
    footprint=2.0,
    far_share=0.05,
    full_share=0.1,
    least_weight=0.03,
    volume_weight=0.01,
    antialias=False,
    dropout=0.0,
)
_STANDARD = replace(_DRAFT, steps=30_000, max_splats=2_000_000, offsets=10, grow_interval=100)
_PAPER = replace(
    _STANDARD,
    **AS_PUBLISHED,
    steps=40_000,
    coarser_levels=0,
    footprint=1.0,
    narrowest=0.0,
    widest=1e9,
    grow_until=0.6249,
    grad_threshold=2e-4,
    far_share=0.0,
    full_share=0.0,
    least_weight=0.0,
    lr_end=1.0,
    bias_rate=0.01,
    joins="published",
    stats_from=500,
    grow_from=1500,
    room_exponent=0.0,
    success_threshold=0.8,
    appearance=32,
    scale_offset_rate=True,
    direct=False,
    view_shapes=True,
)

METHOD = MethodInfo(
    name="octree_neural",
    number=2,
    label="Octree-GS (neural)",
    about="octree anchors with small neural networks, as in the paper; baked for Blender",
    parameters=NeuralOctreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="octree",
    panel_parameters=("levels", "max_splats"),
    unused=(
        "candidates",
        "sh_interval",
        "sparse_sh",
        "dropout",
        "lr_means",
        "lr_means_final",
        "lr_quats",
        "lr_opacities",
        "lr_sh",
    ),
)
