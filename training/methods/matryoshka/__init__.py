"""Matryoshka Gaussian Splatting (arXiv 2603.19234, 2026): one ordered set; each prefix is a coarser scene."""

from dataclasses import dataclass, replace

from ...optimize.method_info import MethodInfo
from ...optimize.parameters import OVERSIZED, PAPER, STANDARD, SplatParameters
from ...settings import setting
from ...splats.levels import MAX_LEVELS


@dataclass(frozen=True)
class MatryoshkaParameters(SplatParameters):
    """Parameters of Matryoshka, which is 3DGS until splats are ordered."""

    begin: float = setting(
        0.5,
        "Fraction of the steps before splats are ordered; with a base they are ordered immediately. Not in "
        "the paper, which trains prefixes from the first step.",
        high=1,
    )
    base_share: float = setting(
        0.1,
        "Fraction of the splats that start as a merge of all splats, when splats are ordered for the first "
        "time. They come first in the order. 0 disables. Not in the paper.",
        high=0.5,
    )
    order_interval: int = setting(
        300,
        "Steps between two computations of the order (Matryoshka: not known to us).",
        above=0,
        unit="steps",
    )
    order_by: str = setting(
        "largest",
        "Importance that orders splats: their largest contribution to a pixel of the training views "
        "(largest), the sum of their contributions to all pixels (total), or their opacity.",
        choices=("largest", "total", "opacity"),
    )
    min_prefix: float = setting(
        0.05, "Minimum length of a random prefix, as a fraction of all splats.", above=0, high=1
    )
    log_uniform: bool = setting(
        True, "Draw the length of a prefix uniformly in the logarithm. Otherwise draw it uniformly."
    )
    prefix_weight: float = setting(
        0.3,
        "Loss weight of the image of the prefix, relative to the image of all splats (Matryoshka: 1). A "
        "larger weight improves prefixes at the expense of the full set.",
    )
    levels: int = setting(
        4, "Number of prefixes that are stored as levels, including the full set.", low=1, high=MAX_LEVELS
    )
    level_ratio: float = setting(
        0.5, "Splat count of a level, as a fraction of the next finer level's.", above=0, high=1
    )
    drawn: float = setting(
        0.45,
        "Fraction of the splats to draw by distance, at the mean distance of the training views. Not in the "
        "paper.",
        above=0,
        high=1,
    )


_DRAFT = MatryoshkaParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100, order_interval=1000)
_PAPER = replace(
    _STANDARD,
    **PAPER,
    **OVERSIZED,
    begin=0.0,
    base_share=0.0,
    prefix_weight=1.0,
    log_uniform=False,
    min_prefix=0.01,
)

METHOD = MethodInfo(
    name="matryoshka",
    number=8,
    label="Matryoshka",
    about="one ordered set of splats; each prefix is a coarser scene",
    parameters=MatryoshkaParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="prefix",
    panel_parameters=("levels", "max_splats", "drawn"),
    from_base=True,
    cell_method="3dgs",
)
