"""Octree-GS (Ren et al. 2024) with explicit anchors: octree levels that add up and fade in one by one."""

from dataclasses import replace

from ...optimize.anchors.parameters import OctreeParameters
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import AS_PUBLISHED, STANDARD

_DRAFT = OctreeParameters(lr_means=4e-4, lr_sh=5e-3)
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, lr_sh=2.5e-3, grow_interval=100)
_PAPER = replace(
    _STANDARD,
    **AS_PUBLISHED,
    steps=40_000,
    coarser_levels=0,
    narrowest=0.0,
    widest=1e9,
    grow_until=0.6249,
    joins="published",
    stats_from=500,
    grow_from=1500,
    room_exponent=0.0,
    grad_threshold=2e-4,
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
    about="octree levels that add up and fade in as the camera approaches",
    parameters=OctreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="octree",
    panel_parameters=("levels", "max_splats"),
    cell_method="octree",
    trains_on_device=lambda parameters: not parameters.volume_weight,
)
