"""Paint lies over splats as a formula by hand has it, and goes by place to others."""

from dataclasses import replace

import numpy as np
import pytest

from tests.training.editing.test_cleaning import bundle_of
from training.editing.cleaning import Cleaning
from training.editing.edit import edit
from training.editing.look import Look, apply_looks
from training.editing.paint import (
    COLUMNS,
    apply_paint,
    blend_paint,
    mix_paint,
    paint_columns,
    read_paint,
    transfer_paint,
)
from training.splats.bundle import read_bundle, write_bundle
from training.splats.ply import read_ply
from training.splats.sh import basis

RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.3, 0.8)


def seen(sh, direction):
    """(N, 3) float64 colours from a direction."""
    values = [0.0] * sh.shape[1]
    x, y, z = direction
    basis(x, y, z, round(sh.shape[1] ** 0.5) - 1, values)
    return 0.5 + np.einsum("k,nkc->nc", np.array(values, float), sh.astype(np.float64))


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_strokes_mix_colours_from_everywhere_one_after_the_other(degree):
    rng = np.random.default_rng(degree)
    sh = rng.normal(0, 0.4, (200, (degree + 1) ** 2, 3)).astype(np.float32)
    first, second, gone = rng.uniform(0, 1, (3, 200)).astype(np.float32)
    paint = blend_paint(
        blend_paint(blend_paint(np.zeros((200, 4), np.float32), first, RED), second, BLUE), gone, None
    )
    found = mix_paint(sh, paint)
    for direction in rng.normal(size=(5, 3)):
        direction /= np.linalg.norm(direction)
        own = seen(sh, direction)
        wanted = own.copy()
        for share, color in ((first, RED), (second, BLUE)):
            wanted = (1 - share[:, None]) * wanted + share[:, None] * np.array(color)
        wanted = (1 - gone[:, None]) * wanted + gone[:, None] * own
        np.testing.assert_allclose(seen(found, direction), wanted, atol=2e-5)


def test_paint_is_columns_that_looks_act_upon_and_mixing_takes_away():
    splats = bundle_of("bands", np.random.default_rng(1)).levels[2].splats
    share = np.random.default_rng(2).uniform(0, 1, len(splats)).astype(np.float32)
    paint = blend_paint(np.zeros((len(splats), 4), np.float32), share, RED)
    there = replace(splats, extras=splats.extras | paint_columns(paint))
    found = read_paint(there.extras)
    assert found is not None
    np.testing.assert_array_equal(found, paint)
    look = Look(0.5, 5000, (1.0, 0.8, 0.9), 0.4)
    found = apply_looks(there, [(None, look)])
    assert found.extras.keys() == splats.extras.keys()
    direction = (0.6, 0.0, 0.8)
    wanted = (1 - share[:, None]) * seen(splats.sh, direction) + share[:, None] * np.array(RED)
    np.testing.assert_allclose(seen(found.sh, direction), wanted @ look.matrix.T, atol=2e-5)
    assert apply_paint(splats) is splats


def test_others_take_paint_over_from_where_they_are():
    """From a painted half and a small patch in the other; of some that are far from everything, none."""
    rng = np.random.default_rng(4)
    means = rng.uniform(-5, 5, (20_000, 3)).astype(np.float32)
    patch = np.linalg.norm(means - (-3, 0, 0), axis=1) < 2.5
    paint = np.zeros((len(means), 4), np.float32)
    paint = blend_paint(paint, (means[:, 0] > 0).astype(np.float32), RED)
    paint = blend_paint(paint, 0.5 * patch.astype(np.float32), BLUE)
    to = np.concatenate([rng.uniform(-4, 4, (3000, 3)), rng.uniform(50, 60, (100, 3))]).astype(np.float32)
    found, clear = transfer_paint(paint, means, to), 1.2  # as long as the largest cells are
    away, far = np.linalg.norm(to - (-3, 0, 0), axis=1), to[:, 0] > 20
    in_half, in_patch = (to[:, 0] > clear) & ~far, away < 2.5 - clear
    nowhere = ((to[:, 0] < -clear) & (away > 2.5 + clear)) | far
    assert min(in_half.sum(), in_patch.sum(), nowhere.sum()) > 5
    np.testing.assert_allclose(found[in_half], np.tile([*RED, 1], (in_half.sum(), 1)), atol=1e-5)
    half = [*(0.5 * np.array(BLUE)), 0.5]
    np.testing.assert_allclose(found[in_patch], np.tile(half, (in_patch.sum(), 1)), atol=1e-5)
    assert not found[nowhere].any()
    # who is exactly where one was takes over just its paint, where nobody else is as near
    few = np.arange(0, len(means), 400)
    np.testing.assert_allclose(transfer_paint(paint[few], means[few], means[few]), paint[few], atol=1e-6)


def test_lodgs_edit_writes_what_is_painted_mixed_in(tmp_path):
    bundle = bundle_of("bands", np.random.default_rng(3))
    for level in bundle.levels:
        share = (level.splats.means[:, 0] > 0).astype(np.float32)
        level.splats.extras |= paint_columns(blend_paint(np.zeros((len(share), 4), np.float32), share, RED))
    write_bundle(tmp_path / "in.ply", bundle)
    back = read_bundle(tmp_path / "in.ply")
    assert all(set(COLUMNS) <= level.splats.extras.keys() for level in back.levels)
    edit(tmp_path / "in.ply", tmp_path / "out.ply", Cleaning(), plain=[tmp_path / "plain.ply"])
    found = read_bundle(tmp_path / "out.ply")
    for level, was in zip(found.levels, bundle.levels, strict=True):
        assert not set(COLUMNS) & level.splats.extras.keys()
        own, there = seen(was.splats.sh, (0, 0, 1)), seen(level.splats.sh, (0, 0, 1))
        half = was.splats.means[:, 0] > 0
        np.testing.assert_allclose(there[half], np.tile(RED, (half.sum(), 1)), atol=1e-5)
        np.testing.assert_allclose(there[~half], own[~half], atol=1e-6)
    np.testing.assert_array_equal(read_ply(tmp_path / "plain.ply").sh, found.levels[-1].splats.sh)
