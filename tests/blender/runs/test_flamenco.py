"""Jobs for a Flamenco manager, whose part a small HTTP server on this computer plays."""

import json
import platform
import shlex
import socket
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace

import pytest

SETTINGS = [
    {"key": key}
    for key in ("scene", "output", "columns", "rows", "method", "preset", "image_scale", "polish", "options")
]
TYPE = {"name": "lodgs-blocks", "etag": "5e", "settings": [*SETTINGS, {"key": "lodgs", "default": "{lodgs}"}]}


class Manager:
    """What the server answers, (code, JSON or bytes) by the end of the path, and what it was asked."""

    def __init__(self) -> None:
        self.type, self.job = (200, TYPE), (200, {"id": "6f-1", "name": "tiny"})
        self.asked: list[tuple[str, str, dict | None]] = []

    def answer(self, method: str, path: str, body: bytes) -> tuple[int, bytes]:
        self.asked.append((method, path, json.loads(body) if body else None))
        code, said = self.job if path == "/api/v3/jobs" else self.type
        return code, said if isinstance(said, bytes) else json.dumps(said).encode()


@contextmanager
def served(manager: Manager):
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            code, said = manager.answer(self.command, self.path, body)
            self.send_response(code)
            self.send_header("Content-Length", str(len(said)))
            self.end_headers()
            self.wfile.write(said)

        do_POST = do_GET

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def flamenco(lodgs, bpy, monkeypatch):
    """The module, in a Blender that may go online (which cannot be set)."""
    module = lodgs("runs.flamenco")
    app = SimpleNamespace(online_access=True)
    monkeypatch.setattr(module, "bpy", SimpleNamespace(app=app, path=bpy.path, data=bpy.data))
    for name in ("http_proxy", "HTTP_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(module, "TIMEOUT", 2.0)
    yield module
    lodgs("extension").preferences().flamenco = ""


@pytest.fixture
def root(bpy, tmp_path):
    collection = bpy.data.collections.new("tiny")
    bpy.context.scene.collection.children.link(collection)
    root = bpy.data.objects.new("tiny", None)
    collection.objects.link(root)
    root.lodgs.is_root, root.lodgs.scene_folder = True, str(tmp_path / "scene")
    root.lodgs.training.output = str(tmp_path / "runs")
    return root


@pytest.fixture
def manager(flamenco, lodgs):
    """A manager whose address the preferences have."""
    made = Manager()
    with served(made) as address:
        lodgs("extension").preferences().flamenco = address
        yield made


def submit(bpy, **given):
    return bpy.ops.lodgs.submit_to_flamenco(**given)


def test_the_job_is_what_the_panel_says(bpy, lodgs, manager, root, tmp_path):
    settings = root.lodgs.training
    settings.method, settings.preset, settings.image_scale = "octree", "standard", 0.65
    settings.columns, settings.rows, settings.seed = 2, 3, 7
    settings.images = str(tmp_path / "my photographs")
    settings.parameters.max_splats = 4321
    assert submit(bpy) == {"FINISHED"}
    (first, second) = manager.asked
    assert first == ("GET", "/api/v3/jobs/type/lodgs-blocks", None)
    method, path, job = second
    assert (method, path) == ("POST", "/api/v3/jobs")
    said = job["settings"]
    options = said.pop("options")
    assert job == {
        "name": "tiny", "type": "lodgs-blocks", "type_etag": "5e", "priority": 50,
        "submitter_platform": platform.system().lower(), "settings": said,
    }  # fmt: skip
    assert said == {
        "scene": str(tmp_path / "scene"), "output": str(tmp_path / "runs" / "tiny"), "columns": 2, "rows": 3,
        "method": "octree", "preset": "standard", "image_scale": 0.65,
        "polish": lodgs("training.runs.job").Job.polish,
        "lodgs": "{lodgs}",
    }  # fmt: skip
    split = shlex.split(options)
    assert split[split.index("--images") + 1] == str(tmp_path / "my photographs")
    assert split[split.index("--seed") + 1] == "7" and "max_splats=4321" in split
    assert "--backend" not in split, "each of the farm's computers has its own"
    assert not (tmp_path / "runs").exists(), "the farm makes it"


def test_what_the_farm_compiles_of_it_is_the_job_that_training_here_has(lodgs, manager, bpy, root, tmp_path):
    """The command that the job type makes of the settings, read as the farm's trainer reads it."""
    import argparse

    settings = root.lodgs.training
    settings.columns, settings.rows, settings.test_every = 2, 2, 5
    settings.parameters.levels = 3
    submit(bpy)
    said = manager.asked[1][2]["settings"]
    options = lodgs("training.cli.job_options")
    parser = argparse.ArgumentParser()
    options.add_options(parser)
    command = [
        "--scene", said["scene"], "--out", said["output"], "--cells", f"{said['columns']}x{said['rows']}",
        "--method", said["method"], "--preset", said["preset"], "--image-scale", str(said["image_scale"]),
        "--polish", str(said["polish"]), *shlex.split(said["options"]),
    ]  # fmt: skip
    there = options.job_from_options(parser.parse_args(command))
    here = lodgs("runs.job_settings").make_job(root, tmp_path / "runs" / "tiny", {})
    assert there.resolved() == here.resolved()


def test_the_type_is_that_of_the_script_that_lies_here(flamenco, manager, bpy, root):
    """Flamenco names a type like its file, with hyphens; settings it does not know would be lost."""
    assert flamenco.SCRIPT.stem.replace("_", "-") == flamenco.JOB_TYPE
    submit(bpy)
    script = flamenco.SCRIPT.read_text()
    for key in manager.asked[1][2]["settings"]:
        assert f'key: "{key}"' in script


def test_a_scene_without_cells_is_one_block(bpy, manager, root):
    assert submit(bpy) == {"FINISHED"}
    said = manager.asked[1][2]["settings"]
    assert (said["columns"], said["rows"]) == (1, 1)


def test_a_script_gets_the_address_of_the_job(flamenco, lodgs, manager, root, tmp_path):
    address = lodgs("extension").preferences().flamenco
    assert flamenco.submit(root, str(tmp_path / "other")) == f"{address}/app/jobs/6f-1"
    assert manager.asked[1][2]["settings"]["output"] == str(tmp_path / "other")


REFUSALS = {
    "unknown type": (
        {"type": (404, {"code": 404, "message": "no such job type known"})},
        "does not know the job type lodgs-blocks. Put .*lodgs_blocks.js into the folder scripts",
    ),
    "an older type": (
        {"type": (200, {**TYPE, "settings": SETTINGS[:-1]})},
        "of another version: it has no options",
    ),
    "refused": (
        {"job": (400, {"code": 400, "message": "uncaught exception: not so."})},
        "refused the job: uncaught exception: not so. Its log",
    ),
    "outdated": (
        {"job": (412, {"code": 412, "message": "rejecting job because its settings are outdated"})},
        "refused the job: rejecting job because",
    ),
    "not JSON": ({"type": (200, b"<html>It works!</html>")}, "is no Flamenco manager"),
    "not UTF-8": ({"job": (200, b"\xff\xfe")}, "is no Flamenco manager"),
    "an answer of another kind": ({"type": (200, {"settings": "none"})}, "is no Flamenco manager"),
    "a job without a name": ({"job": (200, {})}, "is no Flamenco manager"),
    "not JSON, and an error": ({"type": (404, b"<html>Not found</html>")}, "is no Flamenco manager"),
    "too long": ({"type": (200, b'{"a": "' + b"a" * (1 << 21) + b'"}')}, "is no Flamenco manager"),
    "a list": ({"job": (200, [1, 2])}, "is no Flamenco manager"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_the_manager_answers_otherwise_is_a_sentence(bpy, manager, root, case):
    answers, words = REFUSALS[case]
    vars(manager).update(answers)
    with pytest.raises(RuntimeError, match=words) as refused:
        submit(bpy)
    assert "Traceback" not in str(refused.value)


def test_nobody_answers(bpy, lodgs, flamenco, root):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    lodgs("extension").preferences().flamenco = f"127.0.0.1:{port}"
    with pytest.raises(
        RuntimeError, match=r"No Flamenco manager answers at http://127\.0\.0\.1:\d+: .*refused"
    ):
        submit(bpy)


def test_one_that_never_answers_is_given_up(bpy, lodgs, flamenco, root, monkeypatch):
    monkeypatch.setattr(flamenco, "TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        lodgs("extension").preferences().flamenco = "http://{}:{}".format(*silent.getsockname())
        with pytest.raises(RuntimeError, match=r"No Flamenco manager answers at .*timed out"):
            submit(bpy)


def test_the_panel_goes_on_while_it_is_waited_for(flamenco, lodgs, root):
    """As in a window: each piece of the operator's work is over at once."""
    operator = lodgs("operators.flamenco").LODGS_OT_submit_to_flamenco
    with socket.create_server(("127.0.0.1", 0)) as silent:
        lodgs("extension").preferences().flamenco = "http://{}:{}".format(*silent.getsockname())
        work = operator.work(SimpleNamespace(folder=""), flamenco_context(root))
        begun = time.monotonic()
        for _ in range(5):
            next(work)
        assert time.monotonic() - begun < 1.0
        work.close()


def flamenco_context(root):
    import bpy

    bpy.context.view_layer.objects.active = root
    return bpy.context


@pytest.mark.parametrize(
    "address", ["ftp://farm", "http://", "http://farm:port", "http://my farm", "http://[::"]
)
def test_what_is_no_address_is_said(bpy, lodgs, flamenco, root, address):
    lodgs("extension").preferences().flamenco = address
    with pytest.raises(RuntimeError, match="is no address of a Flamenco manager"):
        submit(bpy)


@pytest.mark.parametrize("address", ["farm:8080", "http://farm:8080", "http://farm:8080/", " farm:8080/ "])
def test_addresses_are_taken_as_people_write_them(flamenco, address):
    assert flamenco.manager_of(address) == "http://farm:8080"


def test_what_cannot_be_submitted_is_said_before_anybody_is_asked(
    bpy, lodgs, manager, root, tmp_path, monkeypatch
):
    def refused(words):
        with pytest.raises(RuntimeError, match=words):
            submit(bpy)

    settings = root.lodgs.training
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "job.toml").touch()
    with pytest.raises(RuntimeError, match="already holds a run"):
        submit(bpy, folder=str(taken))
    settings.method = "octree_neural"
    refused("cannot train cells one by one")
    settings.method = "flod"
    settings.output = ""
    refused("not saved")
    settings.output = str(tmp_path)
    root.lodgs.scene_folder = ""
    refused("Import a COLMAP folder")
    root.lodgs.scene_folder = str(tmp_path)
    monkeypatch.setattr(lodgs("runs.flamenco"), "bpy", bpy)
    assert not bpy.app.online_access
    refused("Allow Online Access")
    lodgs("extension").preferences().flamenco = ""
    refused("not said where the Flamenco manager is")
    assert manager.asked == []
