"""The trainer's rasterizer as a program beside Blender (``training.render.serve``), alive between frames.

There is one, started with the first frame and given what has changed since the last. It ends with Blender,
however that ends, with the file, or after some minutes without a frame.
"""

from __future__ import annotations

import itertools
import json
import queue
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np

from ...training.editing.look import Looks, looks_as_dicts
from ...training.errors import LodgsError
from ...training.lod.query import Choice
from ...training.render import wire
from ...training.scenes.cameras import Camera, camera_to_dict
from ...training.splats.gaussians import Splats
from .. import extension
from ..data.changes import Version
from ..runs import environment, processes

IDLE = 300.0
"""Seconds without a frame after which the renderer gives its memory back."""

PATIENCE = 1.0
"""Seconds that a cancelled frame is waited for."""

OnProgress = Callable[[float, str], bool]
"""Called with the fraction that is done and a word on it; where it returns False the frame is cancelled."""


@dataclass(frozen=True)
class Frame:
    """A picture.

    Attributes:
        planes: (H, W) float32 by name as ``training.render.image.RenderedImage.passes``, rows from the top; the
            photograph's, where one was given, are "Photograph.R", ..., display-coded.
        psnr: in dB against the photograph; NaN where none was given.
    """

    planes: dict[str, np.ndarray]
    psnr: float


@dataclass(frozen=True)
class PlacedSplats:
    """Splats in the world, for one frame.

    Attributes:
        key: says which splats are the same from frame to frame.
        read: the splats in the files' form, in their own space, and their weights (N,), or None for ones;
            called where they are not known already.
        matrix: (4, 4) to the world.
        level: 0 where they are no level.
        antialias: see ``SplatScene.antialias``.
        version: the splats with this key do not change as long as it stays; None: nobody knows.
        choice: by what splats are weighted; None: all are drawn.
        empty: whether nothing is seen of them. What has not been seen so far is not even read.
        looks: what is made of their colours and opacities.
    """

    key: int
    read: Callable[[], tuple[Splats, np.ndarray | None]]
    matrix: np.ndarray
    level: int
    antialias: bool = False
    version: Version | None = None
    choice: Choice | None = None
    empty: bool = False
    looks: Looks = ()


@dataclass(frozen=True)
class PlacedTree:
    """A tree of splats in a file, for one frame, of which the renderer reads what the frame shows.

    Attributes:
        path: a bundle of the rule ``cut``.
        matrix, antialias, choice, looks: see :class:`PlacedSplats`.
    """

    path: Path
    matrix: np.ndarray
    antialias: bool
    choice: Choice
    looks: Looks = ()


class _Known(NamedTuple):
    """A set that the program has, or can read: its file, what is in it, and what it was made of."""

    file: Path
    digest: tuple
    count: int
    columns: list[str]
    version: Version | None


class Stopped(Exception):
    """The program has ended by itself."""


class Renderer:
    """One program, and what it knows.

    Raises:
        LodgsError: no Python is set up that can do it.
    """

    def __init__(self) -> None:
        python = environment.trainer_python()
        environment.require(python)
        self._folder = Path(tempfile.mkdtemp(prefix="lodgs-render-", dir=bpy.app.tempdir or None))
        wire.claim_folder(self._folder)
        self._log = self._folder / "renderer.log"
        self._fresh = True  # the first frame on a computer compiles, for some seconds
        self._known: dict[int, _Known] = {}
        self._numbers = itertools.count(1)
        self._answers: queue.SimpleQueue[dict | None] = queue.SimpleQueue()
        command = [str(python), "-m", "training", "serve", str(self._folder)]
        try:
            self.process = processes.spawn_piped(
                [*command, "--backend", extension.preferences().backend], self._log
            )
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise LodgsError(
                f"The renderer cannot be started with {python}: {error.strerror or error}.",
                "Check the trainer's Python in the preferences of LODGS.",
            ) from error
        threading.Thread(target=self._read_answers, daemon=True).start()

    def frame(
        self,
        sets: list[PlacedSplats | PlacedTree],
        camera: Camera,
        near: float,
        on_progress: OnProgress,
        *,
        background: tuple[float, float, float] | None = None,
        depth: bool = False,
        levels: bool = False,
        window: tuple[int, int, int, int] | None = None,
        photograph: Path | None = None,
        mask: Path | None = None,
        holdout: Path | None = None,
    ) -> Frame | None:
        """A picture, or None where it was cancelled.

        Args: as ``training.render.scene.draw``, and
            photograph: to compare with.
            mask: black where it does not count.
            holdout: EXR with the depth of what hides splats.

        Raises:
            LodgsError: it cannot be drawn, says why.
            Stopped: the program has ended.
        """
        frame = next(self._numbers)
        out = self._folder / f"frame-{frame}"
        try:
            old, named = dict(self._known), self._write_sets(sets)
            self._send(
                frame=frame, out=out.name, sets=named, camera=camera_to_dict(camera, near),
                background=background, depth=depth, levels=levels, window=window,
                photograph=str(photograph) if photograph else None, mask=str(mask) if mask else None,
                holdout=str(holdout) if holdout else None,
            )  # fmt: skip
            answer = self._wait(frame, on_progress)
            done = {each.file for each in old.values()} - {each.file for each in self._known.values()}
            if answer["event"] == "frame":  # all has been read
                done |= {each.file for each in self._known.values()}
            for path in done:
                path.unlink(missing_ok=True)
            if answer["event"] == "error":
                raise LodgsError(answer["what"], answer["remedy"])
            if answer["event"] == "cancelled":
                return None
            names = answer["passes"]
            planes = wire.read_planes(out, len(names), answer["height"], answer["width"])
            out.unlink(missing_ok=True)
            return Frame(dict(zip(names, planes, strict=True)), answer.get("psnr", float("nan")))
        except OSError as error:
            if self.process.poll() is not None or isinstance(error, BrokenPipeError):
                raise Stopped from error
            raise LodgsError(
                f"The renderer's files in {self._folder} cannot be used: {error.strerror or error}.",
                "Free some space there.",
            ) from error

    def close(self) -> None:
        """Ends the program and takes its files away."""
        with suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def exit_reason(self) -> str:
        """Why the program has ended, as far as one can know."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=2)
        code = self.process.returncode
        if code is not None and code < 0:
            return f"The renderer was killed (signal {-code}); often that means too little memory."
        try:
            last = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        except OSError:
            last = []
        return " ".join([f"The renderer stopped with exit code {code}.", *last])

    def _write_sets(self, sets: list[PlacedSplats | PlacedTree]) -> list[dict]:
        """Writes the splats that are new or have changed, and names all."""
        known, named = {}, []
        for one in sets:
            if isinstance(one, PlacedTree):
                named.append(
                    {
                        "tree": str(one.path), "matrix": one.matrix.tolist(), "antialias": one.antialias,
                        "choice": one.choice.as_dict(), "looks": looks_as_dicts(one.looks),
                    }
                )  # fmt: skip
                continue
            if one.empty and one.key not in self._known:
                continue
            if one.key not in known:
                known[one.key] = self._written(one)
            file, _, count, columns, _ = known[one.key]
            named.append(
                {
                    "file": file.name, "count": count, "columns": columns,
                    "matrix": one.matrix.tolist(), "level": one.level, "antialias": one.antialias,
                    "choice": None if one.choice is None else one.choice.as_dict(),
                    "looks": looks_as_dicts(one.looks),
                }
            )  # fmt: skip
        self._known = known
        return named

    def _written(self, one: PlacedSplats) -> _Known:
        before = self._known.get(one.key)
        if before is not None and one.version is not None and before.version == one.version:
            return before
        splats, weights = one.read()
        columns = wire.pack_set(splats, weights)
        digest, names = wire.digest(columns), list(splats.extras)
        if before is not None and (before.digest, before.columns) == (digest, names):
            return before._replace(version=one.version)
        path = self._folder / f"set-{next(self._numbers)}"
        wire.write_set(path, columns)
        return _Known(path, digest, len(splats), names, one.version)

    def _wait(self, frame: int, on_progress: OnProgress) -> dict:
        """The answer to a frame; that of a cancelled one may come late, and is then passed over."""
        text, fraction, cancelled = "Preparing the renderer" if self._fresh else "Rendering", 0.0, 0.0
        while True:
            try:
                answer = self._answers.get(timeout=0.1)
            except queue.Empty:
                answer = {}
            if answer is None:
                raise Stopped
            kind, of = answer.get("event"), answer.get("frame")
            if kind == "hello" and answer["protocol"] != wire.PROTOCOL:
                raise LodgsError("The renderer is of another version.", "Restart Blender.")
            if kind == "progress" and of == frame:
                fraction, text, self._fresh = answer["share"], "Rendering", False
            elif kind in {"frame", "cancelled", "error"} and of in {frame, None}:
                return answer
            if cancelled and time.monotonic() - cancelled > PATIENCE:
                return {"event": "cancelled"}
            if not on_progress(fraction, text) and not cancelled:
                cancelled = time.monotonic()
                self._send(cancel=frame)

    def _send(self, **request) -> None:
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def _read_answers(self) -> None:
        """In a thread of its own: what the program answers, and that it has ended."""
        for line in self.process.stdout or ():
            with suppress(ValueError):
                answer = json.loads(line)
                if isinstance(answer, dict):
                    self._answers.put(answer)
        self._answers.put(None)


_renderer: Renderer | None = None
_lock = threading.Lock()
_used = 0.0


def frame(
    sets: list[PlacedSplats | PlacedTree], camera: Camera, near: float, on_progress: OnProgress, **options
) -> Frame | None:
    """:meth:`Renderer.frame` by the one renderer; started when there is none, and once again when it dies.

    Raises:
        LodgsError: no Python is set up that can render, it cannot be drawn, or the renderer died twice.
    """
    global _renderer, _used
    with _lock:
        for attempt in (1, 2):
            if _renderer is None:
                on_progress(0.0, "Starting the renderer")
                _renderer = Renderer()
            try:
                return _renderer.frame(sets, camera, near, on_progress, **options)
            except Stopped:
                reason = _renderer.exit_reason()
                _renderer.close()
                _renderer = None
                if attempt == 2:
                    raise LodgsError(reason, "Render a coarser level or a smaller picture.") from None
                print(f"LODGS: {reason} It is started again.")
            finally:
                _used = time.monotonic()
    return None


def close() -> None:
    """Ends the renderer, if there is one; waits for the frame that is being drawn."""
    global _renderer
    with _lock:
        if _renderer is not None:
            _renderer.close()
            _renderer = None


def _close_when_idle() -> float:
    """A timer: an idle renderer gives its memory back."""
    if _renderer is not None and time.monotonic() - _used > IDLE and not _lock.locked():
        close()
    return 60.0


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    close()


def register() -> None:
    bpy.app.handlers.load_pre.append(_on_load)
    if not bpy.app.background:
        bpy.app.timers.register(_close_when_idle, first_interval=60.0, persistent=True)


def unregister() -> None:
    bpy.app.handlers.load_pre.remove(_on_load)
    if bpy.app.timers.is_registered(_close_when_idle):
        bpy.app.timers.unregister(_close_when_idle)
    close()
