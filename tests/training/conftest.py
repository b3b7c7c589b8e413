"""A COLMAP scene small enough to train on in a second."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0


def look_at(position, target=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return world_to_camera (4, 4) of a camera that looks at a target; +y is up, OpenCV axes."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ np.asarray(position)
    return matrix


def quaternion(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


def write_tiny_scene(folder: Path, views: int = 9, points: int = 60) -> Path:
    """Write a text model and photos from an arc of coloured discs around the origin and behind it."""
    rng = np.random.default_rng(7)
    means = np.concatenate(
        [rng.normal(0, 0.6, (points // 2, 3)), rng.normal(0, 3, (points - points // 2, 3))]
    )
    means[points // 2 :, 2] -= 8
    colors = rng.integers(40, 255, (points, 3))
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "images").mkdir()
    lines = []
    ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for view in range(views):
        angle = np.radians(-40 + 80 * view / (views - 1))
        matrix = look_at((4 * np.sin(angle), 0.3, 4 * np.cos(angle)))
        image = np.zeros((HEIGHT, WIDTH, 3))
        in_camera = means @ matrix[:3, :3].T + matrix[:3, 3]
        for index in np.argsort(-in_camera[:, 2]):  # painter's order
            x, y, z = in_camera[index]
            inside = (
                np.hypot(xs - FOCAL * x / z - WIDTH / 2, ys - FOCAL * y / z - HEIGHT / 2) < FOCAL * 0.25 / z
            )
            image[inside] = colors[index] / 255
        Image.fromarray((image * 255).astype(np.uint8)).save(
            folder / "images" / f"{view:02d}.jpg", quality=95
        )
        pose = " ".join(f"{value:.17g}" for value in (*quaternion(matrix[:3, :3]), *matrix[:3, 3]))
        lines.append(f"{view + 1} {pose} 1 {view:02d}.jpg\n\n")
    model = folder / "sparse" / "0"
    (model / "images.txt").write_text("".join(lines))
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    (model / "points3D.txt").write_text(
        "".join(
            f"{i + 1} {x:.17g} {y:.17g} {z:.17g} {r} {g} {b} 0.5 1 0\n"
            for i, ((x, y, z), (r, g, b)) in enumerate(zip(means, colors, strict=True))
        )
    )
    return folder


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny")


@pytest.fixture(scope="module")
def data(tiny_scene):
    """Training data of the tiny scene."""
    from training.optimize.training_data import TrainingData
    from training.scenes.colmap import read_scene

    return TrainingData(read_scene(tiny_scene), test_every=4)


@pytest.fixture(scope="session")
def tested_graphics() -> None:
    """Skip tests without a graphics device. Software rendering is used if there is no graphics card."""
    from training.errors import LodgsError
    from training.rasterize import self_test
    from training.rasterize.gpu import default_device

    try:
        if all(adapter.software for adapter in default_device.adapters()):
            os.environ.setdefault(default_device.VARIABLE, "software")
        device = default_device.open_default_device()
    except LodgsError as problem:
        pytest.skip(f"no graphics device: {problem}")
    assert self_test.run_self_test(device.adapter) == "", "otherwise tests would use the cpu backend"


@pytest.fixture
def graphics(tested_graphics):
    """Return the device of the gpu backend, reopened if a test has lost it."""
    from training.rasterize.gpu import default_device

    return default_device.open_default_device()


@pytest.fixture
def fake_card(monkeypatch):
    """Run the cuda backend's kernels on the CPU."""
    from tests.training.rasterize.fake_card import cpu_kernels, find_compiler
    from training.rasterize import cuda
    from training.rasterize.cuda import driver

    if not find_compiler():
        pytest.skip("no C++ compiler for Linux")
    monkeypatch.setattr(driver, "kernels", cpu_kernels)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(cuda, "find_problem", lambda: None)
