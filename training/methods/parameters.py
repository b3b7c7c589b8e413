"""What a job can set: every method's parameters, with their presets. No torch: Blender shows these."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from math import inf, isfinite

from ..errors import LodgsError
from ..lod.octree import MOST_LEVELS

PRESETS = {
    "draft": "Minutes on two processor cores: a first look",
    "standard": "An evening on a laptop, minutes on a GPU",
    "paper": "The paper's own schedule",
}
METHODS = {
    "flod": "FLoD: independent levels, each limited to a smallest size of detail",
    "octree": "Octree-GS: levels of an octree that add up, faded in one by one as the eye comes nearer",
    "octree_neural": "Octree-GS, neural: the same with small networks, as in the paper; baked for Blender",
    "3dgs": "Plain 3D Gaussian splatting: one level, for comparison",
}


@dataclass(frozen=True)
class Parameters:
    """What every method has. The defaults are the draft's.

    Sizes and thresholds do not depend on the scene's scale: they are in pixels of the training images or in
    multiples of the scene extent.
    """

    levels: int = 1
    """Number of levels of detail."""
    max_splats: int = 120_000
    """Most splats; those with the largest gradients are densified first. Of more structure-from-motion
    points than this, training begins with a random sample."""
    grad_threshold: float = 1e-4
    """Mean image-plane gradient (3DGS units) above which splats are added, at one megapixel."""
    min_opacity: float = 0.005
    """Splats below this opacity are removed."""
    sh_degree: int = 3
    """Degree of the spherical harmonics that carry view-dependent colour, 0 to 3."""
    sh_interval: int = 250
    """Steps after which the next degree joins in."""
    ssim_weight: float = 0.2
    """Weight of D-SSIM against L1 in the loss."""
    lr_means: float = 3e-4
    """Learning rate of positions, times the scene extent, at the start of a level (FLoD) or of the run."""
    lr_means_final: float = 3e-5
    """The same at the end."""
    lr_scales: float = 1e-2
    lr_quats: float = 1e-3
    lr_opacities: float = 5e-2
    lr_sh: float = 2.5e-3
    """Learning rate of the base colour; the other harmonics take a twentieth."""

    @property
    def total_steps(self) -> int:
        """Training steps of a whole run."""
        raise NotImplementedError


@dataclass(frozen=True)
class FlodParameters(Parameters):
    """Parameters of FLoD; with ``levels`` = 1 they are those of plain 3DGS. The defaults are the draft's.

    A tuple has one entry for each level, coarse to fine. ``max_splats`` is the last level's.
    """

    levels: int = 5
    """Number of levels (FLoD: L_max)."""
    rho: float = 4.0
    """Factor between the smallest sizes of two neighbouring levels (FLoD: rho)."""
    footprint: float = 16.0
    """Pixels that level 1's smallest size covers at the scene's median depth; sets lambda."""
    s_min_1: float = 0.0
    """Level 1's smallest size in scene units (FLoD: lambda); 0 takes it from ``footprint``."""
    steps: tuple[int, ...] = (300, 500, 600, 900, 2000)
    """Training steps of each level."""
    densify_until: tuple[float, ...] = (0.5, 0.5, 0.5, 0.5, 0.5)
    """Share of a level's steps after which splats are no longer added or removed."""
    densify_interval: tuple[int, ...] = (50, 50, 50, 50, 50)
    """Steps between two densifications."""
    budget_ratio: float = 0.65
    """A level's share of the next finer level's budget of splats, so that every level adds some."""
    clone_extent: float = 0.01
    """Splats larger than this multiple of the scene extent are split, smaller ones cloned."""
    prune_interval: int = 100
    """Steps between two removals of transparent splats."""
    overlap_interval: int = 50
    """Steps between two overlap prunings; the last level has none (FLoD, Sec. 4.3)."""
    rejoin_points: bool = True
    """Whether structure-from-motion points that overlap pruning took join again at the level that has room
    for them, all or a random sample. Not in the paper; in short schedules it lets finer levels begin from
    exact positions."""
    opacity_reset_interval: int = 0
    """Steps between two opacity resets; 0 never resets."""
    lr_means_steps: int = 0
    """Steps over which the positions' rate decays; 0 takes each level's own steps."""

    @property
    def total_steps(self) -> int:
        return sum(self.steps)


@dataclass(frozen=True)
class OctreeParameters(Parameters):
    """Parameters of Octree-GS with explicit anchors. The defaults are the draft's."""

    max_splats: int = 180_000
    """Most splats of all levels together, which add up; FLoD's five levels are over 300,000."""
    grad_threshold: float = 5e-5
    lr_means: float = 4e-4
    lr_sh: float = 5e-3
    levels: int = 0
    """Number of levels (Octree-GS: K); 0 takes it from the range of distances (Eq. 3)."""
    nearest: float = 0.05
    """Quantile of the distances from views to points that counts as the smallest (Octree-GS: d_min)."""
    farthest: float = 0.95
    """Quantile that counts as the largest (Octree-GS: d_max), from where on level 1 alone is drawn."""
    coarser_levels: int = 3
    """Levels before those of Eq. 3, for views from farther away than any photograph."""
    footprint: float = 1.0
    """Pixels that the voxel of a level covers where the level is just wanted; sets the voxels' size."""
    narrowest: float = 0.8
    """Pixels that a splat's largest standard deviation covers at least where its level is just wanted;
    narrower splats move to a finer level, up to the first one after ``coarser_levels``."""
    widest: float = 26.0
    """Pixels that it covers at most; wider splats move to a coarser level."""
    visible_share: float = 0.0
    """Anchors that fewer than this share of the views want are dropped; those that none wants always are."""
    steps: int = 4300
    """Training steps."""
    coarse_share: float = 0.25
    """Share of the steps in which levels join one by one; then anchors also grow into the next level."""
    coarse_factor: float = 1.5
    """How many times longer a level trains alone than the next one (Octree-GS: 1/omega)."""
    grow_interval: int = 50
    """Steps between two growings."""
    grow_until: float = 0.55
    """Share of the steps after which anchors are no longer added, nor removed but at the end."""
    least_weight: float = 0.02
    """Splats whose largest blending weight in any training view is below this go when growing ends and once
    more at the end; 0 keeps all. Not in the paper, but in RadSplat."""
    candidates: int = 2
    """Places that each splat with a large gradient proposes in a growing."""
    grow_harder: float = 0.2
    """The gradient's threshold is 2 to this power higher from level to level (Octree-GS: beta), counted from
    the first level after ``coarser_levels``."""
    bias_rate: float = 0.0025
    """What a level's bias gains in a growing where the gradient is a quarter of the threshold or more."""
    far_share: float = 0.05
    """Share of the steps that see a photograph made smaller, as from 2, 4, ... times the distance; if it is
    not 0, so do all steps before the finest level has joined."""
    full_share: float = 0.4
    """Share of the other steps that draw every level wherever it is, as a view at full detail does."""
    lr_end: float = 0.1
    """What is left of the learning rates at the end: they fall from when growing ends; 1 leaves them, as in
    the paper. Positions have a rule of their own."""
    volume_weight: float = 0.0
    """Weight of the mean of the splats' volumes in the loss, lengths in median depths."""

    @property
    def total_steps(self) -> int:
        return self.steps


@dataclass(frozen=True)
class NeuralOctreeParameters(OctreeParameters):
    """Parameters of Octree-GS with neural anchors. The defaults are the draft's.

    ``max_splats`` is of Gaussians, ``min_opacity`` of the sum over an anchor's Gaussians, ``lr_scales`` of
    the anchors' extents; harmonics are those of baking. Without use here: ``candidates``, ``sh_interval`` and
    the learning rates of means, quaternions, opacities and harmonics.
    """

    footprint: float = 2.0
    full_share: float = 0.1
    least_weight: float = 0.03
    offsets: int = 5
    """Gaussians of an anchor (Octree-GS: 10)."""
    features: int = 32
    """Length of an anchor's feature."""
    direct: bool = True
    """Whether each Gaussian has looks of its own too, which those of the networks are added to. Not in the
    paper; short schedules need it."""
    view_shapes: bool = False
    """Whether opacity and covariance change with the direction of view, as in the paper. They then learn the
    photographs by heart where these are few, and baking cannot carry it."""
    appearance: int = 0
    """Length of each view's appearance, for photographs in changing light; 0: all are alike."""
    volume_weight: float = 0.01
    lr_scales: float = 7e-3
    lr_features: float = 7.5e-3
    lr_offsets: float = 1e-2
    """Learning rate of the Gaussians' offsets, which are in units of their anchor's extent."""
    lr_offsets_final: float = 1e-4
    lr_looks: float = 1e-2
    """Learning rate of Gaussians' own scales and colours; opacities take five times, quaternions a
    fifth of it."""
    lr_network: float = 2e-3
    """Learning rate of the opacity's network; the covariance's has twice, the colour's four times as much."""
    lr_network_final: float = 0.01
    """What is left of the rates of opacity, colour and appearance at the end, as a share."""
    lr_appearance: float = 5e-2
    bake_ridge: float = 0.001
    """How firmly baking holds the higher harmonics to zero."""


_MOST = {"sh_degree": 3} | dict.fromkeys(
    (
        "min_opacity", "ssim_weight", "densify_until", "budget_ratio", "nearest", "farthest", "visible_share",
        "coarse_share", "grow_until", "least_weight", "far_share", "full_share", "lr_end", "lr_network_final",
    ),
    1,
)  # fmt: skip
"""Largest possible values."""
_ABOVE_ZERO = {
    "max_splats", "steps", "rho", "densify_interval", "budget_ratio", "footprint", "widest", "coarse_factor",
    "grow_interval", "candidates", "offsets",
}  # fmt: skip
"""What cannot be 0."""

_DRAFT = FlodParameters()
_STANDARD = replace(
    _DRAFT,
    steps=(2_000, 3_000, 4_000, 6_000, 15_000),
    max_splats=1_000_000,
    sh_interval=1000,
    lr_means=1.6e-4,
    lr_means_final=1.6e-6,
    lr_scales=5e-3,
    densify_interval=(100,) * 5,
)
_PAPER = replace(
    _STANDARD,
    footprint=40.0,
    steps=(10_000, 15_000, 20_000, 25_000, 30_000),
    densify_until=(0.5, 0.4, 0.4, 0.4, 0.5),
    densify_interval=(2000, 1000, 500, 500, 200),
    overlap_interval=1000,
    rejoin_points=False,
    opacity_reset_interval=3000,
    grad_threshold=2e-4,
    max_splats=5_000_000,
    budget_ratio=1.0,
    lr_means_steps=30_000,
)
_OCTREE = OctreeParameters()
_OCTREE_STANDARD = replace(
    _OCTREE,
    steps=30_000,
    max_splats=1_000_000,
    sh_interval=1000,
    lr_means=1.6e-4,
    lr_means_final=1.6e-6,
    lr_scales=5e-3,
    lr_sh=2.5e-3,
    grow_interval=100,
)
_OCTREE_PAPER = replace(
    _OCTREE_STANDARD,
    steps=40_000,
    coarser_levels=0,
    narrowest=0.0,
    widest=1e9,
    grow_until=0.625,
    grad_threshold=2e-4,
    max_splats=5_000_000,
    far_share=0.0,
    full_share=0.0,
    least_weight=0.0,
    lr_end=1.0,
    bias_rate=0.01,
    candidates=1,
)
_FLOD_PRESETS = {"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER}
_PRESETS = {
    "flod": _FLOD_PRESETS,
    "3dgs": _FLOD_PRESETS,
    "octree_neural": {
        "draft": NeuralOctreeParameters(),
        "standard": NeuralOctreeParameters(steps=30_000, max_splats=2_000_000, offsets=10, grow_interval=100),
        "paper": NeuralOctreeParameters(
            steps=40_000,
            max_splats=10_000_000,
            offsets=10,
            grow_interval=100,
            coarser_levels=0,
            footprint=1.0,
            narrowest=0.0,
            widest=1e9,
            grow_until=0.625,
            grad_threshold=2e-4,
            far_share=0.0,
            full_share=0.0,
            least_weight=0.0,
            lr_end=1.0,
            bias_rate=0.01,
            direct=False,
            view_shapes=True,
        ),
    },
    "octree": {"draft": _OCTREE, "standard": _OCTREE_STANDARD, "paper": _OCTREE_PAPER},
}


def preset(method: str, name: str) -> Parameters:
    """The parameters of a method's preset.

    Raises:
        LodgsError: if there is no such method or preset.
    """
    if method not in METHODS:
        raise LodgsError(f"There is no method '{method}'.", f"Choose one of: {', '.join(METHODS)}.")
    if name not in PRESETS:
        raise LodgsError(f"There is no preset '{name}'.", f"Choose one of: {', '.join(PRESETS)}.")
    parameters = _PRESETS[method][name]
    if method == "3dgs":
        assert isinstance(parameters, FlodParameters)
        steps = sum(parameters.steps) if name == "draft" else 30_000
        interval = min(parameters.densify_interval[-1], 100)
        parameters = replace(
            parameters, levels=1, steps=(steps,), densify_until=(0.5,), densify_interval=(interval,)
        )
    return parameters


def override(parameters: Parameters, values: dict) -> Parameters:
    """``parameters`` with the named values changed, as a job file gives them.

    A single number for a per-level parameter serves every level; a new number of ``levels`` keeps the
    last entries of the per-level ones (the finest levels) or repeats the first.

    Raises:
        LodgsError: on an unknown name, a value of the wrong kind, or a wrong number of entries.
    """
    kinds = {f.name: type(getattr(parameters, f.name)) for f in fields(parameters)}
    unknown = sorted(set(values) - set(kinds))
    if unknown:
        raise LodgsError(
            f"The job sets the unknown parameter '{unknown[0]}'.", f"Known are: {', '.join(kinds)}."
        )
    before = parameters.levels
    levels = values.get("levels", before)
    if levels != before and (not isinstance(levels, int) or not 1 <= levels <= MOST_LEVELS):
        raise LodgsError(
            f"levels = {levels!r} is not possible.", f"Give a whole number from 1 to {MOST_LEVELS}."
        )
    changed = {}
    for name, kind in kinds.items():
        value = values.get(name, getattr(parameters, name))
        if kind is bool:
            changed[name] = _yes_or_no(name, value)
        elif kind is tuple:
            changed[name] = _per_level(name, value, levels, given=name in values)
        else:
            changed[name] = _number(name, value, kind)
    _together(changed)
    return replace(parameters, **changed)


def _number(name: str, value, kind: type):
    valid = isinstance(value, int) or (kind is float and isinstance(value, float) and isfinite(value))
    most = _MOST.get(name, inf)
    least_fails = valid and (value < 0 or (value == 0 and name in _ABOVE_ZERO))
    if not valid or isinstance(value, bool) or least_fails or value > most:
        wanted = "a whole number" if kind is int else "a number"
        least = "above 0" if name in _ABOVE_ZERO else "of at least 0"
        limit = f" and at most {most}" if most < inf else ""
        raise LodgsError(f"{name} = {value!r} is not possible.", f"Give {wanted} {least}{limit}.")
    return kind(value)


def _together(values: dict) -> None:
    """What values must be beside each other."""
    if values.get("nearest", 0.0) >= values.get("farthest", 1.0):
        raise LodgsError(
            f"nearest = {values['nearest']} is not possible with farthest = {values['farthest']}.",
            "Give a smaller number.",
        )
    if values["max_splats"] < values.get("offsets", 1):
        raise LodgsError(
            f"max_splats = {values['max_splats']} is less than one anchor's {values['offsets']} Gaussians.",
            "Give a larger number.",
        )


def _yes_or_no(name: str, value) -> bool:
    if not isinstance(value, bool):
        raise LodgsError(f"{name} = {value!r} is not possible.", "Give true or false.")
    return value


def _per_level(name: str, value, levels: int, given: bool) -> tuple:
    entries = tuple(value) if isinstance(value, list | tuple) else (value,) * levels
    kind = float if name == "densify_until" else int
    if given and len(entries) != levels:
        raise LodgsError(
            f"{name} has {len(entries)} entries for {levels} levels.",
            "Give one for each level, coarse to fine, or a single number.",
        )
    entries = entries[:1] * (levels - len(entries)) + entries[-levels:]
    return tuple(_number(name, entry, kind) for entry in entries)
