"""Splats are added and removed: 3DGS's adaptive density control (Kerbl et al. 2023, Sec. 5.2), as functions
that methods share. They change a model of splats in place, with whatever columns it has.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch

from ..errors import LodgsError
from ..rasterize.features import rotation_matrices
from .model import PEAK_STATS, Model

RESET_OPACITY = 0.01
"""What an opacity reset leaves at most."""


AXIS_SHRINK = 0.45
"""What a split along the longest axis takes from that axis (Improved-GS, arXiv 2508.12313)."""
CHILD_OFFSET = 3 * AXIS_SHRINK
"""How far from the parent's mean its children lie on that axis, in its standard deviations there."""
SIDE_SCALE = sqrt(1 - AXIS_SHRINK**2)
"""The children's share of the parent's other two."""
CHILD_OPACITY = 0.6
"""The children's share of its opacity."""


def peak_scores(model: Model) -> torch.Tensor:
    """What decides by maxima (N,): the largest gradient times the largest radius times opacity^(1/5).

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
    """Adds splats where the image-plane gradient is large: one more for each.

    Children have their parent's other values; of the model's columns they begin with zeros.

    Args:
        gradients: (N,) mean norm of the image-plane gradient over the views that saw each splat, or
            :func:`peak_scores`.
        threshold: the value above which a splat is densified.
        clone_below: largest scale (scene units) that is cloned; larger ones are split in two at random, as
            in 3DGS. None: all are split in two along their longest axis.
        max_splats: the largest gradients come first until this number is reached.
        rng: places the children of a split at random.
        min_scale: FLoD's s_min; the scale that counts is exp(log_scales) + min_scale.

    Returns:
        How many splats were added.
    """
    chosen = torch.nonzero(gradients > threshold).squeeze(1)
    room = max(max_splats - len(model), 0)
    if len(chosen) > room:
        order = torch.argsort(gradients[chosen], descending=True, stable=True)
        chosen = chosen[order[:room]].sort().values
    if len(chosen) == 0:
        return 0
    rows = model.read_rows(chosen)
    scales = rows["log_scales"].exp() + min_scale
    cloned = scales.amax(1) <= (-torch.inf if clone_below is None else clone_below)
    clones = {name: row[cloned] for name, row in rows.items()}
    parents, scales = chosen[~cloned], scales[~cloned]
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
    return len(chosen)


def split_longest_axis(
    children: dict[str, torch.Tensor], scales: torch.Tensor
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Two children on either side of each parent, which together look much as it did.

    Args:
        children: twice the rows of P parents.
        scales: (P, 3) of the parents.

    Returns:
        The children's rows, changed in place, and their scales (2 P, 3).
    """
    count, longest = len(scales), scales.argmax(1)
    axes = rotation_matrices(children["quats"][:count])[torch.arange(count), :, longest]
    offset = CHILD_OFFSET * scales.amax(1, keepdim=True) * axes
    children["means"] += torch.cat([offset, -offset])
    children["opacity_logits"] = (CHILD_OPACITY * children["opacity_logits"].sigmoid()).logit()
    shares = torch.full_like(scales, SIDE_SCALE)
    shares[torch.arange(count), longest] = 1 - AXIS_SHRINK
    return children, (scales * shares).repeat(2, 1)


def prune(model: Model, min_opacity: float) -> None:
    """Removes splats below an opacity."""
    model.keep(model.read("opacity_logits").sigmoid() >= min_opacity)


def reset_opacities(model: Model) -> None:
    """Opacities fall to RESET_OPACITY at most, from where only splats that are needed rise again."""
    most = float(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    model.assign("opacity_logits", model.read("opacity_logits").clamp_max(most))


def require_rows(model: Model, step: int, limit: str) -> None:
    """LodgsError where nothing is left after a step; ``limit`` names the parameter that took it."""
    if not len(model):
        raise LodgsError(
            f"No splat is left at step {step + 1}.", f"Lower '{limit}', or choose another preset."
        )


def sample_gaussians(quats: torch.Tensor, scales: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """For each of N Gaussians a place drawn from it, (N, 3) from its mean.

    Args:
        quats, scales: (N, 4) wxyz and (N, 3) standard deviations.
    """
    local = torch.from_numpy(rng.standard_normal((len(scales), 3), np.float32)).to(scales)
    return torch.einsum("nij,nj->ni", rotation_matrices(quats), local * scales)


def constrained_log_scales(scales: torch.Tensor, min_scale: float, floor: float = 0.05) -> torch.Tensor:
    """s_opt with exp(s_opt) + min_scale = scales (FLoD, Eq. 5), where that is possible.

    The published code clamps the difference at 1e-7, from which a splat hardly ever grows again (its
    gradient is proportional to the difference); a share of ``min_scale`` leaves it free to move.
    """
    return (scales - min_scale).clamp_min(max(floor * min_scale, 1e-9)).log()
