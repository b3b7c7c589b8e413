"""COLMAP scenes made for tests and written by pycolmap; their photographs are written by pycolmap too.

Pillow saves no PNG here: beside pycolmap in one process that corrupts memory.
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
    """A camera of the given model; `distortion` replaces the usual parameters for it."""
    made = pycolmap.Camera.create_from_model_name(1, model, 80.0, WIDTH, HEIGHT)
    intrinsics = len(made.focal_length_idxs()) + 2
    params = np.array(made.params, float)
    params[:intrinsics] = [80.0, 47.0, 37.0] if intrinsics == 3 else [80.0, 82.0, 47.0, 37.0]
    params[intrinsics:] = DISTORTION.get(model, []) if distortion is None else distortion
    made.params = params
    return made


def write_scene(
    folder: Path,
    lens: pycolmap.Camera | None = None,
    names=("a.png", "b.png", "c.png"),
    points: int = 50,
    model="sparse/0",
    pixels=None,
) -> pycolmap.Reconstruction:
    """A scene of one camera, binary, whose photographs hold `pixels` or noise; tracks have 0 to 3 entries."""
    random = np.random.default_rng(7)
    lens = lens or camera("PINHOLE")
    lens.camera_id = 1
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(lens)
    for number, name in enumerate(names, start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        image.points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(xy) for xy in random.uniform(0, 70, (points, 2))]
        )
        quaternion = random.normal(size=4)
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), random.normal(size=3)
        )
        made.add_image_with_trivial_frame(image, pose)
    for number in range(points):
        track = pycolmap.Track()
        for image in range(1, 1 + number % (len(names) + 1)):
            track.add_element(image, number)
        # Black points, points at the origin: runs of zero bytes, in which a reader can lose its way.
        color = random.integers(0, 256, 3).astype(np.uint8) * (number % 3 > 0)
        made.add_point3D(random.normal(size=3) * (number % 5 > 0), track, color)
    (folder / model).mkdir(parents=True)
    made.write_binary(str(folder / model))
    for name in names:
        write_image(folder / "images" / name, noise() if pixels is None else pixels)
    return made


def noise(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3)).astype(np.uint8)


def write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)).write(str(path))
