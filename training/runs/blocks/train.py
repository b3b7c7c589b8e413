"""Trains the parts of a divided run and puts them together, wherever they are trained."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from pathlib import Path

from ...errors import LodgsError
from ..failures import BAD_INPUT, CANCELLED, DONE
from ..outcome import run_outcome
from .merge import merge, write_surroundings
from .plan import BLOCK, Block, Division
from .workers import Pending, Submit

LOOKS = 0.5
"""Seconds between two looks at how blocks get on."""
SILENT = 20.0
"""Seconds between two words at most."""
GRACE = 10.0
"""Seconds in which who was given a part begins it, and so hears that it is to stop."""
TRIES = 3
"""How often a block may be lost without having got any further before that ends the run."""

Tell = Callable[..., object]
"""Called with an event's kind and values."""


class BlocksStopped(Exception):
    """Some blocks were asked to stop, and the others are finished; the message says which."""


def prepare_part(division: Division, part: Block) -> None:
    """Writes what a part begins with, of those that are finished before it.

    Raises:
        LodgsError: one is not finished, or the disk is full.
    """
    if part.region is not None and part.region.seam:
        write_surroundings(division, part)


def train_blocks(division: Division, path: Path, submit: Submit, tell: Tell) -> None:
    """Trains all parts that are not finished, stage by stage, and writes what they are together.

    How they get on is read from their folders; an interrupt stops all of them politely first. One that was
    stopped by itself goes on when its folder is asked to (``RunFolder.request_resume``): beside the others;
    or, asked before this begins, without them.

    Args:
        path: of the bundle of all.
        submit: has a part trained.

    Raises:
        BlocksStopped: some were cancelled by themselves.
        LodgsError: one could not be trained; the others have been.
    """
    if path.exists():
        return
    stages = [[_Watched(part, division) for part in stage] for stage in division.stages]
    everything = [each for stage in stages for each in stage]
    asked = [each.block for each in everything if each.block.folder.take_resume()]
    for each in everything:
        if each.code is None and each.block not in asked and each.block.kind in {one.kind for one in asked}:
            each.code = CANCELLED
    for stage in stages:
        _train_stage(stage, everything, submit, tell)
    tell("status", message=f"Putting {len(division.blocks)} blocks together")
    kept = merge(division, path)
    for seam in division.seams:
        seam.folder.base.unlink(missing_ok=True)
    for block, (own, all_) in zip(division.blocks, kept, strict=True):
        tell("status", message=f"Block {block.number}: {own:,} of {all_:,} splats stand in its cell")


def _train_stage(
    stage: Sequence[_Watched], everything: Sequence[_Watched], submit: Submit, tell: Tell
) -> None:
    try:
        for each in stage:
            each.begin(submit)
        started = told = each_told = time.monotonic()
        states: list[str] = []
        while not all([each.look(submit) for each in stage]):
            now = time.monotonic()
            if now - told >= min(max((now - started) / 1000, LOOKS), SILENT):
                values, told = _progress(everything), now
                changed = states != (states := [each.state for each in everything])
                if changed or now - each_told >= (now - started) / 30:  # many parts are long lines
                    each_told = now
                else:
                    del values["blocks"]
                tell("progress", **values)
            time.sleep(LOOKS)
    except BaseException:
        _stop_stage(stage)
        raise
    if stage:
        tell("progress", **_progress(everything))
    for each in stage:
        if each.code not in (DONE, CANCELLED):
            raise each.trouble()
    if stopped := [each.block.name for each in stage if each.code == CANCELLED]:
        raise BlocksStopped(f"Stopped: {', '.join(stopped)}; the run can be resumed.")


def _stop_stage(stage: Sequence[_Watched]) -> None:
    """Has all parts stopped: who trains one saves first, and who was given one does not begin."""
    asked = [each for each in stage if not each.over]
    for each in asked:
        each.block.folder.request_cancel()
    given_up = time.monotonic() + GRACE
    while not all(each.over for each in asked):
        time.sleep(LOOKS)
        if time.monotonic() > given_up:
            for each in asked:
                each.give_up()
    for each in asked:
        each.block.folder.take_cancel()  # which nobody has heard


class _Watched:
    """A part on its way.

    Attributes:
        code: its trainer's exit code, once it has ended for good.
    """

    def __init__(self, block: Block, division: Division) -> None:
        self.block, self._division = block, division
        block.folder.take_cancel()  # which was meant for an earlier trainer
        self._pending: Pending | None = None
        self.code: int | None = None
        if block.folder.bundle.exists() and block.folder.state() == "done":
            self.code = DONE
        self._lost, self._reached = 0, -1
        self.progress = block.folder.last_event("progress") or {}
        self._since, self._heard = block.folder.events()[1], False
        self.steps = block.job.resolved_parameters().total_steps
        self._why = ""

    def begin(self, submit: Submit) -> None:
        """Has it trained, unless it is finished."""
        if self.code is None:
            prepare_part(self._division, self.block)
            self._heard = False
            self._pending = submit(self.block.folder.path)

    def give_up(self) -> None:
        """Waits no longer for those who were given it and have not begun: there may be nobody."""
        if self._pending is not None:
            self._pending.cancel()

    @property
    def over(self) -> bool:
        """Whether nobody is at work on it any more, not even a trainer whose worker was lost."""
        return self._pending is None or (self._pending.done() and not self.block.folder.running)

    def look(self, submit: Submit) -> bool:
        """Reads how far it is, and begins it again where whoever trained it was lost, or where it was stopped
        and is asked to; whether it is over."""
        if self.code == CANCELLED and self.block.folder.take_resume():
            self.code = None
            self.begin(submit)
        if self.code is not None:
            return True
        events, self._since = self.block.folder.events(self._since)
        for event in events:
            self._heard = True
            if event["event"] == "progress":
                self.progress = event
        assert self._pending is not None
        if not self._pending.done():
            return False
        try:
            code = self._pending.result()
        except CancelledError:  # the scheduler was lost, and with it who has the part, which may be well
            self.begin(submit)
            return False
        except Exception as error:  # the worker, not the block
            code, self._why = -1, str(error)
        if code in (DONE, BAD_INPUT, CANCELLED):
            self.code = code
            return True
        self._lost = self._lost + 1 if self.step <= self._reached else 1
        self._reached = max(self.step, self._reached)
        if self._lost < TRIES:
            self.begin(submit)
            return False
        self.code = code
        return True

    @property
    def step(self) -> int:
        """How many steps it has made."""
        return self.steps if self.code == DONE else self.progress.get("step", 0)

    @property
    def state(self) -> str:
        """``waiting``, ``running``, ``done``, ``cancelled`` or ``failed``."""
        if self.code is None:
            return "running" if self._heard else "waiting"
        return {DONE: "done", CANCELLED: "cancelled"}.get(self.code, "failed")

    def trouble(self) -> LodgsError:
        """Why it could not be trained."""
        if self.code == BAD_INPUT:
            end = self.block.folder.end_event()
            if end is not None and end["event"] == "error":
                return LodgsError(f"{self._name}: {end['what']}", end.get("remedy", ""))
            return LodgsError(f"{self._name}: {run_outcome(self.block.folder, self.code)[1]}")
        why = f" ({self._why})" if self._why else ""
        return LodgsError(
            f"{self._name} was lost {TRIES} times at step {self.step}{why}.",
            f"What its trainer wrote is in {self.block.folder.log}.",
        )

    @property
    def _name(self) -> str:
        return self.block.name[0].upper() + self.block.name[1:]


def _progress(watched: Sequence[_Watched]) -> dict:
    """How all are together, as a ``progress`` event, with each beside it."""
    there = [each.progress for each in watched if each.progress]
    step, of = sum(each.step for each in watched), sum(each.steps for each in watched)
    speed = sum(each.progress.get("steps_per_s", 0.0) for each in watched if each.code is None)
    blocks = [each for each in watched if each.block.kind == BLOCK]
    over = sum(each.code == DONE for each in blocks)

    def mean(name: str) -> float:
        return round(sum(each.get(name, 0.0) for each in there) / max(len(there), 1), 5)

    return {
        "stage": f"{over} of {len(blocks)} blocks", "level": 1, "levels": 1, "step": step, "of": of,
        "loss": mean("loss"), "psnr": mean("psnr"), "splats": sum(each.get("splats", 0) for each in there),
        "steps_per_s": round(speed, 2), "eta_s": round((of - step) / speed, 1) if speed else 0.0,
        "blocks": [
            {
                "block": each.block.number, "kind": each.block.kind, "state": each.state,
                "step": each.step, "of": each.steps,
            }
            for each in watched
        ],
    }  # fmt: skip
