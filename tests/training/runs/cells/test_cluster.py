"""Encrypted Dask clusters: using or watching them requires the key."""

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from training.errors import LodgsError
from training.runs.cells.cluster import (
    import_dask,
    local_cluster,
    read_key_file,
    run_scheduler,
    run_worker,
    write_key_file,
)
from training.runs.cells.workers import workers

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
psutil = pytest.importorskip("psutil")
PAGES = ("/", "/status", "/health", "/metrics", "/info/main/workers.html", "/api/v1/get_workers")


def listeners() -> set[tuple[str, int]]:
    """Return address and port of the TCP servers of this process and its children."""
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    return {
        tuple(connection.laddr)
        for process in processes
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }


def fetch(address: tuple[str, int], page: str) -> bytes:
    """Return a server's answer to an HTTP request, as another user of the computer gets it."""
    with suppress(OSError), socket.create_connection(address, timeout=5) as stranger:
        stranger.sendall(f"GET {page} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode())
        return stranger.recv(1000)
    return b""


def reject_strangers(address: str) -> None:
    """Check that clients without the cluster's certificate cannot connect to a scheduler."""
    other = distributed.Security.temporary()
    for url, security in ((address, other), (address.replace("tls://", "tcp://"), None)):
        with pytest.raises(OSError):
            distributed.Client(url, security=security, timeout=0.3)


@pytest.mark.parametrize("count", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_local_cluster_rejects_other_users(count):
    before = listeners()
    with local_cluster(count) as cluster:
        servers = listeners() - before
        assert len(servers) >= 2
        assert {host for host, _ in servers} == {"127.0.0.1"}
        for server in servers:
            assert not any(b"200 OK" in fetch(server, page) for page in PAGES)
        assert cluster.scheduler_address.startswith("tls://")
        reject_strangers(cluster.scheduler_address)
        with distributed.Client(cluster, timeout=200) as client:
            assert client.submit(sum, [1, 2]).result(200) == 3 if count else client.status == "running"


def test_cluster_with_a_key_file_rejects_clients_without_it(tmp_path):
    path = tmp_path / "cluster.pem"
    with local_cluster(0) as cluster:
        write_key_file(path, cluster.scheduler_address, cluster.security)
        with workers(str(path)) as submit:
            pending = submit(tmp_path)
            assert not pending.done()
            pending.cancel()
        write_key_file(path, cluster.scheduler_address, distributed.Security.temporary())
        with pytest.MonkeyPatch.context() as patch, pytest.raises(LodgsError, match="Cannot connect"):
            patch.setattr("training.runs.cells.workers.TIMEOUT_SECONDS", 0.3)
            with workers(str(path)):
                pass


def test_key_file_keeps_the_key_and_is_private(tmp_path):
    path, security = tmp_path / "cluster.pem", distributed.Security.temporary()
    previous = os.umask(0)
    try:
        write_key_file(path, "tls://10.0.0.1:8786", security)
    finally:
        os.umask(previous)
    address, copy = read_key_file(path)
    assert address == "tls://10.0.0.1:8786"
    assert copy.require_encryption
    for role in ("client", "scheduler", "worker"):
        assert copy.get_tls_config_for_role(role) == security.get_tls_config_for_role(role)
    if os.name == "posix":
        assert path.stat().st_mode & 0o777 == 0o600
        path.chmod(0o640)
        with pytest.raises(LodgsError, match="other users can access it") as error:
            read_key_file(path)
        assert "chmod 600" in error.value.remedy


@pytest.mark.parametrize("size", [0, 40, 150, 1800, -3])
def test_damaged_key_file_is_reported(tmp_path, size):
    path = tmp_path / "cluster.pem"
    write_key_file(path, "tls://10.0.0.1:8786", distributed.Security.temporary())
    path.write_bytes(path.read_bytes().rstrip()[:size])
    with pytest.raises(LodgsError, match="incomplete or damaged"):
        read_key_file(path)


@pytest.mark.parametrize("kind", ["PRIVATE KEY", "CERTIFICATE"])
def test_changed_key_is_reported(tmp_path, kind):
    path = tmp_path / "cluster.pem"
    write_key_file(path, "tls://10.0.0.1:8786", distributed.Security.temporary())
    before, begin, rest = path.read_text().partition(f"BEGIN {kind}-----\n")
    path.write_text(f"{before}{begin}{'A' * 40}{rest[40:]}")
    with pytest.raises(LodgsError, match="incomplete or damaged"):
        read_key_file(path)


@pytest.mark.parametrize("address", ["tls://127.0.0.1:1", "tls://127.0.0.1", "tls://127.0.0.1:99999999"])
def test_worker_without_a_scheduler_reports_it(tmp_path, address):
    path = tmp_path / "cluster.pem"
    write_key_file(path, address, distributed.Security.temporary())
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "0.3s"}),
        pytest.raises(LodgsError, match=f"Cannot reach the scheduler at {address}: "),
    ):
        run_worker(path)


def start_blocks(*words: object) -> tuple[subprocess.Popen[str], str]:
    """Start an action of ``lodgs blocks``, and return it with its first line of output."""
    command = [sys.executable, "-m", "training", "blocks", *map(str, words)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=Path(__file__).parents[4]
    )
    assert process.stdout is not None
    return process, process.stdout.readline()


def start_cluster(folder: Path) -> tuple[subprocess.Popen[str], subprocess.Popen[str]]:
    """Start a scheduler and its worker."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    key = folder / "cluster.pem"
    scheduler, line = start_blocks("scheduler", key, "--host", "127.0.0.1", "--port", port)
    try:
        assert line.startswith("Scheduler at tls://127.0.0.1:")
        worker, line = start_blocks("worker", key)
        assert line.startswith("Worker of tls://127.0.0.1:")
    except BaseException:
        scheduler.kill()
        raise
    return scheduler, worker


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_scheduler_prints_no_stacks_of_its_connections(tmp_path, number):
    scheduler, worker = start_cluster(tmp_path)
    try:
        scheduler.send_signal(number)
        assert scheduler.wait(60) == 3
        assert worker.wait(60) == 0
    finally:
        scheduler.kill()
    assert "Traceback" not in scheduler.stdout.read()
    output = worker.stdout.read()
    assert "Traceback" not in output and " INFO " not in output


@pytest.mark.slow
def test_worker_reports_a_lost_scheduler(tmp_path):
    scheduler, worker = start_cluster(tmp_path)
    scheduler.kill()
    assert worker.wait(60) == 2
    assert "error: Lost the connection to the scheduler at tls://127.0.0.1:" in worker.stdout.read()


def test_scheduler_reports_unusable_ports(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(LodgsError, match=rf"port {port}: .*in use.*[^.]\.$"):
            run_scheduler(tmp_path / "cluster.pem", "127.0.0.1", port)
    with pytest.raises(LodgsError, match="Cannot use port 65536"):
        run_scheduler(tmp_path / "cluster.pem", "127.0.0.1", 65536)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "ucx://127.0.0.1:8786"])
def test_unencrypted_schedulers_need_an_option(address):
    with pytest.raises(LodgsError, match="unencrypted") as error, workers(address):
        pass
    assert "--no-tls" in error.value.remedy


def test_missing_package_for_certificates_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(LodgsError, match="cryptography is not installed"):
        import_dask()


def test_encrypted_scheduler_of_dask_needs_its_certificates():
    with pytest.raises(LodgsError, match="Cannot connect"), workers("tls://127.0.0.1:1"):
        pass


def test_requirements_include_the_package_for_certificates():
    requirements = Path(__file__).parents[4] / "requirements"
    for name in ("cluster", "develop"):
        assert "\ncryptography==" in (requirements / f"{name}.txt").read_text("utf-8")
