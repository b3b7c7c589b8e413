"""Measuring a finished run: every level, what its rule chooses by distance, and how it looks a step aside."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from ..errors import LodgsError
from ..evaluate.distance import measure_farther_views, measure_popping
from ..evaluate.level_sheet import write_level_sheet
from ..evaluate.messages import summary_lines
from ..evaluate.offset_views import measure_veil
from ..evaluate.summary import summarize
from ..evaluate.views import Evaluation, full_detail_selector
from ..files import atomic_write
from ..lod.on_disk import open_if_large
from ..lod.rule import Values, find_rule
from ..lod.selection import levels_alone, select, settings, unknown_rule
from ..methods import create
from ..rasterize.resident import ResidentBundle
from ..scenes.aside import read_aside
from ..splats.bundle import read_bundle
from ..splats.dialects import Warn, ignore
from .arrays import array_error, read_arrays
from .data import training_data
from .folder import RunFolder
from .job import Job


def evaluate_run(
    run: Path,
    given: Values | None = None,
    picture: Path | None = None,
    far: bool = False,
    warn: Warn = ignore,
) -> dict:
    """Measures a finished run and writes its ``metrics.json``.

    Args:
        run: the run's folder.
        given: controls of the run's rule by name (``lod.rule``); the others are the rule's own.
        picture: a PNG to write, with the levels side by side as the middle held-out view sees them.
        far: measure also how levels do from farther away (``evaluate.distance``).
        warn: told what is odd about the scene: photographs that are gone, first of all.

    Returns:
        Of all levels, but those that are no scene by themselves, ``levels``: coarse to fine, ``level``, its
        facts, ``splats``, ``drawn``, ``psnr``, ``ssim``, ``frame_s``, ``veil``; where levels add up, of each
        with all coarser ones. Of the finest, ``train_psnr``, ``veil``, ``oversized``, ``worst`` and
        ``fitted_psnr`` (``evaluate.summary``), and ``aside`` where the scene has views off its path
        (``scenes.aside``): their mean ``psnr`` and the names of the ``views``.
        By the rule, ``selective``: per view and predetermined (chosen from the mean training camera; not of a
        file that is too large for memory), with the values of the rule's controls; none where the levels have
        no rule. ``frame_s``: seconds a frame
        ``by_distance``, choosing included, and in ``full`` detail, drawn in turn; not for rules whose weights
        always count. ``curve``: as ``selective`` for each value of the rule's ``sweep``, where it has one.
        ``networks``: of a model that was baked, before that.
        ``farther`` and ``jumps`` (of the middle view), where asked for.

        Where no views are held out, ``test_views`` is empty, there is no ``worst``, and quality is of
        training views: it is called ``train_psnr`` and ``train_ssim`` throughout.

    Raises:
        LodgsError: if the run is not finished, its rule has no such control, or a view off the path cannot be
            read; or something in the run is a link.
    """
    folder = RunFolder(run)
    folder.reject_links()
    if not folder.bundle.exists():
        raise LodgsError(
            f"{run} is not the folder of a finished run (it has no bundle.ply).",
            "Name the run's folder, and train it to the end first.",
        )
    job = Job.from_file(folder.job)
    if not job.capture and not Path(job.scene).is_dir():
        raise LodgsError(
            f"The scene that {run} was trained on is gone: {job.scene}.",
            f"Put it back, or write where it is now into {folder.job} (scene = ...).",
        )

    def tell(kind: str, **values: Any) -> None:
        if kind == "warning":
            warn(values["message"])

    data = training_data(job, folder, tell)
    bundle = open_if_large(folder.bundle) or read_bundle(folder.bundle)
    evaluation = Evaluation(data, job.backend, bundle.antialias)
    rule = find_rule(bundle.rule)
    if rule is None and (given or bundle.rule):
        raise LodgsError(*unknown_rule(bundle.rule))
    aside = [camera.scaled(job.image_scale) for camera in read_aside(Path(job.scene))]
    alone = levels_alone(bundle)
    *coarser, finest = alone
    measured = summarize(evaluation, bundle)
    veils = [measure_veil(evaluation, full_detail_selector(bundle, level)) for level in coarser] + [
        measured["veil"]
    ]
    levels = [
        {"level": level.number, **level.facts, **evaluation.measure_level(bundle, level), "veil": veiled}
        for level, veiled in zip(alone, veils, strict=True)
    ]
    report = {
        "scene": job.scene,
        "method": job.method,
        "rule": bundle.rule,
        "test_views": [camera.name for camera in data.test],
        **measured,
        "levels": levels,
        "selective": [],
    }
    if aside:
        quality = float(evaluation.compare_views(aside, full_detail_selector(bundle, finest)).mean())
        report["aside"] = {"psnr": round(quality, 3), "views": [camera.name for camera in aside]}
    values = settings(bundle, given or {}) if rule else {}
    if rule:
        resident = ResidentBundle(bundle, job.backend)
        per_view = evaluation.measure_by_distance(resident, values)
        report["selective"] = [{"set": "per view", **values, **per_view}]
        if not bundle.on_disk:
            predetermined = select(bundle, data.mean_camera, data.focal, values)
            found = evaluation.measure_splats(*predetermined)
            report["selective"].append({"set": "predetermined", **values, **found})
        if rule.sweep:
            name, steps = rule.sweep
            report["curve"] = [
                {name: step, **evaluation.measure_by_distance(resident, {**values, name: step})}
                for step in steps
            ]
        if not rule.always:
            report["frame_s"] = evaluation.frame_times({
                "by_distance": lambda camera: resident.draw(camera, values, near=data.near),
                "full": lambda camera: resident.draw_level(finest.number, camera, near=data.near),
            })  # fmt: skip
    if folder.model.exists():
        method = create(job.method, data, job.resolved_parameters(), job.seed, job.backend)
        arrays = read_arrays(folder.model)
        try:
            method.load_arrays(arrays)
        except (KeyError, ValueError) as error:
            raise array_error(folder.model, error) from error
        report["networks"] = evaluation.measure_images(method.picture)
    middle = evaluation.cameras[len(evaluation.cameras) // 2]
    if far and rule:
        report["farther"] = measure_farther_views(evaluation, bundle, values)
        report["jumps"] = measure_popping(evaluation, bundle, values, middle)
    if picture is not None:
        write_level_sheet(picture, bundle, evaluation, middle, values)
    with atomic_write(folder.metrics) as temporary:
        Path(temporary).write_text(json.dumps(_finite(report), indent=1, allow_nan=False), encoding="utf-8")
    return report


def _finite(value):
    """A report as JSON has it: null where a number is none, as after a training that went astray."""
    match value:
        case dict():
            return {key: _finite(each) for key, each in value.items()}
        case list() | tuple():
            return [_finite(each) for each in value]
        case float() if not math.isfinite(value):
            return None
        case _:
            return value


def format_report(report: dict) -> str:
    """``evaluate_run``'s report as text."""
    quality = [f"{'' if report['test_views'] else 'train_'}{name}" for name in ("psnr", "ssim")]
    measured = ("splats", "drawn", *quality, "frame_s", "veil")
    lines = [f"{'':>28} {'splats':>9} {'PSNR':>7} {'SSIM':>7} {'ms/frame':>8} {'veiled':>7}"]
    rows = []
    for row in report["levels"]:
        facts = "".join(f", {k} {v:.5g}" for k, v in row.items() if k not in ("level", *measured))
        rows.append((f"level {row['level']}{facts}", row))
    for row in report["selective"]:
        values = ", ".join(f"{k} {v:g}" for k, v in row.items() if k not in ("set", *measured))
        rows.append((f"by distance, {row['set']}", row))
        if row is report["selective"][-1]:
            rows.append((f"  ({values})", None))
    for row in report.get("curve", []):
        (name, value), *_ = row.items()
        rows.append((f"{name} = {value:g}, {row['drawn']:,} drawn", row))
    if "networks" in report:
        rows.append(("with networks", {"splats": 0, **report["networks"]}))
    for name, row in rows:
        if row is None:
            lines.append(name)
            continue
        psnr, ssim = (row[each] for each in quality)
        veiled = f" {row['veil']['mean']:>7.1%}" if "veil" in row else ""
        lines.append(
            f"{name:<28} {row['splats']:>9,} {psnr:>7.2f} {ssim:>7.4f} {1e3 * row['frame_s']:>8.1f}{veiled}"
        )
    lines += summary_lines(report)
    for row in report.get("farther", []):
        lines.append(
            f"{row['factor']}x the distance: {row['drawn']:,} of {row['drawn_full']:,} splats drawn, "
            f"{row['psnr']:.1f} dB against full detail"
        )
    for name, jump in report.get("jumps", {}).items():
        lines.append(f"largest jump, {name}: {jump} times that of full detail")
    return "\n".join(lines)
