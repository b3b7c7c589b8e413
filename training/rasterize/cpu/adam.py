"""Kernels of the Adam update."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from .compile import STRICT, f32, inlined, kernel, run_parallel, serialized
from .lanes import WIDTH, load, magnitude, root, select, store

ROW = 1024
VALUES = 1 << 16
"""Values in a thread's unit of work."""
M_TINY = f32(1e-30)
V_TINY = f32(1e-36)


@inlined(STRICT)
def adam_change(i, g, m, v, rate, keep_m, keep_v, scale_v, eps):
    """Update the moments of a value; return the change to subtract from it."""
    first = keep_m * m[i] + (f32(1) - keep_m) * g
    second = keep_v * v[i] + (f32(1) - keep_v) * (g * g)
    first = first if abs(first) > M_TINY else f32(0)
    second = second if second > V_TINY else f32(0)
    m[i] = first
    v[i] = second
    return rate * first / (math.sqrt(second * scale_v) + eps)


@inlined(STRICT)
def adam_values(parameter, start, count, gradient, place, m, v, lr, keep_m, keep_v, scale_v, eps):
    """Update ``count`` values of flat arrays from ``start`` on; their gradient begins at ``place``.

    Args:
        lr: (count,) learning rates with the first moment's bias correction.
    """
    whole = count // WIDTH * WIDTH
    for j in range(0, whole, WIDTH):
        g = load(gradient, place + j)
        first = keep_m * load(m, start + j) + (f32(1) - keep_m) * g
        second = keep_v * load(v, start + j) + (f32(1) - keep_v) * (g * g)
        first = select(magnitude(first) > M_TINY, first, f32(0))
        second = select(second > V_TINY, second, f32(0))
        store(m, start + j, first)
        store(v, start + j, second)
        change = load(lr, j) * first / (root(second * scale_v) + eps)
        store(parameter, start + j, load(parameter, start + j) - change)
    for j in range(whole, count):
        i = start + j
        g = gradient[place + j]
        parameter[i] -= adam_change(i, g, m, v, lr[j], keep_m, keep_v, scale_v, eps)


@kernel(STRICT)
def _update(begin, end, parameter, gradient, m, v, lr, keep_m, keep_v, scale_v, eps):
    """Update flat arrays. ``lr`` (width,) repeats along them and includes the first moment's bias correction.

    Moments of splats that stay invisible would decay to denormal numbers, which are slow. They are set to
    zero far below relevant values: the root of V_TINY is a thousandth of 3DGS's eps.
    """
    width = lr.shape[0]
    total = parameter.shape[0]
    for row in range(begin, end):
        start = row * width
        count = min(width, total - start)
        adam_values(parameter, start, count, gradient, start, m, v, lr, keep_m, keep_v, scale_v, eps)


@kernel(STRICT)
def _decay_rows(begin, end, rows, parameter, m, v, lr, keep_m, keep_v, scale_v, eps):
    """Update ``rows`` of the flat arrays, whose gradients are zero."""
    width = lr.shape[0]
    zeros = np.zeros(width, np.float32)
    for k in range(begin, end):
        start = rows[k] * width
        adam_values(parameter, start, width, zeros, 0, m, v, lr, keep_m, keep_v, scale_v, eps)


@kernel(STRICT)
def _update_rows(begin, end, parameter, rows, gradient, m, v, lr, keep_m, keep_v, scale_v, eps):
    """Update ``rows`` of the flat arrays; a row has ``lr.shape[0]`` values."""
    width = lr.shape[0]
    for k in range(begin, end):
        start = rows[k] * width
        adam_values(parameter, start, width, gradient, k * width, m, v, lr, keep_m, keep_v, scale_v, eps)


def rate_rows(
    lr: ArrayLike, shape: tuple[int, ...], betas: tuple[float, float], step: int, count: int
) -> np.ndarray:
    """Return the rates of ``count`` rows of this shape, flat, with the first moment's bias correction."""
    rate = np.asarray(lr, np.float32) / np.float32(1 - betas[0] ** step)
    if rate.ndim == 0:
        return np.full(math.prod(shape) * count, rate)
    return np.tile(np.broadcast_to(rate, shape).reshape(-1), count)


def step_arguments(
    parameter: np.ndarray,
    m: ArrayLike,
    v: ArrayLike,
    lr: ArrayLike,
    betas: tuple[float, float],
    eps: float,
    step: int,
) -> tuple:
    """Return arguments of :func:`adam_values`: flat arrays, the rates of one row, and constants."""
    flat = [np.asarray(array).reshape(-1) for array in (parameter, m, v)]
    constants = f32(betas[0]), f32(betas[1]), f32(1 / (1 - betas[1] ** step)), f32(eps)
    return *flat, rate_rows(lr, parameter.shape[1:], betas, step, 1), *constants


def repeat_rates(arguments: tuple, count: int) -> tuple:
    """Return the result of :func:`step_arguments` with rates of ``count`` rows."""
    return *arguments[:3], np.tile(arguments[3], count), *arguments[4:]


@serialized
def decay_rows(rows: np.ndarray, arguments: tuple) -> None:
    """Make one Adam step in place for ``rows`` (M,) int64, whose gradients are zero.

    Args:
        arguments: see :func:`step_arguments`.
    """
    run_parallel(_decay_rows, len(rows), max(VALUES // len(arguments[3]), 1), rows, *arguments)


@serialized
def update_rows(
    parameter: np.ndarray,
    rows: np.ndarray,
    gradient: np.ndarray,
    m: np.ndarray,
    v: np.ndarray,
    lr: ArrayLike,
    betas: tuple[float, float],
    eps: float,
    step: int,
) -> None:
    """Make one Adam step in place for ``rows`` (M,) int64; ``lr`` is a number or broadcasts against one
    row."""
    values, *arguments = step_arguments(parameter, m, v, lr, betas, eps, step)
    grain = max(VALUES // len(arguments[2]), 1)
    run_parallel(_update_rows, len(rows), grain, values, rows, gradient.reshape(-1), *arguments)


@serialized
def update(
    parameter: np.ndarray,
    gradient: np.ndarray,
    m: np.ndarray,
    v: np.ndarray,
    lr: ArrayLike,
    betas: tuple[float, float],
    eps: float,
    step: int,
) -> None:
    """Make one Adam step in place.

    Args:
        parameter, gradient, m, v: (N, ...) float32 each: values, gradients, and first and second moments.
        lr: learning rate, a number or an array that broadcasts against one row of ``parameter``.
        betas: decay of the first and the second moment.
        eps: number added to the root of the second moment.
        step: number of the step, from 1, for the correction of bias.
    """
    if not parameter.size:
        return
    width = parameter.size // len(parameter)
    lr_row = rate_rows(lr, parameter.shape[1:], betas, step, max(ROW // width, 1))
    run_parallel(
        _update, -(-parameter.size // len(lr_row)), -(-VALUES // len(lr_row)),
        parameter.reshape(-1), gradient.reshape(-1), m.reshape(-1), v.reshape(-1), lr_row,
        f32(betas[0]), f32(betas[1]), f32(1 / (1 - betas[1] ** step)), f32(eps),
    )  # fmt: skip
