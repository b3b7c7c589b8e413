"""Octree-GS (Ren et al. 2024) with explicit anchors: the finest of merged levels, or levels that add up."""

from dataclasses import replace

from ...optimize.anchors.parameters import ExplicitOctreeParameters
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import AS_PUBLISHED, STANDARD

_DRAFT = ExplicitOctreeParameters(lr_means=4e-4, lr_sh=5e-3, far_share=0.05, refine_steps=4_000)
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, lr_sh=2.5e-3, grow_interval=100)
_PAPER = replace(
    _STANDARD,
    **AS_PUBLISHED,
    steps=40_000,
    levels_from="anchors",
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
    about="splats of all sizes on an octree, and coarser levels merged from them",
    parameters=ExplicitOctreeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="octree",
    merged_rule="bands",
    panel_parameters=("levels", "max_splats"),
    cell_method="octree",
    cell_values={"levels_from": "anchors"},  # cells agree on the distances of these levels
    trains_on_device=lambda parameters: not parameters.volume_weight,
)
