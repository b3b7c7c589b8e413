"""The generated large scene is a valid COLMAP scene."""

import numpy as np
import pycolmap

from lab.large_scene import TRACK, write_large
from training.scenes.colmap import read_scene


def test_large_scene_has_consistent_tracks(tmp_path):
    image = pycolmap.Bitmap.from_array(np.zeros((64, 96, 3), np.uint8))
    image.write(tmp_path / "image.jpg")
    write_large(tmp_path / "large", 200, 10, (tmp_path / "image.jpg").read_bytes())
    model = pycolmap.Reconstruction(tmp_path / "large" / "sparse" / "0")
    assert (model.num_points3D(), model.num_reg_images(), model.num_cameras()) == (200, 10, 1)
    for number, point in model.points3D.items():
        for element in point.track.elements:
            assert model.images[element.image_id].points2D[element.point2D_idx].point3D_id == number
    assert all(point.track.length() == TRACK for point in model.points3D.values())
    scene = read_scene(tmp_path / "large")
    assert len(scene.cameras) == 10 and all(camera.image is not None for camera in scene.cameras)
    assert 9 < scene.median_depth() < 11
