"""The renderer as another program: what it answers, and how it ends."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from training.lod.query import LodQuery
from training.lod.rule import rules
from training.render import wire
from training.render.scene import Instance, SplatSet, draw
from training.scenes.cameras import camera_to_dict

ROOT = Path(__file__).resolve().parents[3]


class Client:
    """Starts the renderer and speaks with it."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        folder.mkdir()
        command = [sys.executable, "-m", "training", "serve", str(folder), *options]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def say(self, **request) -> None:
        self.say_line(json.dumps(request))

    def say_line(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def hear(self, *kinds: str) -> dict:
        """The next answer of one of these kinds."""
        assert self.process.stdout is not None
        while True:
            event = json.loads(self.process.stdout.readline())
            if event["event"] in kinds:
                return event


@pytest.fixture
def client(tmp_path):
    client = Client(tmp_path / "frames", "--backend", "cpu")
    yield client
    client.process.kill()
    client.process.wait()


def request(camera, sets, frame=1, **more) -> dict:
    return {"frame": frame, "out": "frame", "camera": camera_to_dict(camera, 0.01), "sets": sets, **more}


def test_frames_are_what_draw_draws(client, make_splats, camera):
    hello = client.hear("hello")
    assert hello["protocol"] == wire.PROTOCOL and hello["backend"] == "cpu"
    splats, weights = make_splats(80), np.linspace(0, 1, 80, dtype=np.float32)
    wire.write_set(client.folder / "one", wire.pack_set(splats, weights))
    matrix = np.diag([2.0, 2, 2, 1])
    sets = [{"file": "one", "count": 80, "matrix": matrix.tolist(), "level": 4}]
    for frame in (1, 2, 3):
        if frame == 3:
            sets[0]["antialias"] = True
        client.say(**request(camera, sets, frame, depth=True, levels=True, background=None))
        answer = client.hear("frame", "error")
        assert answer["frame"] == frame
        planes = wire.read_planes(client.folder / "frame", len(answer["passes"]), 48, 64)
        placed = [Instance(SplatSet(splats, weights), matrix, 4, antialias=frame == 3)]
        picture = draw(placed, camera, background=None, depth=True, levels=True)
        expected = picture.passes()
        assert answer["passes"] == list(expected)
        for plane, there in zip(expected.values(), planes, strict=True):
            np.testing.assert_array_equal(plane, there)
        (client.folder / "one").unlink(missing_ok=True)  # what was read once is not read again


def test_of_a_set_each_frame_draws_what_it_chooses(client, make_splats, camera):
    """The file is read once, and may go; another eye makes another picture: that of the chosen alone."""
    client.hear("hello")
    splats = make_splats(200)
    splats.extras["lod_bias"] = np.linspace(-1, 1, 200, dtype=np.float32)
    wire.write_set(client.folder / "one", wire.pack_set(splats, None))
    rule, pictures = rules()["octree"], []
    facts = {"level": 2.0, "finer": 3.0, "coarser": 1.0, "levels": 3.0, "d_max": 1.2, "d_max_focal": 1.5}
    values = {"offset": 0.25, "fade": 1}
    for frame, eye in enumerate(((0.0, 0.0, 0.5), (0.5, 0.25, -1.0))):
        choice = LodQuery("octree", eye, 1.5, tuple(facts.items()), tuple(values.items())).as_dict()
        one = {"file": "one", "count": 200, "matrix": np.eye(4).tolist(), "level": 2}
        client.say(**request(camera, [one | {"columns": ["lod_bias"], "choice": choice}], frame))
        answer = client.hear("frame", "error")
        planes = wire.read_planes(client.folder / "frame", len(answer["passes"]), 48, 64)
        (client.folder / "one").unlink(missing_ok=True)
        weights = rule.weights(splats.means, np.float32(eye), 1.5, splats.extras, facts, values)
        some = weights > 0
        assert 20 < some.sum() < 180
        alone = draw([Instance(SplatSet(splats.select(some), weights[some]))], camera, background=None)
        for plane, there in zip(alone.passes().values(), planes, strict=True):
            np.testing.assert_array_equal(plane, there)
        pictures.append(planes)
    assert np.abs(pictures[0] - pictures[1]).max() > 0.1


def test_a_holdout_is_read_and_told_where_it_cannot_be(client, make_splats, camera, tmp_path):
    client.hear("hello")
    splats = make_splats(80)
    wire.write_set(client.folder / "one", wire.pack_set(splats, None))
    sets = [{"file": "one", "count": 80, "matrix": np.eye(4).tolist(), "level": 0}]
    depth = np.full((48, 64), 4, np.float32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"L.Depth.Z": depth}).write(str(tmp_path / "depth.exr"))
    told = {"holdout": str(tmp_path / "depth.exr"), "window": [10, 5, 30, 40], "background": None}
    client.say(**request(camera, sets, **told))
    answer = client.hear("frame", "error")
    planes = wire.read_planes(client.folder / "frame", len(answer["passes"]), 40, 30)
    placed, window = [Instance(SplatSet(splats))], (10, 5, 30, 40)
    expected = draw(placed, camera, background=None, window=window, limit=depth[5:45, 10:40])
    free = draw(placed, camera, background=None, window=window)
    np.testing.assert_array_equal(planes[3], expected.linear()[..., 3])
    assert np.abs(free.alpha - expected.alpha).mean() > 0.01
    client.say(**request(camera, sets, 2, holdout=str(tmp_path / "gone.exr")))
    assert "There is no mesh depth" in client.hear("frame", "error")["what"]


def test_mistakes_are_answered_and_survived(client, make_splats, camera):
    client.hear("hello")
    client.say_line("no json")
    assert "not valid" in client.hear("error")["what"]
    client.say(**request(camera, [{"file": "gone", "count": 3, "matrix": np.eye(4).tolist(), "level": 0}]))
    assert "There is no set of splats gone" in client.hear("error")["what"]
    client.say(**(request(camera, []) | {"camera": {}}))
    assert client.hear("error")["what"] == "The camera lacks 'width'."
    client.say(**request(camera, [], 9))
    assert client.hear("frame", "error")["frame"] == 9


def test_odd_requests_end_nothing(client, make_splats, camera):
    """What was no hashable number to cancel ended the program; so did transforms that no splat survives."""
    client.hear("hello")
    client.say(cancel={})
    assert "not valid" in client.hear("error")["what"]
    client.say_line("[" * 100_000)
    assert "not valid" in client.hear("error")["what"]
    client.say_line("x" * (3 << 20))  # answered once, however long
    assert "not valid" in client.hear("error")["what"]
    splats = make_splats(50)
    spoiled = make_splats(50)
    for place, value in enumerate((np.nan, np.inf, 1e30)):
        for column in (spoiled.means, spoiled.quats, spoiled.log_scales):
            column[place] = value
        spoiled.sh[place, 1, 2] = value
    spoiled.sh[3, 4, 1], spoiled.opacity_logits[4] = np.nan, np.nan
    shear = np.eye(4)
    shear[0, 1] = 0.5
    for name, each in (("good", splats.select(slice(5, None))), ("bad", spoiled)):
        wire.write_set(client.folder / name, wire.pack_set(each, None))
    planes = []
    for frame, (name, count) in enumerate((("good", 45), ("bad", 50))):
        one = {"file": name, "count": count, "matrix": shear.tolist(), "level": 0}
        client.say(**request(camera, [one], frame))
        if name == "bad":
            assert client.hear("warning")["message"].startswith("5 splats of the scene")
        answer = client.hear("frame", "error")
        planes.append(wire.read_planes(client.folder / "frame", len(answer["passes"]), 48, 64))
    np.testing.assert_array_equal(*planes)
    assert np.ptp(planes[0]) > 0.1


def test_a_folder_of_somebodys_is_left_alone(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("dear")
    command = [sys.executable, "-m", "training", "serve", str(tmp_path / "photos"), "--backend", "cpu"]
    done = subprocess.run(command, cwd=ROOT, input="", capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "is not empty" in done.stderr and not done.stdout
    assert (tmp_path / "photos" / "a.jpg").read_text() == "dear"
    done = subprocess.run(
        [*command[:4], str(tmp_path / "new"), *command[5:]],
        cwd=ROOT,
        input="",
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0 and not (tmp_path / "new").exists()


@pytest.mark.slow
def test_a_frame_is_cancelled(client, make_splats, camera):
    client.hear("hello")
    wire.write_set(client.folder / "one", wire.pack_set(make_splats(3000), None))
    sets = [{"file": "one", "count": 3000, "matrix": np.eye(4).tolist(), "level": 0}]
    large = camera.resized(8192, 6144)
    client.say(**request(large, sets, 1))
    client.hear("progress")
    client.say(cancel=1)
    answer = client.hear("frame", "cancelled")
    assert (answer["event"], answer["frame"]) == ("cancelled", 1)
    client.say(**request(camera, sets, 2))
    assert client.hear("frame", "cancelled")["frame"] == 2
    assert not (client.folder / "frame").stat().st_size > 8 * 4 * 64 * 48


@pytest.mark.slow
def test_it_ends_with_the_program_that_started_it(client, make_splats, camera):
    """In the middle of a large frame, too; and what it kept on the disk is gone."""
    client.hear("hello")
    wire.write_set(client.folder / "one", wire.pack_set(make_splats(3000), None))
    sets = [{"file": "one", "count": 3000, "matrix": np.eye(4).tolist(), "level": 0}]
    client.say(**request(camera.resized(8192, 6144), sets, 1))
    client.hear("progress")
    client.process.stdin.close()
    started = time.monotonic()
    assert client.process.wait(timeout=10) == 0
    assert time.monotonic() - started < 5
    assert not client.folder.exists()


def test_a_set_without_splats_is_read_once_too(client, make_splats, camera):
    client.hear("hello")
    wire.write_set(client.folder / "none", wire.pack_set(make_splats(0), None))
    sets = [{"file": "none", "count": 0, "matrix": np.eye(4).tolist(), "level": 1}]
    for frame in (1, 2):
        client.say(**request(camera, sets, frame))
        assert client.hear("frame", "error")["event"] == "frame"
        (client.folder / "none").unlink(missing_ok=True)
