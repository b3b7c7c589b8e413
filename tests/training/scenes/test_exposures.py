"""Correction of photos with a deviating exposure."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.training.conftest import write_tiny_scene
from tools import quality_scenes
from tools.quality_scenes import relight
from training.optimize.training_data import TrainingData
from training.scenes import exposures
from training.scenes.colmap import read_scene
from training.scenes.exposures import (
    complete_gains,
    exposure_gains,
    relative_gains,
    remove_gain,
    smooth_gains,
    stated_stops,
)
from training.scenes.images import load_image

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def copy(tmp_path):
    """Return a function that copies the rendered garden with exposure changes in stops."""

    def make(stops):
        (tmp_path / "images").mkdir()
        (tmp_path / "sparse").symlink_to(GARDEN / "sparse")
        files = sorted((GARDEN / "images").iterdir())
        for file, change in zip(files, stops(len(files)), strict=True):
            pixels = relight(np.asarray(Image.open(file).convert("RGB")), np.full(3, 2.0**change))
            Image.fromarray(pixels).save(tmp_path / "images" / file.name, quality=97)
        return read_scene(tmp_path)

    return make


def log_error(camera, gain=None):
    """Return the median absolute log ratio to the original photo, without black and white pixels."""
    size = camera.width, camera.height
    image, truth = load_image(camera.image, *size), load_image(GARDEN / "images" / camera.name, *size)
    image = image if gain is None else remove_gain(image, gain)
    usable = (np.minimum(image, truth) > 0.1) & (np.maximum(image, truth) < 0.9)
    return np.median(np.abs(np.log(image[usable]) - np.log(truth[usable])))


def test_equally_exposed_renders_stay_unchanged():
    scene = read_scene(GARDEN)
    assert exposure_gains(scene, scene.cameras) == {}


def test_random_exposures_are_matched_to_neighbours(copy):
    scene = copy(lambda count: np.random.default_rng(1).uniform(-0.7, 0.7, count))
    gains = exposure_gains(scene, scene.cameras)
    assert set(gains) == {camera.name for camera in scene.cameras}
    sample = scene.cameras[::4]
    error = np.mean([log_error(camera) for camera in sample])
    corrected = np.mean([log_error(camera, gains[camera.name]) for camera in sample])
    assert error > 0.1 and corrected < error / 3


def test_single_deviating_photo_is_corrected(copy):
    scene = copy(lambda count: 0.6 * (np.arange(count) == 20))
    gains = exposure_gains(scene, scene.cameras)
    outlier = scene.cameras[20]
    assert log_error(outlier) > 0.15 and log_error(outlier, gains[outlier.name]) < 0.04
    remaining = [np.abs(np.log(gain)).max() for name, gain in gains.items() if name != outlier.name]
    assert np.median(remaining) < 0.01


@pytest.mark.nightly
def test_smooth_exposure_changes_stay(copy):
    scene = copy(lambda count: np.linspace(-0.7, 0.7, count))
    assert all(np.abs(np.log(gain)).max() < 0.02 for gain in exposure_gains(scene, scene.cameras).values())


def test_relative_gains_recover_true_gains():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 0.2, (12, 3))
    truth -= truth.mean(0)
    colors = rng.uniform(-2, -0.5, (400, 3))
    view, point = np.nonzero(rng.random((12, 400)) < 0.5)
    values = colors[point] + truth[view] + rng.normal(0, 0.01, (len(view), 3))
    values[rng.random(len(view)) < 0.1] -= 1  # occluded points
    np.testing.assert_allclose(relative_gains(view, point, values), truth, atol=0.01)


def test_smooth_gains_separate_noise_from_signal():
    rng, time = np.random.default_rng(0), np.linspace(0, 1, 60)
    wave = 0.2 * np.sin(4 * time)[:, None] * [1, 0.8, 0.5]
    noise = rng.normal(0, 0.1, (60, 3))
    positions = np.stack([time, 0 * time, 0 * time], axis=1)
    estimate = smooth_gains(wave + noise, positions, np.tile([0.0, 1, 0], (60, 1)))
    assert np.abs(estimate - wave).mean() < 0.04
    np.testing.assert_allclose(smooth_gains(wave, positions, np.tile([0.0, 1, 0], (60, 1))), wave, atol=0.005)


def test_white_stays_white_and_no_pixel_exceeds_it():
    image = np.array([[[1.0, 1.0, 1.0], [0.5, 0.5, 0.5], [0.9, 0.9, 0.9]]], np.float32)
    corrected = remove_gain(image, np.array([1.25, 0.8, 1.0]))
    np.testing.assert_allclose(corrected[0, 0], 1)
    np.testing.assert_allclose(corrected[0, 1], [0.4, 0.625, 0.5], rtol=1e-6)
    np.testing.assert_allclose(corrected[0, 2], [0.72, 1, 0.9], rtol=1e-6)


def test_no_gains_without_tracks_or_for_too_many_photos(copy, monkeypatch):
    scene = copy(lambda count: np.random.default_rng(1).uniform(-0.7, 0.7, count))
    monkeypatch.setattr(exposures, "MAX_PHOTOS", 47)
    assert exposure_gains(scene, scene.cameras) == {}
    monkeypatch.undo()
    scene.point_ids.resize(0, refcheck=False)
    assert exposure_gains(scene, scene.cameras) == {}


def test_only_training_photos_are_corrected():
    scene = read_scene(GARDEN)
    names = [camera.name for camera in scene.split(8)[0]]
    data = TrainingData(scene, 0.25, gains={names[3]: np.array([2.0, 1.0, 0.5])})
    plain = TrainingData(scene, 0.25)
    np.testing.assert_allclose(
        data.target(3).image, remove_gain(plain.target(3).image.numpy(), np.array([2, 1, 0.5]))
    )
    for camera in data.test:
        assert (data.images.target(camera).image == plain.images.target(camera).image).all()
    assert (data.target(4).image == plain.target(4).image).all()


def with_exif(path, seconds=None, aperture=None, iso=None):
    exif = Image.Exif()
    values = {0x829A: seconds, 0x829D: aperture, 0x8827: iso}
    exif.get_ifd(0x8769).update({tag: value for tag, value in values.items() if value is not None})
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    return path


def test_stated_stops_follow_exposure_time_aperture_and_iso(tmp_path):
    stops = stated_stops(with_exif(tmp_path / "a.jpg", 1 / 100, 4.0, 100))
    assert stated_stops(with_exif(tmp_path / "b.jpg", 1 / 50, 4.0, 100)) == pytest.approx(stops + 1)
    assert stated_stops(with_exif(tmp_path / "c.jpg", 1 / 100, 5.6, 100)) == pytest.approx(
        stops - 0.97, abs=0.01
    )
    assert stated_stops(with_exif(tmp_path / "d.jpg", 1 / 100, 4.0, 800)) == pytest.approx(stops + 3)
    assert np.isnan(stated_stops(with_exif(tmp_path / "e.jpg", iso=100)))
    assert np.isnan(stated_stops(with_exif(tmp_path / "f.jpg", 0.0, 4.0, 100)))
    (tmp_path / "g.jpg").write_bytes(b"no image")
    assert np.isnan(stated_stops(tmp_path / "g.jpg"))


def test_stated_exposures_fill_in_missing_gains_relative_to_the_compared_photos():
    gains = np.array([[0.1, 0.2, 0.3], [-0.1, -0.2, -0.3], [np.nan] * 3, [np.nan] * 3])
    filled = complete_gains(gains, np.array([1.0, 1.0, 3.2, np.nan]))
    np.testing.assert_allclose(filled[:2], gains[:2])
    np.testing.assert_allclose(filled[2], 2.2 * np.log(2) / 2.2)
    assert np.isnan(filled[3]).all()
    stated_only = complete_gains(np.full((3, 3), np.nan), np.array([-1.1, 0, 1.1]))
    np.testing.assert_allclose(stated_only[:, 0], np.log(2) / 2 * np.array([-1, 0, 1]))


def test_photos_without_shared_points_are_matched_by_exif(tmp_path):
    write_tiny_scene(tmp_path / "tiny", views=24)  # its model has no tracks
    subset = quality_scenes.SUBSETS["exif"]
    scene = read_scene(quality_scenes.write_subset(tmp_path / "tiny", tmp_path / "copy", subset, stops=0.5))
    trained = [camera for number, camera in enumerate(scene.cameras) if number % subset.test_every]
    stops = np.array([stated_stops(camera.image) for camera in trained])
    gains = exposure_gains(scene, trained)
    logs = np.log([gains[camera.name].mean() for camera in trained])
    expected = np.log(2) / 2.2 * (stops - stops.mean())
    assert np.ptp(expected) > 0.3
    np.testing.assert_allclose(logs, expected, atol=0.08)
