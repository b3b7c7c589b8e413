"""Copies of scenes with changed exposure: linear light by the given stops; held-out photos unchanged."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from training.scenes.colmap import read_scene

ROOT = Path(__file__).resolve().parents[2]


def linear(path: Path) -> np.ndarray:
    """Decode sRGB to linear light; NaN for very dark or saturated values."""
    codes = np.asarray(Image.open(path).convert("RGB")).astype(float)
    light = ((codes / 255 + 0.055) / 1.055) ** 2.4
    return np.where((codes < 30) | (codes > 250), np.nan, light)


def test_photos_change_by_stops_and_held_out_photos_stay(tiny_scene, tmp_path):
    copy = tmp_path / "copy"
    command = [sys.executable, ROOT / "lab" / "jitter.py", tiny_scene, copy, "--test-every", "4"]
    process = subprocess.run([*map(str, command)], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    train, test = read_scene(tiny_scene).split(4)
    assert [camera.name for camera in read_scene(copy).cameras] == sorted(c.name for c in train + test)
    for camera in test:
        assert (copy / camera.image.relative_to(tiny_scene)).read_bytes() == camera.image.read_bytes()
    stops = []
    for camera in train:
        ratio = np.log2(linear(copy / camera.image.relative_to(tiny_scene)) / linear(camera.image))
        stops.append(np.nanmedian(ratio))
        assert (np.abs(ratio - stops[-1]) < 0.3)[np.isfinite(ratio)].mean() > 0.8  # uniform over the image
    expected = np.random.default_rng(0).uniform(-0.7, 0.7, len(train))
    np.testing.assert_allclose(stops, expected, atol=0.05)
    repeated = subprocess.run([*map(str, command)], capture_output=True, text=True)
    assert repeated.returncode == 2 and "Choose another folder" in repeated.stderr
