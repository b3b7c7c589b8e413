"""Compare binning, tile rows and exp2 of the cpu backend with float64 computations."""

import math
import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from training.rasterize.cpu.bin import TILE, bin_splats
from training.rasterize.cpu.blend import GROUP, REACHED, find_rows, first_alphas
from training.rasterize.cpu.compile import Buffers, numba
from training.rasterize.cpu.fastmath import exp2
from training.rasterize.cpu.lanes import WIDTH, ramp, spread, store
from training.rasterize.cpu.project import (
    COLUMNS,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    FALLOFF,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG2_OPACITY,
    RISE,
    SLOPE,
    X_OF_TOP,
    strip_rows,
)


def test_tiles_list_all_touching_splats_once_front_to_back():
    """Compare with a test of all pixels in float64."""
    random = np.random.default_rng(3)
    count, width, height = 400, 100, 60
    projected = np.zeros((count, COLUMNS), np.float32)
    mean = random.uniform((-20, -20), (120, 80), (count, 2))
    axis, angle = np.exp(random.uniform(0, 3.5, (count, 2))), random.uniform(0, np.pi, count)
    cos, sin = np.cos(angle), np.sin(angle)
    xx = (axis[:, 0] * cos) ** 2 + (axis[:, 1] * sin) ** 2
    yy = (axis[:, 0] * sin) ** 2 + (axis[:, 1] * cos) ** 2
    xy = (axis[:, 0] ** 2 - axis[:, 1] ** 2) * cos * sin
    opacity = random.uniform(0.01, 1, count)
    unit = math.log2(math.e) / (xx * yy - xy**2)
    reach = np.sqrt(2 * np.log(255 * opacity))
    projected[:, :2] = mean
    projected[:, CONIC_XX], projected[:, CONIC_XY], projected[:, CONIC_YY] = (
        unit * yy / 2,
        -unit * xy,
        unit * xx / 2,
    )
    projected[:, LOG2_OPACITY] = np.log2(opacity)
    projected[:, HALF_WIDTH], projected[:, HALF_HEIGHT] = reach * np.sqrt(xx), reach * np.sqrt(yy)
    projected[:, SLOPE], projected[:, RISE] = xy / xx, reach * np.sqrt((xx * yy - xy**2) / xx)
    projected[:, X_OF_TOP] = xy / yy * projected[:, HALF_HEIGHT]
    depth = random.uniform(1, 9, count).astype(np.float32)
    radii = np.ones(count, np.float32)
    radii[::9] = 0
    drawn = np.flatnonzero(radii).astype(np.int32)
    pairs = bin_splats(projected, drawn, depth[drawn], width, height, Buffers())

    row = projected.astype(np.float64)[:, :, None, None]
    dx = np.arange(112) + 0.5 - row[:, 0]
    dy = (np.arange(64) + 0.5)[:, None] - row[:, 1]
    log2_alpha = (
        row[:, LOG2_OPACITY]
        - row[:, CONIC_XX] * dx**2
        - row[:, CONIC_XY] * dx * dy
        - row[:, CONIC_YY] * dy**2
    )
    visible = (log2_alpha >= math.log2(1 / 255)) & (radii > 0)[:, None, None]
    expected = visible.reshape(count, 4, TILE, 7, TILE).any((2, 4)).reshape(count, 28)
    listed = np.zeros((count, 28), int)
    for tile in range(28):
        splats = pairs.splat[pairs.tile_start[tile] : pairs.tile_start[tile + 1]]
        np.add.at(listed[:, tile], splats, 1)
        assert (np.diff(depth[splats]) >= 0).all()
    assert listed.max() == 1
    assert (listed[expected] == 1).all()
    # additional splats lie between pixel centres
    assert listed.sum() <= 1.15 * expected.sum()
    assert (listed.sum(1) == pairs.count).all()
    for i in np.flatnonzero(pairs.count):
        assert (pairs.splat[pairs.row[pairs.first[i] : pairs.first[i] + pairs.count[i]]] == i).all()


def ellipses(count, random, largest):
    """Return random projected splats, and their covariances and reaches in float64."""
    angle, axes = random.uniform(0, np.pi, count), np.exp(random.uniform(-0.5, math.log(largest), (2, count)))
    cos, sin = np.cos(angle), np.sin(angle)
    xx, yy = (axes[0] * cos) ** 2 + (axes[1] * sin) ** 2, (axes[0] * sin) ** 2 + (axes[1] * cos) ** 2
    xy = (axes[0] ** 2 - axes[1] ** 2) * cos * sin
    reach = random.uniform(0.3, 3.3, count)
    projected = np.zeros((count, COLUMNS), np.float32)
    projected[:, HALF_WIDTH], projected[:, HALF_HEIGHT] = reach * np.sqrt(xx), reach * np.sqrt(yy)
    projected[:, SLOPE], projected[:, RISE] = xy / xx, reach * axes[0] * axes[1] / np.sqrt(xx)
    projected[:, X_OF_TOP] = xy / yy * projected[:, HALF_HEIGHT]
    return projected, np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1), reach


@numba.njit
def rows_of_splats(projected):
    return [strip_rows(row, np.float32(0.5), np.float32(15), np.float32(0.5), 16) for row in projected]


def test_tile_rows_cover_the_ellipse_tightly():
    """Compare with all 256 pixel centres in float64."""
    random = np.random.default_rng(4)
    projected, covariance, reach = ellipses(3000, random, 30.0)
    projected[:, :2] = random.uniform(-15, 31, (3000, 2))
    rows = np.array(rows_of_splats(projected))
    centres = np.stack(np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5), -1)
    offset = centres - projected[:, None, None, :2].astype(np.float64)
    squared = np.einsum("nyxi,nij,nyxj->nyx", offset, np.linalg.inv(covariance), offset)
    inside = (squared <= (reach**2)[:, None, None]).any(2)
    assert 0.2 < inside.any(1).mean() < 0.9
    listed = (np.arange(16) >= rows[:, :1]) & (np.arange(16) < rows[:, 1:])
    assert listed[inside].all()
    # additional rows are those where the ellipse passes between pixel centres
    assert listed.sum() < 1.1 * inside.sum()


def test_tile_rows_stay_in_the_tile_despite_rounding():
    """Kernels write to these rows; for means and reaches of 1e9 pixels, rounding errors exceed a row."""
    random = np.random.default_rng(0)
    projected, _, _ = ellipses(3000, random, 1e9)
    half = projected[:, [HALF_WIDTH, HALF_HEIGHT]]
    projected[:, :2] = random.choice([-1, 1], (3000, 2)) * half * random.choice([0, 0.5, 1], (3000, 2))
    rows = np.array(rows_of_splats(projected))
    assert rows[:, 0].min() == 0 and rows[:, 0].max() == 16 and rows[:, 1].max() == 16
    assert (rows[:, 0] <= rows[:, 1]).all()


def test_exp2_accuracy():
    @numba.njit
    def exp2_array(xs):
        return np.array([exp2(x) for x in xs])

    xs = np.linspace(-29.9, 20, 5000).astype(np.float32)
    np.testing.assert_allclose(exp2_array(xs), np.exp2(xs.astype(np.float64)), rtol=4e-7)


@numba.njit
def alphas_of_rows(projected, left, alphas):
    """Fill alphas (N, 16, WIDTH) row by row, and return the smallest number on the way."""
    shapes, reached = np.empty((7, WIDTH), np.float32), np.zeros((REACHED, len(projected)), np.uint8)
    splats = np.arange(len(projected), dtype=np.int32)
    find_rows(projected, splats, 0, len(splats), np.float32(0.5), np.float32(0.5), 16, shapes, reached)
    smallest = np.inf
    for i in range(len(projected)):
        row = projected[i]
        dx = ramp() + (left - row[0])
        constant, slope = row[LOG2_OPACITY] - row[CONIC_XX] * dx * dx, row[CONIC_XY] * dx
        for r in range(16):
            if r % reached[GROUP, i] == 0:
                dy = spread(np.float32(r) + np.float32(0.5) - row[1])
                alpha, ratio = first_alphas(constant, slope, row[CONIC_YY], dy)
            store(alphas[i, r], 0, ratio)
            smallest = min(smallest, alphas[i, r].min())
            store(alphas[i, r], 0, alpha)
            smallest = min(smallest, alphas[i, r].min())
            alpha, ratio = alpha * ratio, ratio * row[FALLOFF]
    return smallest


def test_alphas_of_successive_rows():
    """Compare with the exponential in float64, for steep to flat ellipses; no number becomes denormal."""
    random = np.random.default_rng(5)
    count = 3000
    projected, covariance, _ = ellipses(count, random, 60.0)
    conic = np.linalg.inv(covariance + 0.1 * np.eye(2)) * math.log2(math.e) / 2
    projected[:, :2] = random.uniform(-30, 46, (count, 2))
    projected[:, CONIC_XX], projected[:, CONIC_YY] = conic[:, 0, 0], conic[:, 1, 1]
    projected[:, CONIC_XY], projected[:, LOG2_OPACITY] = 2 * conic[:, 0, 1], random.uniform(-7, 0, count)
    projected[:, FALLOFF] = np.exp2(-2 * projected[:, CONIC_YY].astype(np.float64))
    actual = np.empty((count, 16, WIDTH), np.float32)
    assert alphas_of_rows(projected, np.float32(0.5), actual) > np.finfo(np.float32).tiny
    row = projected.astype(np.float64)[:, :, None, None]
    dx, dy = np.arange(WIDTH) + 0.5 - row[:, 0], np.arange(16)[:, None] + 0.5 - row[:, 1]
    expected = np.exp2(
        row[:, LOG2_OPACITY]
        - row[:, CONIC_XX] * dx**2
        - row[:, CONIC_XY] * dx * dy
        - row[:, CONIC_YY] * dy**2
    )
    visible = expected >= 1 / 255
    assert 0.01 < visible.mean() < 0.5
    np.testing.assert_allclose(actual[visible], expected[visible], rtol=2e-4)  # terms of needles cancel
    assert actual[expected < 0.999 / 255].max() < 1 / 255


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="compiles for AVX-512")
def test_avx512_kernels_read_and_write_whole_vectors(tmp_path):
    """LLVM gathers single values if it cannot prove that an index is positive.

    Blending gathers only the bounds of pairs, whose splats are in no order, once for 16 pairs.
    """
    program = """
import re
from functools import partial
from training import rasterize
from training.rasterize.cpu import compile
for kernel, arguments in compile._kernels_of(partial(rasterize._step, "cpu")).items():
    if kernel.py_func.__name__ in ("blend_forward", "blend_backward", "compare"):
        kernel.compile(tuple(map(compile.numba.typeof, arguments)))
        (code,) = kernel.inspect_asm().values()
        print(kernel.py_func.__name__, "zmm" in code, len(re.findall("v(?:gather|scatter)", code)))
"""
    features = "+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+avx512f,+avx512bw,+avx512cd,+avx512dq,+avx512vl"
    environment = os.environ | {
        "NUMBA_CPU_NAME": "znver4", "NUMBA_CPU_FEATURES": features, "NUMBA_CACHE_DIR": str(tmp_path)
    }  # fmt: skip
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    assert sorted(result.stdout.splitlines()) == [
        "blend_backward True 0",
        "blend_forward True 4",
        "compare True 0",
    ]
