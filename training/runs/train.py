"""The training loop: from a job to levels and a bundle, with checkpoints, events, cancel and resume."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
import traceback
from _thread import interrupt_main
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import torch

from .. import VERSION
from ..errors import LodgsError
from ..evaluate.costs import cost_curves, write_cost_plot
from ..evaluate.metrics import psnr
from ..evaluate.summary import summarize
from ..evaluate.views import Evaluation
from ..files import atomic_write
from ..lod.on_disk import IN_MEMORY, in_parts, open_if_large
from ..lod.rule import find_rule
from ..lod.selection import levels_alone, settings
from ..methods import METHODS, create
from ..optimize.memory import keep_freed_memory
from ..optimize.method import Method
from ..optimize.training_data import TrainingData
from ..rasterize import Gaussians, contributions, cpu_fallback_reason, resolve_backend, tensor_device, warm_up
from ..rasterize.gpu.default_device import default_adapter as graphics_device
from ..rasterize.resident import ResidentBundle
from ..scenes.orientation import up_rotation
from ..scenes.regions import Region
from ..scenes.views import tables_of
from ..splats.bundle import NO_SPLATS, Bundle, Level, open_ply, read_bundle, write_bundle
from ..splats.dialects import comments_from_meta
from ..splats.gaussians import SplatRows, Splats
from ..splats.ply import BATCH_ROWS, Columns, read_ply, write_ply
from .base import open_base
from .blocks.plan import write_plan
from .blocks.train import BlocksStopped, train_blocks
from .blocks.workers import HERE, workers
from .checkpoints import read_newest, remove_checkpoints, write_checkpoint
from .data import training_data
from .events import PROTOCOL, EventWriter, event_line
from .failures import CANCELLED, CRASHED, DONE, describe_error
from .folder import RunFolder
from .job import Job, save_job

CHECKPOINT_SECONDS = float(os.environ.get("LODGS_CHECKPOINT_SECONDS", "60"))
PROGRESS_SECONDS = 0.25, 10.0
"""Between two ``progress`` events, at first and at most: a thousandth of the time that it has taken."""


def train(
    job: Job, stream: IO[str] | None = None, on: str = HERE, resources: dict[str, float] | None = None
) -> int:
    """Runs a job, or goes on with it where its run folder was left.

    Args:
        job: what to do; a run folder that already holds another job is refused.
        stream: where the events go besides ``events.jsonl``.
        on, resources: where a job's blocks are trained, if it has cells: see ``blocks.workers``.

    Returns:
        An exit code. Mistakes end in an ``error`` event, never in a traceback on the stream.
    """
    folder = RunFolder(job.out)
    try:
        folder.create()
        with folder.locked():
            return _go_on(job.resolved(), folder, stream, on, resources)
    except BaseException as error:  # the run is not ours to write into
        code, event = _last_words(error)
        if stream is not None:
            with suppress(OSError):
                print(event_line(**event), file=stream, flush=True)
        return code


def _go_on(
    job: Job, folder: RunFolder, stream: IO[str] | None, on: str, resources: dict[str, float] | None
) -> int:
    """Begins, resumes or only repeats the end of the run in a folder that is held; returns an exit code."""
    save_job(job, folder)
    end = folder.end_event()
    if end is not None and end["event"] == "done" and folder.bundle.exists():
        remove_checkpoints(folder)  # a trainer that was killed after its last word has left them
        if stream is not None:
            print(event_line(end.pop("event"), **end), file=stream, flush=True)
        return DONE
    events = EventWriter(folder.events_file, folder.reserve, stream)  # from here on the run says what happens
    try:
        return _train(job, folder, events, on, resources)
    except BaseException as error:
        code, event = _last_words(error)
        events.write_final(**event)
        return code
    finally:
        events.close()


def _last_words(error: BaseException) -> tuple[int, dict]:
    """Exit code and last event of a training that ends with an exception."""
    if isinstance(error, BlocksStopped):
        return CANCELLED, {"kind": "cancelled", "message": str(error)}
    if isinstance(error, KeyboardInterrupt):
        return CANCELLED, {"kind": "cancelled", "message": "Stopped; it can be resumed."}
    what, remedy, code = describe_error(error)
    if code == CRASHED:
        with suppress(OSError):
            traceback.print_exc(file=sys.stderr)
    return code, {"kind": "error", "what": what, "remedy": remedy}


def _train(
    job: Job, folder: RunFolder, events: EventWriter, on: str, resources: dict[str, float] | None
) -> int:
    started = time.monotonic()
    events(
        "hello", protocol=PROTOCOL, version=VERSION, method=job.method, preset=job.preset,
        scene=job.scene, out=str(folder.path), pid=os.getpid(),
    )  # fmt: skip
    with _interrupted_by_cancel(folder):
        together = bool(job.cells) and METHODS[job.method].in_cells == job.method
        if job.cells:
            whole = folder.bundle if together else folder.merged
            division = write_plan(job, folder)
            with workers(on, resources) as submit:
                train_blocks(division, whole, submit, events)
            job = replace(job, base="" if together else str(whole))
        events("status", message="Reading the scene")
        data = training_data(job, folder, events)
        events("status", message="Preparing to train (the first time on a computer up to a minute)")
        torch.set_num_threads(1)  # torch's thread pool beside the kernels' slows both
        keep_freed_memory()
        backend = resolve_backend(job.backend)
        warm_up(backend)
        _tell_backend(job.backend, backend, events)
        if together:
            _hand_over(folder, events, data, backend, started)
            return DONE
        run = _Run(job, backend, folder, events, data)
    with _stop_signals() as stopped:
        if not run.to_the_end(stopped):
            return CANCELLED
    _tell_done(folder, events, run.evaluation, run.write_bundle(), started)
    run.method.close()
    remove_checkpoints(folder)
    return DONE


def _tell_done(
    folder: RunFolder, events: EventWriter, evaluation: Evaluation, bundle: Bundle, started: float
) -> None:
    """The last word: what the run is worth."""
    seconds = round(time.monotonic() - started, 1)
    events("status", message="Measuring the result")
    events("done", bundle=folder.bundle.name, seconds=seconds, **summarize(evaluation, bundle))


def _hand_over(
    folder: RunFolder, events: EventWriter, data: TrainingData, backend: str, started: float
) -> None:
    """Hands over the levels that blocks were put together to, and says what they are worth."""
    bundle = open_if_large(folder.bundle) or read_bundle(folder.bundle)
    evaluation = Evaluation(data, backend, bundle.antialias)
    alone = [level.number for level in levels_alone(bundle)]
    for place, level in enumerate(bundle.levels, 1):
        path = folder.levels_folder / f"level_{level.number}.ply"
        write_ply(path, level.rows, comments_from_meta(bundle.meta))
        quality = evaluation.measure_level(bundle, level) if level.number in alone else {}
        told = quality | _as_event(bundle, level, f"levels/{path.name}")
        events("level", **told, again=False, more=place < len(bundle.levels))
    _tell_done(folder, events, evaluation, bundle, started)


def _as_event(bundle: Bundle, level: Level, path: str) -> dict:
    """What a ``level`` event says of a level and of the bundle that it belongs to."""
    return {
        "level": level.number, "path": path, "splats": len(level.rows), "facts": level.facts,
        "rule": bundle.rule, "scene_facts": bundle.facts, "controls": bundle.controls,
        "cumulative": bundle.cumulative, "meta": bundle.meta,
    }  # fmt: skip


class _Run:
    """A method at work in a run folder.

    Attributes:
        step: the next step to make; what was made before is in the folder.
        levels: a record of each finished level, coarse to fine.
    """

    def __init__(
        self, job: Job, backend: str, folder: RunFolder, events: EventWriter, data: TrainingData
    ) -> None:
        self.job, self.folder, self.events, self.data = job, folder, events, data
        self._backend = backend
        self.method = self._fresh_method()
        self.evaluation = Evaluation(data, backend, self.method.parameters.antialias)
        self._device = tensor_device(backend)
        self.step = 0
        self.levels: list[dict] = []
        self._resume()

    def _fresh_method(self) -> Method:
        """The job's method before its first step."""
        job, data, parameters = self.job, self.data, self.job.resolved_parameters()
        base, region = None, None
        if job.base:
            base, antialias = open_base(job.base, self._warn)
            if not METHODS[job.method].base_in_parts:
                base = base.select(slice(None))
            if antialias != parameters.antialias:
                self._warn(f"The base is {'' if antialias else 'not '}antialiased, and so is this run.")
                parameters = replace(parameters, antialias=antialias)
            if not _seen(base, data):
                raise LodgsError(
                    f"No training view sees a splat of {job.base}.",
                    "Choose splats that were made from these photographs, in the same coordinates.",
                )
            region = Region.read(Path(job.cell)) if job.cell else None
            if region is not None:
                base = self._in_region(base.select(slice(None)), antialias, region)
        method = create(job.method, data, parameters, job.seed, self._backend, base)
        method.warn = self._warn
        if region is not None and region.seam:
            method.model.hold(torch.from_numpy(~region.borders(method.model["means"].detach().cpu().numpy())))
        return method

    def _in_region(self, base: Splats, antialias: bool, region: Region) -> Splats:
        """What of a base is about a region, or shows in its views."""
        found = contributions(
            Gaussians.of(base, tensor_device(self._backend)), self.data.train, near=self.data.near,
            antialias=antialias, backend=self._backend,
        )  # fmt: skip
        return base.select(region.surrounds(base.means) | (found.largest > 0).cpu().numpy())

    def _warn(self, message: str) -> None:
        self.events("warning", message=message)

    def to_the_end(self, stopped: list) -> bool:
        """Trains until all levels are finished (True), or until asked to stop, which saves (False)."""
        method = self.method
        self._started, self._started_step = time.monotonic(), self.step
        last_checkpoint = last_progress = self._started
        while self.step < method.steps:
            self.folder.require_lock()
            if stopped or self.folder.take_cancel():
                self._save()
                message = f"Stopped at step {self.step} of {method.steps}; it can be resumed."
                self.events("cancelled", step=self.step, message=message)
                return False
            loss, image, target = method.train_step(self.step)
            if not math.isfinite(loss):
                raise LodgsError(
                    f"Training diverged at step {self.step + 1}: the loss is {loss}.",
                    "Start again with lower learning rates.",
                )
            level = method.level_at(self.step)
            levels = method.levels_after(self.step)
            self.step += 1
            now = time.monotonic()
            pause = min(max(PROGRESS_SECONDS[0], (now - self._started) / 1000), PROGRESS_SECONDS[1])
            if now - last_progress >= pause or self.step == method.steps:
                quality = psnr(image().cpu(), target.image.cpu(), target.mask)
                self._tell_progress(level, loss, quality)
                last_progress = now
            del image, target  # which the next step's photograph may need the room of
            self._write_levels(levels)
            if levels or time.monotonic() - last_checkpoint >= CHECKPOINT_SECONDS:
                self._save()
                last_checkpoint = time.monotonic()
        return True

    def write_bundle(self) -> Bundle:
        """All levels, as they were written one by one, in one file."""
        self.folder.require_lock()
        levels = [self._written(record) for record in self.levels]
        up = up_rotation(self.data.whole.cameras).round(6)
        meta = {**self.method.meta(), "up_rotation": up, "seed": self.job.seed}
        if self.job.test_every:
            middle = [self.job.test_every // 2] if self.job.validation else []
            meta["held_out"] = [0, *middle, self.job.test_every]
        bundle = replace(
            self._without_splats(), levels=levels, meta=meta, tables=self.method.tables() | self._views()
        )
        if arrays := self.method.arrays():
            with atomic_write(self.folder.model) as temporary, open(temporary, "wb") as file:
                np.savez(file, **arrays)
            if self.data.test:
                before = self.evaluation.measure_images(self.method.picture)["psnr"]
                resident = ResidentBundle(bundle, self.evaluation.backend)
                after = self.evaluation.measure_by_distance(resident, settings(bundle, {}))["psnr"]
                meta |= {"neural_psnr": before, "baked_psnr": after}
                message = f"Held-out views: {before:.2f} dB with networks, {after:.2f} dB baked for Blender."
                self._warn(message)
        write_bundle(self.folder.bundle, bundle)
        return bundle

    def _views(self) -> dict[str, Columns]:
        """Where the scene was photographed from, as tables."""
        cameras = self.data.whole.cameras
        unseen = {camera.name for camera in cameras} - {camera.name for camera in self.data.whole_train}
        return tables_of(cameras, self.data.near, unseen)

    def _written(self, record: dict) -> Level:
        """A level as it was written; large ones stay in their file."""
        path = self.folder.find_file(record["path"])
        if record["splats"] > IN_MEMORY and in_parts(METHODS[self.job.method].rule):
            return Level(record["level"], NO_SPLATS, record["facts"], open_ply(path))
        return Level(record["level"], read_ply(path), record["facts"])

    def _without_splats(self) -> Bundle:
        """What the method says of its levels, as a bundle that has none yet."""
        info, method = METHODS[self.job.method], self.method
        rule = find_rule(info.rule)
        return Bundle(
            self.job.method,
            [],
            info.rule,
            method.facts(),
            method.controls(),
            rule is not None and rule.cumulative,
            method.meta(),
        )

    def _tell_progress(self, level: int, loss: float, quality: float) -> None:
        of, levels, quality = self.method.steps, self.method.levels, round(min(quality, 100.0), 2)
        speed = (self.step - self._started_step) / max(time.monotonic() - self._started, 1e-6)
        self.events(
            "progress", stage=self.method.stage(self.step - 1), level=level, levels=levels,
            step=self.step, of=of, loss=round(loss, 5), psnr=quality, splats=self.method.splats,
            steps_per_s=round(speed, 2), eta_s=round((of - self.step) / speed, 1),
        )  # fmt: skip
        if time.monotonic() - self._started > 10:  # the speed of about the last ten seconds
            self._started, self._started_step = time.monotonic(), self.step

    def _write_levels(self, levels: list[Level]) -> None:
        """Hands levels over: a file and an event each. A level that came before is replaced."""
        known = {record["level"]: record for record in self.levels}
        bundle = replace(self._without_splats(), levels=levels)
        alone = [level.number for level in levels_alone(bundle)]
        for place, level in enumerate(levels, 1):
            path = self.folder.levels_folder / f"level_{level.number}.ply"
            write_ply(path, level.rows, comments_from_meta(bundle.meta))
            record = {
                "level": level.number,
                "path": f"levels/{path.name}",
                "splats": len(level.rows),
                "facts": level.facts,
            }
            quality = {}
            if level.number in alone:
                if level.on_disk is not None:
                    level = self._written(record)
                coarser = [other for other in levels if other.number < level.number]
                quality = self.evaluation.measure_level(replace(bundle, levels=[*coarser, level]), level)
            self.events(
                "level", **(quality | _as_event(bundle, level, record["path"])),
                again=level.number in known, more=place < len(levels),
            )  # fmt: skip
            known[level.number] = record
        self.levels = [known[number] for number in sorted(known)]
        if levels and cost_curves(bundle.meta):
            write_cost_plot(self.folder.costs, bundle.meta)

    def _save(self) -> None:
        write_checkpoint(self.folder, self.step, self.levels, self.method.state_dict())

    def _resume(self) -> None:
        """Takes up the newest checkpoint that can be read; where there is none the run begins."""
        found = read_newest(self.folder, self._device, self._take, self._warn)
        if found is not None:
            self.step, self.levels = found
            self.events("status", message=f"Going on from step {self.step} of {self.method.steps}")
        elif self.folder.levels():
            self._warn("There is no checkpoint to go on from: the run begins anew.")

    def _take(self, state: dict) -> None:
        try:
            self.method.load_state_dict(state)
        except Exception:
            self.method = self._fresh_method()  # it may have taken part of it
            raise


def _seen(base: SplatRows, data: TrainingData) -> bool:
    """Whether a training view sees any of the splats."""
    for begin in range(0, len(base), BATCH_ROWS):
        means = base.select(slice(begin, begin + BATCH_ROWS)).means
        if any(camera.sees(means, near=data.near).any() for camera in data.train):
            return True
    return False


def _tell_backend(asked: str, backend: str, events: EventWriter) -> None:
    """Which rasterizer trains; and why it is not a GPU's, where there is a GPU that could."""
    names = {"cpu": "the CPU", "cuda": "the NVIDIA GPU", "reference": "the CPU, by the slow reference"}
    if problem := cpu_fallback_reason(asked):
        events("warning", message=problem)
    name = names.get(backend) or graphics_device().name
    events("status", message=f"Training on {name}", backend=backend)


# -- being stopped ------------------------------------------------------------


@contextmanager
def _interrupted_by_cancel(folder: RunFolder):
    """A request to cancel, which only the training's loop looks for, ends the block as Ctrl-C does."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.1):
            with suppress(OSError):
                if folder.take_cancel():
                    _interrupt()
                    return

    before = None
    with suppress(ValueError):  # not in the main thread
        # shells have programs in the background ignore it
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()
        if before is not None:
            signal.signal(signal.SIGINT, before)


def _interrupt() -> None:
    """Ctrl-C for the main thread, also where it waits for another program."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        interrupt_main()


@contextmanager
def _stop_signals():
    """A list that becomes non-empty when the process is politely asked to stop."""
    stopped: list[int] = []
    names = ("SIGINT", "SIGTERM", "SIGBREAK")  # the last is Windows' CTRL_BREAK_EVENT
    before = {}
    for name in names:
        if hasattr(signal, name):
            with suppress(ValueError):  # not in the main thread
                number = getattr(signal, name)
                before[number] = signal.signal(number, lambda number, _: stopped.append(number))
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
