"""Views of known points for tests of other programs' exports.

Expected pixels follow the program's own formula; actual pixels come from pycolmap and the converted scene.
"""

from pathlib import Path

import numpy as np
import pycolmap

from training.scenes.colmap import read_scene

from .synthetic import write_image

WIDTH, HEIGHT, FOCAL, CENTER = 96, 72, (80.0, 82.0), (47.0, 37.0)
NAMES = "first.png", "second photo.png", "third.png"
POINTS = np.random.default_rng(3).uniform(-0.4, 0.4, (40, 3))
LENS = {"k1": 0.1, "k2": -0.02, "p1": 0.005, "p2": -0.004}


def poses() -> list[np.ndarray]:
    """Return camera-to-world poses (4, 4) in OpenGL axes, about 3 away from the origin that they face."""
    result = []
    for angle in (0.0, 0.9, 2.2):
        back = np.array([np.cos(angle), np.sin(angle), 0.3])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = 3 * back
        result.append(pose)
    return result


def project(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x / depth (right) and y / depth (down) of POINTS for a pose in OpenGL axes."""
    local = (POINTS - pose[:3, 3]) @ pose[:3, :3]
    return local[:, 0] / -local[:, 2], -local[:, 1] / -local[:, 2]


def opencv(x, y, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """Distort with OpenCV's model (docs.opencv.org, calib3d)."""
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
        y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
    )


def pixels(x, y, focal=FOCAL, center=CENTER):
    return np.stack([focal[0] * x + center[0], focal[1] * y + center[1]], axis=1)


def write_photos(folder: Path, names=NAMES, size=(WIDTH, HEIGHT)) -> None:
    for name in names:
        write_image(folder / name, np.full((size[1], size[0], 3), 90, np.uint8))


def project_with_colmap(scene: Path, points=POINTS) -> dict[str, np.ndarray]:
    """Return the pixels of POINTS in each photo according to pycolmap."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    return {
        image.name: np.array([image.project_point(point) for point in points])
        for image in model.images.values()
    }


def check(scene: Path, expected: list[np.ndarray], names=NAMES, atol=1e-3) -> None:
    actual = project_with_colmap(scene)
    assert sorted(actual) == sorted(names)
    for name, view_pixels in zip(names, expected, strict=True):
        np.testing.assert_allclose(actual[name], view_pixels, atol=atol)
    assert len(read_scene(scene).cameras) == len(names)
