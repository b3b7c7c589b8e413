"""``python -m training serve``: pictures of splats for another program, one frame after the other.

Requests are JSON objects, one a line, on standard input, answers (``runs.events.event_line``) on standard
output; arrays lie in files of one folder (``wire``), which belongs to this process: it is removed when
standard input ends, however the other program ended.

    {"frame": 7, "out": NAME, "camera": {...}, "near": 0.1, "background": [r, g, b] or null,
     "depth": true, "levels": true, "window": [left, top, width, height] or null,
     "photograph": PATH or null, "holdout": PATH or null,
     "sets": [{"file": NAME, "count": N, "matrix": 4x4, "level": 3}, ...]}
    {"cancel": 7}

answer ``progress`` (frame, share), then one of ``frame`` (frame, passes, height, width, seconds; the planes
are in the file OUT), ``cancelled`` (frame) and ``error`` (frame, what, remedy). A photograph is read in the
frame's size and its planes follow the others, display-coded; ``psnr`` then says how alike both are. A holdout
is an EXR with the depth of what hides splats, of the camera's size or the window's.

A set is read when its file is first named, and forgotten when a frame does not name it.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import IO

import numpy as np
import torch

from .. import VERSION
from ..errors import LodgsError
from ..evaluate.metrics import psnr
from ..rasterize import resolve
from ..runs.events import event_line
from ..scenes.cameras import Camera, camera_from_dict
from ..scenes.images import load_image
from . import wire
from .picture import read_depth
from .scene import Instance, SplatSet, draw


def serve(folder: Path, backend: str, requests: IO[str], answers: IO[str]) -> int:
    """Answers until ``requests`` ends; then ``folder`` is removed. Returns an exit code.

    Raises:
        LodgsError: for a backend that does not work here.
    """
    torch.set_num_threads(1)
    server = _Server(folder, backend, answers)
    server.say("hello", protocol=wire.PROTOCOL, version=VERSION, backend=resolve(backend), pid=os.getpid())
    threading.Thread(target=server.listen, args=(requests,), daemon=True).start()
    server.work()
    return 0


class _Server:
    def __init__(self, folder: Path, backend: str, answers: IO[str]) -> None:
        self._folder, self._backend, self._answers = folder, backend, answers
        self._sets: dict[str, SplatSet] = {}
        self._requests: queue.SimpleQueue[dict | None] = queue.SimpleQueue()
        self._cancelled: set[int] = set()

    def say(self, kind: str, **values) -> None:
        """One event. Where nobody listens any more, the end of the requests is the end."""
        try:
            print(event_line(kind, **values), file=self._answers, flush=True)
        except OSError:
            self._end()

    def listen(self, requests: IO[str]) -> None:
        """In a thread of its own, so that a frame that is being drawn can be cancelled."""
        try:
            for line in requests:
                try:
                    request = json.loads(line)
                    if not isinstance(request, dict):
                        raise ValueError("no object")
                except ValueError as error:
                    self.say("error", frame=None, what=f"A request is not valid: {error}.", remedy="")
                    continue
                if "cancel" in request:
                    self._cancelled.add(request["cancel"])
                else:
                    self._requests.put(request)
        finally:
            self._end()

    def work(self) -> None:
        """Draws what is asked for, in order."""
        while True:
            request = self._requests.get()
            frame = request.get("frame") if request else None
            assert request is not None
            try:
                self._answer(request, frame)
            except LodgsError as error:
                self.say("error", frame=frame, what=error.what, remedy=error.remedy)
            except (KeyError, TypeError, ValueError, OSError) as error:
                traceback.print_exc()
                what = f"The renderer could not use what it was given ({type(error).__name__}: {error})."
                self.say("error", frame=frame, what=what, remedy="Please report it with the log.")

    def _answer(self, request: dict, frame: int | None) -> None:
        started = time.perf_counter()
        camera, near = camera_from_dict(request["camera"])
        background, holdout = request.get("background"), request.get("holdout")
        window = _window(request["window"], camera) if request.get("window") else None
        limit = read_depth(Path(holdout), camera.width, camera.height, window) if holdout else None
        instances = self._instances(request["sets"])
        if frame in self._cancelled:
            self.say("cancelled", frame=frame)
            return

        def progress(share: float) -> bool:
            self.say("progress", frame=frame, share=round(share, 4))
            return frame not in self._cancelled

        picture = draw(
            instances, camera, near=near, background=tuple(background) if background else None,
            depth=bool(request.get("depth")), levels=bool(request.get("levels")),
            window=window, limit=limit, backend=self._backend, progress=progress,
        )  # fmt: skip
        if picture is None or frame in self._cancelled:
            self._cancelled.discard(frame)  # type: ignore[arg-type]
            self.say("cancelled", frame=frame)
            return
        passes, (height, width), measured = picture.passes(), picture.alpha.shape, {}
        if request.get("photograph"):
            photograph = load_image(Path(request["photograph"]), camera.width, camera.height)
            passes |= {f"Photograph.{channel}": photograph[..., i] for i, channel in enumerate("RGB")}
            measured["psnr"] = psnr(torch.from_numpy(picture.image), torch.from_numpy(photograph))
        wire.write_planes(self._folder / Path(request["out"]).name, np.stack(list(passes.values())))
        self.say(
            "frame", frame=frame, passes=list(passes), height=height, width=width,
            seconds=round(time.perf_counter() - started, 4), **measured,
        )  # fmt: skip

    def _instances(self, sets: list[dict]) -> list[Instance]:
        """The sets of a frame; those of the last frame that are named again stay as they are."""
        kept, instances = {}, []
        for one in sets:
            name = Path(one["file"]).name
            if name not in kept:
                kept[name] = self._sets.get(name) or SplatSet(
                    *wire.read_set(self._folder / name, int(one["count"])), self._backend
                )
            matrix = np.array(one["matrix"], np.float64).reshape(4, 4)
            instances.append(Instance(kept[name], matrix, int(one["level"])))
        self._sets = kept
        return instances

    def _end(self) -> None:
        """Clean up and go, whatever the other threads are at."""
        shutil.rmtree(self._folder, ignore_errors=True)
        sys.stderr.flush()
        os._exit(0)


def _window(given: list, camera: Camera) -> tuple[int, int, int, int]:
    """A request's window; ValueError where it is no part of the camera's image."""
    left, top, width, height = map(int, given)
    inside = 0 <= left < left + width <= camera.width and 0 <= top < top + height <= camera.height
    if not inside:
        raise ValueError(f"the window {given} is not in the image")
    return left, top, width, height
