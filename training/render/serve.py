"""``python -m training serve``: pictures of splats for another program, one frame after the other.

Requests are JSON objects, one a line, on standard input, answers (``runs.events.event_line``) on standard
output; arrays lie in files of one folder (``wire``), which belongs to this process, as a mark in it says: it
is removed when standard input ends, however the other program ended.

    {"frame": 7, "out": NAME, "camera": {...}, "near": 0.1, "background": [r, g, b] or null,
     "depth": true, "levels": true, "window": [left, top, width, height] or null,
     "photograph": PATH or null, "mask": PATH or null, "holdout": PATH or null,
     "sets": [{"file": NAME, "count": N, "matrix": 4x4, "level": 3,
               "columns": [NAME, ...], "choice": {...} or null, "looks": [...]},
              {"tree": PATH, "matrix": 4x4, "choice": {...}, "looks": [...]}, ...]}
    {"cancel": 7}

answer ``progress`` (frame, share) and ``warning`` (frame, message), then one of ``frame`` (frame, passes,
height, width, seconds; the planes are in the file OUT), ``cancelled`` (frame) and ``error`` (frame, what,
remedy). A photograph is read in the frame's size, over black, and its planes follow the others,
display-coded; ``psnr`` then says how alike both are, where the mask is not black. A holdout is an EXR with
the depth of what hides splats, of the camera's size or the window's.

A set is read when its file is first named, and forgotten when a frame does not name it; its file may go after
an answer ``frame``. With a choice (``lod.query``: ``rule``, ``eye`` in the set's coordinates, ``focal_px``,
and by name ``facts``, ``values`` and ``tables``) its splats are weighted as the rule says, times the file's
weights; what the rule knows of each splat are the file's columns of these names. A tree is a bundle of the
rule ``cut``, of which is read what the frame shows. Looks (``editing.look``) are what is made of its colours and
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
from ..lod.tree.paging import TreeFile
from ..rasterize import cpu_fallback_reason, resolve_backend
from ..runs.events import event_line
from ..scenes.cameras import camera_to_dict
from ..scenes.images import load_image, load_mask
from ..splats.dialects import drop_undrawable
from ..splats.similarity import is_similarity
from . import wire
from .image import read_depth
from .requests import CancelRequest, FrameRequest, SetRequest, frame_number, parse_line, parse_request
from .scene import Instance, SplatSet, draw

MAX_LINE_BYTES = 1 << 20
"""Bytes of a line that asks for something."""
_WEIGHTS = ""
"""Where weights stand among the columns of a set, which all have a name."""


def serve(folder: Path, backend: str, requests: IO[bytes], answers: IO[str]) -> int:
    """Answers until ``requests`` ends; then ``folder`` is removed. Returns an exit code.

    Raises:
        LodgsError: for a backend that does not work here, or a folder with other things in it.
    """
    torch.set_num_threads(1)
    if problem := cpu_fallback_reason(backend):
        print(problem, file=sys.stderr)
    backend = resolve_backend(backend)
    wire.claim_folder(folder)
    server = _Server(folder, backend, answers)
    server.say("hello", protocol=wire.PROTOCOL, version=VERSION, backend=backend, pid=os.getpid())
    threading.Thread(target=server.listen, args=(requests,), daemon=True).start()
    server.work()
    return 0


class _Server:
    def __init__(self, folder: Path, backend: str, answers: IO[str]) -> None:
        self._folder, self._backend, self._answers = folder, backend, answers
        self._sets: dict[str, SplatSet] = {}
        self._trees: dict[Path, tuple[tuple[int, int], TreeFile]] = {}
        self._cuts: dict[tuple, list[tuple[int, SplatSet]]] = {}
        self._requests: queue.SimpleQueue[FrameRequest] = queue.SimpleQueue()
        self._cancelled: set[int] = set()

    def say(self, kind: str, **values) -> None:
        """One event. Where nobody listens any more, the end of the requests is the end."""
        try:
            print(event_line(kind, **values), file=self._answers, flush=True)
        except OSError:
            self._end()

    def listen(self, requests: IO[bytes]) -> None:
        """In a thread of its own, so that a frame that is being drawn can be cancelled."""
        try:
            while line := requests.readline(MAX_LINE_BYTES + 1):
                frame = None
                try:
                    values = parse_line(line)
                    frame = frame_number(values)
                    request = parse_request(values)
                except LodgsError as error:
                    while line and not line.endswith(b"\n"):  # the rest of one that is too long
                        line = requests.readline(MAX_LINE_BYTES)
                    self.say("error", frame=frame, what=error.what, remedy=error.remedy)
                    continue
                if isinstance(request, CancelRequest):
                    self._cancelled.add(request.frame)
                else:
                    self._requests.put(request)
        finally:
            self._end()

    def work(self) -> None:
        """Draws what is asked for, in order."""
        while True:
            request = self._requests.get()
            try:
                self._answer(request)
            except LodgsError as error:
                self.say("error", frame=request.frame, what=error.what, remedy=error.remedy)
            except Exception as error:
                traceback.print_exc()
                what = f"The renderer could not use what it was given ({type(error).__name__}: {error})."
                remedy = "Please report it with the log."
                if is_out_of_memory(error):
                    what, remedy = "There is not enough memory for this picture.", "Render a smaller one."
                self.say("error", frame=request.frame, what=what, remedy=remedy)

    def _answer(self, request: FrameRequest) -> None:
        started = time.perf_counter()
        frame, camera, window = request.frame, request.camera, request.window
        limit = None
        if request.holdout:
            limit = read_depth(request.holdout, camera.width, camera.height, window)
        instances = self._instances(frame, request)
        if frame in self._cancelled:
            self.say("cancelled", frame=frame)
            return

        def progress(share: float) -> bool:
            self.say("progress", frame=frame, share=round(share, 4))
            return frame not in self._cancelled

        picture = draw(
            instances, camera, near=request.near, background=request.background, depth=request.depth,
            levels=request.levels, window=window, limit=limit, backend=self._backend, progress=progress,
        )  # fmt: skip
        if picture is None or frame in self._cancelled:
            self._cancelled.discard(frame)
            self.say("cancelled", frame=frame)
            return
        passes, (height, width), measured = picture.passes(), picture.alpha.shape, {}
        if request.photograph:
            size = camera.width, camera.height
            photograph = load_image(request.photograph, *size, alpha=True)[..., :3]
            passes |= {f"Photograph.{channel}": photograph[..., i] for i, channel in enumerate("RGB")}
            mask = torch.from_numpy(load_mask(request.mask, *size)) if request.mask else None
            measured["psnr"] = psnr(torch.from_numpy(picture.image), torch.from_numpy(photograph), mask)
        wire.write_planes(self._folder / request.out, list(passes.values()))
        self.say(
            "frame", frame=frame, passes=list(passes), height=height, width=width,
            seconds=round(time.perf_counter() - started, 4), **measured,
        )  # fmt: skip

    def _instances(self, frame: int, request: FrameRequest) -> list[Instance]:
        """The sets of a frame; those of the last frame that are named again stay as they are."""
        kept, instances = {}, []
        cuts = {i: self._cut_of(one, request) for i, one in enumerate(request.sets) if one.tree is not None}
        self._cuts = {key: self._cuts[key] for key, _ in cuts.values() if key in self._cuts}
        for i, one in enumerate(request.sets):
            if i in cuts:
                key, read = cuts[i]
                if key not in self._cuts:
                    self._cuts[key] = read()
                instances += [
                    Instance(splats, one.matrix, level, one.antialias, one.choice, one.looks)
                    for level, splats in self._cuts[key]
                ]
                continue
            if one.file not in kept:
                there = self._sets.get(one.file)  # which may be empty
                kept[one.file] = self._read_set(frame, one) if there is None else there
            place = one.matrix, one.level, one.antialias, one.choice, one.looks
            instances.append(Instance(kept[one.file], *place))
        self._sets = kept
        return instances

    def _cut_of(
        self, one: SetRequest, request: FrameRequest
    ) -> tuple[tuple, Callable[[], list[tuple[int, SplatSet]]]]:
        """What a tree's cut depends on, and what reads it: sets by their levels' numbers.

        Raises:
            LodgsError: the file cannot be read.
        """
        path, choice, camera, unit = one.tree, one.choice, None, 1.0
        assert path is not None and choice is not None
        try:
            stat = path.stat()
        except OSError as error:
            raise LodgsError(
                f"{path} cannot be read: {error.strerror}.",
                "Choose where the file is under Streaming, or clear it to draw what the scene holds.",
            ) from error
        stamp = stat.st_mtime_ns, stat.st_size
        if path not in self._trees or self._trees[path][0] != stamp:
            self._trees[path] = stamp, TreeFile(path)
        file = self._trees[path][1]
        if is_similarity(one.matrix):
            camera, unit = request.camera.in_object_space(one.matrix)
        near = request.near / unit
        where = None if camera is None else json.dumps(camera_to_dict(camera, near))

        def read() -> list[tuple[int, SplatSet]]:
            cut = file.cut(choice, camera, near)
            return [(level, SplatSet(splats, None, self._backend)) for level, splats in cut.items()]

        return (path, stamp, choice, where), read

    def _read_set(self, frame: int, one: SetRequest) -> SplatSet:
        """A set from its file, without what cannot be drawn."""
        splats, weights = wire.read_set(self._folder / one.file, one.count, one.columns)
        splats.extras[_WEIGHTS] = np.nan_to_num(weights)
        splats = drop_undrawable(
            splats, "the scene", lambda text: self.say("warning", frame=frame, message=text)
        )
        return SplatSet(splats, splats.extras.pop(_WEIGHTS), self._backend)

    def _end(self) -> None:
        """Clean up and go, whatever the other threads are at."""
        wire.release_folder(self._folder)
        sys.stderr.flush()
        os._exit(0)
