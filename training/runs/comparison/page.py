"""The page that compares runs of a scene: one HTML file that loads nothing from the network."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ...evaluate.views import Evaluation
from ...files import atomic_write, create_folder
from ...lod.on_disk import read_or_open_bundle
from ...lod.rule import Values
from ...lod.selection import complete_splats, resolve_controls
from ...scenes.cameras import Camera
from ...splats.dialects import Warn, ignore
from ..events import finite
from ..finished import open_finished
from ..folder import RunFolder
from .images import RunImages, compared_views, photos, render_merges, render_run
from .measures import (
    ComparedRun,
    Notify,
    collect_measures,
    compared_count,
    label_runs,
    measure_run,
    merge_baseline,
)

TEMPLATE = Path(__file__).with_name("page.html")


def compare(
    runs: Sequence[Path],
    out: Path,
    warn: Warn = ignore,
    notify: Notify = ignore,
    lpips: Path | None = None,
) -> dict:
    """Compare finished runs of a scene and write ``index.html`` and ``compare.json``.

    Args:
        runs: run folders. A run without levels of detail is also compared with neighbours merged.
        out: folder of the page. It is created.
        warn: receives warnings about the scene and the runs.
        notify: receives one sentence for each part of the work.
        lpips: archive of the weights of LPIPS, see ``evaluate.lpips.load_lpips``.

    Returns:
        The contents of ``compare.json``: ``scene``, ``held_out``, ``views``, ``measured_views`` (number),
        ``size`` (width and height in pixels), ``compared_splats``, ``runs`` (see ``measures.ComparedRun``)
        and ``answers``.

    Raises:
        LodgsError: a run is not finished, the runs have different scenes, or a file cannot be written.
    """
    labels = label_runs(runs, warn)
    measured = [
        measure_run(run, label, _default_values(run), warn, notify, lpips)
        for run, label in zip(runs, labels, strict=True)
    ]
    _, job, data = open_finished(runs[0], warn)
    evaluation = Evaluation(data, job.backend)
    cameras = compared_views(evaluation)
    images = _render(runs, measured, evaluation, cameras, notify)
    report = {
        "scene": Path(job.scene or job.base).name,
        "held_out": bool(data.test),
        "views": [camera.name for camera in cameras],
        "measured_views": len(evaluation.cameras),
        "size": [evaluation.cameras[0].width, evaluation.cameras[0].height],
        **collect_measures(measured),
    }
    page = build_page(report, photos(evaluation, cameras), images)
    create_folder(out)
    with atomic_write(out / "compare.json") as temporary:
        Path(temporary).write_text(json.dumps(finite(report), indent=1), encoding="utf-8")
    with atomic_write(out / "index.html") as temporary:
        Path(temporary).write_text(page, encoding="utf-8")
    return report


def _render(
    runs: Sequence[Path],
    measured: list[ComparedRun],
    evaluation: Evaluation,
    cameras: Sequence[Camera],
    notify: Notify,
) -> list[RunImages]:
    """Render the images of runs, and insert the baseline of the first single level into ``measured``."""
    count, images, has_baseline = compared_count(measured), [], False
    for run, row in zip(runs, list(measured), strict=True):
        notify(f"Rendering {row.label}.")
        bundle = read_or_open_bundle(RunFolder(run).bundle)
        images.append(render_run(evaluation, bundle, row, cameras, count if len(runs) > 1 else None))
        if len(bundle.levels) == 1 and not bundle.rule and not bundle.on_disk and not has_baseline:
            plain = evaluation.with_filter(bundle.antialias)
            splats = complete_splats(bundle, bundle.levels[0])
            baseline, sets = merge_baseline(plain, splats, row.label)
            has_baseline = True
            images.append(render_merges(plain, baseline, sets, cameras, count))
            measured.insert(measured.index(row) + 1, baseline)
    return images


def _default_values(run: Path) -> Values:
    """Return the values of the controls with which a run's bundle is shown at first."""
    bundle = read_or_open_bundle(RunFolder(run).bundle)
    return resolve_controls(bundle, {}) if bundle.rule else {}


def build_page(report: dict, photo_addresses: Sequence[str], images: Sequence[RunImages]) -> str:
    """Return the page as HTML.

    Args:
        report: contents of ``compare.json``.
        photo_addresses: addresses of the photos of the views.
        images: images of the runs, in the order of the report.
    """
    content = finite({**report, "photos": list(photo_addresses), "images": [asdict(run) for run in images]})
    # "</" would end the script in which the data are
    data = json.dumps(content, allow_nan=False).replace("</", "<\\/")
    template = TEMPLATE.read_text(encoding="utf-8")
    return template.replace("@SCENE@", html.escape(report["scene"])).replace("@DATA@", data)


def format_comparison(report: dict) -> str:
    """Format the contents of ``compare.json`` as text."""
    count = report["compared_splats"]
    width = max(len(run["label"]) for run in report["runs"])
    lines = [f"{'':<{width}} {'splats':>9} {'PSNR':>7} {f'at {count:,}':>10} {'by dist.':>9} {'ms/frame':>9}"]
    for run in report["runs"]:
        finest, selected = run["points"][-1], run["by_distance"]
        at_share = "-" if run["at_share"] is None else f"{run['at_share']:.2f}"
        distance = f"{selected['psnr']:.2f}" if selected else "-"
        frame = 1e3 * (selected or finest)["frame_s"]
        lines.append(
            f"{run['label']:<{width}} {finest['splats']:>9,} {finest['psnr']:>7.2f} {at_share:>10} "
            f"{distance:>9} {frame:>9.1f}"
        )
    lines += [f"{row['purpose']}: {row['best']} ({row['why']})." for row in report["answers"]]
    return "\n".join(lines)
