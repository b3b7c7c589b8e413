"""Splats in records, one after the other, with Adam's moments and what density control asks for.

A record holds C values (means, quaternions, log-scales, opacity logits, harmonics), their first and their
second moments, and from column 3 C on STEPS, how many steps it has made; SCORE, the largest product of its
gradient's norm in the image plane, its radius and opacity^(1/5) (LODGE, Eq. 6); SEEN, the number of the last
step that had it in its image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from . import adam
from .gaussians import Gaussians
from .rendering import Rendering

STEPS, SCORE, SEEN = range(3)
OPACITY_LOGIT = 10
"""Its column."""


def gather_gaussians(records: torch.Tensor, places: np.ndarray, terms: int) -> Gaussians:
    """The splats (M,) at places (M,) int64 of records (N, width), with so many harmonics: a copy."""
    shapes = (3,), (4,), (3,), (), (terms, 3)
    if records.device.type == "cpu":
        from .cpu.records import gather as gather_on_cpu

        parts = [torch.empty(len(places), *shape) for shape in shapes]
        gather_on_cpu(records.numpy(), places, [part.numpy() for part in parts])
        return Gaussians(*parts)
    count = 11 + 3 * terms
    values = records[:, :count].index_select(0, torch.from_numpy(places).to(records.device))
    parts = values.split([3, 4, 3, 1, 3 * terms], dim=1)
    return Gaussians(*(part.reshape(-1, *shape) for part, shape in zip(parts, shapes, strict=True)))


@torch.no_grad()
def adam_step(
    records: torch.Tensor,
    places: np.ndarray,
    gradients: Sequence[torch.Tensor],
    rendering: Rendering,
    number: int,
    lr: torch.Tensor,
    shares: torch.Tensor | None = None,
    betas: tuple[float, float] = adam.BETAS,
    eps: float = adam.EPS,
) -> None:
    """One step of Adam in place for those of some records that are in the image, by their radii.

    Each has a number of steps of its own; what is out of the image stays as it is, moments and all.

    Args:
        records: (N, width).
        places: (M,) int64 of those that move, each once.
        gradients: (M, ...) of their values, in the order of ``Gaussians``.
        rendering: of these splats, after ``backward``.
        number: of the step, from 1; no record has made more.
        lr: (C,) learning rates.
        shares: (M,) float32, each record's factor of them, 1 if None; those of share 0 stay as they are.
    """
    if not len(places):
        return
    shares = torch.ones(len(places), device=records.device) if shares is None else shares.to(records.device)
    if records.device.type == "cpu":
        from .cpu.records import step as step_on_cpu

        told = [each.contiguous().numpy() for each in (*gradients, rendering.grad2d)]
        *told, grad2d = told
        radii, rates = rendering.radii.numpy(), np.ascontiguousarray(lr.numpy(), np.float32)
        step_on_cpu(records.numpy(), places, told, grad2d, radii, number, rates, shares.numpy(), betas, eps)
        return
    seen = rendering.radii > 0
    at, count = torch.from_numpy(places).to(records.device)[seen], len(lr)
    some, shares = records[at], shares[seen]
    told = some[:, 3 * count :]
    score = (
        rendering.grad2d[seen].norm(dim=1) * rendering.radii[seen] * some[:, OPACITY_LOGIT].sigmoid() ** 0.2
    )
    told[:, SCORE] = torch.maximum(told[:, SCORE], score)
    told[:, SEEN] = float(number)
    moves = shares != 0
    moving, share = some[moves], shares[moves, None]
    moving[:, 3 * count + STEPS] += 1
    values, m, v = (moving[:, i * count : (i + 1) * count] for i in range(3))
    gradient = torch.cat([each.reshape(len(places), -1) for each in gradients], 1)[seen][moves]
    times = moving[:, 3 * count + STEPS, None].double()
    adam.update_in_torch(values, gradient, m, v, lr.to(share) * share, betas, eps, times)
    some[moves] = moving
    records[at] = some
