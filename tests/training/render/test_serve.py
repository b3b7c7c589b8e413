"""The renderer process: its answers and its end."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from training.__main__ import main
from training.lod.query import LodQuery
from training.lod.rule import rules
from training.render import wire
from training.render.scene import Instance, SplatSet, draw
from training.scenes.cameras import camera_to_dict

ROOT = Path(__file__).resolve().parents[3]


class Client:
    """A renderer process with its streams."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self.hello: dict = {}
        folder.mkdir()
        command = [sys.executable, "-m", "training", "serve", str(folder), *options]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def send(self, **request) -> None:
        self.send_line(json.dumps(request))

    def send_line(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def receive(self, *kinds: str) -> dict:
        """Return the next answer of one of these kinds."""
        assert self.process.stdout is not None
        while True:
            event = json.loads(self.process.stdout.readline())
            if event["event"] in kinds:
                return event


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """A renderer that the tests share, because it takes seconds to start. Each test names its own sets."""
    yield from start(tmp_path_factory.mktemp("client"))


@pytest.fixture
def own_client(tmp_path):
    """A renderer that the test may end."""
    yield from start(tmp_path)


def start(folder: Path):
    client = Client(folder / "frames", "--backend", "cpu")
    client.hello = client.receive("hello")
    yield client
    client.process.kill()
    client.process.wait()


def request(camera, sets, frame=1, **values) -> dict:
    return {"frame": frame, "out": "frame", "camera": camera_to_dict(camera, 0.01), "sets": sets, **values}


def test_frames_match_draw(client, make_splats, camera):
    assert client.hello["protocol"] == wire.PROTOCOL and client.hello["backend"] == "cpu"
    splats, weights = make_splats(80), np.linspace(0, 1, 80, dtype=np.float32)
    wire.write_set(client.folder / "drawn", wire.pack_set(splats, weights))
    matrix = np.diag([2.0, 2, 2, 1])
    sets = [{"file": "drawn", "count": 80, "matrix": matrix.tolist(), "level": 4}]
    for frame in (1, 2, 3):
        if frame == 3:
            sets[0]["antialias"] = True
        client.send(**request(camera, sets, frame, depth=True, levels=True, background=None))
        answer = client.receive("frame", "error")
        assert answer["frame"] == frame
        planes = wire.read_planes(client.folder / "frame", len(answer["passes"]), 48, 64)
        instances = [Instance(SplatSet(splats, weights), matrix, 4, antialias=frame == 3)]
        image = draw(instances, camera, background=None, depth=True, levels=True)
        expected = image.passes()
        assert answer["passes"] == list(expected)
        for expected_plane, plane in zip(expected.values(), planes, strict=True):
            np.testing.assert_array_equal(expected_plane, plane)
        (client.folder / "drawn").unlink(missing_ok=True)  # a set is read only once


def test_queries_select_splats_of_a_set(client, make_splats, camera):
    """The file is read only once. Another camera position selects other splats, and only these are drawn."""
    splats = make_splats(200)
    splats.extras["lod_bias"] = np.linspace(-1, 1, 200, dtype=np.float32)
    wire.write_set(client.folder / "queried", wire.pack_set(splats, None))
    rule, images = rules()["octree"], []
    facts = {"level": 2.0, "finer": 3.0, "coarser": 1.0, "levels": 3.0, "d_max": 1.2, "d_max_focal": 1.5}
    values = {"offset": 0.25, "fade": 1}
    for frame, position in enumerate(((0.0, 0.0, 0.5), (0.5, 0.25, -1.0))):
        query = LodQuery("octree", position, 1.5, tuple(facts.items()), tuple(values.items())).as_dict()
        item = {"file": "queried", "count": 200, "matrix": np.eye(4).tolist(), "level": 2}
        client.send(**request(camera, [item | {"columns": ["lod_bias"], "query": query}], frame))
        answer = client.receive("frame", "error")
        planes = wire.read_planes(client.folder / "frame", len(answer["passes"]), 48, 64)
        (client.folder / "queried").unlink(missing_ok=True)
        weights = rule.weights(splats.means, np.float32(position), 1.5, splats.extras, facts, values)
        selected = weights > 0
        assert 20 < selected.sum() < 180
        subset = SplatSet(splats.select(selected), weights[selected])
        expected = draw([Instance(subset)], camera, background=None)
        for expected_plane, plane in zip(expected.passes().values(), planes, strict=True):
            np.testing.assert_array_equal(expected_plane, plane)
        images.append(planes)
    assert np.abs(images[0] - images[1]).max() > 0.1


def test_holdout_is_read_or_reported_missing(client, make_splats, camera, tmp_path):
    splats = make_splats(80)
    wire.write_set(client.folder / "behind", wire.pack_set(splats, None))
    sets = [{"file": "behind", "count": 80, "matrix": np.eye(4).tolist(), "level": 0}]
    depth = np.full((48, 64), 4, np.float32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"L.Depth.Z": depth}).write(str(tmp_path / "depth.exr"))
    options = {"holdout": str(tmp_path / "depth.exr"), "window": [10, 5, 30, 40], "background": None}
    client.send(**request(camera, sets, **options))
    answer = client.receive("frame", "error")
    planes = wire.read_planes(client.folder / "frame", len(answer["passes"]), 40, 30)
    instances, window = [Instance(SplatSet(splats))], (10, 5, 30, 40)
    expected = draw(instances, camera, background=None, window=window, limit=depth[5:45, 10:40])
    unlimited = draw(instances, camera, background=None, window=window)
    np.testing.assert_array_equal(planes[3], expected.linear()[..., 3])
    assert np.abs(unlimited.alpha - expected.alpha).mean() > 0.01
    client.send(**request(camera, sets, 2, holdout=str(tmp_path / "gone.exr")))
    assert "it does not exist" in client.receive("frame", "error")["what"]


def test_invalid_requests_are_answered_with_errors(client, make_splats, camera):
    client.send_line("no json")
    assert "not valid" in client.receive("error")["what"]
    client.send(**request(camera, [{"file": "gone", "count": 3, "matrix": np.eye(4).tolist(), "level": 0}]))
    assert "Cannot read the set of splats gone" in client.receive("error")["what"]
    client.send(**(request(camera, []) | {"camera": {}}))
    assert "'width'" in client.receive("error")["what"]
    client.send(**request(camera, [], 9))
    assert client.receive("frame", "error")["frame"] == 9


def test_malformed_requests_do_not_end_the_renderer(client, make_splats, camera):
    """Unhashable frame numbers and transforms that drop all splats once ended the process."""
    client.send(cancel={})
    assert "Cannot read the request" in client.receive("error")["what"]
    client.send_line("[" * 100_000)
    assert "not valid" in client.receive("error")["what"]
    client.send_line("x" * (3 << 20))  # answered once, however long
    assert "not valid" in client.receive("error")["what"]
    splats = make_splats(50)
    corrupt = make_splats(50)
    for row, value in enumerate((np.nan, np.inf, 1e30)):
        for column in (corrupt.means, corrupt.quats, corrupt.log_scales):
            column[row] = value
        corrupt.sh[row, 1, 2] = value
    corrupt.sh[3, 4, 1], corrupt.opacity_logits[4] = np.nan, np.nan
    shear = np.eye(4)
    shear[0, 1] = 0.5
    for name, rows in (("good", splats.select(slice(5, None))), ("bad", corrupt)):
        wire.write_set(client.folder / name, wire.pack_set(rows, None))
    planes = []
    for frame, (name, count) in enumerate((("good", 45), ("bad", 50))):
        item = {"file": name, "count": count, "matrix": shear.tolist(), "level": 0}
        client.send(**request(camera, [item], frame))
        if name == "bad":
            assert client.receive("warning")["message"].startswith("5 splats of the scene")
        answer = client.receive("frame", "error")
        planes.append(wire.read_planes(client.folder / "frame", len(answer["passes"]), 48, 64))
    np.testing.assert_array_equal(*planes)
    assert np.ptp(planes[0]) > 0.1


def test_foreign_folder_is_refused(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("dear")
    assert main(["serve", str(tmp_path / "photos"), "--backend", "cpu"]) == 2
    output = capsys.readouterr()
    assert "is not empty" in output.err and not output.out
    assert (tmp_path / "photos" / "a.jpg").read_text() == "dear"


@pytest.mark.slow
def test_frame_is_cancelled(client, make_splats, camera):
    wire.write_set(client.folder / "many", wire.pack_set(make_splats(3000), None))
    sets = [{"file": "many", "count": 3000, "matrix": np.eye(4).tolist(), "level": 0}]
    large = camera.resized(8192, 6144)
    client.send(**request(large, sets, 1))
    client.receive("progress")
    client.send(cancel=1)
    answer = client.receive("frame", "cancelled")
    assert (answer["event"], answer["frame"]) == ("cancelled", 1)
    client.send(**request(camera, sets, 2))
    assert client.receive("frame", "cancelled")["frame"] == 2
    assert not (client.folder / "frame").stat().st_size > 8 * 4 * 64 * 48


@pytest.mark.slow
def test_renderer_ends_with_its_client(own_client, make_splats, camera):
    """It ends even in the middle of a large frame, and removes its folder."""
    wire.write_set(own_client.folder / "many", wire.pack_set(make_splats(3000), None))
    sets = [{"file": "many", "count": 3000, "matrix": np.eye(4).tolist(), "level": 0}]
    own_client.send(**request(camera.resized(8192, 6144), sets, 1))
    own_client.receive("progress")
    own_client.process.stdin.close()
    assert own_client.process.wait(timeout=200) == 0
    events = [json.loads(line)["event"] for line in own_client.process.stdout]
    assert set(events) <= {"progress"}, "it finished the frame"
    assert not own_client.folder.exists()


def test_empty_set_is_read_only_once(client, make_splats, camera):
    wire.write_set(client.folder / "none", wire.pack_set(make_splats(0), None))
    sets = [{"file": "none", "count": 0, "matrix": np.eye(4).tolist(), "level": 1}]
    for frame in (1, 2):
        client.send(**request(camera, sets, frame))
        assert client.receive("frame", "error")["event"] == "frame"
        (client.folder / "none").unlink(missing_ok=True)
