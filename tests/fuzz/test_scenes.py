"""The doors of scenes: COLMAP models, binary and text, and cameras as JSON."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.doors import attempt
from tests.fuzz.mutations import spoiled, spoiled_value
from tests.training.scenes import synthetic
from training.scenes.cameras import MAX_COORDINATE, Camera, camera_to_dict, read_camera
from training.scenes.colmap import read_scene

CAMERA = camera_to_dict(Camera("a.png", 96, 72, 80.0, 82.0, 47.0, 37.0, np.eye(4)), 0.1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Photographs, and beside them a folder for the model that is tried."""
    folder = tmp_path_factory.mktemp("scene")
    truth = synthetic.write_scene(folder, model="binary", points=40)
    (folder / "text").mkdir()
    truth.write_text(str(folder / "text"))
    return folder


@pytest.fixture(scope="module")
def files(scene) -> dict[str, dict[str, bytes]]:
    """The three files of the model by the kind and their names."""
    names = ("cameras", "images", "points3D")
    return {
        suffix: {f"{name}{suffix}": (scene / kind / f"{name}{suffix}").read_bytes() for name in names}
        for kind, suffix in (("binary", ".bin"), ("text", ".txt"))
    }


def check(scene, model, given: object) -> None:
    """What is read can be used: photographs are there, everything has a place, extents are numbers."""
    found = attempt("COLMAP", lambda: read_scene(scene, model=model), given)
    if found is not None:
        assert found.cameras and all(camera.image.is_file() and not camera.flaw for camera in found.cameras)
        assert (
            len(found.points) == len(found.point_colors)
            and np.abs(found.points).max(initial=0) <= MAX_COORDINATE
        )
        assert np.isfinite(found.extent() if len(found.points) else found.center).all()
        assert np.isfinite(found.up_rotation()).all()
        assert "".join(found.warnings).encode() is not None  # can be printed


@pytest.mark.cases(short=150, weight=3)
@given(data=st.data(), suffix=st.sampled_from([".bin", ".txt"]))
def test_models(scene, files, data, suffix):
    model = scene / "tried"
    shutil.rmtree(model, ignore_errors=True)
    model.mkdir()
    whole = files[suffix]
    chosen = data.draw(st.sampled_from(sorted(whole)))
    spoilt = data.draw(spoiled([whole[chosen]]))
    for name, content in (whole | {chosen: spoilt}).items():
        (model / name).write_bytes(content)
    check(scene, model, (chosen, spoilt))


@pytest.mark.cases(short=80, weight=1)
@given(
    names=st.lists(
        st.one_of(st.text(max_size=12), st.sampled_from(["a.png", "../a.png", "b.png/", "."])), max_size=4
    ),
    pose=st.lists(st.floats(), min_size=7, max_size=7),
    lens=st.lists(st.floats(), min_size=4, max_size=4),
)
def test_names_and_numbers(scene, names, pose, lens):
    model = scene / "numbers"
    model.mkdir(exist_ok=True)
    (model / "cameras.txt").write_text(
        f"1 PINHOLE 96 72 80 80 48 36\n2 PINHOLE 96 72 {' '.join(map(repr, lens))}\n"
    )
    lines = ["1 1 0 0 0 0 0 0 1 a.png", *(f"9 {' '.join(map(repr, pose))} 2 {name}" for name in names)]
    text = "\n\n".join([*lines, "8 1 0 0 0 1 0 0 1 b.png", ""])
    (model / "images.txt").write_bytes(text.encode("utf-8", "surrogatepass"))
    (model / "points3D.txt").write_text(f"1 {' '.join(map(repr, pose[:3]))} 1 2 3 0\n2 0 0 5 1 2 3 0\n")
    check(scene, model, text)


@pytest.mark.cases(short=150, weight=2)
@given(values=spoiled_value(CAMERA))
def test_cameras(scene, values):
    path = scene / "camera.json"
    path.write_text(json.dumps(values))
    answer = attempt("camera", lambda: read_camera(path), values)
    if answer is not None:
        camera, near = answer
        assert not camera.flaw and near >= 0 and np.isfinite(camera.center).all()


@given(data=st.data())
def test_texts_of_cameras(scene, data):
    text = data.draw(spoiled([json.dumps(CAMERA).encode()]))
    path = scene / "text.json"
    path.write_bytes(text)
    attempt("camera", lambda: read_camera(path), text)
