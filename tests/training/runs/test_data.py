"""What a job trains on: photographs that can be decoded, and what is said of the others."""

from pathlib import Path

import numpy as np
import pytest

from lab.jitter import jittered
from tests.training.conftest import write_tiny_scene
from tests.training.scenes import synthetic
from training.errors import LodgsError
from training.optimize.training_data import TrainingData
from training.runs.data import training_data
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.colmap import read_scene

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def torn(path) -> None:
    """Whole by its header and its end, without tables to decode it by."""
    data = path.read_bytes()
    at = data.index(b"\xff\xc4")
    path.write_bytes(data[: at + 5] + bytes([255]) * 16 + data[at + 21 :])


def read(scene, run, **options):
    told = []
    data = training_data(
        Job(str(scene), str(run), image_scale=1.0),
        RunFolder(run),
        lambda kind, **values: told.append(values) if kind == "warning" else None,
        **options,
    )
    return data, [values["message"] for values in told]


def test_a_photograph_that_cannot_be_decoded_is_left_out(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    torn(scene / "images" / "03.jpg")
    data, told = read(scene, tmp_path / "run")
    names = [camera.name for camera in data.scene.cameras]
    assert len(names) == 8 and "03.jpg" not in names
    (message,) = told
    assert message.startswith("03.jpg is left out: ") and "cannot be read as an image" in message
    for index in range(len(data.train)):
        data.target(index)
    assert len(read(scene, tmp_path / "run", pixels=False)[0].scene.cameras) == 9


def test_before_its_lens_is_undone(tmp_path):
    synthetic.write_scene(tmp_path, synthetic.camera("RADIAL"), names=["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    torn(tmp_path / "images" / "c.jpg")
    data, told = read(tmp_path, tmp_path / "run")
    assert [camera.name for camera in data.scene.cameras] == ["a.jpg", "b.jpg", "d.jpg"]
    assert sum("left out" in message for message in told) == 1


def test_where_none_can_be_decoded(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    for path in (scene / "images").iterdir():
        torn(path)
    with pytest.raises(LodgsError, match="No view of"):
        read(scene, tmp_path / "run")


def test_photographs_of_differing_exposure_are_evened_unless_that_is_switched_off(tmp_path):
    scene = tmp_path / "copy"
    jittered(GARDEN, scene, 0.7, 0, 8)

    def apart(**parameters):
        job = Job(str(scene), str(tmp_path / "run"), image_scale=0.25, parameters=parameters)
        told = []
        data = training_data(job, RunFolder(tmp_path / "run"), lambda kind, **values: told.append(values))
        original = TrainingData(read_scene(GARDEN), 0.25)
        pairs = [(data.target(view).image, original.target(view).image) for view in range(len(data.train))]
        evened = any("evened" in values["message"] for values in told)
        return float(np.mean([(one - other).abs().mean() for one, other in pairs])), evened

    (before, untold), (after, told) = apart(match_exposure=False), apart()
    assert after < before / 2 and told and not untold
