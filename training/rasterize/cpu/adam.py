"""The Adam update."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from .compile import STRICT, f32, in_parallel, inlined, kernel, serialised

ROW = 1024
VALUES = 1 << 16
"""How many a thread takes at a time."""
M_TINY = f32(1e-30)
V_TINY = f32(1e-36)


@inlined(STRICT)
def _moved(i, g, m, v, rate, keep_m, keep_v, scale_v, eps):
    """Updates the moments of a value and returns by how much it gets smaller."""
    first = keep_m * m[i] + (f32(1) - keep_m) * g
    second = keep_v * v[i] + (f32(1) - keep_v) * (g * g)
    first = first if abs(first) > M_TINY else f32(0)
    second = second if second > V_TINY else f32(0)
    m[i] = first
    v[i] = second
    return rate * first / (math.sqrt(second * scale_v) + eps)


@kernel(STRICT)
def _update(begin, end, parameter, gradient, m, v, lr, keep_m, keep_v, scale_v, eps):
    """All arrays flat; ``lr`` (width,) repeats along them and has the first moment's bias correction in it.

    Moments of splats that stay out of sight decay into denormal numbers, which are slow; they are cut off far
    below where they could matter (the root of V_TINY is a thousandth of 3DGS's eps).
    """
    width = lr.shape[0]
    total = parameter.shape[0]
    for row in range(begin, end):
        start = row * width
        for j in range(min(width, total - start)):
            i = start + j
            parameter[i] -= _moved(i, gradient[i], m, v, lr[j], keep_m, keep_v, scale_v, eps)


@kernel(STRICT)
def _update_rows(begin, end, parameter, rows, gradient, m, v, lr, keep_m, keep_v, scale_v, eps):
    """The same for ``rows`` of the flat arrays, of the gradient's ``lr.shape[0]`` values each."""
    width = lr.shape[0]
    for k in range(begin, end):
        start = rows[k] * width
        for j in range(width):
            i = start + j
            parameter[i] -= _moved(i, gradient[k * width + j], m, v, lr[j], keep_m, keep_v, scale_v, eps)


@kernel(STRICT)
def _update_records(
    begin, end, records, places, gradient, lr, steps, first, second, keep_m, keep_v, eps, width
):
    """The same for flat records of ``width`` numbers, at ``places``: values, moments, steps made."""
    count = lr.shape[0]
    m, v = records[count:], records[2 * count :]
    for k in range(begin, end):
        start = places[k] * width
        records[start + steps] += f32(1)
        made = int(records[start + steps])
        keep, scale_v = first[made], second[made]
        for j in range(count):
            i = start + j
            g = gradient[k * count + j]
            records[i] -= _moved(i, g, m, v, lr[j] / keep, keep_m, keep_v, scale_v, eps)


@lru_cache(4)
def _corrections(betas: tuple[float, float], count: int) -> tuple[np.ndarray, np.ndarray]:
    """1 - b1^t and 1 / (1 - b2^t), (count,) float32, for t from 0."""
    first, second = (1 - np.power(beta, np.arange(count)) for beta in betas)
    first[0] = second[0] = 1  # no step has number 0
    return first.astype(np.float32), (1 / second).astype(np.float32)


@serialised
def update_records(records, places, gradient, lr, steps, betas, eps, most) -> None:
    """One Adam step in place for records (N, width): values, both moments of each, and ``steps``.

    Args:
        records: values in the columns from 0 on, then first, then second moments.
        places: (M,) int64 of those that move, each once.
        gradient: (M, C) of the values.
        lr: (C,) learning rate of each value.
        steps: the column with the number of steps that a record has made.
        most: no record has made more.
    """
    count = gradient.shape[1]
    made = _corrections(betas, 1 << int(most + 1).bit_length())
    in_parallel(
        _update_records, len(places), max(VALUES // count, 1),
        records.reshape(-1), places, gradient.reshape(-1), lr, steps, *made,
        f32(betas[0]), f32(betas[1]), f32(eps), records.shape[1],
    )  # fmt: skip


@serialised
def update_rows(parameter, rows, gradient, m, v, lr, betas, eps, step) -> None:
    """One Adam step in place for ``rows`` (M,) int64; ``lr`` is a number or broadcasts against one row."""
    width = int(np.prod(parameter.shape[1:], dtype=int))
    rate = np.asarray(lr, np.float32) / np.float32(1 - betas[0] ** step)
    row = np.ascontiguousarray(np.broadcast_to(rate, parameter.shape[1:])).reshape(-1)
    in_parallel(
        _update_rows, len(rows), max(VALUES // width, 1),
        parameter.reshape(-1), rows, gradient.reshape(-1), m.reshape(-1), v.reshape(-1), row,
        f32(betas[0]), f32(betas[1]), f32(1 / (1 - betas[1] ** step)), f32(eps),
    )  # fmt: skip


@serialised
def update(parameter, gradient, m, v, lr, betas, eps, step) -> None:
    """One Adam step in place; ``lr`` is a number or broadcasts against one row of ``parameter``."""
    correction = 1 - betas[0] ** step
    lr = np.asarray(lr, np.float32) / np.float32(correction)
    if lr.size == 1:
        lr_row = np.full(ROW, lr.item(), np.float32)
    else:
        lr_row = np.ascontiguousarray(np.broadcast_to(lr, parameter.shape[1:])).reshape(-1)
    in_parallel(
        _update, -(-parameter.size // len(lr_row)), -(-VALUES // len(lr_row)),
        parameter.reshape(-1), gradient.reshape(-1), m.reshape(-1), v.reshape(-1), lr_row,
        f32(betas[0]), f32(betas[1]), f32(1 / (1 - betas[1] ** step)), f32(eps),
    )  # fmt: skip
