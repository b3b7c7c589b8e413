"""Compare vectors in kernels with numpy in float64."""

import numpy as np

from training.rasterize.cpu.compile import numba
from training.rasterize.cpu.fastmath import exp2_lanes, exp_lanes, log2_lanes
from training.rasterize.cpu.lanes import (
    WIDTH,
    any_of,
    exponent,
    floor,
    larger,
    load,
    load_row,
    magnitude,
    ramp,
    root,
    select,
    smaller,
    spread,
    store,
    store_totals,
    total,
)


@numba.njit
def apply_functions(xs, ys, out):
    x, y = load(xs, 0), load(ys, 0)
    store(out[0], 0, (x + y) * x - y / np.float32(3))
    store(out[1], 0, select((x > y) & (x >= np.float32(0)), smaller(x, y), magnitude(x)))
    store(out[2], 0, larger(root(magnitude(x)), floor(y)))
    store(out[3], 0, exp2_lanes(x) + ramp() * spread(np.float32(2)))
    return total(x), any_of(x > np.float32(4)), any_of(x > np.float32(6))


@numba.njit
def sum_rows(rows, sums):
    store_totals(
        sums, 1, load(rows[0], 0), load(rows[1], 0), load(rows[2], 0), load(rows[3], 0), load(rows[4], 0),
        load(rows[5], 0), load(rows[6], 0), load(rows[7], 0),
    )  # fmt: skip


def test_functions_apply_to_every_lane():
    random = np.random.default_rng(0)
    x, y = random.uniform(-5, 3, (2, WIDTH)).astype(np.float32)
    x[2] = 5
    out = np.zeros((4, WIDTH), np.float32)
    summed, over_four, over_six = apply_functions(x, y, out)
    wide_x, wide_y = x.astype(np.float64), y.astype(np.float64)
    expected = [
        (wide_x + wide_y) * wide_x - wide_y / 3,
        np.where((x > y) & (x >= 0), np.minimum(x, y), np.abs(x)),
        np.maximum(np.sqrt(np.abs(wide_x)), np.floor(y)),
        np.exp2(wide_x) + 2 * np.arange(WIDTH),
    ]
    np.testing.assert_allclose(out, expected, rtol=5e-6, atol=5e-6)
    np.testing.assert_allclose(summed, wide_x.sum(), rtol=1e-5)
    assert over_four and not over_six


def test_totals_of_eight_vectors():
    rows = np.random.default_rng(1).normal(size=(8, WIDTH)).astype(np.float32)
    sums = np.full(10, 7, np.float32)
    sum_rows(rows, sums)
    np.testing.assert_allclose(sums[1:9], rows.sum(1, dtype=np.float64), rtol=1e-5, atol=1e-6)
    assert sums[0] == sums[9] == 7


@numba.njit
def apply_to_rows(values, rows):
    value = load_row(values, 1)
    rows[0] = exponent(value)
    rows[1] = log2_lanes(value)
    rows[2] = exp_lanes(load_row(values, 0))
    rows[3] = -value
    rows[4] = np.float32(7)


def test_logarithms_exponentials_and_rows():
    random = np.random.default_rng(1)
    values = np.stack([random.uniform(-80, 80, WIDTH), 2.0 ** random.uniform(-100, 100, WIDTH)])
    values[1, :4] = 1, 1 + 2**-20, 1.4999, 1.5
    values = values.astype(np.float32)
    rows = np.zeros((5, WIDTH), np.float32)
    apply_to_rows(values, rows)
    exponents, positive = values.astype(np.float64)
    np.testing.assert_array_equal(rows[0], np.floor(np.log2(positive)))
    np.testing.assert_allclose(rows[1], np.log2(positive), rtol=3e-7, atol=1e-9)
    np.testing.assert_allclose(rows[2], np.exp(exponents), rtol=1e-5)
    np.testing.assert_array_equal(rows[3], -values[1])
    np.testing.assert_array_equal(rows[4], 7)


def test_exponentials_are_clamped_to_normal_numbers():
    values = np.full((2, WIDTH), 1, np.float32)
    values[0, 0], values[0, 1] = -1000, 1000
    rows = np.zeros((5, WIDTH), np.float32)
    apply_to_rows(values, rows)
    assert rows[2, 0] == 2.0**-126 and rows[2, 1] == 2.0**126
