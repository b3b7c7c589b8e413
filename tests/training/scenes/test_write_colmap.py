"""Written COLMAP models, read back by pycolmap; a disk that is too small leaves the old model."""

import resource
from contextlib import contextmanager

import numpy as np
import pycolmap
import pytest

from training.scenes.cameras import Camera, look_at
from training.scenes.write_colmap import write_colmap


def make_views() -> list[Camera]:
    """Return three views with two lenses."""
    origins = np.array([[3.0, 0.2, 1.0], [0.5, 3.0, 1.2], [-2.0, 2.5, 0.7]])
    return [
        Camera(f"{n} ä.png", 64, 48 + n // 2, 50.0, 51.0, 31.5, 24.0, look_at(origin, np.zeros(3), (0, 0, 1)))
        for n, origin in enumerate(origins)
    ]


@contextmanager
def small_files(size: int):
    """Limit the size of the files that this process can write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def write(scene, count: int) -> tuple[list[Camera], np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    views, points = make_views(), rng.normal(0, 0.2, (count, 3))
    visible, colors = rng.random((3, count)) < 0.7, rng.uniform(0, 255, (count, 3))
    write_colmap(scene, views, points, visible, colors)
    return views, points, visible, colors


def test_pycolmap_reads_cameras_points_and_tracks(tmp_path):
    views, points, visible, colors = write(tmp_path, 40)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert len(model.cameras) == 2 and [model.images[n].name for n in (1, 2, 3)] == [v.name for v in views]
    for number, view in enumerate(views, 1):
        image, lens = model.images[number], model.cameras[model.images[number].camera_id]
        assert lens.model == pycolmap.CameraModelId.PINHOLE and (lens.width, lens.height) == (64, view.height)
        np.testing.assert_array_equal(lens.params, [50, 51, 31.5, 24])
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, view.world_to_camera[:3], atol=1e-12)
        expected, _ = view.project(points[visible[number - 1]])
        np.testing.assert_allclose([point.xy for point in image.points2D], expected, atol=1e-9)
    for row, point in enumerate(points):
        written = model.points3D[row + 1]
        np.testing.assert_array_equal(written.xyz, point)
        np.testing.assert_array_equal(written.color, np.round(colors[row]))
        track = {(entry.image_id, entry.point2D_idx) for entry in written.track.elements}
        assert track == {
            (view + 1, int(visible[view, :row].sum())) for view in np.flatnonzero(visible[:, row])
        }


@pytest.mark.parametrize("size", [0, 100, 700, 3000])
def test_model_is_written_completely_or_not_at_all(tmp_path, size):
    write(tmp_path, 40)
    folder = tmp_path / "sparse" / "0"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(OSError, match="too large"), small_files(size):
        write(tmp_path, 200)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == ["0"]
