"""Paint: mixing formula by hand, and transfer to other splats by position."""

from dataclasses import replace

import numpy as np
import pytest

from tests.training.editing.test_cleaning import bundle_of
from training.editing.edit import Outputs, edit
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


def view_colors(sh, direction):
    """Return colours (N, 3) float64 from a direction."""
    values = [0.0] * sh.shape[1]
    x, y, z = direction
    basis(x, y, z, round(sh.shape[1] ** 0.5) - 1, values)
    return 0.5 + np.einsum("k,nkc->nc", np.array(values, float), sh.astype(np.float64))


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_strokes_mix_colours_in_order(degree):
    rng = np.random.default_rng(degree)
    sh = rng.normal(0, 0.4, (200, (degree + 1) ** 2, 3)).astype(np.float32)
    first, second, erased = rng.uniform(0, 1, (3, 200)).astype(np.float32)
    paint = blend_paint(
        blend_paint(blend_paint(np.zeros((200, 4), np.float32), first, RED), second, BLUE), erased, None
    )
    result = mix_paint(sh, paint)
    for direction in rng.normal(size=(5, 3)):
        direction /= np.linalg.norm(direction)
        trained = view_colors(sh, direction)
        expected = trained.copy()
        for share, color in ((first, RED), (second, BLUE)):
            expected = (1 - share[:, None]) * expected + share[:, None] * np.array(color)
        expected = (1 - erased[:, None]) * expected + erased[:, None] * trained
        np.testing.assert_allclose(view_colors(result, direction), expected, atol=2e-5)


def test_looks_apply_to_paint_and_mixing_removes_columns():
    splats = bundle_of("bands", np.random.default_rng(1)).levels[2].splats
    share = np.random.default_rng(2).uniform(0, 1, len(splats)).astype(np.float32)
    paint = blend_paint(np.zeros((len(splats), 4), np.float32), share, RED)
    present = replace(splats, extras=splats.extras | paint_columns(paint))
    result = read_paint(present.extras)
    assert result is not None
    np.testing.assert_array_equal(result, paint)
    look = Look(0.5, 5000, (1.0, 0.8, 0.9), 0.4)
    result = apply_looks(present, [(None, look)])
    assert result.extras.keys() == splats.extras.keys()
    direction = (0.6, 0.0, 0.8)
    expected = (1 - share[:, None]) * view_colors(splats.sh, direction) + share[:, None] * np.array(RED)
    np.testing.assert_allclose(view_colors(result.sh, direction), expected @ look.matrix.T, atol=2e-5)
    assert apply_paint(splats) is splats


def test_paint_is_transferred_by_position():
    """One half is painted, and a small patch of the other. Distant splats get no paint."""
    rng = np.random.default_rng(4)
    means = rng.uniform(-5, 5, (20_000, 3)).astype(np.float32)
    patch = np.linalg.norm(means - (-3, 0, 0), axis=1) < 2.5
    paint = np.zeros((len(means), 4), np.float32)
    paint = blend_paint(paint, (means[:, 0] > 0).astype(np.float32), RED)
    paint = blend_paint(paint, 0.5 * patch.astype(np.float32), BLUE)
    targets = np.concatenate([rng.uniform(-4, 4, (3000, 3)), rng.uniform(50, 60, (100, 3))]).astype(
        np.float32
    )
    result, clear = transfer_paint(paint, means, targets), 1.2  # size of the largest cells
    distance, far = np.linalg.norm(targets - (-3, 0, 0), axis=1), targets[:, 0] > 20
    in_half, in_patch = (targets[:, 0] > clear) & ~far, distance < 2.5 - clear
    unpainted = ((targets[:, 0] < -clear) & (distance > 2.5 + clear)) | far
    assert min(in_half.sum(), in_patch.sum(), unpainted.sum()) > 5
    np.testing.assert_allclose(result[in_half], np.tile([*RED, 1], (in_half.sum(), 1)), atol=1e-5)
    patch_paint = [*(0.5 * np.array(BLUE)), 0.5]
    np.testing.assert_allclose(result[in_patch], np.tile(patch_paint, (in_patch.sum(), 1)), atol=1e-5)
    assert not result[unpainted].any()
    # a target at the position of a painted splat takes its paint, if no other splat is as close
    few = np.arange(0, len(means), 400)
    np.testing.assert_allclose(transfer_paint(paint[few], means[few], means[few]), paint[few], atol=1e-6)


def test_edit_writes_paint_mixed_in(tmp_path):
    bundle = bundle_of("bands", np.random.default_rng(3))
    for level in bundle.levels:
        share = (level.splats.means[:, 0] > 0).astype(np.float32)
        level.splats.extras |= paint_columns(blend_paint(np.zeros((len(share), 4), np.float32), share, RED))
    write_bundle(tmp_path / "in.ply", bundle)
    written = read_bundle(tmp_path / "in.ply")
    assert all(set(COLUMNS) <= level.splats.extras.keys() for level in written.levels)
    edit(tmp_path / "in.ply", Outputs(tmp_path / "out.ply", plain=[tmp_path / "plain.ply"]))
    result = read_bundle(tmp_path / "out.ply")
    for level, original in zip(result.levels, bundle.levels, strict=True):
        assert not set(COLUMNS) & level.splats.extras.keys()
        trained, edited = view_colors(original.splats.sh, (0, 0, 1)), view_colors(level.splats.sh, (0, 0, 1))
        painted = original.splats.means[:, 0] > 0
        np.testing.assert_allclose(edited[painted], np.tile(RED, (painted.sum(), 1)), atol=1e-5)
        np.testing.assert_allclose(edited[~painted], trained[~painted], atol=1e-6)
    np.testing.assert_array_equal(read_ply(tmp_path / "plain.ply").sh, result.levels[-1].splats.sh)
