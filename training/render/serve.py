"""``python -m training serve``: rendering for another program, frame after frame.

Requests are JSON objects on standard input, one per line. Answers (``runs.events.event_line``) go to
standard output. Arrays are in files of one folder (``wire``) that belongs to this process, as a marker file
in it shows. The folder is removed when standard input ends, also if the other program crashed.

    {"frame": 7, "out": NAME, "camera": {...}, "near": 0.1, "background": [r, g, b] or null,
     "depth": true, "levels": true, "window": [left, top, width, height] or null,
     "photograph": PATH or null, "mask": PATH or null, "holdout": PATH or null,
     "sets": [{"file": NAME, "count": N, "matrix": 4x4, "level": 3,
               "columns": [NAME, ...], "query": {...} or null, "looks": [...], "motion": [4x4, ...]},
              {"paged": PATH, "matrix": 4x4, "query": {...}, "looks": [...]}, ...]}
    {"cancel": 7}

Optional keys of a frame blur it or change the lens: ``projection`` and ``aperture`` (``lens``), ``samples``,
and ``cameras``, the camera at equal intervals of the shutter time, like ``motion`` of a set.

Answers to a frame are ``progress`` (frame, share) and ``warning`` (frame, message), then ``frame`` (frame,
passes, height, width, seconds; the planes are in the file OUT), ``cancelled`` (frame) or ``error`` (frame,
what, remedy). A photograph is read in the frame's size, over black. Its display-coded planes follow the
others, and ``psnr`` compares it with the image outside the black parts of the mask. A holdout is an EXR
with the depth of objects that hide splats, in the size of the camera or the window.

A set is read when its file is first named, and discarded when a frame does not name it. Its file may be
removed after an answer ``frame``. A query (``lod.query``: ``rule``, ``position`` in the set's coordinates,
``focal_px``, and ``facts``, ``values`` and ``tables`` by name) weights the splats by a rule, in addition to
the file's weights. The rule's columns are the file's columns of the same names. Of a paged bundle
(``lod.query.PagedFile``), only the visible part is read. Looks (``editing.look``) change colours and
opacities: {"crop": {...} or null for everywhere, "look": {"exposure": 0.5, ...}}.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
import torch

from .. import VERSION
from ..errors import LodgsError, is_out_of_memory
from ..evaluate.metrics import psnr
from ..lod.on_disk import open_paged
from ..lod.query import PagedFile
from ..rasterize import cpu_fallback_reason, resolve_backend
from ..runs.events import event_line
from ..scenes.cameras import camera_to_dict
from ..scenes.images import load_image, load_mask
from ..splats.dialects import drop_undrawable
from ..splats.similarity import is_similarity
from . import wire
from .blur import Blur, draw_blurred
from .image import read_depth
from .requests import CancelRequest, FrameRequest, SetRequest, frame_number, parse_line, parse_request
from .scene import Instance, SplatSet

MAX_LINE_BYTES = 1 << 20
"""Maximum length of a request."""
_WEIGHTS = ""
"""Temporary extra column for the weights; no other column has an empty name."""


def serve(folder: Path, backend: str, requests: IO[bytes], answers: IO[str]) -> int:
    """Answer requests until they end, then remove ``folder``.

    Returns:
        The exit code.

    Raises:
        LodgsError: the backend is not available, or the folder has other contents.
    """
    torch.set_num_threads(1)
    if problem := cpu_fallback_reason(backend):
        print(problem, file=sys.stderr)
    backend = resolve_backend(backend)
    wire.claim_folder(folder)
    server = _Server(folder, backend, answers)
    server.send("hello", protocol=wire.PROTOCOL, version=VERSION, backend=backend, pid=os.getpid())
    threading.Thread(target=server.listen, args=(requests,), daemon=True).start()
    server.work()
    return 0


class _Server:
    def __init__(self, folder: Path, backend: str, answers: IO[str]) -> None:
        self._folder = folder
        self._backend = backend
        self._answers = answers
        self._sets: dict[str, SplatSet] = {}
        self._files: dict[Path, tuple[tuple[int, int], PagedFile]] = {}
        self._parts: dict[tuple, list[tuple[int, SplatSet]]] = {}
        self._requests: queue.SimpleQueue[FrameRequest] = queue.SimpleQueue()
        self._cancelled: set[int] = set()

    def send(self, kind: str, **values) -> None:
        """Send an event, or exit if the other program has closed the stream."""
        try:
            print(event_line(kind, **values), file=self._answers, flush=True)
        except OSError:
            self._exit()

    def listen(self, requests: IO[bytes]) -> None:
        """Receive requests in a separate thread, so that a frame can be cancelled while it is drawn."""
        try:
            while line := requests.readline(MAX_LINE_BYTES + 1):
                frame = None
                try:
                    values = parse_line(line)
                    frame = frame_number(values)
                    request = parse_request(values)
                except LodgsError as error:
                    while line and not line.endswith(b"\n"):  # skip the remainder of a line that is too long
                        line = requests.readline(MAX_LINE_BYTES)
                    self.send("error", frame=frame, what=error.what, remedy=error.remedy)
                    continue
                if isinstance(request, CancelRequest):
                    self._cancelled.add(request.frame)
                else:
                    self._requests.put(request)
        finally:
            self._exit()

    def work(self) -> None:
        """Draw the requested frames in order."""
        while True:
            request = self._requests.get()
            try:
                self._answer(request)
            except LodgsError as error:
                self.send("error", frame=request.frame, what=error.what, remedy=error.remedy)
            except Exception as error:
                traceback.print_exc()
                problem = f"Cannot draw the frame: unexpected {type(error).__name__} ({error})."
                remedy = "Please report it with the log."
                if is_out_of_memory(error):
                    problem = "Cannot draw the frame: not enough memory."
                    remedy = "Render a smaller image."
                self.send("error", frame=request.frame, what=problem, remedy=remedy)

    def _answer(self, request: FrameRequest) -> None:
        """Draw a frame, write its passes and send the result, or that it was cancelled.

        Raises:
            LodgsError: a file cannot be read, or the frame cannot be drawn.
        """
        started = time.perf_counter()
        frame, camera, window = request.frame, request.camera, request.window
        limit = None
        if request.holdout:
            limit = read_depth(request.holdout, camera.width, camera.height, window)
        instances = self._instances(frame, request)
        if frame in self._cancelled:
            self.send("cancelled", frame=frame)
            return

        def progress(share: float) -> bool:
            self.send("progress", frame=frame, share=round(share, 4))
            return frame not in self._cancelled

        blur = Blur(request.samples, request.aperture, request.cameras)
        image = draw_blurred(
            instances, camera, request.projection, blur,
            near=request.near, background=request.background, depth=request.depth,
            levels=request.levels, window=window, limit=limit, backend=self._backend, progress=progress,
        )  # fmt: skip
        if image is None or frame in self._cancelled:
            self._cancelled.discard(frame)
            self.send("cancelled", frame=frame)
            return
        passes, (height, width), measures = image.passes(), image.alpha.shape, {}
        if request.photograph:
            size = camera.width, camera.height
            photo = load_image(request.photograph, *size, alpha=True)[..., :3]
            passes |= {f"Photograph.{channel}": photo[..., i] for i, channel in enumerate("RGB")}
            mask = torch.from_numpy(load_mask(request.mask, *size)) if request.mask else None
            measures["psnr"] = psnr(torch.from_numpy(image.image), torch.from_numpy(photo), mask)
        wire.write_planes(self._folder / request.out, list(passes.values()))
        self.send(
            "frame", frame=frame, passes=list(passes), height=height, width=width,
            seconds=round(time.perf_counter() - started, 4), **measures,
        )  # fmt: skip

    def _instances(self, frame: int, request: FrameRequest) -> list[Instance]:
        """Return the instances of a frame. Sets that the last frame has loaded are reused."""
        sets: dict[str, SplatSet] = {}
        instances = []
        parts = {
            i: self._find_parts(item, request)
            for i, item in enumerate(request.sets)
            if item.paged is not None
        }
        self._parts = {key: self._parts[key] for key, _ in parts.values() if key in self._parts}
        for i, item in enumerate(request.sets):
            if i in parts:
                key, read = parts[i]
                if key not in self._parts:
                    self._parts[key] = read()
                instances += [
                    Instance(splats, item.matrix, level, item.antialias, item.query, item.looks, item.motion)
                    for level, splats in self._parts[key]
                ]
                continue
            if item.file not in sets:
                loaded = self._sets.get(item.file)
                # an empty set is false, so compare with None
                sets[item.file] = self._read_set(frame, item) if loaded is None else loaded
            splats = sets[item.file]
            instances.append(
                Instance(splats, item.matrix, item.level, item.antialias, item.query, item.looks, item.motion)
            )
        self._sets = sets
        return instances

    def _find_parts(
        self, item: SetRequest, request: FrameRequest
    ) -> tuple[tuple, Callable[[], list[tuple[int, SplatSet]]]]:
        """Return the cache key of a paged set, and a function that reads its visible part by level.

        Raises:
            LodgsError: the file cannot be read.
        """
        path, query = item.paged, item.query
        assert path is not None and query is not None
        try:
            stat = path.stat()
        except OSError as error:
            raise LodgsError(
                f"Cannot read {path}: {error.strerror}.",
                "Choose the file again under Streaming, or clear it to draw the levels in the scene.",
            ) from error
        stamp = stat.st_mtime_ns, stat.st_size
        if path not in self._files or self._files[path][0] != stamp:
            self._files[path] = stamp, open_paged(path)
        file = self._files[path][1]
        camera, unit = None, 1.0
        if request.is_one_view and is_similarity(item.matrix):
            camera, unit = request.camera.in_object_space(item.matrix)
        near = request.near / unit
        camera_key = None if camera is None else json.dumps(camera_to_dict(camera, near))

        def read() -> list[tuple[int, SplatSet]]:
            parts = file.visible(query, camera, near)
            return [(level, SplatSet(splats, None, self._backend)) for level, splats in parts.items()]

        return (path, stamp, query, camera_key), read

    def _read_set(self, frame: int, item: SetRequest) -> SplatSet:
        """Read a set from its file, without splats that cannot be drawn."""
        splats, weights = wire.read_set(self._folder / item.file, item.count, item.columns)
        splats.extras[_WEIGHTS] = np.nan_to_num(weights)
        splats = drop_undrawable(
            splats, "the scene", lambda text: self.send("warning", frame=frame, message=text)
        )
        return SplatSet(splats, splats.extras.pop(_WEIGHTS), self._backend)

    def _exit(self) -> None:
        """Remove the folder and exit the process, even if other threads are busy."""
        wire.release_folder(self._folder)
        sys.stderr.flush()
        os._exit(0)
