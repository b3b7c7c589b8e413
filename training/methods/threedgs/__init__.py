"""Plain 3D Gaussian splatting (Kerbl et al. 2023): one level, for comparison."""

from dataclasses import dataclass, replace

from ..info import MethodInfo
from ..parameters import PAPER, STANDARD, DensityParameters, parameter


@dataclass(frozen=True)
class ThreedgsParameters(DensityParameters):
    """Those of 3DGS."""

    densify_until: float = parameter(
        0.5, "Share of the steps after which splats are no longer added or removed.", high=1
    )
    densify_interval: int = parameter(50, "Steps between two densifications.", above=0, unit="steps")


_DRAFT = ThreedgsParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100)
_PAPER = replace(_STANDARD, **PAPER)

METHOD = MethodInfo(
    name="3dgs",
    number=3,
    label="Plain 3D Gaussian splatting",
    about="one level, for comparison",
    parameters=ThreedgsParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    offered=("max_splats",),
    retired=("levels", "rho", "footprint", "s_min_1", "budget_ratio", "overlap_interval", "rejoin_points"),
)
