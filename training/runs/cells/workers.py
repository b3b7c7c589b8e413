"""Workers that train parts: this process, one part at a time, or a Dask cluster in parallel."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from ...errors import LodgsError, system_reason, system_remedy
from ...files import is_file
from .. import processes
from ..failures import CANCELLED
from ..folder import RunFolder
from .cluster import import_dask, local_cluster, read_key_file

HERE = "here"
TIMEOUT_SECONDS = 20
"""Seconds to wait for a scheduler or nvidia-smi."""
_PACKAGE = (__package__ or "").partition(".")[0]


class Pending(Protocol):
    """Submitted training of a part, as a future of ``concurrent.futures`` or Dask."""

    def done(self) -> bool:
        """Return whether it has ended."""
        ...

    def result(self) -> int:
        """Return the trainer's exit code, or raise the error of the worker."""
        ...

    def cancel(self) -> object:
        """Withdraw it if no worker has started it."""
        ...


Submit = Callable[[Path], Pending]
"""Submits a run folder for training."""


class _DaskTask:
    """A Dask future that also ends when the client loses its scheduler.

    A future submitted at that moment would never end.
    """

    def __init__(self, future: Any, client: Any) -> None:
        self._future = future
        self._client = client

    def done(self) -> bool:
        return self._future.done() or self._client.status == "closed"

    def result(self) -> int:
        if self.done() and not self._future.done():
            raise CancelledError
        return self._future.result()

    def cancel(self) -> object:
        return self._future.cancel()


def train_part(folder: str, threads: int = 0, cards: Sequence[str] = ()) -> int:
    """Start or resume a run in a separate process, and wait for its end. Called by a worker.

    If the trainer of a lost worker still runs, wait for it first. A run with a cancel request does not start.

    Args:
        folder: run folder with its job.
        threads: number of kernel threads; 0 for all cores.
        cards: CUDA identifiers of graphics cards; a Dask worker uses the one with its number. Empty for all
            visible cards.

    Returns:
        The trainer's exit code, negative if it was killed.

    Raises:
        LodgsError: the trainer cannot be started.
    """
    try:
        return _train_part(RunFolder(folder), threads, cards)
    except OSError as error:
        raise LodgsError(
            f"Cannot start the trainer of {folder}: {system_reason(error)}.",
            system_remedy(error, "Check that the worker can read and write this folder."),
        ) from error


def _train_part(run: RunFolder, threads: int, cards: Sequence[str]) -> int:
    was_running = run.running
    while run.running:
        time.sleep(1)
    if run.take_cancel() or (was_running and run.state() == "cancelled"):
        return CANCELLED
    package = Path(__file__).resolve().parents[2]
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(package.parent), os.environ.get("PYTHONPATH")])
    )
    if threads:
        environment.setdefault("LODGS_THREADS", str(threads))
    if cards:
        environment["CUDA_VISIBLE_DEVICES"] = cards[int(import_dask().get_worker().name) % len(cards)]
    run.output.write_bytes(b"")
    with run.log.open("ab") as log, run.output.open("ab") as output:
        trainer = subprocess.Popen(
            [sys.executable, "-m", _PACKAGE, "train", str(run.job)],
            env=environment | processes.parent_variable(), stdin=subprocess.DEVNULL,
            stdout=output, stderr=log,
        )  # fmt: skip
        return trainer.wait()


@contextmanager
def workers(on: str = HERE, resources: dict[str, float] | None = None, tls: bool = True) -> Iterator[Submit]:
    """Start workers and yield a function that submits parts to them.

    Args:
        on: HERE, one part at a time; "local:N", N parts at a time on this computer, sharing its cores and
            graphics cards; the key file of a scheduler, see ``cluster.run_scheduler``; or the address of a
            Dask scheduler, "tls://HOST:8786", with the certificates of Dask's configuration. The workers
            access run and scene under the same paths.
        resources: Dask resources that each part requires, such as {"GPU": 1}.
        tls: False to permit "tcp://HOST:8786", where everybody who reaches the port can run programs.

    Raises:
        LodgsError: the cluster is unknown or unreachable, or Dask is not installed.
    """
    if on == HERE:
        with ThreadPoolExecutor(1) as pool:
            yield lambda folder: pool.submit(train_part, str(folder))
        return
    kind, _, count = on.partition(":")
    local = kind == "local" and count.isdecimal() and int(count) > 0
    if not local:
        _check_scheduler(on, tls)
    distributed = import_dask()
    threads, cards = 0, []
    cluster: Any = on
    security = None
    if local:
        cards = graphics_cards()
        threads = max(_cores() // int(count), 1)
        cluster = local_cluster(int(count), resources)
        security = cluster.security
    elif "://" not in on:
        cluster, security = read_key_file(Path(on))
    try:
        client = distributed.Client(cluster, timeout=TIMEOUT_SECONDS, security=security)
    except (OSError, ValueError, TypeError) as error:  # TypeError: no certificates for a tls:// address
        if local:
            cluster.close()
        raise LodgsError(
            f"Cannot connect to the Dask scheduler at {on}.",
            "Start it, or correct the address. Copy its key file again if it has a new key.",
        ) from error

    def submit(folder: Path) -> Pending:
        try:
            future = client.submit(train_part, str(folder), threads, cards, pure=False, resources=resources)
            return _DaskTask(future, client)
        except distributed.client.ClosedClientError as error:
            raise LodgsError(
                f"Lost the connection to the Dask scheduler at {on}.",
                "Restart it and its workers, and repeat the command to resume.",
            ) from error

    try:
        yield submit
    finally:
        client.close()
        if local:
            cluster.close()


def _check_scheduler(on: str, tls: bool) -> None:
    """Raise an error unless this is a key file or an address that may be used."""
    if "://" not in on and not is_file(on):
        raise LodgsError(
            f"Unknown workers '{on}'.",
            "Use here, local:2 (two cells at a time), or the file that lodgs blocks scheduler has written.",
        )
    if tls and "://" in on and not on.startswith("tls://"):
        raise LodgsError(
            f"Cannot use {on}: other users could run programs through its unencrypted connections.",
            "Start it with lodgs blocks scheduler FILE and use --on FILE, or add --no-tls.",
        )


def graphics_cards() -> list[str]:
    """Return CUDA identifiers of this computer's NVIDIA cards: those in CUDA_VISIBLE_DEVICES, or all."""
    identifiers = os.environ.get("CUDA_VISIBLE_DEVICES")
    if identifiers is None:
        try:
            identifiers = subprocess.run(
                ["nvidia-smi", "--query-gpu=uuid", "--format=csv,noheader"], capture_output=True, text=True,
                timeout=TIMEOUT_SECONDS, check=True,
            ).stdout  # fmt: skip
        except (OSError, subprocess.SubprocessError):
            identifiers = ""
    return identifiers.replace(",", " ").split()


def _cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
