"""Parameters of methods, and their values in presets and jobs. Does not import torch."""

from __future__ import annotations

from dataclasses import Field, dataclass, replace
from typing import Any, Self

from ..documents import quote
from ..errors import LodgsError
from ..scenes.depths import DEPTH_KINDS
from ..settings import MAX_INTEGER, check_value, setting, settings_of

MAX_MARGIN_SHARE = 0.1
"""Maximum share of all splats for margins."""
MAX_MARGIN_SPLATS = 4000
"""Maximum number of splats for margins."""


@dataclass(frozen=True)
class Parameters:
    """Parameters of every method. Presets give the initial values of a job.

    Sizes and thresholds are independent of the scene's scale: they are in pixels of the training images or
    multiples of the scene extent.
    """

    steps: int = setting(3000, "Training steps.", above=0, unit="steps")
    max_splats: int = setting(
        60_000,
        "Maximum number of splats. Those with the largest gradients are densified first. If the scene has "
        "more points, training starts from a random sample. 0 is unlimited.",
    )
    grad_threshold: float = setting(
        1e-4,
        "Mean image-plane gradient (3DGS units, at one megapixel) above which splats are added.",
    )
    scale_threshold: bool = setting(
        True,
        "Multiply gradient thresholds by the square root of one megapixel over the photos' size, so that "
        "they mean the same at every size. Disable to use the papers' thresholds unchanged.",
    )
    min_opacity: float = setting(0.005, "Remove splats below this opacity.", high=1)
    sh_degree: int = setting(3, "Degree of spherical harmonics for view-dependent colour, 0 to 3.", high=3)
    sh_interval: int = setting(250, "Steps between increases of the harmonics' degree.", unit="steps")
    sparse_sh: bool = setting(
        True,
        "In steps without autograd, change the harmonics only of splats in the image. Those of others keep "
        "their values and moments, instead of an Adam step with zero gradients, which takes longer.",
    )
    ssim_weight: float = setting(0.2, "Weight of D-SSIM relative to L1 in the loss.", high=1)
    free_depth: float = setting(
        0.5,
        "Remove splats closer to a training camera, or to the midpoint of two neighbouring cameras, than "
        "this fraction of its nearest scene points. Within the same distance outside the frame, keep only "
        "splats seen by two or more photos. Without a base, also remove splats far in front of the points "
        "that a photo observes around their pixel. 0 disables all.",
        high=1,
    )
    largest: float = setting(
        0.3,
        "Maximum standard deviation of a splat, as a fraction of its distance from the nearest training "
        "camera. 0 disables.",
    )
    random_background: bool = setting(
        True,
        "Use a random background colour in every step, so that splats cannot use the black background as a "
        "scene colour. Disable for photos with a black background.",
    )
    margin: float = setting(
        0.5,
        "Width of the margin around photos, as a fraction of their size. Areas outside all photos are filled "
        "with blurred colours at the depth of the edge. 0 disables.",
        high=2,
    )
    antialias: bool = setting(
        True,
        "Use the 2D filter of Mip-Splatting, which preserves the brightness of splats smaller than a pixel, "
        "instead of the dilation of 3DGS. Runs that start from a base use the base's setting.",
    )
    dropout: float = setting(
        0.2,
        "Fraction of random splats to drop in each step, which reduces overfitting to few photos. It "
        "decreases to 0 at 40 photos, and is 0 in the last eighth of the steps. Not in the papers.",
        high=0.5,
    )
    depth_weight: float = setting(
        0.0,
        "Initial weight of the depth loss, L1 of inverse depth in inverse median depths, at pixels where "
        "the depth source has a value. It decreases to a hundredth. 0 disables.",
    )
    depth: str = setting(
        "metric",
        "Source of depth: maps of depth in scene units (metric), of relative depth (relative) or of relative "
        "inverse depth (inverse), or the scene's points (points). Maps are in the folder depths. "
        "Scale and shift of relative ones are fitted to the points of each view.",
        label="Depth Source",
        choices=DEPTH_KINDS,
    )
    match_exposure: bool = setting(
        True,
        "Before training, correct photos whose exposure or white balance differs from their neighbours, by "
        "shared scene points, or by their EXIF data if they share too few. Smooth changes along the sequence "
        "remain.",
    )
    lr_exposure: float = setting(
        0.0,
        "Learning rate of a colour gain and offset per photo, which renders do not use. For photos with "
        "different exposure or white balance. 0 disables.",
    )
    lr_means: float = setting(
        3e-4,
        "Learning rate of positions, times the scene extent, at the start of a level (FLoD) or the run.",
    )
    lr_means_final: float = setting(3e-5, "Learning rate of positions, times the scene extent, at the end.")
    lr_scales: float = setting(1e-2, "Learning rate of log-scales.")
    lr_quats: float = setting(1e-3, "Learning rate of quaternions.")
    lr_opacities: float = setting(5e-2, "Learning rate of opacity logits.")
    lr_sh: float = setting(
        2.5e-3, "Learning rate of the base colour. Higher harmonics use a twentieth of it."
    )

    @property
    def levels(self) -> int:
        """Number of levels, a parameter of methods with several; 0 if it depends on the scene."""
        return 1

    def for_photos(self, count: int) -> Self:
        """Return the parameters for a number of training photos."""
        return self

    @property
    def total_steps(self) -> int:
        """Training steps of the run."""
        return self.steps

    @property
    def base_steps(self) -> int:
        """Training steps of a run that starts from a base."""
        return self.total_steps

    @property
    def continues_levels(self) -> bool:
        """True if training continues the coarser levels of a base."""
        return False

    @property
    def splat_limit(self) -> int:
        """Maximum number of splats; the largest integer if 'max_splats' is unlimited."""
        return self.max_splats or MAX_INTEGER

    @property
    def max_trained_splats(self) -> int:
        """Maximum number of splats trained at the same time; 0 is unlimited."""
        return self.max_splats

    @property
    def growth_rounds(self) -> float | None:
        """Number of densifications of the finest level, the same as 3DGS's; None if splats grow otherwise."""
        return None

    def threshold_factor(self, image_factor: float) -> float:
        """Return the factor on gradient thresholds, given that of the image size."""
        return image_factor if self.scale_threshold else 1.0

    def margin_room(self, budget: int) -> int:
        """Return the share of a budget of splats that is reserved for margins."""
        return min(int(MAX_MARGIN_SHARE * budget), MAX_MARGIN_SPLATS) if self.margin else 0

    def growth_limit(self, budget: int) -> int:
        """Return the maximum number of splats for densification, which reserves the budget of margins."""
        return budget - self.margin_room(budget)

    def check(self) -> None:
        """Check parameters against each other. Methods override this.

        Raises:
            LodgsError: parameters are inconsistent.
        """


@dataclass(frozen=True)
class FarViewParameters(Parameters):
    """Parameters of methods that train some steps on reduced images."""

    far_share: float = setting(
        0.25,
        "Fraction of late steps that reduce their image, as if seen from 2, 4, ... times the distance. "
        "Improves small images. Late steps follow density control, except the last tenth. In Octree-GS they "
        "follow the last level's join, and above 0 all earlier steps reduce their image too.",
        high=1,
    )


@dataclass(frozen=True)
class DensityParameters(FarViewParameters):
    """Parameters of methods with the density control of 3DGS (``optimize.density_control``)."""

    first_resolution: float = setting(
        0.35,
        "Initial side of the training images, as a fraction of the full side. 1 always trains at full size.",
        above=0,
        high=1,
    )
    full_resolution: float = setting(
        0.5, "Fraction of the steps after which training images have full size.", high=1
    )
    points_between: float = setting(
        1.0,
        "Maximum number of initial splats between the scene's points, as a multiple of their number. Where a "
        "photo has no points, those around with similar depths determine position and colour. 0 disables.",
    )
    long_axis: bool = setting(
        True,
        "Densify by splitting splats in two along their longest axis, which changes the image little. "
        "Otherwise clone small splats and split large ones at random, as in 3DGS.",
    )
    clone_extent: float = setting(
        0.01,
        "Without 'long_axis', split splats larger than this multiple of the scene extent and clone smaller "
        "ones.",
    )
    densify_from: int = setting(
        0, "First step of density control. In FLoD, counted from the start of each level.", unit="steps"
    )
    prune_interval: int = setting(
        100, "Steps between removals of transparent splats. 0 disables.", unit="steps"
    )
    opacity_decay: float = setting(
        0.1,
        "Fraction by which opacities fall at each removal of transparent splats, so that splats without "
        "support in several photos disappear. It decreases to 0 at 40 photos. 3DGS from a base does not "
        "use it. 0 disables.",
        high=0.9,
    )
    opacity_reset_interval: int = setting(0, "Steps between opacity resets. 0 disables.", unit="steps")
    lr_final: float = setting(
        0.1,
        "Factor on the learning rates of scales, quaternions, opacities and colours at the end. They fall in "
        "the last 15 % of the steps (FLoD: of a level). 1 keeps them.",
        above=0,
        high=1,
    )
    lr_means_steps: int = setting(
        0,
        "Steps over which the learning rate of positions decays. 0 uses all steps (FLoD: of the level).",
        unit="steps",
    )


@dataclass(frozen=True)
class SplatParameters(DensityParameters):
    """Parameters of methods that train splats as 3DGS does (``optimize.splat_method``)."""

    densify_until: float = setting(
        0.5, "Fraction of the steps in which splats are added and removed.", high=1
    )
    densify_interval: int = setting(50, "Steps between two densifications.", above=0, unit="steps")
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
    prune_oversized: bool = setting(
        False,
        "At each densification after the first opacity reset, remove splats with a radius above 20 pixels or "
        "a standard deviation above a tenth of the scene extent, as 3DGS does.",
    )

    @property
    def growth_rounds(self) -> float | None:
        return self.densify_until * self.steps / self.densify_interval


STANDARD: dict[str, Any] = {
    "max_splats": 1_000_000,
    "sh_interval": 1000,
    "lr_means": 1.6e-4,
    "lr_means_final": 1.6e-6,
    "lr_scales": 5e-3,
}
"""Values of presets *standard*: 3DGS as published, with fewer splats."""
AS_PUBLISHED: dict[str, Any] = {
    "max_splats": 0,
    "scale_threshold": False,
    "sparse_sh": False,
    "free_depth": 0.0,
    "largest": 0.0,
    "random_background": False,
    "margin": 0.0,
    "antialias": False,
    "match_exposure": False,
    "dropout": 0.0,
}
"""Values of presets *paper* that disable additions to the papers. Only LODGE uses the filter."""
PAPER: dict[str, Any] = AS_PUBLISHED | {
    "first_resolution": 1.0,
    "far_share": 0.0,
    "points_between": 0.0,
    "opacity_decay": 0.0,
    "lr_final": 1.0,
    "long_axis": False,
    "opacity_reset_interval": 3000,
    "grad_threshold": 2e-4,
    "densify_from": 501,
    "lr_means_steps": 30_000,
}
"""Values of presets *paper* of methods with the density control of 3DGS, which begins after step 500."""
OVERSIZED: dict[str, Any] = {"densify_until": 0.499, "prune_oversized": True}
"""Values of presets *paper* that train 3DGS as its program does: density control ends before step 15,000."""


def override(parameters: Parameters, values: dict) -> Parameters:
    """Return ``parameters`` with the values of a job file. None keeps the current value.

    A single number for a per-level parameter applies to every level. A new number of ``levels`` keeps the
    last entries of per-level parameters (the finest levels) or repeats the first. A list of one entry is
    accepted as a number.

    Raises:
        LodgsError: unknown name, invalid value, or wrong number of entries.
    """
    all_fields = settings_of(parameters)
    if unknown := sorted(set(values) - set(all_fields)):
        raise LodgsError(
            f"Cannot read the job: unknown parameter {quote(unknown[0])}.",
            f"Choose from: {', '.join(all_fields)}.",
        )
    overrides = {name: value for name, value in values.items() if value is not None}
    result: dict[str, Any] = {name: getattr(parameters, name) for name in all_fields} | overrides
    if "levels" in all_fields:
        result["levels"] = check_value(all_fields["levels"], result["levels"])
    for name, f in all_fields.items():
        value = result[name]
        if isinstance(f.default, tuple):
            result[name] = _per_level(f, value, result["levels"], name in overrides)
        else:
            value = value[0] if isinstance(value, list) and len(value) == 1 else value
            result[name] = check_value(f, value)
    overridden = replace(parameters, **result)
    overridden.check()
    return overridden


def _per_level(f: Field, value: Any, levels: int, explicit: bool) -> tuple:
    """Return one entry per level. Only an explicit value must have the right number of entries."""
    entries = tuple(value) if isinstance(value, list | tuple) else (value,) * levels
    if explicit and len(entries) != levels:
        raise LodgsError(
            f"{f.name} has {len(entries)} entries for {levels} levels.",
            "Use one entry per level, coarse to fine, or a single number.",
        )
    entries = entries[:1] * (levels - len(entries)) + entries[-levels:]
    return tuple(check_value(f, entry) for entry in entries)
