"""Kernels that gather and update records of splats; see ``rasterize.records``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from .adam import adam_change
from .compile import STRICT, f32, inlined, kernel, run_parallel, serialized

_GRAIN = 1 << 12


@kernel(STRICT)
def _gather(begin, end, records, width, indices, means, quats, log_scales, opacity_logits, sh):
    terms = sh.shape[1]
    for k in range(begin, end):
        i = indices[k] * width
        for j in range(3):
            means[k, j] = records[i + j]
            log_scales[k, j] = records[i + 7 + j]
        for j in range(4):
            quats[k, j] = records[i + 3 + j]
        opacity_logits[k] = records[i + 10]
        for j in range(terms):
            sh[k, j] = records[i + 11 + j]


@inlined(STRICT)
def _move(records, first, count, extent, gradient, place, lr, keep, keep_m, keep_v, scale_v, eps):
    """Update ``extent`` values of a record from ``first`` on; their gradient begins at ``place``."""
    m, v = records[count:], records[2 * count :]
    for j in range(extent):
        g = gradient[place + j]
        records[first + j] -= adam_change(first + j, g, m, v, lr[j] / keep, keep_m, keep_v, scale_v, eps)


@kernel(STRICT)
def _step(
    begin, end, records, width, indices, means, quats, log_scales, opacity_logits, sh, grad2d, radii, number,
    lr, shares, bias_m, bias_v, keep_m, keep_v, eps,
):  # fmt: skip
    """Update the visible records of ``indices[begin:end]``; all arrays are flat."""
    count = lr.shape[0]
    terms = count - 11
    for k in range(begin, end):
        if radii[k] <= 0:
            continue
        i = indices[k] * width
        stats = i + 3 * count
        x, y = grad2d[2 * k], grad2d[2 * k + 1]
        opacity = 1 / (1 + np.exp(-records[i + 10]))
        score = np.sqrt(x * x + y * y) * radii[k] * opacity ** f32(0.2)
        records[stats + 1] = max(records[stats + 1], score)
        records[stats + 2] = number
        if shares[k] == 0:
            continue
        records[stats] += f32(1)
        steps = int(records[stats])
        keep, scale_v = bias_m[steps] / shares[k], bias_v[steps]
        constants = keep, keep_m, keep_v, scale_v, eps
        _move(records, i, count, 3, means, 3 * k, lr, *constants)
        _move(records, i + 3, count, 4, quats, 4 * k, lr[3:], *constants)
        _move(records, i + 7, count, 3, log_scales, 3 * k, lr[7:], *constants)
        _move(records, i + 10, count, 1, opacity_logits, k, lr[10:], *constants)
        _move(records, i + 11, count, terms, sh, terms * k, lr[11:], *constants)


@lru_cache(4)
def _corrections(betas: tuple[float, float], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 - b1^t and 1 / (1 - b2^t), (count,) float32, for t from 0; entry 0 is unused."""
    first, second = (1 - np.power(beta, np.arange(count)) for beta in betas)
    first[0] = second[0] = 1
    return first.astype(np.float32), (1 / second).astype(np.float32)


def gather(records: np.ndarray, indices: np.ndarray, arrays: Sequence[np.ndarray]) -> None:
    """Copy the values of records (N, width) at ``indices`` (M,) int64 to arrays (M, ...)."""
    *arrays, sh = arrays
    sh = sh.reshape(len(indices), 3 * sh.shape[1])
    run_parallel(_gather, len(indices), _GRAIN, records.reshape(-1), records.shape[1], indices, *arrays, sh)


@serialized
def step(
    records: np.ndarray,
    indices: np.ndarray,
    gradients: Sequence[np.ndarray],
    grad2d: np.ndarray,
    radii: np.ndarray,
    number: int,
    lr: np.ndarray,
    shares: np.ndarray,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Make one Adam step on arrays; see ``rasterize.records.adam_step``."""
    corrections = _corrections(betas, 1 << int(number + 1).bit_length())
    flat = (array.reshape(-1) for array in (*gradients, grad2d))
    run_parallel(
        _step, len(indices), _GRAIN, records.reshape(-1), records.shape[1], indices, *flat, radii,
        f32(number), lr, shares, *corrections, f32(betas[0]), f32(betas[1]), f32(eps),
    )  # fmt: skip
