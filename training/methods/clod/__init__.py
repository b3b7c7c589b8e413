"""CLoD-GS (arXiv 2510.09997, 2025): one set of splats, of which each fades with distance at its own pace."""

from dataclasses import dataclass, replace

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, parameter
from ..threedgs import ThreedgsParameters


@dataclass(frozen=True)
class ClodParameters(ThreedgsParameters):
    """Those of CLoD-GS; until the decay begins it is 3DGS."""

    begin: float = parameter(
        0.5, "Share of the steps after which the decay begins; with a base it begins at once.", high=1
    )
    keep_share: float = parameter(
        0.74,
        "When the decay begins, the splats that give most to the pixels of a view stay, so many that views "
        "draw this share of what they drew; 1 keeps all. Not in the paper.",
        above=0,
        high=1,
        label="Keep Share",
    )
    by_importance: bool = parameter(
        True,
        "Whether each splat begins with the decay that its share in the views' pixels asks for. Not in the "
        "paper; in short schedules it is what teaches decays anything.",
    )
    sigma_init: float = parameter(10.0, "Decay that all splats begin with otherwise.", above=0)
    log_sigma: bool = parameter(
        True, "Whether the decay is trained as its logarithm, so that steps are relative. Not in the paper."
    )
    lr_sigma: float = parameter(1e-2, "Learning rate of the decay.")
    s_v_most: float = parameter(
        10.0,
        "Largest virtual distance scale that a step may draw (CLoD-GS: 3, 5 or 10).",
        low=1,
        label="Max Distance",
    )
    log_uniform: bool = parameter(
        True, "Whether random scales are as likely between 1 and 2 as between 5 and 10; the paper's are not."
    )
    random_weight: float = parameter(
        0.5, "Weight of the picture at a random scale against the one as it is (CLoD-GS: 1)."
    )
    exponent: float = parameter(
        0.7, "The share of splats wanted at a scale is its inverse to this power (CLoD-GS: 1.5).", above=0
    )
    onset: float = parameter(2.0, "The scale up to which all splats are wanted (CLoD-GS: 1).", low=1)
    count_weight: float = parameter(
        1.0, "Weight of the count's regularisation, times (s_v - 1)² (CLoD-GS: λ_reg)."
    )
    count_softness: float = parameter(
        0.5,
        "How near to the threshold, as a logarithm, a splat feels the count: its gradient is a sigmoid's.",
        above=0,
    )
    tau: float = parameter(
        0.02, "Attenuated opacity under which a splat is not drawn (CLoD-GS: τ, without a number).", above=0
    )
    reference_quantile: float = parameter(
        0.99,
        "Quantile of the distances between views and the points that they see that is the reference of all "
        "distances; 0 takes the farthest splat of each view, as published.",
        high=1,
    )


_DRAFT = ClodParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100)
_PAPER = replace(
    _STANDARD,
    **PAPER,
    begin=1 / 6,
    keep_share=1.0,
    by_importance=False,
    log_sigma=False,
    s_v_most=5.0,
    log_uniform=False,
    random_weight=1.0,
    exponent=1.5,
    onset=1.0,
    tau=1 / 255,
    reference_quantile=0.0,
)

METHOD = MethodInfo(
    name="clod",
    number=4,
    label="CLoD-GS",
    about="one set of splats that fade with distance, each at its own pace",
    parameters=ClodParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="decay",
    panel_parameters=("max_splats", "keep_share", "s_v_most"),
    from_base=True,
    cell_method="clod",
)
