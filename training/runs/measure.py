"""Measure the quality and speed of a finished run.

A report has these keys:

- ``levels``: levels that are complete by themselves, coarse to fine: ``level``, facts, ``splats``,
  ``drawn``, ``psnr``, ``ssim``, ``lpips_alex`` and ``lpips_vgg`` (if weights exist), ``frame_s``,
  ``veil``. Cumulative levels include all coarser ones.
  ``by_size`` is the PSNR at full, 1/2, 1/4 and 1/8 of the image size. Coarser levels in memory also
  have ``merged``, the same of the finest level merged to as many splats
- ``train_psnr``, ``veil``, ``oversized``, ``worst``, ``fitted_psnr``: see ``evaluate.summary``
- ``aside``: mean ``psnr`` of the finest level in ``views`` off the path (``scenes.offset_views``)
- ``selective``: quality with the rule, selected per view, and once for the mean training camera
  (not if the bundle exceeds memory), with the rule's controls. Earlier rows with others follow
- ``loaded``: mean number of splats that a viewer loads for a view, all without chunks (not if the
  bundle exceeds memory)
- ``bytes``: size of the bundle's file
- ``frame_s``: seconds per frame ``by_distance``, including selection, and in ``full`` detail, drawn
  alternately; not for rules that always weight
- ``frame_memory``: bytes in use while views are drawn, ``by_distance`` and in ``full`` detail, see
  ``evaluate.frame_memory``
- ``curve``: as ``selective``, for each value of the rule's ``sweep``, without LPIPS; in memory also
  PSNR ``merged``
- ``networks``: quality of a neural model before baking
- ``farther``, the largest ``jumps`` of the middle view, and all jumps of the first kind as ``flight``, if
  ``far``

Without held-out views, ``test_views`` is empty, ``worst`` is missing, and quality is measured on
training views as ``train_psnr`` and ``train_ssim``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..evaluate.distance import measure_farther_views, measure_popping
from ..evaluate.frame_memory import measure_frame_memory
from ..evaluate.level_sheet import write_level_sheet
from ..evaluate.offset_views import measure_veil
from ..evaluate.summary import summarize
from ..evaluate.views import Evaluation, full_detail_source
from ..files import atomic_write
from ..lod.rule import Rule, Values, find_rule
from ..lod.selection import (
    BundleSelector,
    complete_splats,
    full_detail_controls,
    resolve_controls,
    select,
    standalone_levels,
    unknown_rule_error,
)
from ..optimize.merging import merge
from ..rasterize.resident import ResidentBundle
from ..scenes.cameras import Camera
from ..scenes.images import check_suffix
from ..scenes.offset_views import read_offset_views
from ..splats.dialects import Warn, ignore
from ..splats.levels import Bundle
from .events import finite
from .finished import load_networks, open_evaluation
from .folder import RunFolder
from .job import Job

MAX_EARLIER_ROWS = 100
"""Maximum number of rows of earlier evaluations that a report keeps."""


def evaluate_run(
    run: Path,
    controls: Values | None = None,
    image: Path | None = None,
    far: bool = False,
    warn: Warn = ignore,
    lpips: Path | None = None,
) -> dict:
    """Measure a finished run and write its ``metrics.json``.

    Args:
        run: run folder.
        controls: controls of the run's rule by name (``lod.rule``). Missing ones have their defaults.
        image: PNG file to write, with all levels from the middle held-out view.
        far: also measure the levels from greater distances (``evaluate.distance``).
        warn: called with warnings about the scene, such as missing photos.
        lpips: archive of the networks' weights, see ``evaluate.lpips.load_lpips``.

    Returns:
        A report, see the module.

    Raises:
        LodgsError: the run is not finished or contains a link, the rule has no such control, the image is not
            a PNG, or a view off the path cannot be read.
    """
    if image is not None:
        check_suffix(image, ".png")
    folder, job, bundle, evaluation = open_evaluation(run, warn, lpips)
    rule, values = _resolve_rule(bundle, controls or {})
    report = _measure_levels(job, evaluation, bundle)
    middle = evaluation.cameras[len(evaluation.cameras) // 2]
    if rule:
        report |= _measure_rule(job, folder, evaluation, bundle, rule, values)
    report["bytes"] = folder.bundle.stat().st_size
    report["frame_memory"] = _measure_memory(folder, evaluation, bundle, values if rule else None)
    if folder.model.exists():
        report["networks"] = _measure_networks(job, folder, evaluation)
    if far and rule:
        report["farther"] = measure_farther_views(evaluation, bundle, values)
        jumps = measure_popping(evaluation, bundle, values, middle)
        report["jumps"] = {name: max(row) for name, row in jumps.items()}
        report["flight"] = next(iter(jumps.values()))
    with atomic_write(folder.metrics) as temporary:
        Path(temporary).write_text(json.dumps(finite(report), indent=1, allow_nan=False), encoding="utf-8")
    if image is not None:
        write_level_sheet(image, bundle, evaluation, middle, values)
    return report


def _resolve_rule(bundle: Bundle, controls: Values) -> tuple[Rule | None, Values]:
    """Return the rule of a bundle and the values of all its controls; (None, {}) without a rule.

    Raises:
        LodgsError: the rule is unknown, has no such control, or there are controls without a rule.
    """
    rule = find_rule(bundle.rule)
    if rule is None and (controls or bundle.rule):
        raise LodgsError(*unknown_rule_error(bundle.rule))
    return rule, resolve_controls(bundle, controls) if rule else {}


def _measure_levels(job: Job, evaluation: Evaluation, bundle: Bundle) -> dict:
    """Return the report's head, the summary of the finest level, ``levels`` and ``aside``."""
    offset_views = read_offset_views(Path(job.scene), bundle.origin) if job.scene else []
    offset_cameras = [camera.scaled(job.image_scale) for camera in offset_views]
    levels = standalone_levels(bundle)
    summary = summarize(evaluation, bundle)
    sources = [full_detail_source(bundle, level) for level in levels]
    veils = [measure_veil(evaluation, source) for source in sources[:-1]]
    veils.append(summary["veil"])
    rows = [
        {"level": level.number, **level.facts, **evaluation.measure_level(bundle, level), "veil": veil,
         "by_size": evaluation.measure_sizes(source)}
        for level, source, veil in zip(levels, sources, veils, strict=True)
    ]  # fmt: skip
    for row, merged in zip(rows, _measure_merges(evaluation, bundle), strict=False):
        row["merged"] = merged
    report = {
        "scene": job.scene,
        "method": job.method,
        "rule": bundle.rule,
        "test_views": [camera.name for camera in evaluation.data.test],
        **summary,
        "levels": rows,
        "selective": [],
    }
    if offset_cameras:
        quality = float(evaluation.compare_views(offset_cameras, sources[-1]).mean())
        names = [camera.name for camera in offset_cameras]
        report["aside"] = {"psnr": round(quality, 3), "views": names}
    return report


def _measure_merges(evaluation: Evaluation, bundle: Bundle) -> list[list[float]]:
    """Measure merges of the finest level at the splat count of each coarser level, as ``measure_sizes``.

    Empty if the bundle exceeds memory, or the rule weights splats at full detail.
    """
    rule = find_rule(bundle.rule)
    if bundle.on_disk or (rule is not None and rule.weights_full_detail):
        return []
    *coarser, merged = [complete_splats(bundle, level) for level in standalone_levels(bundle)]
    values = []
    for splats in reversed(coarser):
        merged = merge(merged, len(splats))
        values.append(evaluation.measure_sizes(lambda camera, splats=merged: (splats, None)))
    return values[::-1]


def _measure_rule(
    job: Job, folder: RunFolder, evaluation: Evaluation, bundle: Bundle, rule: Rule, values: Values
) -> dict:
    """Return ``selective``, ``curve`` and ``frame_s`` of the report."""
    data = evaluation.data
    resident = ResidentBundle(bundle, job.backend)
    per_view = evaluation.measure_by_distance(resident, values)
    report: dict[str, Any] = {"selective": [{"set": "per view", **values, **per_view}]}
    if not bundle.on_disk:
        selector = BundleSelector(bundle)
        loaded = [selector.loaded(camera.center, values) for camera in evaluation.cameras]
        report["loaded"] = round(float(np.mean(loaded)))
        predetermined = select(bundle, data.mean_camera, data.focal, values)
        quality = evaluation.measure_splats(*predetermined)
        report["selective"].append({"set": "predetermined", **values, **quality})
    report["selective"] += _earlier_rows(folder, report["selective"][0], values)
    if rule.sweep:
        name, steps = rule.sweep
        quick = Evaluation(data, job.backend, bundle.antialias)  # LPIPS takes seconds a view
        report["curve"] = [
            {name: step, **quick.measure_by_distance(resident, {**values, name: step})} for step in steps
        ]
        if not bundle.on_disk:
            _add_merges(evaluation, bundle, report["curve"])
    if not rule.weights_full_detail:
        finest = standalone_levels(bundle)[-1]
        report["frame_s"] = evaluation.frame_times({
            "by_distance": lambda camera: resident.draw(camera, values, near=data.near),
            "full": lambda camera: resident.draw_level(finest.number, camera, near=data.near),
        })  # fmt: skip
    return report


def _add_merges(evaluation: Evaluation, bundle: Bundle, rows: list[dict]) -> None:
    """Add the PSNR of merges of the finest level, at the splat counts of the rows, as ``merged``."""
    merged = complete_splats(bundle, standalone_levels(bundle)[-1])
    for row in sorted(rows, key=lambda row: -row["splats"]):
        merged = merge(merged, row["splats"])
        quality = evaluation.compare_views(evaluation.cameras, lambda camera, splats=merged: (splats, None))
        row["merged"] = round(float(quality.mean()), 3)


def _measure_memory(
    folder: RunFolder, evaluation: Evaluation, bundle: Bundle, values: Values | None
) -> dict[str, int | None]:
    """Return ``frame_memory`` of the report.

    Args:
        values: values of the rule's controls; None without a rule.
    """
    backend, near = evaluation.backend, evaluation.data.near
    finest = standalone_levels(bundle)[-1].number
    controls = full_detail_controls(bundle)

    def prepare(values: Values | None) -> Callable[[Camera], object]:
        resident = ResidentBundle(folder.bundle, backend)
        if values is None:
            return lambda camera: resident.draw_level(finest, camera, near=near)
        return lambda camera: resident.draw(camera, values, near=near)

    cases = {"full": controls} if values is None else {"by_distance": values, "full": controls}
    return {
        name: measure_frame_memory(partial(prepare, case), evaluation.cameras, backend)
        for name, case in cases.items()
    }


def _earlier_rows(folder: RunFolder, row: dict, values: Values) -> list[dict]:
    """Return the rows of earlier evaluations of the same bundle with other values of the controls.

    Args:
        row: a row of this evaluation.
    """
    with suppress(KeyError, TypeError, AttributeError):  # a changed report
        return [
            earlier
            for earlier in folder.read_metrics()["selective"][:MAX_EARLIER_ROWS]
            if earlier.keys() == row.keys()
            and all(isinstance(earlier[name], (int, float)) for name in row.keys() - {"set"})
            and any(earlier[name] != value for name, value in values.items())
        ]
    return []


def _measure_networks(job: Job, folder: RunFolder, evaluation: Evaluation) -> dict:
    """Return the quality of the run's neural model before baking, and the splats that it decodes."""
    _, model = load_networks(job, folder, evaluation.data)
    return evaluation.measure(model.render)
