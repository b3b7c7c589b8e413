"""Folders, files and requests that Blender and the renderer exchange."""

import json

import numpy as np
import pytest

from training.errors import LodgsError
from training.render import wire
from training.render.requests import CancelRequest, frame_number, parse_line, parse_request
from training.scenes.cameras import camera_to_dict


def test_only_claimed_folders_are_removed(tmp_path):
    """Folders with other contents are neither claimed nor removed."""
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("dear")
    with pytest.raises(LodgsError, match="is not empty"):
        wire.claim_folder(photos)
    wire.release_folder(photos)
    assert [path.name for path in photos.iterdir()] == ["a.jpg"]
    for folder in (tmp_path / "new", tmp_path / "empty"):
        if folder.name == "empty":
            folder.mkdir()
        wire.claim_folder(folder)
        (folder / "set-1").write_bytes(b"1234")
        wire.claim_folder(folder)  # claimed already
        (folder / "photos").mkdir()
        (folder / "photos" / "b.jpg").write_text("dear")
        wire.release_folder(folder)
        assert [path.name for path in folder.iterdir()] == ["photos"]
    wire.claim_folder(tmp_path / "gone")
    wire.release_folder(tmp_path / "gone")
    assert not (tmp_path / "gone").exists()
    with pytest.raises(LodgsError, match="Cannot create"):
        wire.claim_folder(photos / "a.jpg")


def test_extra_columns_round_trip(make_splats, tmp_path):
    splats = make_splats(5)
    splats.extras |= {"lod_bias": np.arange(5, dtype=np.float32), "sigma_d": np.ones(5, np.float32)}
    columns = wire.pack_set(splats, None)
    wire.write_set(tmp_path / "set", columns)
    actual, weights = wire.read_set(tmp_path / "set", 5, list(splats.extras))
    assert actual.extras.keys() == splats.extras.keys() and (weights == 1).all()
    for column, expected in zip(wire.pack_set(actual, weights), columns, strict=True):
        np.testing.assert_array_equal(column, expected)
    with pytest.raises(LodgsError, match="does not contain"):
        wire.read_set(tmp_path / "set", 5, ["lod_bias"])
    for number in range(len(columns)):
        changed = [column.copy() for column in columns]
        changed[number][-1] += 1e-3
        assert wire.digest(changed) != wire.digest(columns)
    assert wire.digest([column.copy() for column in columns]) == wire.digest(columns)


def test_set_size_is_checked(make_splats, tmp_path):
    path = tmp_path / "set"
    for count, degree in ((5, 3), (1, 0), (0, 0)):
        splats, weights = make_splats(count, degree), np.linspace(0, 1, count, dtype=np.float32)
        wire.write_set(path, wire.pack_set(splats, weights))
        actual, actual_weights = wire.read_set(path, count)
        np.testing.assert_array_equal(actual.means, splats.means)
        assert np.array_equal(actual_weights, weights) and actual.sh.shape[0] == count
        for wrong in (count + 1, 1 << 29):
            with pytest.raises(LodgsError, match="does not contain"):
                wire.read_set(path, wrong)
    path.write_bytes(b"12345")
    with pytest.raises(LodgsError, match="Cannot read the set of splats set"):
        wire.read_set(path, 1)
    for name in ("absent", "."):
        with pytest.raises(LodgsError, match="it does not exist"):
            wire.read_set(tmp_path / name, 1)


@pytest.fixture
def valid(camera) -> dict:
    item = {"file": "set-1", "count": 3, "matrix": np.eye(4).tolist(), "level": 2}
    return {"frame": 1, "out": "frame-1", "camera": camera_to_dict(camera, 0.1), "sets": [item]}


def test_request_is_parsed(valid, camera):
    request = parse_request(
        parse_line(json.dumps(valid | {"window": [1, 2, 3, 4], "background": [0, 1, 2]}).encode())
    )
    assert request.window == (1, 2, 3, 4) and request.background == (0.0, 1.0, 2.0) and request.near == 0.1
    assert request.sets[0].file == "set-1" and request.sets[0].level == 2 and not request.depth
    assert camera_to_dict(request.camera, 0.1) == camera_to_dict(camera, 0.1)
    assert parse_request({"cancel": 3}) == CancelRequest(3)
    assert frame_number(valid) == 1 and frame_number({"frame": []}) is None


@pytest.mark.parametrize(
    "change",
    [
        {"cancel": {}}, {"cancel": True}, {"frame": "1"}, {"frame": None}, {"out": "../x"}, {"out": ".x"},
        {"out": ""}, {"out": 3}, {"camera": []}, {"sets": {}}, {"sets": [3]}, {"sets": None},
        {"background": [1, 2]}, {"background": [1, 2, 1e30]}, {"background": "red"},
        {"background": [True] * 3},
        {"window": [0, 0, 65, 1]}, {"window": [0, 0, 0, 0]}, {"window": [0.5, 0, 1, 1]}, {"window": 3},
        {"window": [0, 0, 1, 1], "photograph": "a.png"}, {"holdout": 3}, {"photograph": ["a"]}, {"mask": 1},
    ],
)  # fmt: skip
def test_invalid_requests_raise_one_sentence(valid, change):
    with pytest.raises(LodgsError, match="Cannot read the request"):
        parse_request(valid | change)


@pytest.mark.parametrize(
    "change",
    [
        {"count": -1}, {"count": 1 << 40}, {"count": 1.5}, {"matrix": [[1, 0], [0, 1]]}, {"matrix": 1},
        {"matrix": np.full((4, 4), 1e300).tolist()}, {"matrix": np.ones((4, 4)).tolist()}, {"level": -1},
        {"level": None}, {"file": "/etc/passwd"}, {"file": "a\0"}, {"file": "C:x"},
        {"matrix": [["a"] * 4] * 4}, {"columns": "a"}, {"columns": ["a", "a"]}, {"columns": ["../a"]},
        {"columns": [1]}, {"columns": [f"a{i}" for i in range(40)]}, {"query": 1}, {"query": []},
        {"matrix": [[1, 0, 0, [0]], *np.eye(4)[1:].tolist()]},
    ],
)  # fmt: skip
def test_invalid_sets_raise_one_sentence(valid, change):
    valid["sets"][0] |= change
    with pytest.raises(LodgsError, match="Cannot read the request"):
        parse_request(valid)


@pytest.mark.parametrize(
    "line", [b"no json", b"[]", b"[" * 5000, b"\xff", b'{"a": 1e999}', b'{"frame": NaN}', b""]
)
def test_invalid_lines_raise_one_sentence(line):
    with pytest.raises(LodgsError, match="A request is not valid"):
        parse_line(line)
