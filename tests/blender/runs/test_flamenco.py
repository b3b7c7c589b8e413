"""Job submission to a Flamenco manager, which a local HTTP server replaces."""

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

pytestmark = pytest.mark.one_blender


SETTINGS = [
    {"key": key}
    for key in ("scene", "output", "columns", "rows", "method", "preset", "image_scale", "polish", "options")
]
TYPE = {"name": "lodgs-blocks", "etag": "5e", "settings": [*SETTINGS, {"key": "lodgs", "default": "{lodgs}"}]}


class Manager:
    """Responses of the server as (code, JSON or bytes), and the requests it received."""

    def __init__(self) -> None:
        self.type = (200, TYPE)
        self.job = (200, {"id": "6f-1", "name": "tiny"})
        self.requests: list[tuple[str, str, dict | None]] = []

    def answer(self, method: str, path: str, body: bytes) -> tuple[int, bytes]:
        self.requests.append((method, path, json.loads(body) if body else None))
        code, content = self.job if path == "/api/v3/jobs" else self.type
        return code, content if isinstance(content, bytes) else json.dumps(content).encode()


@contextmanager
def served(manager: Manager):
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            code, content = manager.answer(self.command, self.path, body)
            self.send_response(code)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_POST = do_GET

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def flamenco(lodgs, bpy, monkeypatch):
    """The module, with online access (which Python cannot enable in Blender)."""
    module = lodgs("runs.flamenco")
    app = SimpleNamespace(online_access=True)
    monkeypatch.setattr(module, "bpy", SimpleNamespace(app=app, path=bpy.path, data=bpy.data))
    for name in ("http_proxy", "HTTP_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(module, "TIMEOUT", 200.0)
    yield module
    lodgs("extension").preferences().flamenco = ""


@pytest.fixture
def root(root, tmp_path):
    root.lodgs.training.output = str(tmp_path / "runs")
    return root


@pytest.fixture
def manager(flamenco, lodgs):
    """A manager whose address is set in the preferences."""
    manager = Manager()
    with served(manager) as address:
        lodgs("extension").preferences().flamenco = address
        yield manager


def submit(bpy, **options):
    return bpy.ops.lodgs.submit_to_flamenco(**options)


def test_job_has_the_settings_of_the_panel(bpy, lodgs, manager, root, tmp_path):
    settings = root.lodgs.training
    settings.method, settings.preset, settings.image_scale = "octree", "standard", 0.65
    settings.columns, settings.rows, settings.seed = 2, 3, 7
    settings.images = str(tmp_path / "my photographs")
    settings.parameters.max_splats = 4321
    assert submit(bpy) == {"FINISHED"}
    (first, second) = manager.requests
    assert first == ("GET", "/api/v3/jobs/type/lodgs-blocks", None)
    method, path, job = second
    assert (method, path) == ("POST", "/api/v3/jobs")
    submitted = job["settings"]
    options = submitted.pop("options")
    assert job == {
        "name": "tiny", "type": "lodgs-blocks", "type_etag": "5e", "priority": 50,
        "submitter_platform": platform.system().lower(), "settings": submitted,
    }  # fmt: skip
    assert submitted == {
        "scene": str(tmp_path / "scene"), "output": str(tmp_path / "runs" / "tiny"), "columns": 2, "rows": 3,
        "method": "octree", "preset": "standard", "image_scale": 0.65,
        "polish": lodgs("training.runs.job").Job.polish,
        "lodgs": "{lodgs}",
    }  # fmt: skip
    split = shlex.split(options)
    assert split[split.index("--images") + 1] == str(tmp_path / "my photographs")
    assert split[split.index("--seed") + 1] == "7" and "max_splats=4321" in split
    assert "--backend" not in split, "each worker has its own backend"
    assert not (tmp_path / "runs").exists(), "the farm creates it"


def test_farm_and_local_training_have_the_same_job(lodgs, manager, bpy, root, tmp_path):
    """Parse the command of the job type as the trainer on the farm does."""
    import argparse

    settings = root.lodgs.training
    settings.columns, settings.rows, settings.test_every = 2, 2, 5
    settings.parameters.levels = 3
    submit(bpy)
    submitted = manager.requests[1][2]["settings"]
    options = lodgs("training.cli.job_options")
    parser = argparse.ArgumentParser()
    options.add_options(parser)
    command = [
        "--scene", submitted["scene"], "--out", submitted["output"],
        "--cells", f"{submitted['columns']}x{submitted['rows']}",
        "--method", submitted["method"], "--preset", submitted["preset"],
        "--image-scale", str(submitted["image_scale"]), "--polish", str(submitted["polish"]),
        *shlex.split(submitted["options"]),
    ]  # fmt: skip
    farm_job = options.job_from_options(parser.parse_args(command))
    local_job = lodgs("runs.job_settings").make_job(root, tmp_path / "runs" / "tiny", {})
    assert farm_job.resolved() == local_job.resolved()


def test_job_type_matches_the_script(flamenco, manager, bpy, root):
    """Flamenco derives the name of a type from its file, and ignores unknown settings."""
    assert flamenco.SCRIPT.stem.replace("_", "-") == flamenco.JOB_TYPE
    submit(bpy)
    script = flamenco.SCRIPT.read_text()
    for key in manager.requests[1][2]["settings"]:
        assert f'key: "{key}"' in script


def test_scene_without_cells_is_one_cell(bpy, manager, root):
    assert submit(bpy) == {"FINISHED"}
    submitted = manager.requests[1][2]["settings"]
    assert (submitted["columns"], submitted["rows"]) == (1, 1)


def test_submit_returns_the_url_of_the_job(flamenco, lodgs, manager, root, tmp_path):
    address = lodgs("extension").preferences().flamenco
    assert flamenco.submit(root, str(tmp_path / "other")) == f"{address}/app/jobs/6f-1"
    assert manager.requests[1][2]["settings"]["output"] == str(tmp_path / "other")


REJECTIONS = {
    "unknown type": (
        {"type": (404, {"code": 404, "message": "no such job type known"})},
        r"has no job type lodgs-blocks\.\s+Copy .*lodgs_blocks.js to the scripts folder",
    ),
    "an older type": (
        {"type": (200, {**TYPE, "settings": SETTINGS[:-1]})},
        "job type lodgs-blocks has no setting options",
    ),
    "rejected": (
        {"job": (400, {"code": 400, "message": "uncaught exception: not so."})},
        r"reports: uncaught exception: not so\.\s+See the log",
    ),
    "outdated": (
        {"job": (412, {"code": 412, "message": "rejecting job because its settings are outdated"})},
        "reports: rejecting job because",
    ),
    "not JSON": ({"type": (200, b"<html>It works!</html>")}, "is not a Flamenco manager"),
    "not UTF-8": ({"job": (200, b"\xff\xfe")}, "is not a Flamenco manager"),
    "invalid settings": ({"type": (200, {"settings": "none"})}, "is not a Flamenco manager"),
    "a job without an ID": ({"job": (200, {})}, "is not a Flamenco manager"),
    "an error that is not JSON": ({"type": (404, b"<html>Not found</html>")}, "is not a Flamenco manager"),
    "too long": ({"type": (200, b'{"a": "' + b"a" * (1 << 21) + b'"}')}, "is not a Flamenco manager"),
    "a list": ({"job": (200, [1, 2])}, "is not a Flamenco manager"),
}


@pytest.mark.parametrize("case", REJECTIONS)
def test_rejections_are_reported(bpy, manager, root, case):
    responses, message = REJECTIONS[case]
    vars(manager).update(responses)
    with pytest.raises(RuntimeError, match=message) as rejected:
        submit(bpy)
    assert "Traceback" not in str(rejected.value)


def test_unreachable_manager_is_reported(bpy, lodgs, flamenco, root):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    lodgs("extension").preferences().flamenco = f"127.0.0.1:{port}"
    with pytest.raises(
        RuntimeError, match=r"Cannot reach a Flamenco manager at http://127\.0\.0\.1:\d+: .*refused"
    ):
        submit(bpy)


def test_silent_manager_times_out(bpy, lodgs, flamenco, root, monkeypatch):
    monkeypatch.setattr(flamenco, "TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        lodgs("extension").preferences().flamenco = "http://{}:{}".format(*silent.getsockname())
        with pytest.raises(RuntimeError, match=r"Cannot reach a Flamenco manager at .*timed out"):
            submit(bpy)


def test_operator_does_not_block_while_waiting(flamenco, lodgs, root):
    """Each step of the modal operator returns before the manager answers."""
    operator = lodgs("operators.flamenco").LODGS_OT_submit_to_flamenco
    with socket.create_server(("127.0.0.1", 0)) as silent:
        lodgs("extension").preferences().flamenco = "http://{}:{}".format(*silent.getsockname())
        work = operator.work(SimpleNamespace(folder=""), flamenco_context(root))
        start = time.monotonic()
        for _ in range(5):
            next(work)
        assert time.monotonic() - start < flamenco.TIMEOUT / 2
        work.close()


def flamenco_context(root):
    import bpy

    bpy.context.view_layer.objects.active = root
    return bpy.context


@pytest.mark.parametrize(
    "address", ["ftp://farm", "http://", "http://farm:port", "http://my farm", "http://[::"]
)
def test_invalid_addresses_are_rejected(bpy, lodgs, flamenco, root, address):
    lodgs("extension").preferences().flamenco = address
    with pytest.raises(RuntimeError, match="as address of the Flamenco manager: it is invalid"):
        submit(bpy)


@pytest.mark.parametrize("address", ["farm:8080", "http://farm:8080", "http://farm:8080/", " farm:8080/ "])
def test_addresses_are_normalized(flamenco, address):
    assert flamenco.manager_url(address) == "http://farm:8080"


def test_invalid_jobs_are_rejected_before_any_request(bpy, lodgs, manager, root, tmp_path, monkeypatch):
    def assert_rejected(message):
        with pytest.raises(RuntimeError, match=message):
            submit(bpy)

    settings = root.lodgs.training
    run = tmp_path / "run"
    run.mkdir()
    (run / "job.toml").touch()
    with pytest.raises(RuntimeError, match="contains a run"):
        submit(bpy, folder=str(run))
    settings.method = "octree_neural"
    assert_rejected("cannot train a scene in cells")
    settings.method = "flod"
    settings.output = ""
    assert_rejected("not saved")
    settings.output = str(tmp_path)
    root.lodgs.scene_folder = ""
    assert_rejected("Import a COLMAP folder")
    root.lodgs.scene_folder = str(tmp_path)
    monkeypatch.setattr(lodgs("runs.flamenco"), "bpy", bpy)
    assert not bpy.app.online_access
    assert_rejected("Allow Online Access")
    lodgs("extension").preferences().flamenco = ""
    assert_rejected("no Flamenco manager is set")
    assert manager.requests == []
