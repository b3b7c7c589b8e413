"""Adaptive density control of 3DGS (Kerbl et al. 2023, Sec. 5.2), shared by methods.

The functions change a model of splats in place and keep its columns consistent.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch

from ..errors import LodgsError
from ..rasterize.features import rotation_matrices
from .model import PEAK_STATS, Model

RESET_OPACITY = 0.01
"""Maximum opacity after an opacity reset."""

OVERSIZED_PIXELS = 20.0
"""Maximum radius of three standard deviations in an image, in pixels, if oversized splats are removed."""
OVERSIZED_EXTENT = 0.1
"""Maximum standard deviation as a fraction of the scene extent, if oversized splats are removed."""

AXIS_SHRINK = 0.45
"""Reduction of the longest axis by a split along it (Improved-GS, arXiv 2508.12313)."""
CHILD_OFFSET = 3 * AXIS_SHRINK
"""Distance of the children from the parent's mean, in its standard deviations along that axis."""
SIDE_SCALE = sqrt(1 - AXIS_SHRINK**2)
"""Scale of the children along the other two axes, as a share of the parent's."""
CHILD_OPACITY = 0.6
"""Opacity of the children, as a share of the parent's."""


def peak_scores(model: Model) -> torch.Tensor:
    """Score splats by maxima (N,): largest gradient times largest radius times opacity^(1/5).

    LODGE, Eq. 6, after H3DGS: gradients in 3DGS units, radii of three standard deviations in pixels.
    """
    gradient, radius, logits = (model.read(name) for name in (*PEAK_STATS, "opacity_logits"))
    return gradient * radius * logits.sigmoid() ** 0.2


@torch.no_grad()
def densify(
    model: Model,
    gradients: torch.Tensor,
    *,
    threshold: float,
    clone_below: float | None,
    max_splats: int,
    rng: np.random.Generator,
    min_scale: float = 0.0,
) -> int:
    """Add one splat for each splat with a large image-plane gradient.

    Children inherit their parent's values, and their columns start at zero.

    Args:
        gradients: (N,) mean norm of the image-plane gradient over the views that saw each splat, or
            :func:`peak_scores`.
        threshold: value above which a splat is densified.
        clone_below: clone splats up to this scale (scene units) and split larger ones in two at random, as
            in 3DGS. None splits all in two along their longest axis.
        max_splats: limit of the model; splats with the largest gradients come first.
        rng: random generator of the children's positions.
        min_scale: FLoD's s_min; scales are compared as exp(log_scales) + min_scale.

    Returns:
        Number of splats added.
    """
    selected = torch.nonzero(gradients > threshold).squeeze(1)
    room = max(max_splats - len(model), 0)
    if len(selected) > room:
        order = torch.argsort(gradients[selected], descending=True, stable=True)
        selected = selected[order[:room]].sort().values
    if len(selected) == 0:
        return 0
    rows = model.read_rows(selected)
    scales = rows["log_scales"].exp() + min_scale
    cloned = scales.amax(1) <= (-torch.inf if clone_below is None else clone_below)
    clones = {name: row[cloned] for name, row in rows.items()}
    parents, scales = selected[~cloned], scales[~cloned]
    children = {name: torch.cat([row[~cloned]] * 2) for name, row in rows.items()}
    if clone_below is None:
        children, scales = split_longest_axis(children, scales)
    else:
        children["means"] += sample_gaussians(children["quats"], scales.repeat(2, 1), rng)
        scales = (scales / 1.6).repeat(2, 1)
    children["log_scales"] = constrained_log_scales(scales, min_scale)
    alive = torch.ones(len(model), dtype=torch.bool, device=parents.device)
    alive[parents] = False
    model.keep(alive)
    model.append({name: torch.cat([clone, children[name]]) for name, clone in clones.items()})
    return len(selected)


def split_longest_axis(
    children: dict[str, torch.Tensor], scales: torch.Tensor
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Place two children on either side of each parent, preserving its appearance approximately.

    Args:
        children: rows of P parents, repeated twice.
        scales: (P, 3) of the parents.

    Returns:
        The children's rows, changed in place, and their scales (2 P, 3).
    """
    count = len(scales)
    longest = scales.argmax(1)
    axes = rotation_matrices(children["quats"][:count])[torch.arange(count), :, longest]
    offset = CHILD_OFFSET * scales.amax(1, keepdim=True) * axes
    children["means"] += torch.cat([offset, -offset])
    children["opacity_logits"] = (CHILD_OPACITY * children["opacity_logits"].sigmoid()).logit()
    shares = torch.full_like(scales, SIDE_SCALE)
    shares[torch.arange(count), longest] = 1 - AXIS_SHRINK
    return children, (scales * shares).repeat(2, 1)


def prune(model: Model, min_opacity: float, decay: float = 0.0) -> None:
    """Reduce all opacities by a share, ``decay``, and remove splats below an opacity."""
    if decay:
        model.fade(decay)
    model.keep(model.read("opacity_logits").sigmoid() >= min_opacity)


def prune_oversized(model: Model, max_scale: float) -> None:
    """Remove splats wider than ``max_scale`` (scene units), or than OVERSIZED_PIXELS since the last reset of
    the statistics (3DGS, Sec. 5.2).
    """
    wide = model.read("log_scales").amax(1).exp() > max_scale
    model.keep(~(wide | (model.read(PEAK_STATS[1]) > OVERSIZED_PIXELS)))


def reset_opacities(model: Model) -> None:
    """Limit opacities to ``RESET_OPACITY``. Only splats that the images need rise again."""
    limit = float(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    model.assign("opacity_logits", model.read("opacity_logits").clamp_max(limit))


def require_rows(model: Model, step: int, parameter: str) -> None:
    """Raise LodgsError if a step removed all splats, naming the responsible parameter."""
    if not len(model):
        raise LodgsError(
            f"Cannot continue training: no splats remain at step {step + 1}.",
            f"Lower or disable '{parameter}', or choose another preset.",
        )


def sample_gaussians(quats: torch.Tensor, scales: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Draw a random offset from the mean for each of N Gaussians, (N, 3).

    Args:
        quats: (N, 4) wxyz.
        scales: (N, 3) standard deviations.
    """
    local = torch.from_numpy(rng.standard_normal((len(scales), 3), np.float32)).to(scales)
    return torch.einsum("nij,nj->ni", rotation_matrices(quats), local * scales)


def constrained_log_scales(scales: torch.Tensor, min_scale: float, floor: float = 0.05) -> torch.Tensor:
    """Solve exp(s_opt) + min_scale = scales for s_opt where possible (FLoD, Eq. 5).

    The published code clamps the difference at 1e-7. Such a splat hardly grows again, because its gradient is
    proportional to the difference. A share of ``min_scale`` as lower bound leaves it free to move.
    """
    return (scales - min_scale).clamp_min(max(floor * min_scale, 1e-9)).log()
