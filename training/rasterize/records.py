"""Splats in records, one after the other, with Adam's moments and what density control asks for.

A record holds C values (means, quaternions, log-scales, opacity logits, harmonics), their first and their
second moments, and from column 3 C on: STEPS, how many steps it has made; SCORE, the largest of those that it
has been given; SEEN, the number of the last step that had it in its image, 0 for none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from . import adam
from .gaussians import Gaussians

STEPS, SCORE, SEEN = range(3)


def gather(records: torch.Tensor, places: np.ndarray, terms: int) -> Gaussians:
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
def step(
    records: torch.Tensor,
    places: np.ndarray,
    gradients: Sequence[torch.Tensor],
    score: torch.Tensor,
    seen: torch.Tensor,
    number: int,
    lr: torch.Tensor,
    betas: tuple[float, float] = adam.BETAS,
    eps: float = adam.EPS,
) -> None:
    """One step of Adam in place for some records, each with the number of steps of its own.

    Args:
        records: (N, width).
        places: (M,) int64 of those that move, each once.
        gradients: (M, ...) of their values, in the order of ``Gaussians``.
        score: (M,).
        seen: (M,) bool.
        number: of the step, from 1; no record has made more.
        lr: (C,) learning rates.
    """
    if not len(places):
        return
    if records.device.type == "cpu":
        from .cpu.records import step as step_on_cpu

        arrays = [each.contiguous().numpy() for each in gradients]
        rates = np.ascontiguousarray(lr.numpy(), np.float32)
        step_on_cpu(records.numpy(), places, arrays, score.numpy(), seen.numpy(), number, rates, betas, eps)
        return
    at, count = torch.from_numpy(places).to(records.device), len(lr)
    some = records[at]
    values, m, v = (some[:, i * count : (i + 1) * count] for i in range(3))
    told = some[:, 3 * count :]
    told[:, STEPS] += 1
    gradient = torch.cat([each.reshape(len(places), -1) for each in gradients], 1)
    adam.update_in_torch(values, gradient, m, v, lr, betas, eps, told[:, STEPS, None].double())
    told[:, SCORE] = torch.maximum(told[:, SCORE], score)
    told[:, SEEN] = torch.where(seen, float(number), told[:, SEEN])
    records[at] = some
