"""Octree-GS (Ren et al. 2024) with neural anchors, as in the paper; baked for Blender."""

from dataclasses import dataclass, replace

from ...errors import LodgsError
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import AS_PUBLISHED, parameter
from ..octree import OctreeParameters


@dataclass(frozen=True)
class NeuralOctreeParameters(OctreeParameters):
    """Harmonics are those of baking."""

    max_splats: int = parameter(180_000, "Most Gaussians of all levels together, which add up.", above=0)
    min_opacity: float = parameter(
        0.005, "Anchors the sum of whose Gaussians' opacities is below this are removed.", high=1
    )
    lr_scales: float = parameter(7e-3, "Learning rate of the logs of the anchors' extents.")
    offsets: int = parameter(5, "Gaussians of an anchor (Octree-GS: 10).", above=0, high=100)
    features: int = parameter(32, "Length of an anchor's feature.", high=1024)
    direct: bool = parameter(
        True,
        "Whether each Gaussian has looks of its own too, which those of the networks are added to. Not in "
        "the paper; short schedules need it.",
    )
    view_shapes: bool = parameter(
        False,
        "Whether opacity and covariance change with the direction of view, as in the paper. They then learn "
        "the photographs by heart where these are few, and baking cannot carry it.",
    )
    appearance: int = parameter(
        0,
        "Length of each view's appearance, for photographs in changing light; 0: all are alike.",
        high=1024,
    )
    lr_features: float = parameter(7.5e-3, "Learning rate of features.")
    lr_offsets: float = parameter(
        1e-2,
        "Learning rate of the Gaussians' offsets, which are in units of their anchor's extent, at the start.",
    )
    lr_offsets_final: float = parameter(1e-4, "The same at the end.")
    lr_looks: float = parameter(
        1e-2,
        "Learning rate of Gaussians' own scales and colours; opacities take five times, quaternions a fifth "
        "of it.",
    )
    lr_network: float = parameter(
        2e-3,
        "Learning rate of the opacity's network; covariance has twice, colour four times as much.",
    )
    lr_network_final: float = parameter(
        0.01,
        "What is left of the rates of opacity, colour and appearance at the end, as a share.",
        high=1,
    )
    lr_appearance: float = parameter(5e-2, "Learning rate of the views' appearances.")
    bake_ridge: float = parameter(0.001, "How firmly baking holds the higher harmonics to zero.", above=0)

    def check(self) -> None:
        super().check()
        if self.max_splats < self.offsets:
            raise LodgsError(
                f"max_splats = {self.max_splats} is less than one anchor's {self.offsets} Gaussians.",
                "Give a larger number.",
            )


_DRAFT = NeuralOctreeParameters(
    steps=4300,
    max_splats=180_000,
    footprint=2.0,
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
    max_splats=10_000_000,
    coarser_levels=0,
    footprint=1.0,
    narrowest=0.0,
    widest=1e9,
    grow_until=0.625,
    grad_threshold=2e-4,
    far_share=0.0,
    full_share=0.0,
    least_weight=0.0,
    lr_end=1.0,
    bias_rate=0.01,
    direct=False,
    view_shapes=True,
)

METHOD = MethodInfo(
    name="octree_neural",
    number=2,
    label="Octree-GS, neural",
    about="the same with small networks, as in the paper; baked for Blender",
    parameters=NeuralOctreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="octree",
    panel_parameters=("levels", "max_splats"),
    unused=(
        "candidates",
        "sh_interval",
        "dropout",
        "lr_means",
        "lr_means_final",
        "lr_quats",
        "lr_opacities",
        "lr_sh",
    ),
)
