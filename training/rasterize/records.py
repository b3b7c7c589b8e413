"""Splats stored as records of parameters, Adam moments and density statistics.

A record holds C values (mean, quaternion, log-scales, opacity logit, harmonics), their first and their second
moments, and three statistics at columns 3 C + STEPS, SCORE and LAST_STEP: the number of the record's steps,
the maximum of gradient norm in the image plane times radius times opacity^(1/5) (LODGE, Eq. 6), and the
number of the last step in which the splat was visible.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from . import adam
from .gaussians import Gaussians
from .rendering import Rendering

STEPS, SCORE, LAST_STEP = range(3)
OPACITY_LOGIT = 10
"""Column of the opacity logit."""


def gather_gaussians(records: torch.Tensor, indices: np.ndarray, terms: int) -> Gaussians:
    """Copy the splats at ``indices`` (M,) int64 of records (N, width), with ``terms`` harmonics."""
    shapes = (3,), (4,), (3,), (), (terms, 3)
    if records.device.type == "cpu":
        from .cpu.records import gather as gather_on_cpu

        parts = [torch.empty(len(indices), *shape) for shape in shapes]
        gather_on_cpu(records.numpy(), indices, [part.numpy() for part in parts])
        return Gaussians(*parts)
    count = 11 + 3 * terms
    values = records[:, :count].index_select(0, torch.from_numpy(indices).to(records.device))
    parts = values.split([3, 4, 3, 1, 3 * terms], dim=1)
    return Gaussians(*(part.reshape(-1, *shape) for part, shape in zip(parts, shapes, strict=True)))


@torch.no_grad()
def adam_step(
    records: torch.Tensor,
    indices: np.ndarray,
    gradients: Sequence[torch.Tensor],
    rendering: Rendering,
    number: int,
    lr: torch.Tensor,
    shares: torch.Tensor | None = None,
    betas: tuple[float, float] = adam.BETAS,
    eps: float = adam.EPS,
) -> None:
    """Make one Adam step in place for the visible records among ``indices``, i.e. those with positive radii.

    Every record counts its own steps. Invisible records keep their values and moments.

    Args:
        records: (N, width).
        indices: (M,) int64, of the records to update; none occurs twice.
        gradients: (M, ...) gradients of their values, in the order of ``Gaussians``.
        rendering: rendering of these splats, after ``backward``.
        number: number of the step, from 1; at least the step count of every record.
        lr: (C,) learning rates.
        shares: (M,) float32, factor of the learning rates for each record; None means 1. Records of share 0
            keep their values and moments.
    """
    if not len(indices):
        return
    shares = torch.ones(len(indices), device=records.device) if shares is None else shares.to(records.device)
    if records.device.type == "cpu":
        from .cpu.records import step as step_on_cpu

        *arrays, grad2d = [tensor.contiguous().numpy() for tensor in (*gradients, rendering.grad2d)]
        radii = rendering.radii.numpy()
        rates = np.ascontiguousarray(lr.numpy(), np.float32)
        step_on_cpu(
            records.numpy(), indices, arrays, grad2d, radii, number, rates, shares.numpy(), betas, eps
        )
        return
    count = len(lr)
    visible = rendering.radii > 0
    index = torch.from_numpy(indices).to(records.device)[visible]
    rows = records[index]
    shares = shares[visible]
    stats = rows[:, 3 * count :]
    norm = rendering.grad2d[visible].norm(dim=1)
    score = norm * rendering.radii[visible] * rows[:, OPACITY_LOGIT].sigmoid() ** 0.2
    stats[:, SCORE] = torch.maximum(stats[:, SCORE], score)
    stats[:, LAST_STEP] = float(number)
    active = shares != 0
    moving = rows[active]
    share = shares[active, None]
    moving[:, 3 * count + STEPS] += 1
    values, m, v = (moving[:, i * count : (i + 1) * count] for i in range(3))
    gradient = torch.cat([tensor.reshape(len(indices), -1) for tensor in gradients], 1)[visible][active]
    steps = moving[:, 3 * count + STEPS, None].double()
    adam.update_in_torch(values, gradient, m, v, lr.to(share) * share, betas, eps, steps)
    rows[active] = moving
    records[index] = rows
