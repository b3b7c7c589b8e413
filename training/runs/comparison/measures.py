"""Measures of finished runs of one scene side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ...errors import LodgsError
from ...evaluate.lpips import missing_line
from ...evaluate.views import Evaluation
from ...lod.rule import Values, find_rule
from ...methods import METHODS
from ...optimize.merging import merge
from ...splats.dialects import Warn, ignore
from ...splats.gaussians import Splats
from ..finished import open_finished
from ..folder import RunFolder
from ..job import Job
from ..measure import evaluate_run

SHARE = 0.25
"""Share of the splats of finest levels at which methods are compared."""
MERGED_SHARES = (0.5, 0.25, 0.125, 0.0625)
"""Shares of a finest level's splats to which the baseline merges neighbours."""

Notify = Callable[[str], object]
"""Receives a sentence about progress."""


@dataclass(frozen=True)
class Point:
    """Quality of a set of splats.

    Attributes:
        name: label of the set, such as "Level 3" or "s_v = 2".
        splats: mean number of splats with a weight above 0, in view or not.
        psnr: dB.
        ssim: structural similarity.
        frame_s: seconds per frame with selection.
        level: number of the level, or 0.
        values: values of the rule's controls, if they select the set.
        drawn: mean number of splats in the image.
        lpips_alex, lpips_vgg: LPIPS of AlexNet and VGG, or None without their weights.
    """

    name: str
    splats: int
    psnr: float
    ssim: float
    frame_s: float
    level: int = 0
    values: dict[str, float] = field(default_factory=dict)
    drawn: int = 0
    lpips_alex: float | None = None
    lpips_vgg: float | None = None

    @classmethod
    def of(cls, row: dict, name: str, prefix: str, **where: Any) -> Point:
        """Make a point of a row of ``evaluate_run``'s report, whose quality names have a prefix."""
        psnr, ssim = (float(row[f"{prefix}{measure}"]) for measure in ("psnr", "ssim"))
        alex, vgg = (row.get(f"{prefix}{measure}") for measure in ("lpips_alex", "lpips_vgg"))
        splats, drawn, frame_s = int(row["splats"]), int(row["drawn"]), float(row["frame_s"])
        return cls(name, splats, psnr, ssim, frame_s, drawn=drawn, lpips_alex=alex, lpips_vgg=vgg, **where)


@dataclass(frozen=True)
class ComparedRun:
    """Measures of a run.

    Attributes:
        label: name in tables and plots.
        about: description of the method.
        points: sets of splats, ascending by ``splats``. The last is the finest level.
        by_distance: quality with the rule's default controls, or None without a rule.
        merged: number of splats and PSNR in dB of the finest level with merged neighbours, the baseline.
        farther: rows of ``evaluate.distance.measure_farther_views``.
        jumps: change between consecutive frames of a fly-out relative to full detail, faded if the rule can
            fade; empty without a rule.
        loaded: mean number of splats that a viewer loads for a view.
        megabytes: size of all levels in one file.
        seconds: seconds of training, or None.
        memory: most bytes of memory that the training used, or None.
        frame_memory: bytes in use while views are drawn, by distance if the run has a rule, or None.
        steps: number of training steps.
        baseline: the sets are not trained; they are only drawn for comparison.
    """

    label: str
    about: str
    points: list[Point]
    by_distance: Point | None = None
    merged: list[tuple[int, float]] = field(default_factory=list)
    farther: list[dict] = field(default_factory=list)
    jumps: list[float] = field(default_factory=list)
    loaded: int = 0
    megabytes: float = 0.0
    seconds: float | None = None
    memory: int | None = None
    frame_memory: int | None = None
    steps: int = 0
    baseline: bool = False

    @property
    def largest_jump(self) -> float | None:
        """Largest of the jumps, or None without a rule."""
        return max(self.jumps, default=None)

    @property
    def finest(self) -> Point:
        """Set of the highest number of splats."""
        return self.points[-1]

    def psnr_at(self, splats: float) -> float | None:
        """Return the PSNR with a number of splats in dB; None below the smallest set.

        Between sets it is interpolated over the logarithm of their number of splats.
        """
        counts = [point.splats for point in self.points]
        if splats < min(counts):
            return None
        return float(np.interp(np.log(splats), np.log(counts), [point.psnr for point in self.points]))

    def nearest(self, splats: float) -> Point:
        """Return the set whose number of splats is nearest to a number, as a ratio."""
        return min(self.points, key=lambda point: abs(np.log(point.splats / splats)))


def measure_run(
    run: Path,
    label: str,
    values: Values,
    warn: Warn = ignore,
    notify: Notify = ignore,
    lpips: Path | None = None,
) -> ComparedRun:
    """Measure a finished run as ``lodgs evaluate --far`` does.

    A report that is newer than the run's bundle and has the same values and measures is not measured again.

    Args:
        values: values of the controls of the run's rule.
        lpips: archive of the networks' weights, see ``evaluate.lpips.load_lpips``.

    Raises:
        LodgsError: see ``evaluate_run``.
    """
    folder = RunFolder(run)
    job = Job.from_file(folder.job)
    with suppress(
        OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError
    ):  # a changed report
        report = folder.read_metrics()
        newest = report["selective"][0] if report["selective"] else {}
        is_same = all(newest[name] == value for name, value in values.items())
        has_lpips = any({"lpips_vgg", "train_lpips_vgg"} & level.keys() for level in report["levels"])
        is_complete = bool(missing_line(lpips)) or has_lpips
        if is_same and is_complete and (not report["rule"] or "flight" in report):
            return compared_run(folder, job, report, label)
    notify(f"Measuring {label}.")
    return compared_run(folder, job, evaluate_run(run, values, far=True, warn=warn, lpips=lpips), label)


def compared_run(folder: RunFolder, job: Job, report: dict, label: str) -> ComparedRun:
    """Make the measures of a run from the report of ``evaluate_run``.

    Raises:
        KeyError, TypeError, ValueError: the report has another form.
    """
    prefix = "" if report["test_views"] else "train_"
    points = [
        Point.of(row, f"Level {row['level']}", prefix, level=int(row["level"])) for row in report["levels"]
    ]
    rule = find_rule(report["rule"])
    if rule and rule.sweep:
        name, _ = rule.sweep
        points += [
            Point.of(row, f"{name} = {row[name]:g}", prefix, values={name: float(row[name])})
            for row in report.get("curve", [])
        ]
    points = [point for point in points if point.splats]
    end = folder.end_event() or {}
    seconds, memory = end.get("seconds"), end.get("memory")
    finest = max(points, key=lambda point: point.splats)
    merged = [(int(row["splats"]), float(row["merged"][0])) for row in report["levels"] if "merged" in row]
    return ComparedRun(
        label=label,
        about=METHODS[job.method].about,
        # of equal sets, the level has LPIPS
        points=sorted(points, key=lambda point: (point.splats, point.psnr, point.level)),
        by_distance=Point.of(report["selective"][0], "By distance", prefix) if report["selective"] else None,
        merged=[*merged, (finest.splats, finest.psnr)] if merged else [],
        farther=[dict(row) for row in report.get("farther", [])],
        jumps=[float(jump) for jump in report.get("flight", [])],
        loaded=int(report.get("loaded", finest.splats)),
        megabytes=report["bytes"] / 1e6,
        seconds=float(seconds) if isinstance(seconds, (int, float)) else None,
        memory=memory if isinstance(memory, int) else None,
        frame_memory=report["frame_memory"]["by_distance" if report["selective"] else "full"],
        steps=end.get("steps", job.steps),
    )


def merge_baseline(
    evaluation: Evaluation, splats: Splats, label: str
) -> tuple[ComparedRun, dict[int, Splats]]:
    """Measure a complete level with neighbours merged to MERGED_SHARES of its splats.

    Args:
        splats: the level.
        label: label of its run.

    Returns:
        The measures, and the merged splats by their number.
    """
    merged, sets, names = splats, {len(splats): splats}, {len(splats): "Finest level"}
    for share in MERGED_SHARES:
        merged = merge(merged, max(round(len(splats) * share), 1))
        if len(merged) not in sets:  # of few splats, several shares have as many
            sets[len(merged)], names[len(merged)] = merged, f"Merged to {100 * share:g}%"
    points = [
        Point.of(evaluation.measure_splats(part), names[count], evaluation.prefix)
        for count, part in sorted(sets.items())
    ]
    about = f"{label} with neighbours merged, for comparison"
    size = 4 * len(splats) * (11 + splats.sh[0].size) / 1e6
    run = ComparedRun(f"{label}, merged", about, points, loaded=len(splats), megabytes=size, baseline=True)
    return run, sets


def compared_count(runs: Sequence[ComparedRun]) -> float:
    """Return the number of splats at which runs are compared: SHARE of the median finest level."""
    return SHARE * median(run.finest.splats for run in runs if not run.baseline)


@dataclass(frozen=True)
class Purpose:
    """A purpose for which runs are compared.

    Attributes:
        name: its name in tables.
        measure: return the measure of a run, from the number of splats at which runs are compared; None if
            there is none.
        form: format of the measure.
        detail: return a text that follows the measure.
        highest: whether a higher measure is better.
    """

    name: str
    measure: Callable[[ComparedRun, float], float | None]
    form: str
    detail: Callable[[ComparedRun, float], str]
    highest: bool = False


def _full_detail(run: ComparedRun) -> str:
    return f"{run.finest.psnr:.2f} dB with {run.finest.splats:,}"


PURPOSES = (
    Purpose("Quality at full detail", lambda run, _: run.finest.psnr, "{:.2f} dB",
            lambda run, _: f" with {run.finest.splats:,} splats", highest=True),
    Purpose(f"Quality with {SHARE:.0%} of the splats", ComparedRun.psnr_at, "{:.2f} dB",
            lambda run, count: f" with {count:,.0f} splats; full detail has {_full_detail(run)}",
            highest=True),
    Purpose("Speed from far away", lambda run, _: 1e3 * run.farther[-1]["frame_s"] if run.farther else None,
            "{:.1f} ms a frame",
            lambda run, _: f" from {run.farther[-1]['factor']} times the distance, with "
                           f"{run.farther[-1]['drawn']:,} splats in the image"),
    Purpose("Few splats to load", lambda run, _: run.loaded, "{:,.0f} splats", lambda *_: " for a view"),
    Purpose("Smooth changes", lambda run, _: run.largest_jump, "{:.2f} times",
            lambda *_: " the change of full detail between two frames, at most"),
    Purpose("Short training", lambda run, _: run.seconds, "{:,.0f} s", lambda *_: ""),
)  # fmt: skip
"""Purposes in the order of the page."""


def recommend_runs(runs: Sequence[ComparedRun]) -> list[dict[str, str]]:
    """Recommend a run for each purpose.

    Returns:
        ``purpose``, ``best`` (label), its ``measure``, ``why`` (the measure in detail) and ``next`` (label
        and measure of the second), for each purpose with at least two measured runs that are trained.
    """
    runs = [run for run in runs if not run.baseline]
    count = compared_count(runs)
    result = []
    for purpose in PURPOSES:
        measured = [(value, run) for run in runs if (value := purpose.measure(run, count)) is not None]
        if len(measured) < 2:
            continue
        (value, best), (next_value, second), *_ = sorted(
            measured, key=lambda pair: pair[0], reverse=purpose.highest
        )
        text = purpose.form.format(value)
        result.append({
            "purpose": purpose.name, "best": best.label, "measure": text,
            "why": text + purpose.detail(best, count),
            "next": f"{second.label} ({purpose.form.format(next_value)})",
        })  # fmt: skip
    return result


def collect_measures(runs: Sequence[ComparedRun]) -> dict:
    """Return the measures of runs as plain values for JSON."""
    count = compared_count(runs)
    rows = [{**asdict(run), "largest_jump": run.largest_jump, "at_share": run.psnr_at(count)} for run in runs]
    return {"compared_splats": max(round(count), 1), "runs": rows, "answers": recommend_runs(runs)}


def label_runs(runs: Sequence[Path], warn: Warn = ignore) -> list[str]:
    """Return labels of finished runs: the method, with the folder's name where methods repeat.

    Args:
        warn: receives warnings about runs whose photos have another size or exposure.

    Raises:
        LodgsError: a run is not finished or named twice, or the runs have different scenes or held-out
            photos.
    """
    jobs = [open_finished(run, ignore)[1] for run in runs]
    for run, job in zip(runs, jobs, strict=True):
        if _views_of(job) != _views_of(jobs[0]):
            raise LodgsError(
                f"Cannot compare {run} with {runs[0]}: their scenes or held-out photos differ.",
                "Choose runs of one scene.",
            )
        if (job.image_scale, job.exposure) != (jobs[0].image_scale, jobs[0].exposure):
            warn(
                f"{run} is measured on photos of another size or exposure than {runs[0]}, so that their "
                "quality differs for this reason, too. Train both with the same image_scale and exposure."
            )
    methods = [METHODS[job.method].label for job in jobs]
    names = [run.resolve().name for run in runs]
    labels = [
        label if methods.count(label) == 1 else f"{label} ({name if names.count(name) == 1 else run})"
        for label, name, run in zip(methods, names, runs, strict=True)
    ]
    if len(set(labels)) < len(labels):
        raise LodgsError("Cannot compare a run with itself: a run is named twice.", "Name each run once.")
    return labels


def _views_of(job: Job) -> tuple:
    """Return what determines the views that measure a run."""
    captured = (job.base, job.capture, job.views, job.view_width) if job.capture else ()
    return job.scene, job.test_every, job.validation, captured
