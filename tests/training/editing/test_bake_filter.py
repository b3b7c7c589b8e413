"""Splats with a baked filter look similar in programs without Mip-Splatting's filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.editing.bake_filter import bake_filter
from training.editing.edit import Outputs, edit
from training.editing.export import FileOptions
from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera, look_at
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import read_bundle, write_bundle
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply

SIZE, FOCAL = (48, 36), 40.0


def view(name: str, position: tuple, times: int = 1) -> Camera:
    """Return a camera that looks at the origin."""
    width, height = (times * side for side in SIZE)
    pose = look_at(np.array(position, float), np.zeros(3), (0, 0, 1))
    return Camera(name, width, height, times * FOCAL, times * FOCAL, width / 2, height / 2, pose)


POSITIONS = {"a": (4, 0, 0), "b": (4, 2, 1), "c": (4, -2, 0.5), "d": (5, 0.5, 1)}


@pytest.fixture
def bundle() -> Bundle:
    """Flat splats of 0.1 to several pixels; photos have three times the training size."""
    rng, count = np.random.default_rng(3), 1500
    sizes = rng.uniform(-6, -2.5, (count, 1)) + rng.normal(0, 0.5, (count, 3))
    splats = Splats(
        rng.normal(0, 0.7, (count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        sizes.astype(np.float32), rng.normal(1, 1, count).astype(np.float32),
        rng.normal(0, 1, (count, 1, 3)).astype(np.float32),
    )  # fmt: skip
    views = [view(name, position, 3) for name, position in POSITIONS.items()]
    meta = {"antialias": True, "focal_px": FOCAL}
    return Bundle("3dgs", [Level(1, splats)], meta=meta, tables=make_view_tables(views, 0.05))


def error(selected: Bundle, truth: Bundle) -> float:
    """Return the mean absolute difference of images at training size."""
    separate = []
    for name, position in POSITIONS.items():
        images = [
            rasterize(
                Gaussians.of(first.levels[0].rows.select(slice(None))), view(name, position), near=0.05,
                antialias=first.antialias, backend="cpu",
            ).image
            for first in (selected, truth)
        ]  # fmt: skip
        separate.append((images[0] - images[1]).abs().mean().item())
    return float(np.mean(separate))


def test_baked_images_resemble_filtered_images(bundle):
    unmarked = replace(bundle, meta={})
    result = bake_filter(bundle)
    assert not result.antialias and result.tables == bundle.tables
    assert error(result, bundle) < 0.4 * error(unmarked, bundle)
    assert bundle.antialias, "the source is unchanged"


def test_opacities_match_the_filter_in_one_view(bundle):
    """Compare with the alpha at the centre of a single rendered splat."""
    position = POSITIONS["a"]
    single = replace(bundle, tables=make_view_tables([view("a", position, 3)], 0.05))
    result = bake_filter(single).levels[0].rows.select(np.array([1, 4, 900]))
    trained = bundle.levels[0].splats.select(np.array([1, 4, 900]))
    for row in range(3):
        first = trained.select(slice(row, row + 1))
        camera = view("a", position)
        pixel, _ = camera.project(first.means)  # moved to the centre of a pixel
        camera = replace(camera, cx=camera.cx + 24.5 - pixel[0, 0], cy=camera.cy + 18.5 - pixel[0, 1])
        alpha = rasterize(Gaussians.of(first), camera, near=0.05, antialias=True, backend="reference").alpha
        expected = 1 / (1 + np.exp(-result.opacity_logits[row]))
        assert alpha[18, 24].item() == pytest.approx(expected, abs=5e-3)


def test_exports_are_baked_and_bundles_are_not(bundle, tmp_path):
    write_bundle(tmp_path / "bundle.ply", bundle)
    for antialiased in (False, True):
        paths = tmp_path / f"{antialiased}.ply", tmp_path / f"{antialiased}.splat"
        out = tmp_path / f"{antialiased}_bundle.ply"
        edit(tmp_path / "bundle.ply", Outputs(out, paths), options=FileOptions(antialiased))
        retained = read_bundle(out)
        assert retained.antialias
        np.testing.assert_array_equal(
            retained.levels[0].splats.opacity_logits, bundle.levels[0].splats.opacity_logits
        )
        plain = read_bundle(paths[0])
        assert plain.antialias is antialiased, "the filter is not baked twice"
        expected = (bundle if antialiased else bake_filter(bundle)).levels[0].rows.select(slice(None))
        np.testing.assert_array_equal(plain.levels[0].splats.opacity_logits, expected.opacity_logits)
        with open_as_ply(paths[1]) as path:
            opacity = torch.sigmoid(torch.from_numpy(read_ply(path).opacity_logits)).numpy()
        np.testing.assert_allclose(opacity, 1 / (1 + np.exp(-expected.opacity_logits)), atol=3 / 255)


def test_bundles_without_views_or_filter_are_unchanged(bundle):
    for first in (replace(bundle, tables={}), replace(bundle, meta={})):
        assert bake_filter(first) is first
