"""What a job can set: parameters as dataclass fields that know their bounds, units and help. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, dataclass, field, fields, replace
from math import inf, isfinite
from typing import Any

from ..documents import quote
from ..errors import LodgsError
from ..scenes.depths import DEPTH_KINDS

MAX_MARGIN_SHARE, MAX_MARGIN_SPLATS = 0.1, 4000
"""The most of all splats that may continue photographs beyond their edges, and the most at all."""
MAX_INTEGER, MAX_NUMBER = 2**31 - 1, 1e9
"""The largest whole number, and the largest other one, that any parameter takes."""


def parameter(
    default: Any,
    about: str = "",
    *,
    label: str = "",
    low: float = 0,
    high: float = inf,
    above: float | None = None,
    unit: str = "",
    choices: Sequence[str] = (),
) -> Any:
    """A field of a `Parameters` class. All that is said of it is in the field's ``metadata``, by these names.

    Args:
        default: a bool, int, float or str, or a tuple of one of these with an entry for each level; its type
            is the parameter's.
        about: help, one or two sentences.
        label: what a panel calls it; "" for its name in words.
        low, high: bounds of a number, inclusive; ``high`` is never above MOST_WHOLE or MOST_NUMBER.
        above: the number that it has to exceed, in place of ``low``.
        unit: "px", "steps", ...; "" for a pure number.
        choices: the texts that are possible.
    """
    described = {"about": about, "label": label, "low": low, "high": high, "above": above}
    return field(default=default, metadata=described | {"unit": unit, "choices": tuple(choices)})


@dataclass(frozen=True)
class Parameters:
    """What every method has; a job begins with the values of a preset.

    Sizes and thresholds do not depend on the scene's scale: they are in pixels of the training images or in
    multiples of the scene extent.
    """

    steps: int = parameter(3000, "Training steps.", above=0, unit="steps")
    max_splats: int = parameter(
        60_000,
        "Most splats; those with the largest gradients are densified first. Of more structure-from-motion "
        "points than this, training begins with a random sample.",
        above=0,
    )
    grad_threshold: float = parameter(
        1e-4, "Mean image-plane gradient (3DGS units) above which splats are added, at one megapixel."
    )
    min_opacity: float = parameter(0.005, "Splats below this opacity are removed.", high=1)
    sh_degree: int = parameter(
        3, "Degree of the spherical harmonics that carry view-dependent colour, 0 to 3.", high=3
    )
    sh_interval: int = parameter(250, "Steps after which the next degree joins in.", unit="steps")
    ssim_weight: float = parameter(0.2, "Weight of D-SSIM against L1 in the loss.", high=1)
    free_depth: float = parameter(
        0.5,
        "Nothing stands before a training view, or one halfway between two, that is nearer than this share "
        "of the nearest points in it, nor as near beside or behind its eye what fewer than two photographs "
        "see; 0 lets splats stand anywhere.",
        high=1,
    )
    largest: float = parameter(
        0.3,
        "Largest standard deviation of a splat, as a share of its distance from the nearest training view; 0 "
        "sets no bound.",
    )
    random_background: bool = parameter(
        True,
        "Whether every step draws over another colour, so that no splat can use the black behind it as a "
        "colour of the scene; not for photographs whose black is nothing.",
    )
    margin: float = parameter(
        0.5,
        "How much photographs are continued on every side, as a share of their size, where none shows "
        "anything: blurred colours at the depth of the edge instead of black. 0 leaves it empty.",
        high=2,
    )
    antialias: bool = parameter(
        True,
        "Whether splats are drawn through Mip-Splatting's 2D filter, which keeps the light of those that are "
        "smaller than a pixel, instead of 3DGS's dilation. Where a run begins with a base, the base decides.",
    )
    dropout: float = parameter(
        0.2,
        "Where photographs are few, a step leaves out splats at random, so that none serves one photograph "
        "alone: this share of them with one photograph, less with more, none from 40 on, nor in the last "
        "eighth of the steps. Not in the papers.",
        high=0.5,
    )
    depth_weight: float = parameter(
        0.0,
        "Weight in the loss, at the start, of how far off the depth of splats is where it is known (see "
        "depth): L1 of inverse depth, in inverse median depths. It falls to a hundredth; 0 for none.",
        label="Depth Weight",
    )
    depth: str = parameter(
        "metric",
        "What is known of depth: maps in the folder depths, in the scene's unit (metric); maps of depth "
        "(relative) or of inverse depth (inverse) of which scale and shift are found by the scene's points, "
        "view by view; or only these points themselves (points).",
        label="Depth Is",
        choices=DEPTH_KINDS,
    )
    match_exposure: bool = parameter(
        True,
        "Whether photographs that are exposed or balanced otherwise than those beside them are evened first, "
        "by the points that they share. What changes smoothly from one to the next stays.",
    )
    lr_exposure: float = parameter(
        0.0,
        "Learning rate of each photograph's own gain and offset of colours, which pictures do not have; for "
        "photographs that differ in exposure or white balance. 0 learns none.",
    )
    lr_means: float = parameter(
        3e-4,
        "Learning rate of positions, times the scene extent, at the start of a level (FLoD) or of the run.",
    )
    lr_means_final: float = parameter(3e-5, "The same at the end.")
    lr_scales: float = parameter(1e-2, "Learning rate of log-scales.")
    lr_quats: float = parameter(1e-3, "Learning rate of quaternions.")
    lr_opacities: float = parameter(5e-2, "Learning rate of opacity logits.")
    lr_sh: float = parameter(
        2.5e-3, "Learning rate of the base colour; the other harmonics take a twentieth."
    )

    @property
    def levels(self) -> int:
        """Number of levels, a parameter where there can be several; 0 where the scene decides."""
        return 1

    @property
    def total_steps(self) -> int:
        """Training steps of a whole run."""
        return self.steps

    @property
    def base_steps(self) -> int:
        """Training steps of a run that begins with a base, where the method can."""
        return self.total_steps

    @property
    def continues_levels(self) -> bool:
        """Whether training goes on from coarser levels, which a base has."""
        return False

    @property
    def max_trained_splats(self) -> int:
        """Most splats that are trained at a time."""
        return self.max_splats

    def margin_room(self, budget: int) -> int:
        """How many of at most so many splats may continue photographs."""
        return min(int(MAX_MARGIN_SHARE * budget), MAX_MARGIN_SPLATS) if self.margin else 0

    def check(self) -> None:
        """What values must be beside each other; a method's class says it of its own.

        Raises:
            LodgsError: where they are not.
        """


@dataclass(frozen=True)
class DensityParameters(Parameters):
    """Those of methods that clone, split and prune as 3DGS does (``optimize.density_control``)."""

    first_resolution: float = parameter(
        0.35,
        "Photographs begin this much smaller, as a share of their side; 1 trains on their size throughout.",
        above=0,
        high=1,
    )
    full_resolution: float = parameter(
        0.5, "Share of the steps after which photographs have their size.", high=1
    )
    long_axis: bool = parameter(
        True,
        "Whether splats are added by splitting one in two along its longest axis, so that the picture stays "
        "much as it was; otherwise small ones are cloned and large ones split at random, as in 3DGS.",
    )
    clone_extent: float = parameter(
        0.01,
        "Splats larger than this multiple of the scene extent are split at random, smaller ones cloned, "
        "where 'long_axis' is false.",
    )
    prune_interval: int = parameter(
        100, "Steps between two removals of transparent splats; 0 never removes.", unit="steps"
    )
    opacity_reset_interval: int = parameter(
        0, "Steps between two opacity resets; 0 never resets.", unit="steps"
    )
    lr_means_steps: int = parameter(
        0, "Steps over which the positions' rate decays; 0 takes all (FLoD: the level's own).", unit="steps"
    )


STANDARD: dict[str, Any] = {
    "max_splats": 1_000_000,
    "sh_interval": 1000,
    "lr_means": 1.6e-4,
    "lr_means_final": 1.6e-6,
    "lr_scales": 5e-3,
}
"""What presets *standard* take from 3DGS as published, but for its number of splats."""
AS_PUBLISHED: dict[str, Any] = {
    "free_depth": 0.0,
    "largest": 0.0,
    "random_background": False,
    "margin": 0.0,
    "antialias": False,
    "match_exposure": False,
    "dropout": 0.0,
}
"""What presets *paper* leave out, whatever the method: it is in no paper, but for the filter, in LODGE's."""
PAPER: dict[str, Any] = AS_PUBLISHED | {
    "first_resolution": 1.0,
    "long_axis": False,
    "opacity_reset_interval": 3000,
    "grad_threshold": 2e-4,
    "max_splats": 5_000_000,
    "lr_means_steps": 30_000,
}
"""What presets *paper* take from it besides, where density is controlled as in 3DGS."""


def override(parameters: Parameters, values: dict) -> Parameters:
    """``parameters`` with the named values changed, as a job file gives them; None leaves one as it is.

    A single number for a per-level parameter serves every level; a new number of ``levels`` keeps the
    last entries of the per-level ones (the finest levels) or repeats the first. A list of one entry serves as
    a number.

    Raises:
        LodgsError: on an unknown name, a value of the wrong kind, or a wrong number of entries.
    """
    known = {f.name: f for f in fields(parameters)}
    if unknown := sorted(set(values) - set(known)):
        raise LodgsError(
            f"The job sets the unknown parameter {quote(unknown[0])}.", f"Known are: {', '.join(known)}."
        )
    given = {name: value for name, value in values.items() if value is not None}
    changed: dict[str, Any] = {name: getattr(parameters, name) for name in known} | given
    if "levels" in known:
        changed["levels"] = _valid(known["levels"], changed["levels"])
    for name, f in known.items():
        value = changed[name]
        if isinstance(f.default, tuple):
            changed[name] = _per_level(f, value, changed["levels"], name in given)
        else:
            changed[name] = _valid(f, value[0] if isinstance(value, list) and len(value) == 1 else value)
    made = replace(parameters, **changed)
    made.check()
    return made


def describe_values(f: Field) -> str:
    """What a parameter (or each entry of a tuple) can be: "a number above 0 and at most 1"."""
    about, default = f.metadata, f.default[0] if isinstance(f.default, tuple) else f.default
    if isinstance(default, bool):
        return "true or false"
    if isinstance(default, str):
        return f"one of: {', '.join(about['choices'])}"
    kind = "a whole number" if isinstance(default, int) else "a number"
    least = f"of at least {about['low']}" if about["above"] is None else f"above {about['above']}"
    return f"{kind} {least}" + (f" and at most {about['high']}" if about["high"] < inf else "")


def _valid(f: Field, value: Any) -> Any:
    """A value of the field's kind and within its bounds, or a sentence that says what is possible."""
    default = f.default[0] if isinstance(f.default, tuple) else f.default
    low, high, above, choices = (f.metadata[name] for name in ("low", "high", "above", "choices"))
    if isinstance(default, bool):
        valid = isinstance(value, bool)
    elif isinstance(default, str):
        valid = value in choices
    else:
        whole = isinstance(value, int) and not isinstance(value, bool)
        valid = whole or (isinstance(default, float) and isinstance(value, float) and isfinite(value))
        valid = valid and value <= high and (value >= low if above is None else value > above)
        most = MAX_INTEGER if isinstance(default, int) else MAX_NUMBER
        if valid and value > most:
            raise LodgsError(
                f"{f.name} = {quote(value)} is more than any use of it.", f"Give at most {most:g}."
            )
    if not valid:
        raise LodgsError(f"{f.name} = {quote(value)} is not possible.", f"Give {describe_values(f)}.")
    return type(default)(value)


def _per_level(f: Field, value: Any, levels: int, given: bool) -> tuple:
    entries = tuple(value) if isinstance(value, list | tuple) else (value,) * levels
    if given and len(entries) != levels:
        raise LodgsError(
            f"{f.name} has {len(entries)} entries for {levels} levels.",
            "Give one for each level, coarse to fine, or a single number.",
        )
    entries = entries[:1] * (levels - len(entries)) + entries[-levels:]
    return tuple(_valid(f, entry) for entry in entries)
