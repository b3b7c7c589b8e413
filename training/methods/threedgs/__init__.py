"""Plain 3D Gaussian splatting (Kerbl et al. 2023): a single level, for comparison."""

from dataclasses import dataclass, replace

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, DensityParameters
from ...settings import setting


@dataclass(frozen=True)
class ThreedgsParameters(DensityParameters):
    """Parameters of 3DGS."""

    densify_until: float = setting(
        0.5, "Fraction of the steps in which splats are added and removed.", high=1
    )
    densify_interval: int = setting(50, "Steps between two densifications.", above=0, unit="steps")
    densify_from: int = setting(0, "First step with densification.", unit="steps")
    densify_by: str = setting(
        "mean",
        "Criterion for adding splats: the mean image-plane gradient over the views since the last "
        "densification (mean), or the maximum gradient times the maximum radius times opacity^(1/5) "
        "(max; LODGE, Eq. 6).",
        choices=("mean", "max"),
    )
    max_threshold: float = setting(
        0.015,
        "Threshold of the criterion 'max' at one megapixel: gradients in 3DGS units, radii of three "
        "standard deviations in pixels (LODGE: 0.015 outdoors, 0.03 indoors).",
    )
    least_weight: float = setting(
        0.0,
        "Minimum blending weight of a splat in any training view; splats below it are removed at 8, "
        "16 and 24 thirtieths of the steps (LODGE, A.2: 0.02). 0 keeps all.",
        high=1,
    )


_DRAFT = ThreedgsParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100)
_PAPER = replace(_STANDARD, **PAPER)

METHOD = MethodInfo(
    name="3dgs",
    number=3,
    label="Plain 3D Gaussian splatting",
    about="a single level, for comparison",
    parameters=ThreedgsParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    panel_parameters=("max_splats",),
    from_base=True,
    cell_method="3dgs",
)
