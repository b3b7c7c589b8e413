"""Client of the renderer process (``training.render.serve``), which stays alive between frames.

There is one renderer process. It starts with the first frame and receives only changed splats afterwards. It
ends when Blender ends or crashes, when a file is opened, or after some minutes without a frame.
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
from ...training.errors import LodgsError, system_reason
from ...training.lod.query import LodQuery
from ...training.render import wire
from ...training.render.lens import SHARP, Aperture, LensProjection
from ...training.scenes.cameras import Camera, camera_to_dict
from ...training.splats.gaussians import Splats
from .. import extension
from ..data.changes import Version
from ..runs import environment, processes

IDLE = 300.0
"""Seconds without a frame after which the renderer is closed to free its memory."""

PATIENCE = 1.0
"""Seconds to wait for a cancelled frame."""

OnProgress = Callable[[float, str], bool]
"""Function called with the progress (0 to 1) and a status text. It returns False to cancel the frame."""


@dataclass(frozen=True)
class RenderedFrame:
    """A rendered image with its passes.

    Attributes:
        planes: (H, W) float32 by name as ``training.render.image.RenderedImage.passes``, rows from the
            top. A photo, if given, is "Photograph.R" and so on, sRGB-encoded.
        psnr: PSNR to the photo in dB. NaN without a photo.
    """

    planes: dict[str, np.ndarray]
    psnr: float


@dataclass(frozen=True)
class PlacedSplats:
    """Splats with a placement in the world, for one frame.

    Attributes:
        key: identifier of the splats across frames.
        read: function that returns the splats in their local space and their weights (N,), or None for ones.
            It is called only if the renderer does not have these splats.
        matrix: (4, 4), local space to world.
        level: level number, or 0 if the splats are no level.
        antialias: see ``SplatScene.antialias``.
        version: version of the splats with this key: unchanged if equal. None if unknown.
        query: rule and arguments that select splats; None draws all.
        empty: whether no splat is visible. Empty sets are not read before they become visible.
        looks: adjustments of colours and opacities.
        motion: the matrix at equal intervals of the shutter time; empty for splats at rest.
    """

    key: int
    read: Callable[[], tuple[Splats, np.ndarray | None]]
    matrix: np.ndarray
    level: int
    antialias: bool = False
    version: Version | None = None
    query: LodQuery | None = None
    empty: bool = False
    looks: Looks = ()
    motion: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class PlacedFile:
    """A file of splats for one frame. The renderer reads only the visible part.

    Attributes:
        path: bundle, see ``training.lod.query.PagedFile``.
        matrix, antialias, query, looks, motion: see :class:`PlacedSplats`.
    """

    path: Path
    matrix: np.ndarray
    antialias: bool
    query: LodQuery
    looks: Looks = ()
    motion: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class FrameLens:
    """Lens and samples of a frame, see ``training.render.blur``.

    Attributes:
        projection: projection of the camera.
        aperture: opening of the lens, or None for a pinhole.
        cameras: the camera at equal intervals of the shutter time; empty for a camera at rest.
        samples: number of averaged images.
    """

    projection: LensProjection = SHARP
    aperture: Aperture | None = None
    cameras: tuple[Camera, ...] = ()
    samples: int = 1

    def as_dict(self, near: float) -> dict:
        """Return the keys of a request."""
        return {
            "projection": self.projection.as_dict(),
            "aperture": self.aperture and self.aperture.as_dict(),
            "cameras": [camera_to_dict(camera, near) for camera in self.cameras],
            "samples": self.samples,
        }


@dataclass(frozen=True)
class FrameView:
    """View and passes of a frame.

    Attributes:
        camera: camera in world space.
        near: near clipping distance.
        background: colour of the background, or None for transparent.
        depth: whether to render the depth pass.
        levels: whether to render the level passes.
        window: left, top, width and height of the rendered region in pixels, or None for the full image.
        photograph: photo to compare with.
        mask: image that is black where the comparison ignores pixels.
        holdout: EXR file with the depth of objects that occlude splats.
        lens: lens and samples.
    """

    camera: Camera
    near: float
    background: tuple[float, float, float] | None = None
    depth: bool = False
    levels: bool = False
    window: tuple[int, int, int, int] | None = None
    photograph: Path | None = None
    mask: Path | None = None
    holdout: Path | None = None
    lens: FrameLens = FrameLens()

    def as_dict(self) -> dict:
        """Return the keys of a request."""
        files = {name: getattr(self, name) for name in ("photograph", "mask", "holdout")}
        return {
            "camera": camera_to_dict(self.camera, self.near),
            **{name: getattr(self, name) for name in ("background", "depth", "levels", "window")},
            **{name: str(path) if path else None for name, path in files.items()},
            **self.lens.as_dict(self.near),
        }


class _SentSet(NamedTuple):
    """A set of splats that the renderer has or can read, with its file, content and version."""

    file: Path
    digest: tuple
    count: int
    columns: list[str]
    version: Version | None


class RendererStopped(Exception):
    """The renderer process has ended unexpectedly."""


class Renderer:
    """A renderer process and the splats that it has.

    Raises:
        LodgsError: the trainer is missing or cannot be started.
    """

    def __init__(self) -> None:
        python = environment.trainer_python()
        environment.require(python)
        self._folder = Path(tempfile.mkdtemp(prefix="lodgs-render-", dir=bpy.app.tempdir or None))
        wire.claim_folder(self._folder)
        self._log = self._folder / "renderer.log"
        self._is_first_frame = True  # compiles kernels, which may take some seconds
        self._sent: dict[int, _SentSet] = {}
        self._numbers = itertools.count(1)
        self._responses: queue.SimpleQueue[dict | None] = queue.SimpleQueue()
        command = [str(python), "-m", "training", "serve", str(self._folder)]
        try:
            self.process = processes.spawn_piped(
                [*command, "--backend", extension.preferences().backend], self._log
            )
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise LodgsError(
                f"Cannot start the renderer with {python}: {error.strerror or error}.",
                "Check the trainer's Python in the preferences of LODGS.",
            ) from error
        threading.Thread(target=self._read_responses, daemon=True).start()

    def draw_frame(
        self, sets: list[PlacedSplats | PlacedFile], view: FrameView, on_progress: OnProgress
    ) -> RenderedFrame | None:
        """Render a frame.

        Args:
            sets: visible splats.
            view: view and passes of the frame.
            on_progress: function that receives the progress and may cancel the frame.

        Returns:
            The frame, or None if it was cancelled.

        Raises:
            LodgsError: the frame cannot be rendered.
            RendererStopped: the process has ended.
        """
        frame = next(self._numbers)
        out = self._folder / f"frame-{frame}"
        try:
            previous = dict(self._sent)
            described = self._write_sets(sets)
            self._send(frame=frame, out=out.name, sets=described, **view.as_dict())
            response = self._wait(frame, on_progress)
            self._remove_files(previous, all_read=response["event"] == "frame")
            return self._read_frame(out, response)
        except OSError as error:
            if self.process.poll() is not None or isinstance(error, BrokenPipeError):
                raise RendererStopped from error
            raise LodgsError(
                f"Cannot use the renderer's files in {self._folder}: {system_reason(error)}.",
                "Free some disk space.",
            ) from error

    def _remove_files(self, previous: dict[int, _SentSet], all_read: bool) -> None:
        """Remove the files of replaced sets, or of all sets once the renderer has read them."""
        sent = {item.file for item in self._sent.values()}
        unused = {item.file for item in previous.values()} - sent
        for path in unused | sent if all_read else unused:
            path.unlink(missing_ok=True)

    def _read_frame(self, path: Path, response: dict) -> RenderedFrame | None:
        """Read the frame of a response, or return None if it was cancelled."""
        if response["event"] == "error":
            raise LodgsError(response["what"], response["remedy"])
        if response["event"] == "cancelled":
            return None
        names = response["passes"]
        planes = wire.read_planes(path, len(names), response["height"], response["width"])
        path.unlink(missing_ok=True)
        return RenderedFrame(dict(zip(names, planes, strict=True)), response.get("psnr", float("nan")))

    def close(self) -> None:
        """End the process and remove its files."""
        with suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def exit_reason(self) -> str:
        """Return why the process has ended."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=2)
        code = self.process.returncode
        if code is not None and code < 0:
            return f"The renderer was killed (signal {-code}), often because the memory is full."
        try:
            last = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        except OSError:
            last = []
        return " ".join([f"The renderer stopped with exit code {code}.", *last])

    def _write_sets(self, sets: list[PlacedSplats | PlacedFile]) -> list[dict]:
        """Write new and changed splats to files. Return the descriptions of all sets for the request."""
        sent: dict[int, _SentSet] = {}
        described = []
        for item in sets:
            if isinstance(item, PlacedFile):
                described.append(
                    {
                        "paged": str(item.path), "matrix": item.matrix.tolist(), "antialias": item.antialias,
                        "query": item.query.as_dict(), "looks": looks_as_dicts(item.looks),
                        "motion": [matrix.tolist() for matrix in item.motion],
                    }
                )  # fmt: skip
                continue
            if item.empty and item.key not in self._sent:
                continue
            if item.key not in sent:
                sent[item.key] = self._write_set(item)
            file, _, count, columns, _ = sent[item.key]
            described.append(
                {
                    "file": file.name, "count": count, "columns": columns,
                    "matrix": item.matrix.tolist(), "level": item.level, "antialias": item.antialias,
                    "query": None if item.query is None else item.query.as_dict(),
                    "looks": looks_as_dicts(item.looks),
                    "motion": [matrix.tolist() for matrix in item.motion],
                }
            )  # fmt: skip
        self._sent = sent
        return described

    def _write_set(self, item: PlacedSplats) -> _SentSet:
        """Write a set to a file if it has changed since it was sent."""
        previous = self._sent.get(item.key)
        if previous is not None and item.version is not None and previous.version == item.version:
            return previous
        splats, weights = item.read()
        columns = wire.pack_set(splats, weights)
        digest, names = wire.digest(columns), list(splats.extras)
        if previous is not None and (previous.digest, previous.columns) == (digest, names):
            return previous._replace(version=item.version)
        path = self._folder / f"set-{next(self._numbers)}"
        wire.write_set(path, columns)
        return _SentSet(path, digest, len(splats), names, item.version)

    def _wait(self, frame: int, on_progress: OnProgress) -> dict:
        """Return the response to a frame. Responses to earlier frames, which were cancelled, are ignored."""
        text = "Preparing the renderer" if self._is_first_frame else "Rendering"
        fraction = 0.0
        cancel_time = 0.0
        while True:
            try:
                response = self._responses.get(timeout=0.1)
            except queue.Empty:
                response = {}
            if response is None:
                raise RendererStopped
            kind = response.get("event")
            number = response.get("frame")
            if kind == "hello" and response["protocol"] != wire.PROTOCOL:
                raise LodgsError(
                    "Cannot render: the renderer has another version than LODGS.", "Restart Blender."
                )
            if kind == "progress" and number == frame:
                fraction = response["share"]
                text = "Rendering"
                self._is_first_frame = False
            elif kind in {"frame", "cancelled", "error"} and number in {frame, None}:
                return response
            if cancel_time and time.monotonic() - cancel_time > PATIENCE:
                return {"event": "cancelled"}
            if not on_progress(fraction, text) and not cancel_time:
                cancel_time = time.monotonic()
                self._send(cancel=frame)

    def _send(self, **request) -> None:
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def _read_responses(self) -> None:
        """Queue the responses of the process, and None when it ends. Runs in a thread."""
        for line in self.process.stdout or ():
            with suppress(ValueError):
                response = json.loads(line)
                if isinstance(response, dict):
                    self._responses.put(response)
        self._responses.put(None)


_renderer: Renderer | None = None
_lock = threading.Lock()
_last_use = 0.0


def draw_frame(
    sets: list[PlacedSplats | PlacedFile], view: FrameView, on_progress: OnProgress
) -> RenderedFrame | None:
    """Call :meth:`Renderer.draw_frame` of the shared renderer. Start it if needed, and once more if it dies.

    Raises:
        LodgsError: the trainer is missing, the frame cannot be rendered, or the renderer died twice.
    """
    global _renderer, _last_use
    with _lock:
        for attempt in (1, 2):
            if _renderer is None:
                on_progress(0.0, "Starting the renderer")
                _renderer = Renderer()
            try:
                return _renderer.draw_frame(sets, view, on_progress)
            except RendererStopped:
                reason = _renderer.exit_reason()
                _renderer.close()
                _renderer = None
                if attempt == 2:
                    raise LodgsError(reason, "Render a coarser level or a smaller image.") from None
                print(f"LODGS: {reason} Restarting it.")
            finally:
                _last_use = time.monotonic()
    return None


def close() -> None:
    """End the shared renderer after its current frame."""
    global _renderer
    with _lock:
        if _renderer is not None:
            _renderer.close()
            _renderer = None


def _close_when_idle() -> float:
    """Close an idle renderer. Timer function."""
    if _renderer is not None and time.monotonic() - _last_use > IDLE and not _lock.locked():
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
