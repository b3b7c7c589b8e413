"""Synthetic COLMAP scenes and photos, written by pycolmap.

Pillow must not save PNGs here: in one process with pycolmap, that corrupts memory.
"""

from pathlib import Path

import numpy as np
import pycolmap

WIDTH, HEIGHT = 96, 72
DISTORTION = {
    "SIMPLE_RADIAL": [0.1],
    "RADIAL": [0.1, -0.02],
    "OPENCV": [0.1, -0.02, 0.005, -0.004],
    "OPENCV_FISHEYE": [0.05, -0.02, 0.003, -0.001],
    "FULL_OPENCV": [0.1, -0.02, 0.005, -0.004, 0.01, 0.02, -0.01, 0.005],
    "FOV": [0.6],
    "SIMPLE_RADIAL_FISHEYE": [0.05],
    "RADIAL_FISHEYE": [0.05, -0.02],
    "THIN_PRISM_FISHEYE": [0.05, -0.02, 0.002, -0.001, 0.003, -0.001, 0.002, 0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.05, -0.02, 0.003, 0.001, 0.0, 0.0, 0.002, 0.001, 0.001, 0.0, 0.001, 0.0],
    "SIMPLE_DIVISION": [-0.1],
    "DIVISION": [-0.1],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [0.4, 1.1],
}
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")


def camera(model: str, distortion=None) -> pycolmap.Camera:
    """Return a camera of the given model; ``distortion`` replaces the default parameters."""
    result = pycolmap.Camera.create_from_model_name(1, model, 80.0, WIDTH, HEIGHT)
    intrinsics = len(result.focal_length_idxs()) + 2
    params = np.array(result.params, float)
    params[:intrinsics] = [80.0, 47.0, 37.0] if intrinsics == 3 else [80.0, 82.0, 47.0, 37.0]
    params[intrinsics:] = DISTORTION.get(model, []) if distortion is None else distortion
    result.params = params
    return result


def write_scene(
    folder: Path,
    lens: pycolmap.Camera | None = None,
    names=("a.png", "b.png", "c.png"),
    points: int = 50,
    model="sparse/0",
    pixels=None,
) -> pycolmap.Reconstruction:
    """Write a binary scene of one camera with photos of ``pixels`` or noise; tracks have 0 to 3 entries."""
    random = np.random.default_rng(7)
    lens = lens or camera("PINHOLE")
    lens.camera_id = 1
    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(lens)
    for number, name in enumerate(names, start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        image.points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(xy) for xy in random.uniform(0, 70, (points, 2))]
        )
        quaternion = random.normal(size=4)
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), random.normal(size=3)
        )
        scene.add_image_with_trivial_frame(image, pose)
    for number in range(points):
        track = pycolmap.Track()
        for image in range(1, 1 + number % (len(names) + 1)):
            track.add_element(image, number)
        # Black points and points at the origin: runs of zero bytes that could confuse the reader.
        color = random.integers(0, 256, 3).astype(np.uint8) * (number % 3 > 0)
        scene.add_point3D(random.normal(size=3) * (number % 5 > 0), track, color)
    (folder / model).mkdir(parents=True)
    scene.write_binary(str(folder / model))
    for name in names:
        write_image(folder / "images" / name, noise() if pixels is None else pixels)
    return scene


def noise(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return random pixels, (height, width, 3) uint8."""
    return np.random.default_rng(3).integers(0, 256, (height, width, 3)).astype(np.uint8)


def write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)).write(str(path))
