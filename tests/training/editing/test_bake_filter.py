"""Splats for programs without Mip-Splatting's filter look there about as the filter shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.editing.bake_filter import bake_filter
from training.editing.cleaning import Cleaning
from training.editing.edit import edit
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera, look_at
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import read_bundle, write_bundle
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply

SIZE, FOCAL = (48, 36), 40.0


def view(name: str, eye: tuple, times: int = 1) -> Camera:
    """A view of what is around the origin."""
    width, height = (times * side for side in SIZE)
    pose = look_at(np.array(eye, float), np.zeros(3), (0, 0, 1))
    return Camera(name, width, height, times * FOCAL, times * FOCAL, width / 2, height / 2, pose)


EYES = {"a": (4, 0, 0), "b": (4, 2, 1), "c": (4, -2, 0.5), "d": (5, 0.5, 1)}


@pytest.fixture
def bundle() -> Bundle:
    """Splats of a tenth of a pixel to some pixels, flat, photographed at three times the size of training."""
    rng, count = np.random.default_rng(3), 1500
    sizes = rng.uniform(-6, -2.5, (count, 1)) + rng.normal(0, 0.5, (count, 3))
    splats = Splats(
        rng.normal(0, 0.7, (count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        sizes.astype(np.float32), rng.normal(1, 1, count).astype(np.float32),
        rng.normal(0, 1, (count, 1, 3)).astype(np.float32),
    )  # fmt: skip
    views = [view(name, eye, 3) for name, eye in EYES.items()]
    meta = {"antialias": True, "focal_px": FOCAL}
    return Bundle("3dgs", [Level(1, splats)], meta=meta, tables=make_view_tables(views, 0.05))


def error(shown: Bundle, truth: Bundle) -> float:
    """Mean absolute difference of pictures at the size of training, each as its bundle is to be drawn."""
    apart = []
    for name, eye in EYES.items():
        pictures = [
            rasterize(
                Gaussians.of(one.levels[0].rows.select(slice(None))), view(name, eye), near=0.05,
                antialias=one.antialias, backend="cpu",
            ).image
            for one in (shown, truth)
        ]  # fmt: skip
        apart.append((pictures[0] - pictures[1]).abs().mean().item())
    return float(np.mean(apart))


def test_it_looks_about_as_the_filter_shows_it(bundle):
    untold = replace(bundle, meta={})
    found = bake_filter(bundle)
    assert not found.antialias and found.tables == bundle.tables
    assert error(found, bundle) < 0.4 * error(untold, bundle)
    assert bundle.antialias, "untouched"


def test_opacities_are_what_the_filter_leaves_in_a_view(bundle):
    """Of one view: the alpha in the middle of a splat that is drawn alone."""
    eye = EYES["a"]
    alone = replace(bundle, tables=make_view_tables([view("a", eye, 3)], 0.05))
    found = bake_filter(alone).levels[0].rows.select(np.array([1, 4, 900]))
    own = bundle.levels[0].splats.select(np.array([1, 4, 900]))
    for row in range(3):
        one = own.select(slice(row, row + 1))
        camera = view("a", eye)
        place, _ = camera.project(one.means)  # which is brought to the middle of a pixel
        camera = replace(camera, cx=camera.cx + 24.5 - place[0, 0], cy=camera.cy + 18.5 - place[0, 1])
        alpha = rasterize(Gaussians.of(one), camera, near=0.05, antialias=True, backend="reference").alpha
        expected = 1 / (1 + np.exp(-found.opacity_logits[row]))
        assert alpha[18, 24].item() == pytest.approx(expected, abs=5e-3)


def test_files_for_others_have_it_and_bundles_do_not(bundle, tmp_path):
    write_bundle(tmp_path / "bundle.ply", bundle)
    for antialiased in (False, True):
        paths = tmp_path / f"{antialiased}.ply", tmp_path / f"{antialiased}.splat"
        out = tmp_path / f"{antialiased}_bundle.ply"
        edit(tmp_path / "bundle.ply", out, Cleaning(), plain=paths, antialiased=antialiased)
        kept = read_bundle(out)
        assert kept.antialias
        np.testing.assert_array_equal(
            kept.levels[0].splats.opacity_logits, bundle.levels[0].splats.opacity_logits
        )
        plain = read_bundle(paths[0])
        assert plain.antialias is antialiased, "so that it is not done twice"
        expected = (bundle if antialiased else bake_filter(bundle)).levels[0].rows.select(slice(None))
        np.testing.assert_array_equal(plain.levels[0].splats.opacity_logits, expected.opacity_logits)
        with open_as_ply(paths[1]) as path:
            opacity = torch.sigmoid(torch.from_numpy(read_ply(path).opacity_logits)).numpy()
        np.testing.assert_allclose(opacity, 1 / (1 + np.exp(-expected.opacity_logits)), atol=3 / 255)


def test_where_views_are_unknown_or_no_filter_is_nothing_changes(bundle):
    for one in (replace(bundle, tables={}), replace(bundle, meta={})):
        assert bake_filter(one) is one
