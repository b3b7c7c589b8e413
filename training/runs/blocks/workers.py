"""Where blocks are trained: one after the other here, or side by side by the workers of a Dask cluster."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from ...errors import LodgsError
from ..failures import CANCELLED
from ..folder import RunFolder

HERE = "here"
ANSWERS = 20
"""Seconds in which a scheduler answers."""
_LETS_US_STOP = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""What Dask's workers here begin with: Ctrl-C in a terminal goes to all programs, and we handle it."""
_PACKAGE = (__package__ or "").partition(".")[0]


class Pending(Protocol):
    """A block that somebody trains, as ``concurrent.futures`` and Dask have it."""

    def done(self) -> bool:
        """Whether it has ended."""
        ...

    def result(self) -> int:
        """The trainer's exit code; raises what went wrong with whoever ran it."""
        ...

    def cancel(self) -> object:
        """Gives it up where nobody has begun it."""
        ...


Submit = Callable[[Path], Pending]
"""Has a run's folder trained."""


class _Given:
    """What a Dask client was given, which is over, too, where the client has lost its scheduler: a future
    that came in that moment would wait for ever."""

    def __init__(self, future: Any, client: Any) -> None:
        self._future, self._client = future, client

    def done(self) -> bool:
        return self._future.done() or self._client.status == "closed"

    def result(self) -> int:
        if self.done() and not self._future.done():
            raise CancelledError
        return self._future.result()

    def cancel(self) -> object:
        return self._future.cancel()


def train_block(folder: str, threads: int = 0, cards: Sequence[str] = ()) -> int:
    """Trains a run to its end, or goes on with it, in a process of its own; a worker calls it.

    Where the trainer of a worker that was lost is still at work it is waited for first. A run that has been
    asked to stop does not begin.

    Args:
        folder: of the run, which has its job.
        threads: of the kernels; 0 for as many as the computer has.
        cards: graphics cards as CUDA names them, of which a Dask worker takes the one of its number; none for
            what the process sees.

    Returns:
        The trainer's exit code, negative where it was killed.
    """
    run = RunFolder(folder)
    left = run.running
    while run.running:
        time.sleep(1)
    if run.take_cancel() or (left and run.state() == "cancelled"):
        return CANCELLED
    package = Path(__file__).resolve().parents[2]
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(package.parent), os.environ.get("PYTHONPATH")])
    )
    if threads:
        environment.setdefault("LODGS_THREADS", str(threads))
    if cards:
        environment["CUDA_VISIBLE_DEVICES"] = cards[int(_distributed().get_worker().name) % len(cards)]
    with run.log.open("ab") as log:
        return subprocess.run(
            [sys.executable, "-m", _PACKAGE, "train", str(run.job)], env=environment, check=False,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log,
        ).returncode  # fmt: skip


@contextmanager
def workers(on: str = HERE, resources: dict[str, float] | None = None) -> Iterator[Submit]:
    """Those who train blocks.

    Args:
        on: HERE, one block after the other; "local:N", N at a time on this computer, which share its cores
            and graphics cards; or the address of a Dask scheduler, "tcp://HOST:8786", whose workers see run
            and scene under the same paths.
        resources: what each block takes of a Dask worker's, such as {"GPU": 1}.

    Raises:
        LodgsError: there is no such cluster, or Dask is not installed.
    """
    if on == HERE:
        with ThreadPoolExecutor(1) as pool:
            yield lambda folder: pool.submit(train_block, str(folder))
        return
    kind, _, count = on.partition(":")
    if not (kind == "local" and count.isdecimal() and int(count)) and "://" not in on:
        raise LodgsError(
            f"There is nothing to train on at '{on}'.",
            "Say here, local:2 (two at a time on this computer) or tcp://HOST:8786 (a Dask scheduler).",
        )
    distributed = _distributed()
    threads, cards = 0, []
    made: Any = on
    if kind == "local":
        n, cards = int(count), graphics_cards()
        threads = max(_cores() // n, 1)
        made = distributed.LocalCluster(
            n_workers=n, threads_per_worker=1, processes=True, dashboard_address=":0", resources=resources,
            silence_logs=logging.ERROR, preload=[_LETS_US_STOP],
        )  # fmt: skip
    try:
        client = distributed.Client(made, timeout=ANSWERS)
    except (OSError, ValueError) as error:
        raise LodgsError(
            f"No Dask scheduler answers at {on}.", "Start it, or correct the address."
        ) from error

    def submit(folder: Path) -> Pending:
        try:
            given = client.submit(train_block, str(folder), threads, cards, pure=False, resources=resources)
            return _Given(given, client)
        except distributed.client.ClosedClientError as error:
            raise LodgsError(
                f"The Dask scheduler at {on} is gone.",
                "Start it and its workers again, and give the same command: all goes on from where it is.",
            ) from error

    try:
        yield submit
    finally:
        client.close()
        if kind == "local":
            made.close()


def graphics_cards() -> list[str]:
    """NVIDIA's graphics cards of this computer as CUDA names them: those of CUDA_VISIBLE_DEVICES, or all."""
    said = os.environ.get("CUDA_VISIBLE_DEVICES")
    if said is None:
        try:
            said = subprocess.run(
                ["nvidia-smi", "--query-gpu=uuid", "--format=csv,noheader"], capture_output=True, text=True,
                timeout=ANSWERS, check=True,
            ).stdout  # fmt: skip
        except (OSError, subprocess.SubprocessError):
            said = ""
    return said.replace(",", " ").split()


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _distributed() -> Any:
    try:
        import distributed
    except ModuleNotFoundError:
        raise LodgsError(
            f"Dask is not installed in {sys.executable}.",
            'Install it there with: pip install "lodgs[cluster]", or train on: here.',
        ) from None
    return distributed
