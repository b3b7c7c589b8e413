"""Training loop: train a job's levels and bundle, with checkpoints, events, cancelling and resuming."""

from __future__ import annotations

import os
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from .. import VERSION
from ..errors import SYSTEM, LodgsError, error_cause
from ..evaluate.costs import cost_curves, write_cost_plot
from ..evaluate.level_sheet import write_level_sheet
from ..evaluate.metrics import psnr
from ..evaluate.summary import summarize
from ..evaluate.views import Evaluation
from ..files import atomic_write
from ..lod.on_disk import MAX_IN_MEMORY, read_or_open_bundle, supports_culled_reads
from ..lod.rule import find_rule
from ..lod.selection import resolve_controls, standalone_levels
from ..methods import METHODS, create
from ..optimize.memory import keep_freed_memory, peak_memory, reset_peak_memory
from ..optimize.method import ImageModel, Method, require_finite
from ..optimize.training_data import TrainingData
from ..rasterize import Gaussians, contributions, tensor_device, warm_up
from ..rasterize.resident import ResidentBundle
from ..scenes.check import INFO, check_scene
from ..scenes.orientation import up_rotation
from ..scenes.regions import Region
from ..scenes.view_tables import make_view_tables
from ..splats.batches import batch_slices
from ..splats.bundle import write_bundle
from ..splats.dialects import comments_from_meta
from ..splats.file_rows import open_ply
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import NO_SPLATS, Bundle, Level
from ..splats.ply import Columns, read_ply, write_ply
from . import processes
from .backend import choose_backend, report_backend
from .base import open_base
from .cells.plan import write_plan
from .cells.train import CellsStopped, train_cells
from .cells.workers import workers
from .checkpoints import read_newest, remove_checkpoints, write_checkpoint
from .data import ensure_points, training_data
from .events import PROTOCOL, EventWriter, event_line
from .failures import BAD_INPUT, CANCELLED, CRASHED, DONE, describe_error
from .folder import RunFolder
from .job import Job, save_job
from .stopping import interrupt_on_cancel, stop_signals

CHECKPOINT_SECONDS = float(os.environ.get("LODGS_CHECKPOINT_SECONDS", "60"))
PROGRESS_SECONDS = 0.5, 10.0
"""Minimum and maximum seconds between ``progress`` events; a thousandth of the elapsed time in between."""


def train(job: Job, stream: IO[str] | None = None, **placement: Any) -> int:
    """Start or resume a job.

    Args:
        job: the job. A run folder with results of another job is rejected.
        stream: additional output for events.
        placement: arguments of ``cells.workers.workers``, which train the cells of a scene.

    Returns:
        An exit code. Errors end in an ``error`` event, never in a traceback on the stream.
    """
    folder = RunFolder(job.out)
    try:
        folder.create()
        with folder.locked():
            return _start_or_resume(job.resolved(), folder, stream, placement)
    except BaseException as error:  # another process or job owns the run: do not write into it
        code, event = _final_event(error)
        if stream is not None:
            with suppress(OSError):
                print(event_line(**event), file=stream, flush=True)
        return code


def _start_or_resume(job: Job, folder: RunFolder, stream: IO[str] | None, placement: dict[str, Any]) -> int:
    """Start or resume the run in a locked folder, or repeat its final event; return an exit code."""
    save_job(job, folder)
    end = folder.end_event()
    if end is not None and end["event"] == "done" and folder.bundle.exists():
        remove_checkpoints(folder)  # left by a trainer that was killed after its final event
        if stream is not None:
            print(event_line(end.pop("event"), **end), file=stream, flush=True)
        return DONE
    events = EventWriter(folder.events_file, folder.reserve, stream)
    try:
        return _train(job, folder, events, placement)
    except BaseException as error:
        code, event = _final_event(error)
        events.write_final(**event)
        return code
    finally:
        events.close()


def _final_event(error: BaseException) -> tuple[int, dict]:
    """Return exit code and final event of a training that ends with an exception."""
    if isinstance(error, CellsStopped):
        return CANCELLED, {"kind": "cancelled", "message": str(error)}
    if isinstance(error, KeyboardInterrupt) and processes.parent_ended.is_set():
        problem = "Training stopped: the process that started it has ended."
        return BAD_INPUT, {
            "kind": "error", "what": problem, "remedy": "Resume the run.", "cause": SYSTEM,
        }  # fmt: skip
    if isinstance(error, KeyboardInterrupt):
        return CANCELLED, {"kind": "cancelled", "message": "Stopped. The run can be resumed."}
    problem, remedy, code = describe_error(error)
    if code == CRASHED:
        with suppress(OSError):
            traceback.print_exc(file=sys.stderr)
    return code, {"kind": "error", "what": problem, "remedy": remedy, "cause": error_cause(error)}


def _train(job: Job, folder: RunFolder, events: EventWriter, placement: dict[str, Any]) -> int:
    """Train a job in its locked folder, first its cells if it has any; return an exit code."""
    started = time.monotonic()
    reset_peak_memory()
    events(
        "hello", protocol=PROTOCOL, version=VERSION, method=job.method, preset=job.preset,
        scene=job.scene, out=str(folder.path), pid=os.getpid(),
    )  # fmt: skip
    with interrupt_on_cancel(folder):
        merged_is_result = bool(job.cells) and METHODS[job.method].cell_method == job.method
        if job.cells:
            merged = folder.bundle if merged_is_result else folder.merged
            division = write_plan(
                job, folder, add_points=lambda scene: ensure_points(scene, job, folder, events)
            )
            with workers(**placement) as submit:
                train_cells(division, merged, submit, events)
            job = replace(job, base="" if merged_is_result else str(merged))
        events("status", message="Reading the scene")
        data = training_data(job, folder, events, keep_views=True)
        if not job.cell:
            for warning in job.warnings():
                events("warning", message=warning)
            for finding in check_scene(data.full_scene, job.image_scale):
                events("status" if finding.severity == INFO else "warning", message=str(finding))
        events("status", message="Preparing to train (up to a minute on first use)")
        torch.set_num_threads(1)  # torch's threads would compete with the kernels' threads
        keep_freed_memory()
        backend = choose_backend(job, data.scene, lambda: data.transparent)
        warm_up(backend)
        report_backend(job, data.scene, backend, events)
        if merged_is_result:
            _write_merged_levels(folder, events, data, backend, started)
            remove_checkpoints(folder)
            return DONE
        run = _TrainingRun(job, backend, folder, events, data)
    with stop_signals() as received:
        if not run.run(received):
            return CANCELLED
    _report_done(folder, events, run.evaluation, run.write_bundle(), started, steps=run.method.steps)
    run.method.close()
    remove_checkpoints(folder)
    return DONE


def _report_done(
    folder: RunFolder,
    events: EventWriter,
    evaluation: Evaluation,
    bundle: Bundle,
    started: float,
    **facts: int,
) -> None:
    """Measure the result and write the ``done`` event, which also has ``facts``."""
    seconds = round(time.monotonic() - started, 1)
    events("status", message="Measuring the result")
    measures = summarize(evaluation, bundle)
    middle = evaluation.cameras[len(evaluation.cameras) // 2]
    controls = resolve_controls(bundle, {}) if find_rule(bundle.rule) else {}
    write_level_sheet(folder.sheet, bundle, evaluation, middle, controls)
    events("done", bundle=folder.bundle.name, seconds=seconds, memory=peak_memory(), **facts, **measures)


def _write_merged_levels(
    folder: RunFolder, events: EventWriter, data: TrainingData, backend: str, started: float
) -> None:
    """Write the levels of merged cells, with their quality, and finish the run."""
    bundle = read_or_open_bundle(folder.bundle)
    evaluation = Evaluation(data, backend, bundle.antialias, measures={})
    complete = [level.number for level in standalone_levels(bundle)]
    for position, level in enumerate(bundle.levels, 1):
        path = folder.level_file(level.number)
        write_ply(path, level.rows, comments_from_meta(bundle.meta))
        quality = evaluation.measure_level(bundle, level) if level.number in complete else {}
        values = quality | _level_values(bundle, level, f"levels/{path.name}")
        events("level", **values, again=False, more=position < len(bundle.levels))
    _report_done(folder, events, evaluation, bundle, started)


def _level_values(bundle: Bundle, level: Level, path: str) -> dict:
    """Return the values of a ``level`` event."""
    return {
        "level": level.number, "path": path, "splats": len(level.rows), "facts": level.facts,
        "rule": bundle.rule, "scene_facts": bundle.facts, "controls": bundle.controls,
        "cumulative": bundle.cumulative, "meta": bundle.meta,
    }  # fmt: skip


class _TrainingRun:
    """A method that trains in a run folder.

    Attributes:
        step: next step.
        levels: records of the finished levels, coarse to fine.
    """

    def __init__(
        self, job: Job, backend: str, folder: RunFolder, events: EventWriter, data: TrainingData
    ) -> None:
        self.job = job
        self.folder = folder
        self.events = events
        self.data = data
        self._backend = backend
        self.method = self._new_method()
        self.evaluation = Evaluation(data, backend, self.method.parameters.antialias, measures={})
        self._device = tensor_device(backend)
        self.step = 0
        self.levels: list[dict] = []
        self._resume()

    def _new_method(self) -> Method:
        """Create the job's method in its initial state."""
        job = self.job
        data = self.data
        parameters = job.resolved_parameters()
        base = None
        region = None
        if job.base:
            base, antialias = open_base(job.base, self._warn)
            if not METHODS[job.method].streams_base:
                base = base.select(slice(None))
            if antialias != parameters.antialias:
                self._warn(f"Antialiasing is {'on' if antialias else 'off'} for this run, as in its base.")
                parameters = replace(parameters, antialias=antialias)
            if not _any_visible(base, data):
                raise LodgsError(
                    f"Cannot start from {job.base}: no training view sees any of its splats.",
                    "Choose splats of the same scene in the same coordinates.",
                )
            region = Region.read(Path(job.cell)) if job.cell else None
            if region is not None:
                base = self._in_region(base.select(slice(None)), antialias, region)
        method = create(job.method, data, parameters, job.seed, self._backend, base)
        method.warn = self._warn
        if region is not None and region.seam:
            method.model.freeze_rows(
                torch.from_numpy(~region.near_border(method.model["means"].detach().cpu().numpy()))
            )
        return method

    def _in_region(self, base: Splats, antialias: bool, region: Region) -> Splats:
        """Select the splats of a base that surround a region or contribute to its views."""
        visible = contributions(
            Gaussians.of(base, tensor_device(self._backend)), self.data.train, near=self.data.near,
            antialias=antialias, backend=self._backend,
        )  # fmt: skip
        return base.select(region.in_enlarged_cell(base.means) | (visible.largest > 0).cpu().numpy())

    def _warn(self, message: str) -> None:
        self.events("warning", message=message)

    def run(self, received: list[int]) -> bool:
        """Train all remaining steps; save and return False on a stop signal or a cancel request."""
        method = self.method
        begin = last_checkpoint = last_progress = time.monotonic()
        self._speed_start = begin, self.step
        while not self._stopped(received):
            if self.step == method.steps:
                return True
            loss, image, target = method.train_step(self.step)
            level = method.level_at(self.step)
            levels = method.levels_after(self.step)
            self.step += 1
            now = time.monotonic()
            interval = min(max(PROGRESS_SECONDS[0], (now - begin) / 1000), PROGRESS_SECONDS[1])
            if now - last_progress >= interval or self.step == method.steps:
                require_finite(loss, self.step)
                quality = psnr(image().cpu(), target.image.cpu(), target.mask)
                self._report_progress(level, loss(), quality)
                last_progress = now
            del image, target  # frees memory for the next step's photo
            saves = levels or time.monotonic() - last_checkpoint >= CHECKPOINT_SECONDS
            if saves:
                require_finite(loss, self.step)
            if levels:
                self._write_levels(levels)
            if saves:
                self._save()
                last_checkpoint = time.monotonic()
        return False

    def _stopped(self, received: list[int]) -> bool:
        """Save, report and return True on a stop signal or a cancel request, also after the last step."""
        self.folder.require_lock()
        if not (received or processes.parent_ended.is_set() or self.folder.take_cancel()):
            return False
        self._save()
        if processes.parent_ended.is_set():
            raise KeyboardInterrupt
        message = f"Stopped at step {self.step} of {self.method.steps}. The run can be resumed."
        self.events("cancelled", step=self.step, message=message)
        return True

    def write_bundle(self) -> Bundle:
        """Write the levels, as stored after their training, into one bundle."""
        self.folder.require_lock()
        levels = [self._read_level(record) for record in self.levels]
        up = up_rotation(self.data.full_scene.cameras).round(6)
        meta = {**self.method.meta(), "up_rotation": up, "seed": self.job.seed}
        if self.job.test_every:
            middle = [self.job.test_every // 2] if self.job.validation else []
            meta["held_out"] = [0, *middle, self.job.test_every]
        bundle = replace(
            self._empty_bundle(), levels=levels, meta=meta, tables=self.method.tables() | self._view_tables()
        )
        if image_model := self.method.image_model:
            with atomic_write(self.folder.model) as temporary, open(temporary, "wb") as file:
                np.savez(file, **image_model.arrays())
            if self.data.test:
                meta |= self._measure_baking(image_model, bundle)
        self.folder.require_lock()
        write_bundle(self.folder.bundle, bundle)
        return bundle

    def _measure_baking(self, image_model: ImageModel, bundle: Bundle) -> dict[str, float]:
        """Return the PSNR of held-out views in dB, with networks and baked, as metadata; report both."""
        neural = self.evaluation.measure(image_model.render)["psnr"]
        resident = ResidentBundle(bundle, self.evaluation.backend)
        baked = self.evaluation.measure_by_distance(resident, resolve_controls(bundle, {}))["psnr"]
        self._warn(f"Held-out views: {neural:.2f} dB with networks, {baked:.2f} dB baked for Blender.")
        return {"neural_psnr": neural, "baked_psnr": baked}

    def _view_tables(self) -> dict[str, Columns]:
        """Return the scene's cameras as bundle tables."""
        cameras = self.data.full_scene.cameras
        excluded = {camera.name for camera in cameras} - {camera.name for camera in self.data.full_train}
        return make_view_tables(cameras, self.data.near, excluded)

    def _read_level(self, record: dict) -> Level:
        """Read a stored level; large ones stay on disk."""
        path = self.folder.find_file(record["path"])
        if record["splats"] > MAX_IN_MEMORY and supports_culled_reads(self._rule_name):
            return Level(record["level"], NO_SPLATS, record["facts"], open_ply(path))
        return Level(record["level"], read_ply(path), record["facts"])

    @property
    def _rule_name(self) -> str:
        return METHODS[self.job.method].rule_for(self.method.parameters)

    def _empty_bundle(self) -> Bundle:
        """Return the method's bundle header without levels."""
        method, name = self.method, self._rule_name
        rule = find_rule(name)
        return Bundle(
            self.job.method,
            [],
            name,
            method.facts,
            method.controls,
            rule is not None and rule.cumulative,
            method.meta(),
        )

    def _report_progress(self, level: int, loss: float, quality: float) -> None:
        """Write a ``progress`` event, with the speed of about the last ten seconds."""
        steps, now = self.method.steps, time.monotonic()
        begin, first_step = self._speed_start
        speed = (self.step - first_step) / max(now - begin, 1e-6)
        self.events(
            "progress", stage=self.method.stage(self.step - 1), level=level, levels=self.method.levels,
            step=self.step, of=steps, loss=round(loss, 5), psnr=round(min(quality, 100.0), 2),
            splats=self.method.splats, steps_per_s=round(speed, 2),
            eta_s=round((steps - self.step) / speed, 1),
        )  # fmt: skip
        if now - begin > 10:
            self._speed_start = now, self.step

    def _write_levels(self, levels: list[Level]) -> None:
        """Write a file and an event for each finished level; replace a level that was written before."""
        records = {record["level"]: record for record in self.levels}
        bundle = replace(self._empty_bundle(), levels=levels)
        complete = [level.number for level in standalone_levels(bundle)]
        for position, level in enumerate(levels, 1):
            path = self.folder.level_file(level.number)
            self.folder.require_lock()  # writing would create a folder that was moved
            write_ply(path, level.rows, comments_from_meta(bundle.meta))
            record = {
                "level": level.number,
                "path": f"levels/{path.name}",
                "splats": len(level.rows),
                "facts": level.facts,
            }
            quality = {}
            if level.number in complete:
                if level.on_disk is not None:
                    level = self._read_level(record)
                coarser = [coarse for coarse in levels if coarse.number < level.number]
                quality = self.evaluation.measure_level(replace(bundle, levels=[*coarser, level]), level)
            self.events(
                "level", **(quality | _level_values(bundle, level, record["path"])),
                again=level.number in records, more=position < len(levels),
            )  # fmt: skip
            records[level.number] = record
        self.levels = [records[number] for number in sorted(records)]
        if levels and cost_curves(bundle.meta):
            write_cost_plot(self.folder.costs, bundle.meta)

    def _save(self) -> None:
        self.folder.require_lock()
        write_checkpoint(self.folder, self.step, self.levels, self.method.state_dict())

    def _resume(self) -> None:
        """Load the newest readable checkpoint, if there is one."""
        checkpoint = read_newest(self.folder, self._device, self._load_method, self._warn)
        if checkpoint is not None:
            self.step, self.levels = checkpoint
            self.events("status", message=f"Resuming at step {self.step} of {self.method.steps}")
        elif self.folder.levels():
            self._warn("No checkpoint found: training starts again from the first step.")

    def _load_method(self, state: dict) -> None:
        try:
            self.method.load_state_dict(state)
        except Exception:
            self.method = self._new_method()  # the old one may be partly loaded
            raise


def _any_visible(base: SplatRows, data: TrainingData) -> bool:
    """Return whether a training view sees any of the splats."""
    for batch in batch_slices(len(base)):
        means = base.select(batch).means
        if any(camera.sees(means, near=data.near).any() for camera in data.train):
            return True
    return False
