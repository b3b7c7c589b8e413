"""Encrypted Dask clusters: their key file, and a scheduler and workers that use it.

A client of a Dask scheduler or worker runs programs as its user. Hence every connection requires the
cluster's certificate, and the HTTP servers of Dask listen on this computer only and have no pages.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import ssl
import stat
import sys
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from ...documents import open_file
from ...errors import LodgsError, printable
from ...files import atomic_write

PORT = 8786
"""Port of a scheduler; Dask's default."""
CONFIGURATION = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
}
"""Dask configuration without web pages, and without messages of the processes of workers: their errors reach
the client, and a lost scheduler the nanny. Dask opens its HTTP servers even without pages."""
_HTTP_ADDRESS = "127.0.0.1:0"
_SCHEDULER_CLOSES = "scheduler-close"
"""Dask's reason to close a worker when its scheduler is stopped."""
_MAX_KEY_BYTES, _MAX_PORT = 1 << 16, 65535
_COMMENT = "# Key of a LODGS cluster. Keep it secret: it permits running programs on all its computers."
_IGNORE_INTERRUPT = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""Preload code of local Dask workers: a terminal sends Ctrl-C to all processes, and this one handles it."""


def import_dask() -> Any:
    """Return the module ``distributed``.

    Raises:
        LodgsError: Dask, or the package that creates its certificates, is not installed.
    """
    try:
        import cryptography  # noqa: F401 - imported by Security.temporary
        import distributed
    except ModuleNotFoundError as error:
        name = "Dask" if error.name == "distributed" else f"The package {error.name}"
        raise LodgsError(
            f"{name} is not installed in {sys.executable}.",
            'Install it with: pip install "lodgs[cluster]", or train with --on here.',
        ) from None
    return distributed


def local_cluster(count: int, resources: dict[str, float] | None = None) -> Any:
    """Start a scheduler and workers that only this process and its workers can use."""
    import dask.config

    distributed = import_dask()
    with dask.config.set(CONFIGURATION):
        return distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, resources=resources,
            silence_logs=logging.ERROR, preload=[_IGNORE_INTERRUPT],
            host="127.0.0.1", protocol="tls://", security=distributed.Security.temporary(),
            scheduler_kwargs={"dashboard": False, "dashboard_address": _HTTP_ADDRESS},
        )  # fmt: skip


def read_key_file(path: Path) -> tuple[str, Any]:
    """Read the address of a cluster's scheduler and Dask's ``Security`` for it.

    Raises:
        LodgsError: the file cannot be read, is not a key file, or other users can read it.
    """
    with open_file(path) as file:
        mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        text = file.read(_MAX_KEY_BYTES).decode("ascii", "replace")
    if os.name == "posix" and mode & 0o077:
        raise LodgsError(
            f"Cannot use key file {path}: other users can access it (mode {mode:04o}).",
            f"Run: chmod 600 {path}. If others may have read it, delete it and restart the scheduler.",
        )
    damaged = LodgsError(
        f"Cannot use key file {path}: it is incomplete or damaged.", "Copy it from the scheduler again."
    )
    address = re.search(r"^tls://\S+$", text, re.MULTILINE)
    key, certificate = (
        re.search(rf"^-----BEGIN {kind}-----\n[\w+/=\n]+-----END {kind}-----$", text, re.MULTILINE)
        for kind in ("PRIVATE KEY", "CERTIFICATE")
    )
    if address is None or key is None or certificate is None:
        raise damaged
    parts = {"tls_ca_file": f"{certificate[0]}\n"}
    for role in ("client", "scheduler", "worker"):
        parts |= {f"tls_{role}_key": f"{key[0]}\n", f"tls_{role}_cert": f"{certificate[0]}\n"}
    security = import_dask().Security(require_encryption=True, **parts)
    try:
        security.get_connection_args("client")
    except ssl.SSLError as error:
        raise damaged from error
    return address[0], security


def write_key_file(path: Path, address: str, security: Any) -> None:
    """Write a key file that only its owner can read; see `read_key_file` for the arguments."""
    text = "\n".join([_COMMENT, address, security.tls_scheduler_key + security.tls_scheduler_cert])
    with atomic_write(path) as temporary:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with open(descriptor, "w", encoding="ascii", newline="\n") as file:
            file.write(text)


def run_scheduler(path: Path, host: str | None = None, port: int = PORT) -> None:
    """Run a scheduler until it is interrupted, and write its key file; an existing one keeps its key.

    Args:
        host: address for other computers; None for this computer's main address.

    Raises:
        LodgsError: the key file is unusable, or the port is not available.
    """
    import dask.config

    if port > _MAX_PORT:
        raise LodgsError(f"Cannot use port {port}.", f"Choose a port from 1 to {_MAX_PORT}.")

    distributed = import_dask()
    security = read_key_file(path)[1] if path.exists() else distributed.Security.temporary()

    async def serve() -> None:
        async with distributed.Scheduler(
            host=host, port=port, protocol="tls://", security=security, dashboard=False,
            dashboard_address=_HTTP_ADDRESS,
        ) as scheduler:  # fmt: skip
            write_key_file(path, scheduler.address, security)
            print(f"Scheduler at {scheduler.address}. Copy {path} to every computer that trains.", flush=True)
            await scheduler.finished()

    logging.getLogger("distributed").setLevel(logging.WARNING)
    with dask.config.set(CONFIGURATION):
        try:
            _run(serve)
        except (OSError, RuntimeError, ValueError) as error:
            raise LodgsError(
                f"Cannot start a scheduler on {printable(host or 'this computer')}, port {port}: "
                f"{_reason(error)}.",
                "Choose another --host or --port, or stop the scheduler that uses it.",
            ) from error


def run_worker(path: Path, resources: dict[str, float] | None = None) -> None:
    """Run a worker that trains one part at a time, until it is interrupted.

    Args:
        path: the scheduler's key file.
        resources: Dask resources of this worker, such as {"GPU": 1}.

    Raises:
        LodgsError: the key file is unusable, or the scheduler does not answer or vanishes.
    """
    import dask.config

    distributed = import_dask()
    address, security = read_key_file(path)
    reasons = []

    class Nanny(distributed.Nanny):
        def close_gracefully(self, reason: str = "") -> None:
            reasons.append(reason)
            super().close_gracefully(reason)

    async def serve() -> None:
        async with Nanny(
            address, nthreads=1, security=security, resources=resources, dashboard=False,
            dashboard_address=_HTTP_ADDRESS,
        ) as nanny:  # fmt: skip
            print(f"Worker of {address}.", flush=True)
            await nanny.finished()

    logging.getLogger("distributed").setLevel(logging.WARNING)
    with dask.config.set(CONFIGURATION):
        try:
            _run(serve)
        except (OSError, RuntimeError, ValueError) as error:
            raise LodgsError(
                f"Cannot reach the scheduler at {address}: {_reason(error)}.",
                f"Start it, copy its key file to {path}, and open its port in the firewall.",
            ) from error
    if _SCHEDULER_CLOSES not in reasons:
        raise LodgsError(
            f"Lost the connection to the scheduler at {address}.", "Restart it, and then this worker."
        )


def _run(serve: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine until it ends or a signal stops it.

    A signal only cancels the coroutine: an exception of its handler can end in code that ignores exceptions.

    Raises:
        KeyboardInterrupt: SIGINT or SIGTERM arrived.
    """

    async def stoppable() -> None:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None

        def stop(number: int, frame: object) -> None:
            logging.disable()  # Dask logs the stacks of all connections that end
            loop.call_soon_threadsafe(task.cancel)

        for number in signals:
            signal.signal(number, stop)
        await serve()

    is_main = threading.current_thread() is threading.main_thread()
    signals = (signal.SIGINT, signal.SIGTERM) if is_main else ()
    previous = [signal.getsignal(number) for number in signals]
    try:
        asyncio.run(stoppable())
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None
    finally:
        for number, handler in zip(signals, previous, strict=True):
            signal.signal(number, handler)


def _reason(error: BaseException) -> str:
    """Return the first cause of an exception of Dask as a clause."""
    while error.__cause__ is not None:
        error = error.__cause__
    return printable(str(error) or type(error).__name__)[:300].rstrip(".")
