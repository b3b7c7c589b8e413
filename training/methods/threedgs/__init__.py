"""Plain 3D Gaussian splatting (Kerbl et al. 2023): a single level, for comparison."""

from dataclasses import replace

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import OVERSIZED, PAPER, STANDARD, SplatParameters

_DRAFT = SplatParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100)
_PAPER = replace(_STANDARD, **PAPER, **OVERSIZED)

METHOD = MethodInfo(
    name="3dgs",
    number=3,
    label="3DGS",
    about="a single level, for comparison",
    parameters=SplatParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    panel_parameters=("max_splats",),
    from_base=True,
    cell_method="3dgs",
    trains_on_device=lambda parameters: True,
)
