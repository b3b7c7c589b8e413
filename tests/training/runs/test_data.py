"""Training data of a job: undecodable photos and exposure differences."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from tests.training.conftest import write_tiny_scene
from tests.training.scenes import synthetic
from tools.quality_scenes import SUBSETS, write_subset
from training.errors import LodgsError, SystemProblem
from training.optimize.training_data import TrainingData
from training.runs.data import training_data
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.colmap import read_scene
from training.scenes.images import write_png

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def corrupt(path) -> None:
    """Destroy a JPEG's Huffman table: its header and end stay intact, its pixels cannot be decoded."""
    data = path.read_bytes()
    offset = data.index(b"\xff\xc4")
    path.write_bytes(data[: offset + 5] + bytes([255]) * 16 + data[offset + 21 :])


def read(scene, run, **options):
    warnings = []
    data = training_data(
        Job(str(scene), str(run), image_scale=1.0),
        RunFolder(run),
        lambda kind, **values: warnings.append(values) if kind == "warning" else None,
        **options,
    )
    return data, [values["message"] for values in warnings]


def test_undecodable_photos_are_excluded(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    corrupt(scene / "images" / "03.jpg")
    data, warnings = read(scene, tmp_path / "run")
    names = [camera.name for camera in data.scene.cameras]
    assert len(names) == 8 and "03.jpg" not in names
    (message,) = warnings
    assert message.startswith("Skipped 03.jpg: ") and "as an image" in message
    for index in range(len(data.train)):
        data.target(index)
    assert len(read(scene, tmp_path / "run", pixels=False)[0].scene.cameras) == 9


@pytest.mark.parametrize("code", ["EMFILE", "EIO", "ESTALE", "ENOMEM", "EACCES"])
@pytest.mark.parametrize("call", ["open", "stat"])
def test_system_errors_do_not_exclude_photos(tmp_path, monkeypatch, call, code):
    scene = write_tiny_scene(tmp_path / "scene")
    number = getattr(errno, code)
    original = getattr(os, call)

    def fail(path, *arguments, **options):
        if str(path).endswith("03.jpg"):
            raise OSError(number, os.strerror(number), str(path))
        return original(path, *arguments, **options)

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(SystemProblem, match=rf"Cannot read .*03\.jpg: {os.strerror(number)}"):
        read(scene, tmp_path / "run")


def test_resumed_run_requires_its_views(tmp_path):
    scene, run = write_tiny_scene(tmp_path / "scene"), RunFolder(tmp_path / "run")
    run.create()
    photo, other = scene / "images" / "03.jpg", (scene / "images" / "04.jpg").read_bytes()
    content = photo.read_bytes()
    names = [camera.name for camera in read(scene, run.path, keep_views=True)[0].scene.cameras]
    photo.unlink()
    assert len(read(scene, run.path, keep_views=True)[0].scene.cameras) == 8, "no step depends on the views"
    (run.checkpoints / "step_0000001.pt").touch()
    photo.write_bytes(content)
    data, warnings = read(scene, run.path, keep_views=True)
    assert [camera.name for camera in data.scene.cameras] == [name for name in names if name != "03.jpg"]
    assert warnings == ["Skipped 03.jpg: the run began without it."]
    run.views.unlink()
    read(scene, run.path, keep_views=True)
    photo.unlink()
    message = r"Cannot resume .* 1 of its 9 photos changed or are missing, such as 03\.jpg\. Restore"
    with pytest.raises(LodgsError, match=message):
        read(scene, run.path, keep_views=True)
    photo.write_bytes(other)
    assert len(read(scene, run.path, keep_views=True)[0].scene.cameras) == 9
    write_png(photo, np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(LodgsError, match=message):
        read(scene, run.path, keep_views=True)


def test_photo_replaced_during_training_is_reported(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    data, _ = read(scene, tmp_path / "run")
    image = data.train[0].image
    assert image is not None
    write_png(image, np.zeros((21, 33, 3), np.uint8))
    with pytest.raises(LodgsError, match=rf"the size of .*{image.name} changed from \d+x\d+ to 33x21 pixels"):
        data.target(0)


def test_undecodable_photos_are_excluded_before_undistortion(tmp_path):
    synthetic.write_scene(tmp_path, synthetic.camera("RADIAL"), names=["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    corrupt(tmp_path / "images" / "c.jpg")
    data, warnings = read(tmp_path, tmp_path / "run")
    assert [camera.name for camera in data.scene.cameras] == ["a.jpg", "b.jpg", "d.jpg"]
    assert sum("Skipped" in message for message in warnings) == 1


def test_scene_without_decodable_photos_is_rejected(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    for path in (scene / "images").iterdir():
        corrupt(path)
    with pytest.raises(LodgsError, match="any view of"):
        read(scene, tmp_path / "run")


def test_exposure_differences_are_compensated_unless_disabled(tmp_path):
    scene = tmp_path / "copy"
    write_subset(GARDEN, scene, SUBSETS["jittered"], stops=0.5)

    def exposure_error(**parameters):
        job = Job(str(scene), str(tmp_path / "run"), image_scale=0.25, parameters=parameters)
        reports = []
        data = training_data(job, RunFolder(tmp_path / "run"), lambda kind, **values: reports.append(values))
        original = TrainingData(read_scene(GARDEN), 0.25)
        pairs = [(data.target(view).image, original.target(view).image) for view in range(len(data.train))]
        compensated = any("Compensating exposure" in values["message"] for values in reports)
        return float(np.mean([(image - truth).abs().mean() for image, truth in pairs])), compensated

    error, compensated = exposure_error(match_exposure=False)
    assert not compensated
    compensated_error, compensated = exposure_error()
    assert compensated_error < error / 2 and compensated
