"""Looks of splats, compared with the sRGB curve, Planck's law, colours by direction, and images."""

from dataclasses import replace

import numpy as np
import pytest

from tests.training.conftest import look_at
from tests.training.editing.test_cleaning import bundle_of
from tests.training.splats.test_similarity import random_splats, render
from training.__main__ import main
from training.color import linear_from_srgb, srgb_from_linear
from training.editing.look import LUMA, NEUTRAL, Look, RowsWithLook, apply_looks
from training.errors import LodgsError
from training.lod.crop import Crop, crop_mask
from training.scenes.cameras import Camera
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import SH_C0
from training.splats.levels import Bundle, Level
from training.splats.sh import basis, coefficient_count

LOOK = Look(exposure=-0.7, temperature=8000, tint=(1, 0.8, 0.9), saturation=0.4, opacity=0.6)


def view_colors(splats, degree, direction):
    """Return colours (N, 3) float64 from a direction, not clamped at black."""
    values = np.empty(coefficient_count(degree))
    basis(*direction, degree, values)
    return 0.5 + np.einsum("k,nkc->nc", values, splats.sh.astype(np.float64))


def opacities(splats):
    return 1 / (1 + np.exp(-splats.opacity_logits.astype(np.float64)))


def test_neutral_look_changes_nothing():
    splats = random_splats(20, 3)
    np.testing.assert_allclose(NEUTRAL.matrix, np.eye(3), atol=1e-12)
    result = apply_looks(splats, [(None, NEUTRAL)])
    np.testing.assert_allclose(result.sh, splats.sh, atol=1e-6)
    np.testing.assert_array_equal(result.opacity_logits, splats.opacity_logits)


@pytest.mark.parametrize("exposure", [-2, -1, 0.5, 1])
def test_exposure_scales_linear_light(exposure):
    codes = np.linspace(0.2, 0.65, 10)
    light = srgb_from_linear(2.0**exposure * linear_from_srgb(codes))
    np.testing.assert_allclose(Look(exposure=exposure).matrix[0, 0] * codes, light, atol=0.02)


def planck_in_srgb(kelvins):
    """Return linear sRGB (3,) of a black body: Planck's law, with the observer fit of Wyman et al. (2013)."""

    def lobe(x, height, peak, left_slope, right_slope):
        return height * np.exp(-0.5 * ((x - peak) * np.where(x < peak, left_slope, right_slope)) ** 2)

    nm = np.arange(360.0, 831.0)
    power = nm**-5 / np.expm1(1.438777e7 / (nm * kelvins))
    x = lobe(nm, 0.362, 442, 0.0624, 0.0374) + lobe(nm, 1.056, 599.8, 0.0264, 0.0323)
    x += lobe(nm, -0.065, 501.1, 0.0490, 0.0382)
    y = lobe(nm, 0.821, 568.8, 0.0213, 0.0247) + lobe(nm, 0.286, 530.9, 0.0613, 0.0322)
    z = lobe(nm, 1.217, 437, 0.0845, 0.0278) + lobe(nm, 0.681, 459, 0.0385, 0.0725)
    xyz = np.array([x, y, z]) @ power
    to_srgb = np.linalg.inv(
        ((0.41239, 0.35758, 0.18048), (0.21264, 0.71517, 0.07219), (0.01933, 0.11919, 0.95053))
    )
    return to_srgb @ xyz / xyz[1]


@pytest.mark.parametrize("kelvins", [2500, 3200, 4000, 5000, 9000, 15000])
def test_white_balance_neutralises_the_light(kelvins):
    """Within 1 % of the display value in daylight."""
    grey = (0.3 * planck_in_srgb(kelvins) / planck_in_srgb(6500)) ** (1 / 2.2)
    result = Look(temperature=kelvins).matrix @ grey
    np.testing.assert_allclose(result / result.mean(), 1, atol=0.01)
    white = Look(temperature=kelvins).matrix @ np.ones(3)
    assert white @ LUMA == pytest.approx(1) and (white[2] > white[0]) == (kelvins < 6500)


def test_saturation_keeps_luma_and_tint_maps_white():
    color = np.array([0.7, 0.3, 0.1])
    grey = Look(saturation=0).matrix @ color
    np.testing.assert_allclose(grey, 0.2126 * 0.7 + 0.7152 * 0.3 + 0.0722 * 0.1, rtol=1e-12)
    strong = Look(saturation=2).matrix @ color
    np.testing.assert_allclose(strong, 2 * color - grey, rtol=1e-12)
    for saturation in (0, 0.5, 2):
        look = Look(tint=(0.9, 0.5, 0.2), saturation=saturation)
        np.testing.assert_allclose(look.matrix @ np.ones(3), (0.9, 0.5, 0.2), rtol=1e-12)


@pytest.mark.parametrize("degree", range(5))
def test_matrix_applies_to_every_degree_and_direction(degree):
    splats = random_splats(200, degree)
    result = apply_looks(splats, [(None, LOOK)])
    for direction in ((0, 0, 1), (0.6, -0.8, 0), (-0.48, 0.6, 0.64)):
        expected = view_colors(splats, degree, direction) @ LOOK.matrix.T
        np.testing.assert_allclose(view_colors(result, degree, direction), expected, atol=1e-5)
    np.testing.assert_allclose(opacities(result), 0.6 * opacities(splats), rtol=1e-5)
    for name in ("means", "quats", "log_scales"):
        assert getattr(result, name) is getattr(splats, name)


def test_opacity_factor_for_extreme_logits():
    splats = replace(random_splats(5, 0), opacity_logits=np.float32([-200, -5, 0, 5, 200]))
    for factor in (0.0, 0.25, 1.0):
        result = apply_looks(splats, [(None, Look(opacity=factor))])
        assert np.isfinite(result.opacity_logits).all()
        np.testing.assert_allclose(opacities(result), factor * opacities(splats), rtol=1e-4, atol=1e-5)


def test_regions_combine_with_a_global_look():
    splats, ball = random_splats(500, 1), Crop.sphere((0.2, 0, 0), 0.8)
    box, present = Crop.box((-2, -2, -2), (2, 2, 0), outside=True), Look(tint=(0.2, 1, 1))
    result = apply_looks(splats, [(None, LOOK), (ball, present), (box, Look(opacity=0.5))])
    holder = np.linalg.norm(splats.means - np.float32([0.2, 0, 0]), axis=1) <= 0.8
    above = splats.means[:, 2] >= 0
    assert 50 < holder.sum() < 450 and 50 < above.sum() < 450
    expected = view_colors(splats, 1, (0, 0, 1)) @ LOOK.matrix.T
    expected[holder] *= (0.2, 1, 1)
    np.testing.assert_allclose(view_colors(result, 1, (0, 0, 1)), expected, atol=1e-5)
    np.testing.assert_allclose(
        opacities(result), 0.6 * opacities(splats) * np.where(above, 0.5, 1), rtol=1e-5
    )


def test_rendered_image_equals_colour_mapped_image():
    """Blending is linear in colours, and the matrix maps black to black."""
    splats = random_splats(300, 2)
    splats.sh[:, 0] = np.abs(splats.sh[:, 0]) / 2
    splats.sh[:, 1:] *= 0.1
    camera = Camera("", 96, 72, 90.0, 80.0, 50.0, 33.0, look_at((2.5, 0.4, 1.5)))
    look = replace(LOOK, exposure=0.6, opacity=1.0)
    original, updated = (
        render(splats, camera, 0.01),
        render(apply_looks(splats, [(None, look)]), camera, 0.01),
    )
    assert original.std() > 0.1 and np.abs(updated - original).max() > 0.1
    np.testing.assert_allclose(updated, original @ look.matrix.T, atol=2e-5)


@pytest.mark.parametrize(
    "values",
    [{"exposure": 11}, {"temperature": 900}, {"tint": (1, 2, 1)}, {"saturation": -1}, {"opacity": 1.5},
     {"exposure": float("nan")}],
)  # fmt: skip
def test_invalid_values_are_rejected(values):
    with pytest.raises(LodgsError, match=f"{next(iter(values))} = .* is invalid"):
        Look(**values)


@pytest.mark.parametrize("name", ["bands", "octree", "chunks", "decay"])
def test_command_edits_every_level(name, tmp_path, capsys):
    bundle = bundle_of(name, np.random.default_rng(0))
    write_bundle(tmp_path / "in.ply", bundle)
    arguments = [
        "--exposure", "0.5", "--saturation", "0.8", "--tint", "1", "0.9", "0.8", "--temperature", "5000",
        "--opacity", "0.7",
    ]  # fmt: skip
    out = tmp_path / "out.ply"
    assert main(["edit", str(tmp_path / "in.ply"), "--out", str(out), *arguments]) == 0
    look = Look(0.5, 5000, (1, 0.9, 0.8), 0.8, 0.7)
    result, original = read_bundle(out), read_bundle(tmp_path / "in.ply")
    assert (result.rule, result.facts, list(result.tables)) == (
        original.rule,
        original.facts,
        list(original.tables),
    )
    for first, second in zip(result.levels, original.levels, strict=True):
        expected = 0.5 + SH_C0 * second.splats.sh[:, 0]
        np.testing.assert_allclose(0.5 + SH_C0 * first.splats.sh[:, 0], expected @ look.matrix.T, atol=1e-5)
        np.testing.assert_allclose(opacities(first.splats), 0.7 * opacities(second.splats), rtol=1e-4)
        np.testing.assert_array_equal(first.splats.means, second.splats.means)
    assert "level 3:" in capsys.readouterr().out


def test_command_edits_regions_and_folders(tmp_path, capsys):
    bundle = bundle_of("bands", np.random.default_rng(0))
    write_bundle(tmp_path / "in.ply", bundle)
    box = ["--keep", "all", "--crop-box", "0", "-99", "-99", "99", "99", "99"]
    out = tmp_path / "out.ply"
    command = ["edit", str(tmp_path / "in.ply"), "--out", str(out)]
    assert main([*command, *box, "--exposure", "1"]) == 0
    for first, second in zip(read_bundle(out).levels, bundle.levels, strict=True):
        holder = second.splats.means[:, 0] >= 0
        assert 0 < holder.sum() < len(holder) == len(first.splats)
        np.testing.assert_array_equal((first.splats.sh != second.splats.sh).any(axis=(1, 2)), holder)
    for wrong, text in (
        (box, "--keep all"),
        (["--opacity", "2"], "opacity = 2.0 is invalid. Use a number of at least 0 and at most 1."),
        (["--tint", "1", "1", "7"], "tint = 7.0 is invalid"),
    ):
        out.unlink(missing_ok=True)
        assert main([*command, *wrong]) == 2 and not out.exists()
        assert text in capsys.readouterr().err


def test_overlapping_crops_apply_the_look_once(tmp_path):
    splats = random_splats(50, 1)
    write_bundle(tmp_path / "in.ply", Bundle("", [Level(1, splats)]))
    crops = ["--crop-sphere", "0", "0", "0", "1", "--crop-box", "-1", "-1", "-1", "1", "1", "0.5"]
    command = ["edit", str(tmp_path / "in.ply"), "--out", str(tmp_path / "out.ply"), "--keep", "all", *crops]
    assert main([*command, "--exposure", "1"]) == 0
    inside = crop_mask([Crop.sphere((0, 0, 0), 1), Crop.box((-1, -1, -1), (1, 1, 0.5))], splats.means)
    assert 0 < inside.sum() < len(inside)
    brighter = apply_looks(splats, [(None, Look(exposure=1))])
    expected = np.where(inside[:, None, None], brighter.sh, splats.sh)
    np.testing.assert_array_equal(read_bundle(tmp_path / "out.ply").levels[0].splats.sh, expected)


def test_rows_on_disk_equal_rows_in_memory():
    splats = random_splats(50, 1)
    looks = [(None, LOOK), (Crop.sphere((0, 0, 0), 0.7), Look(exposure=1))]
    rows = RowsWithLook(splats, looks)
    assert len(rows) == 50
    np.testing.assert_array_equal(rows.select(slice(10, 30)).sh, apply_looks(splats, looks).sh[10:30])
