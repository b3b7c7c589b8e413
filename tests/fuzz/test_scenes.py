"""Scenes: binary and text COLMAP models, and cameras as JSON."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted, corrupted_value
from tests.training.scenes import synthetic
from training.scenes.cameras import MAX_COORDINATE, Camera, camera_to_dict, read_camera
from training.scenes.colmap import read_scene
from training.scenes.observations import observed_pixels
from training.splats.georeference import ECEF, FILE, Georeference, read_georeference

CAMERA = camera_to_dict(Camera("a.png", 96, 72, 80.0, 82.0, 47.0, 37.0, np.eye(4)), 0.1)
PLACE = Georeference(ECEF, np.diag([2.0, 2.0, 2.0, 1.0])).to_json()
PROJECTION = (
    'PROJCS["WGS 84 / UTM zone 31N",GEOGCS["WGS 84",DATUM["WGS_1984",'
    'SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["central_meridian",3],UNIT["metre",1],AUTHORITY["EPSG","32631"]]'
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Write photos and valid models."""
    folder = tmp_path_factory.mktemp("scene")
    truth = synthetic.write_scene(folder, model="binary", points=40)
    (folder / "text").mkdir()
    truth.write_text(str(folder / "text"))
    return folder


@pytest.fixture(scope="module")
def files(scene) -> dict[str, dict[str, bytes]]:
    """Return the three files of each model by suffix and name."""
    names = ("cameras", "images", "points3D")
    return {
        suffix: {f"{name}{suffix}": (scene / kind / f"{name}{suffix}").read_bytes() for name in names}
        for kind, suffix in (("binary", ".bin"), ("text", ".txt"))
    }


def check(scene, model, content: object) -> None:
    """Check that an accepted scene is usable: photos exist, positions and extents are finite."""
    result = attempt("COLMAP", lambda: read_scene(scene, model=model), content)
    if result is not None:
        assert result.cameras and all(camera.image.is_file() and not camera.flaw for camera in result.cameras)
        assert (
            len(result.points) == len(result.point_colors)
            and np.abs(result.points).max(initial=0) <= MAX_COORDINATE
        )
        assert np.isfinite(result.extent(default=1.0) if len(result.points) else result.center).all()
        assert np.isfinite(result.up_rotation()).all()
        assert "".join(result.warnings).encode() is not None  # printable
        names = [camera.name for camera in result.cameras]
        attempt("COLMAP observations", lambda: observed_pixels(result, names), content)


@pytest.mark.cases(short=150, weight=3)
@given(data=st.data(), suffix=st.sampled_from([".bin", ".txt"]))
def test_corrupt_models(scene, files, data, suffix):
    model = scene / "tried"
    shutil.rmtree(model, ignore_errors=True)
    model.mkdir()
    valid = files[suffix]
    target = data.draw(st.sampled_from(sorted(valid)))
    replacement = data.draw(corrupted([valid[target]]))
    for name, content in (valid | {target: replacement}).items():
        (model / name).write_bytes(content)
    check(scene, model, (target, replacement))


@pytest.mark.cases(short=80, weight=1)
@given(
    names=st.lists(
        st.one_of(st.text(max_size=12), st.sampled_from(["a.png", "../a.png", "b.png/", "."])), max_size=4
    ),
    pose=st.lists(st.floats(), min_size=7, max_size=7),
    lens=st.lists(st.floats(), min_size=4, max_size=4),
)
def test_unusual_names_and_numbers(scene, names, pose, lens):
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
@given(values=corrupted_value(CAMERA))
def test_cameras_with_unusual_values(scene, values):
    path = scene / "camera.json"
    path.write_text(json.dumps(values))
    answer = attempt("camera", lambda: read_camera(path), values)
    if answer is not None:
        camera, near = answer
        assert not camera.flaw and near >= 0 and np.isfinite(camera.center).all()


@given(data=st.data())
def test_corrupt_camera_files(scene, data):
    text = data.draw(corrupted([json.dumps(CAMERA).encode()]))
    path = scene / "text.json"
    path.write_bytes(text)
    attempt("camera", lambda: read_camera(path), text)


def check_place(folder, name: str, content: bytes) -> None:
    """Check that a place on Earth is valid, or ignored with a warning."""
    for path in [*folder.glob("*.prj"), folder / FILE]:
        path.unlink(missing_ok=True)
    (folder / name).write_bytes(content)
    warnings = []
    place = attempt("place on Earth", lambda: read_georeference(folder, warnings.append), (name, content))
    if place is None:
        assert len(warnings) == 1 and warnings[0].encode()
        return
    assert not warnings and np.isfinite(np.linalg.inv(place.matrix)).all()
    assert Georeference.from_json(json.loads(json.dumps(place.to_json()))).crs == place.crs


@pytest.mark.cases(short=100, weight=1)
@given(data=st.data(), name=st.sampled_from([FILE, "utm.prj"]))
def test_corrupt_places(tmp_path_factory, data, name):
    seed = (json.dumps(PLACE) if name == FILE else PROJECTION).encode()
    content = data.draw(corrupted([seed, seed.decode().encode("utf-16")]))
    check_place(tmp_path_factory.getbasetemp(), name, content)


@pytest.mark.cases(short=60, weight=0.5)
@given(values=corrupted_value(PLACE))
def test_places_with_unusual_values(tmp_path_factory, values):
    content = json.dumps(values).encode("utf-8", "surrogatepass")
    check_place(tmp_path_factory.getbasetemp(), FILE, content)
