"""Harder copies of scenes for the quality benchmark."""

import numpy as np
import pytest
from PIL import Image

from tests.training.conftest import write_tiny_scene
from tools import bench_quality, quality_scenes
from tools.quality_scenes import EXIF, EXPOSURE_TIME, SUBSETS, relight, write_subset
from training.scenes.colmap import read_scene
from training.scenes.observations import observations


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("wide") / "tiny", views=26)


def linear(path):
    """Decode sRGB to linear light (IEC 61966-2-1); NaN for very dark or saturated values."""
    codes = np.asarray(Image.open(path).convert("RGB")).astype(float)
    light = ((codes / 255 + 0.055) / 1.055) ** 2.4
    return np.where((codes < 30) | (codes > 250), np.nan, light)


@pytest.mark.parametrize(
    "name, trained, held_out", [("row", 12, 4), ("arc", 12, 12), ("few", 12, 12), ("third", 8, 8)]
)
def test_sparse_copies_hold_out_views_beside_the_trained_ones(scene, tmp_path, name, trained, held_out):
    write_subset(scene, tmp_path / name, SUBSETS[name])
    copy, original = read_scene(tmp_path / name), read_scene(scene)
    train, test = copy.split(SUBSETS[name].test_every)
    assert (len(train), len(test)) == (trained, held_out)
    poses = {camera.name: camera.world_to_camera for camera in original.cameras}
    for camera in copy.cameras:
        np.testing.assert_allclose(camera.world_to_camera, poses[camera.name], atol=1e-12)
        assert camera.image.read_bytes() == (scene / "images" / camera.name).read_bytes()
    assert len(copy.points) == len(original.points)  # the tiny model has no tracks


def test_points_of_a_copy_are_observed_by_two_of_its_photos(tmp_path):
    from tests.training.scenes.test_check import GARDEN

    copy = read_scene(write_subset(GARDEN, tmp_path / "row", SUBSETS["row"]))
    original = read_scene(GARDEN)
    names = [camera.name for camera in copy.cameras]
    counts = np.zeros(len(original.points), int)
    for rows in observations(original, names).values():
        counts[np.unique(rows)] += 1
    assert 0 < len(copy.points) == (counts > 1).sum() < len(original.points)
    observed = observations(copy, names)
    assert (np.bincount(np.concatenate([np.unique(rows) for rows in observed.values()])) > 1).all()


def test_light_of_training_photos_changes_by_the_stops_in_exif(scene, tmp_path):
    copy = read_scene(write_subset(scene, tmp_path / "exif", SUBSETS["exif"], stops=0.5))
    stops = []
    for number, camera in enumerate(copy.cameras):
        original = scene / "images" / camera.name
        if number % 8 == 0:
            assert camera.image.read_bytes() == original.read_bytes()
            continue
        ratio = np.log2(linear(camera.image) / linear(original))
        stops.append(np.nanmedian(ratio))
        assert (np.abs(ratio - stops[-1]) < 0.3)[np.isfinite(ratio)].mean() > 0.8
        time = Image.open(camera.image).getexif().get_ifd(EXIF)[EXPOSURE_TIME]
        np.testing.assert_allclose(np.log2(float(time) * 100), stops[-1], atol=0.1)
    assert 0.3 < max(map(abs, stops)) < 0.8 and np.std(stops) > 0.2


def test_vignette_takes_light_from_the_corners():
    photo = np.full((30, 40, 3), 188, np.uint8)  # half of white in linear light
    changed = relight(photo, np.ones(3), 0.5)
    assert abs(int(changed[15, 20, 0]) - 188) <= 1
    np.testing.assert_allclose(changed[0, 0] / 255, 0.5 ** (1 / 2.2) * 188 / 255, atol=0.02)


def test_small_scenes_have_no_sparse_copies(tiny_scene, tmp_path):
    assert write_subset(tiny_scene, tmp_path / "few", SUBSETS["few"]) is None
    assert not (tmp_path / "few").exists()


def test_benchmark_lists_scenes_with_their_copies_once(scene, tmp_path, monkeypatch):
    def courtyard(out):
        out.mkdir(exist_ok=True)
        return out

    monkeypatch.setattr(bench_quality, "write_courtyard", courtyard)
    listed = bench_quality.scenes_to_train([scene], tmp_path / "copies")
    assert {path.name: interval for path, interval in listed.items()} == {
        "tiny": 8, "courtyard": 8, **{f"tiny-{name}": subset.test_every for name, subset in SUBSETS.items()}
    }  # fmt: skip
    monkeypatch.setattr(quality_scenes, "read_scene", None)  # copies exist
    assert bench_quality.scenes_to_train([scene], tmp_path / "copies") == listed
    assert list(bench_quality.scenes_to_train([scene], None)) == [scene]
