"""CLoD-GS (arXiv 2510.09997, 2025): one set of splats that fade with distance, each at its own rate."""

from dataclasses import dataclass, replace

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import OVERSIZED, PAPER, STANDARD, SplatParameters
from ...settings import setting


@dataclass(frozen=True)
class ClodParameters(SplatParameters):
    """Parameters of CLoD-GS, which is 3DGS until the decay begins."""

    begin: float = setting(
        0.5, "Fraction of the steps before the decay begins; with a base it begins immediately.", high=1
    )
    keep_share: float = setting(
        0.74,
        "When the decay begins, keep the splats that contribute most to the pixels of the views, so "
        "that views draw this fraction of their splats. 1 keeps all. Not in the paper.",
        above=0,
        high=1,
    )
    by_importance: bool = setting(
        True,
        "Initialize each splat's decay from its contribution to the views. Short schedules need it to "
        "learn decays. Not in the paper.",
    )
    sigma_init: float = setting(
        10.0,
        "Initial decay of all splats, if 'by_importance' is off. 0 derives it from each splat's mean "
        "distance in the views: its opacity is halved at the square root of 's_v_most' (CLoD-GS: not "
        "published).",
    )
    log_sigma: bool = setting(
        True, "Train the logarithm of the decay, so that updates are relative. Not in the paper."
    )
    lr_sigma: float = setting(1e-2, "Learning rate of the decay.")
    s_v_most: float = setting(
        10.0,
        "Maximum virtual distance scale in training (CLoD-GS: 3, 5 or 10).",
        low=1,
        label="Max Distance",
    )
    log_uniform: bool = setting(
        True, "Sample the virtual distance scale uniformly in the logarithm; the paper samples it linearly."
    )
    random_weight: float = setting(
        0.5, "Loss weight of the image at the random scale, relative to the image at scale 1 (CLoD-GS: 1)."
    )
    exponent: float = setting(
        0.7,
        "Exponent of the target splat count: at scale s the target fraction is s to the power of "
        "minus this value (CLoD-GS: 1.5).",
        above=0,
    )
    onset: float = setting(2.0, "Scale up to which the target is all splats (CLoD-GS: 1).", low=1)
    count_weight: float = setting(
        1.0, "Weight of the splat count regularization (CLoD-GS: λ_reg). 0 disables it."
    )
    scale_weight: bool = setting(
        True, "Multiply the splat count regularization by (s_v - 1)² (CLoD-GS: w_s, Table 2)."
    )
    count_of: str = setting(
        "view",
        "Splats that count as 100 %: those in view, or all (CLoD-GS: N_total).",
        choices=("view", "all"),
    )
    prune_undrawn: bool = setting(
        True, "Remove splats that no training camera draws, once the decay has begun. Not in the paper."
    )
    count_softness: float = setting(
        0.5,
        "Width of the sigmoid that gives the splat count a gradient, in log opacity relative to the "
        "threshold.",
        above=0,
    )
    count_opacities: bool = setting(
        True,
        "Train opacities by the splat count regularization, too. Otherwise it trains decays only, which "
        "keeps the quality at scale 1 (CLoD-GS: not published).",
    )
    tau: float = setting(
        0.02, "Minimum attenuated opacity of a drawn splat (CLoD-GS: τ, value not published).", above=0
    )
    reference_quantile: float = setting(
        0.99,
        "Quantile of the distances between views and their visible points, used as the reference "
        "distance. 0 trains with the farthest splat in each view, as published, and stores their mean.",
        high=1,
    )


_DRAFT = ClodParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100)
_PAPER = replace(
    _STANDARD,
    **PAPER,
    **OVERSIZED,
    begin=1 / 6,
    keep_share=1.0,
    by_importance=False,
    sigma_init=0.0,
    count_of="all",
    prune_undrawn=False,
    count_opacities=False,
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
    about="one set of splats that fade with distance, each at its own rate",
    parameters=ClodParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="decay",
    panel_parameters=("max_splats", "keep_share", "s_v_most"),
    from_base=True,
    cell_method="clod",
)
