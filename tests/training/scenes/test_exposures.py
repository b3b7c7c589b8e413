"""Photographs that are exposed otherwise than those beside them: found and evened, and nothing else is."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lab.jitter import exposed
from training.optimize.training_data import TrainingData
from training.scenes import exposures
from training.scenes.colmap import read_scene
from training.scenes.exposures import exposure_gains, relative_gains, remove_gain, smooth_gains
from training.scenes.images import load_image

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def copy(tmp_path):
    """Makes a copy of the rendered garden, each photograph given so many stops more light."""

    def make(stops):
        (tmp_path / "images").mkdir()
        (tmp_path / "sparse").symlink_to(GARDEN / "sparse")
        files = sorted((GARDEN / "images").iterdir())
        for file, change in zip(files, stops(len(files)), strict=True):
            pixels = exposed(np.asarray(Image.open(file).convert("RGB")), change)
            Image.fromarray(pixels).save(tmp_path / "images" / file.name, quality=97)
        return read_scene(tmp_path)

    return make


def apart(camera, gain=None):
    """Median |log| that a copy's photograph is off the original's, of what is not black or white."""
    size = camera.width, camera.height
    image, truth = load_image(camera.image, *size), load_image(GARDEN / "images" / camera.name, *size)
    image = image if gain is None else remove_gain(image, gain)
    known = (np.minimum(image, truth) > 0.1) & (np.maximum(image, truth) < 0.9)
    return np.median(np.abs(np.log(image[known]) - np.log(truth[known])))


def test_renders_of_one_exposure_are_left_alone():
    scene = read_scene(GARDEN)
    assert exposure_gains(scene, scene.cameras) == {}


def test_photographs_of_any_exposure_are_brought_to_what_those_beside_them_have(copy):
    scene = copy(lambda count: np.random.default_rng(1).uniform(-0.7, 0.7, count))
    gains = exposure_gains(scene, scene.cameras)
    assert set(gains) == {camera.name for camera in scene.cameras}
    before = np.mean([apart(camera) for camera in scene.cameras])
    after = np.mean([apart(camera, gains[camera.name]) for camera in scene.cameras])
    assert before > 0.1 and after < before / 3


def test_one_photograph_among_many_is_the_one_that_changes(copy):
    scene = copy(lambda count: 0.6 * (np.arange(count) == 20))
    gains = exposure_gains(scene, scene.cameras)
    odd = scene.cameras[20]
    assert apart(odd) > 0.15 and apart(odd, gains[odd.name]) < 0.04
    others = [np.abs(np.log(gain)).max() for name, gain in gains.items() if name != odd.name]
    assert np.median(others) < 0.01


def test_what_changes_smoothly_from_photograph_to_photograph_stays(copy):
    scene = copy(lambda count: np.linspace(-0.7, 0.7, count))
    assert all(np.abs(np.log(gain)).max() < 0.02 for gain in exposure_gains(scene, scene.cameras).values())


def test_gains_are_the_ones_that_colours_were_made_with():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 0.2, (12, 3))
    truth -= truth.mean(0)
    colors = rng.uniform(-2, -0.5, (400, 3))
    view, point = np.nonzero(rng.random((12, 400)) < 0.5)
    values = colors[point] + truth[view] + rng.normal(0, 0.01, (len(view), 3))
    values[rng.random(len(view)) < 0.1] -= 1  # something stands before the point
    np.testing.assert_allclose(relative_gains(view, point, values), truth, atol=0.01)


def test_noise_is_told_from_what_is_smooth():
    rng, along = np.random.default_rng(0), np.linspace(0, 1, 60)
    wave = 0.2 * np.sin(4 * along)[:, None] * [1, 0.8, 0.5]
    noise = rng.normal(0, 0.1, (60, 3))
    places = np.stack([along, 0 * along, 0 * along], axis=1)
    found = smooth_gains(wave + noise, places, np.tile([0.0, 1, 0], (60, 1)))
    assert np.abs(found - wave).mean() < 0.04
    np.testing.assert_allclose(smooth_gains(wave, places, np.tile([0.0, 1, 0], (60, 1))), wave, atol=0.005)


def test_white_stays_white_and_nothing_is_brighter():
    image = np.array([[[1.0, 1.0, 1.0], [0.5, 0.5, 0.5], [0.9, 0.9, 0.9]]], np.float32)
    found = remove_gain(image, np.array([1.25, 0.8, 1.0]))
    np.testing.assert_allclose(found[0, 0], 1)
    np.testing.assert_allclose(found[0, 1], [0.4, 0.625, 0.5], rtol=1e-6)
    np.testing.assert_allclose(found[0, 2], [0.72, 1, 0.9], rtol=1e-6)


def test_there_is_nothing_to_compare_without_tracks_or_of_too_many(copy, monkeypatch):
    scene = copy(lambda count: np.random.default_rng(1).uniform(-0.7, 0.7, count))
    monkeypatch.setattr(exposures, "MAX_PHOTOS", 47)
    assert exposure_gains(scene, scene.cameras) == {}
    monkeypatch.undo()
    scene.point_ids.resize(0, refcheck=False)
    assert exposure_gains(scene, scene.cameras) == {}


def test_photographs_are_evened_for_training_and_others_never():
    scene = read_scene(GARDEN)
    names = [camera.name for camera in scene.split(8)[0]]
    data = TrainingData(scene, 0.25, gains={names[3]: np.array([2.0, 1.0, 0.5])})
    plain = TrainingData(scene, 0.25)
    np.testing.assert_allclose(
        data.target(3).image, remove_gain(plain.target(3).image.numpy(), np.array([2, 1, 0.5]))
    )
    for camera in data.test:
        assert (data.photographs.target(camera).image == plain.photographs.target(camera).image).all()
    assert (data.target(4).image == plain.target(4).image).all()
